"""What is kept of a run's tokens to look at: a small picture, or a text of what has none?

The same value is seen the same whatever was run before, and in whichever process: of images whose dtype does not tell
what is black and white, each has a range of its own, which its caption tells.
"""

from __future__ import annotations

import io
from collections.abc import Iterable
from typing import Any, Final

from epypes.batch.results import Thumbnail
from epypes.display.paint.thumbnails import THUMB_HEIGHT, THUMB_WIDTH, paint_thumbnail
from epypes.display.previews.arrays import plain_array
from epypes.display.previews.imagekinds import image_kind, is_image, sampled
from epypes.display.previews.preview import finished, looked_closer, sketch
from epypes.display.previews.ranges import Range, display_range, sole_value
from epypes.display.previews.raster import THUMBNAIL_PX
from epypes.display.previews.short import float_text
from epypes.display.previews.shown import Look, Sketch
from epypes.display.views.backdrops import RunSurroundings
from epypes.graph import CompGraph, colour_order
from epypes.images import Order
from epypes.optional import optional_import
from epypes.run import Run

# A chart stands alone in its file, so it brings its colours: a grey that is seen on white and on black.
_CHART_STYLE: Final = (
    "<style>.paper{fill:none}.chart polyline,.bars,.dots{fill:none;stroke:#7a8490;stroke-width:2}"
    ".dots{stroke-width:4;stroke-linecap:round}</style>"
)


def thumbnail_of(run: Run, token: str) -> Thumbnail | str:
    """Return a picture of a token of at most 5 KB, with what was found in an image drawn over it; a text without one.

    An image of one value is told by it, where a picture would not.
    """
    value = run.tokens.values[run.tokens.program.slots[token]]
    sketched = sketch(value, Look(colour_order(run.cg, token), around=RunSurroundings(run, token, _range_of)))
    return _all_the_same(value, sketched) or _as_file(sketched)


def thumbnail_of_value(value: Any, order: Order = "bgr") -> Thumbnail | None:
    """Return a picture of any value of at most 5 KB; ``order`` is that of its colours. None if it has none."""
    shown = _as_file(sketch(value, Look(order)))
    return shown if isinstance(shown, Thumbnail) else None


def _range_of(token: str, image: Any) -> Range:
    return display_range(image)


def _all_the_same(value: Any, sketched: Sketch) -> str:
    """Return what is said of an image of one value; "" of anything else."""
    if not (sketched.is_image and is_image(value)):
        return ""
    image = plain_array(value)
    sole = sole_value(image)
    if sole is None or image_kind(image, sampled(image)) != "photograph":
        return ""
    return f"{sketched.shown.text}, all {float_text(sole) if isinstance(sole, float) else sole}"


def _as_file(sketched: Sketch) -> Thumbnail | str:
    closer = looked_closer(sketched)
    shown = finished(closer)
    caption = ", ".join(filter(None, (shown.text, closer.note)))
    if shown.picture is not None:
        return Thumbnail(shown.picture.media_type, shown.picture.data, caption)
    if shown.chart is None:
        return shown.text
    size, painted = f'width="{THUMB_WIDTH}" height="{THUMB_HEIGHT}"', paint_thumbnail(shown, (THUMB_WIDTH / 2, 0))
    chart = f'<svg xmlns="http://www.w3.org/2000/svg" {size}>{_CHART_STYLE}{painted}</svg>'
    return Thumbnail("image/svg+xml", chart.encode(), caption)


class Album:
    """What is shown of the tokens of one item; of values that stay from run to run it is made once."""

    def __init__(self) -> None:
        self._made: dict[str, tuple[Any, Thumbnail | str]] = {}

    def shown_of(self, run: Run, tokens: Iterable[str] | None) -> tuple[dict[str, Thumbnail], dict[str, str]]:
        """Return pictures of tokens, and texts of those that have none. Never raises.

        None: pictures of all, texts of what functions have made. What was not computed has neither. Threads may ask
        for several runs at once.
        """
        wanted = run.cg.tokens if tokens is None else tokens
        found = {token: self._shown_of(run, token) for token in wanted if run.tokens.is_readable(token)}
        pictures = {token: shown for token, shown in found.items() if isinstance(shown, Thumbnail)}
        given = run.cg.source_tokens if tokens is None else ()
        return pictures, {token: text for token, text in found.items() if isinstance(text, str) and token not in given}

    def _shown_of(self, run: Run, token: str) -> Thumbnail | str:
        value = run.tokens.values[run.tokens.program.slots[token]]
        made = self._made.get(token)
        if made is None or made[0] is not value:
            self._made[token] = made = value, thumbnail_of(run, token)
        return made[1]


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
