"""What is seen of a value beside what was expected, and of where they differ?"""

from __future__ import annotations

from typing import Any, Final

from epypes.display import is_image
from epypes.display.previews.raster import THUMBNAIL_PX
from epypes.graph import CompGraph, colour_order
from epypes.scale.outcome import Thumbnail
from epypes.scale.thumbnails import thumbnail_of_value

# Blue and orange are told apart by everybody; the legend says which is which.
_AGREE: Final = (150, 150, 150)
_MISSING: Final = (40, 110, 220)
_EXTRA: Final = (240, 140, 20)
# JPEG has colours for squares of so many pixels.
_COARSE_PX: Final = 2
LEGEND: Final = "blue: expected and missing, orange: there and not expected, grey: both"


def pictures_of(value: Any, expected: Any, cg: CompGraph, token: str) -> dict[str, Thumbnail]:
    """Return small pictures of what has one: ``"expected"``, ``"got"``, and ``"difference"`` of two images.

    The difference of two masks has three colours, see LEGEND; of other images it is the absolute difference, from black
    where there is none to white where it is largest.
    """
    order = colour_order(cg, token)
    found = {
        "expected": thumbnail_of_value(expected, order),
        "got": thumbnail_of_value(value, order),
        "difference": _difference(value, expected),
    }
    return {name: picture for name, picture in found.items() if picture is not None}


def _difference(value: Any, expected: Any) -> Thumbnail | None:
    if not (is_image(value) and is_image(expected)):
        return None
    import numpy as np

    got, wanted = np.asarray(value), np.asarray(expected)
    if got.shape != wanted.shape:
        return None
    if _is_mask(got) and _is_mask(wanted):
        return thumbnail_of_value(_three_colours(got != 0, wanted != 0), "rgb")
    distance = np.abs(got.astype(np.float32) - wanted.astype(np.float32))
    distance = distance.max(axis=2) if distance.ndim == 3 else distance
    largest = float(np.nanmax(distance, initial=0.0))
    if not largest or not np.isfinite(largest):
        return None
    return thumbnail_of_value((distance * (255 / largest)).astype(np.uint8))


def _is_mask(image: Any) -> bool:
    import numpy as np

    if image.ndim != 2:
        return False
    return image.dtype.kind == "b" or (image.dtype.kind in "iu" and len(np.unique(image)) <= 2)


def _three_colours(got: Any, wanted: Any) -> Any:
    import numpy as np

    # One pixel that differs is to be seen, so it is not averaged with those around it.
    both, missing, extra = (_coarser(mask) for mask in (got & wanted, wanted & ~got, got & ~wanted))
    picture = np.zeros((*both.shape, 3), np.uint8)
    for mask, colour in ((both, _AGREE), (missing, _MISSING), (extra, _EXTRA)):
        picture[mask] = colour
    return picture


def _coarser(mask: Any) -> Any:
    """Return a mask of about the size of a thumbnail; what is in one pixel is in all of the coarse one around it."""
    import numpy as np

    side = -(-max(mask.shape) * _COARSE_PX // THUMBNAIL_PX)
    starts = [np.arange(0, length, side) for length in mask.shape]
    coarse = np.logical_or.reduceat(np.logical_or.reduceat(mask, starts[0], axis=0), starts[1], axis=1)
    return coarse if side == 1 else coarse.repeat(_COARSE_PX, axis=0).repeat(_COARSE_PX, axis=1)
