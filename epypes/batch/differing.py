"""What is seen of a value beside what was expected, and of where they differ?"""

from __future__ import annotations

import io
from typing import Any, Final

from epypes.batch.results import Thumbnail
from epypes.batch.thumbnails import thumbnail_of_value
from epypes.display import is_image
from epypes.display.previews.raster import THUMBNAIL_PX
from epypes.graph import CompGraph, colour_order
from epypes.optional import optional_import

# Blue and orange are told apart by everybody; the legend says which is which.
_NEITHER: Final = (0, 0, 0)
_AGREE: Final = (150, 150, 150)
_MISSING: Final = (40, 110, 220)
_EXTRA: Final = (240, 140, 20)
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
    with optional_import("scale"):
        import numpy as np

    got, wanted = np.asarray(value), np.asarray(expected)
    if got.shape != wanted.shape:
        return None
    if _is_mask(got) and _is_mask(wanted):
        return _three_colours(got != 0, wanted != 0)
    distance = np.abs(got.astype(np.float32) - wanted.astype(np.float32))
    distance = distance.max(axis=2) if distance.ndim == 3 else distance
    largest = float(np.nanmax(distance, initial=0.0))
    if not largest or not np.isfinite(largest):
        return None
    return thumbnail_of_value((distance * (255 / largest)).astype(np.uint8))


def _is_mask(image: Any) -> bool:
    with optional_import("scale"):
        import numpy as np

    if image.ndim != 2:
        return False
    return image.dtype.kind == "b" or (image.dtype.kind in "iu" and len(np.unique(image)) <= 2)


def _three_colours(got: Any, wanted: Any) -> Thumbnail:
    """Return a PNG: as JPEG, a single pixel that differs would be grey, as if it did not."""
    with optional_import("scale"):
        import numpy as np
        from PIL import Image

    both, missing, extra = (_coarser(mask) for mask in (got & wanted, wanted & ~got, got & ~wanted))
    places = np.zeros(both.shape, np.uint8)
    for place, mask in enumerate((both, missing, extra), start=1):
        places[mask] = place
    picture = Image.fromarray(places).convert("P")
    picture.putpalette(bytes((*_NEITHER, *_AGREE, *_MISSING, *_EXTRA)))
    data = io.BytesIO()
    picture.save(data, "PNG", bits=2)
    pixels = np.count_nonzero(got != wanted)
    return Thumbnail("image/png", data.getvalue(), f"{pixels} of {got.size} pixels differ")


def _coarser(mask: Any) -> Any:
    """Return a mask of about the size of a thumbnail; what is in one pixel is in the coarse one around it."""
    with optional_import("scale"):
        import numpy as np

    side = -(-max(mask.shape) // THUMBNAIL_PX)
    starts = [np.arange(0, length, side) for length in mask.shape]
    return np.logical_or.reduceat(np.logical_or.reduceat(mask, starts[0], axis=0), starts[1], axis=1)
