"""Thumbnails: small pictures of a run's tokens, of what was expected of them, and of the difference.

The same value looks the same whatever was run before, in any process: an image whose dtype does not define black and
white has a display range of its own, which its caption states.
"""

from __future__ import annotations

import base64
import io
from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final

# First, since an import of a module of display that Ctrl-C has ended could not be repeated otherwise.
from epypes.display import is_image
from epypes.display.paint.vertices import THUMB_HEIGHT, THUMB_WIDTH, paint_thumbnail
from epypes.display.previews import THUMBNAIL_PX, Look, Sketch
from epypes.display.previews.arrays import plain_array
from epypes.display.previews.encoding import encode_small
from epypes.display.previews.images import image_kind, sampled, sole_value
from epypes.display.previews.preview import finished, looked_closer, sketch
from epypes.display.previews.short import float_text
from epypes.display.text import escape, fitted
from epypes.display.views.surroundings import RunSurroundings
from epypes.graph import CompGraph, colour_order
from epypes.images import Order
from epypes.optional import optional_import
from epypes.run import Run

if TYPE_CHECKING:
    from PIL import Image

# A chart stands alone in its file, so it brings its colours: a grey that is seen on white and on black.
_CHART_STYLE: Final = (
    "<style>.paper{fill:none}.chart polyline,.bars,.dots{fill:none;stroke:#7a8490;stroke-width:2}"
    ".dots{stroke-width:4;stroke-linecap:round}</style>"
)


@dataclass(frozen=True, slots=True)
class Thumbnail:
    """A small picture of a token's value.

    Attributes
    ----------
    media_type
        ``"image/jpeg"``, ``"image/png"`` or ``"image/svg+xml"``.
    data
        The bytes of such a file.
    caption
        What it is of, as ``"uint8 400 x 600"``.
    """

    media_type: str
    data: bytes
    caption: str


def thumbnail_of(run: Run, token: str) -> Thumbnail | str:
    """Return a picture of a token of at most 5 KB, with what was found in an image drawn over it; a text without one.

    An image of one value is a text that states it, which a picture would not.
    """
    value = run.tokens.values[run.tokens.program.slots[token]]
    around = RunSurroundings(run, token, keeps_ranges=False)
    sketched = sketch(value, Look(colour_order(run.cg, token), around=around))
    return _sole_value_text(value, sketched) or _as_file(sketched)


def thumbnail_of_value(value: Any, order: Order = "bgr") -> Thumbnail | None:
    """Return a picture of any value of at most 5 KB; ``order`` is that of its colours. None if it has none."""
    shown = _as_file(sketch(value, Look(order)))
    return shown if isinstance(shown, Thumbnail) else None


def _sole_value_text(value: Any, sketched: Sketch) -> str:
    """Return the text of an image of one value; "" for anything else."""
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
    size = f'width="{THUMB_WIDTH}" height="{THUMB_HEIGHT}" viewBox="0 0 {THUMB_WIDTH} {THUMB_HEIGHT}"'
    painted = paint_thumbnail(shown, (THUMB_WIDTH / 2, 0))
    chart = f'<svg xmlns="http://www.w3.org/2000/svg" {size}>{_CHART_STYLE}{painted}</svg>'
    return Thumbnail("image/svg+xml", chart.encode(), caption)


class Album:
    """Thumbnails and texts of the tokens of one item; those of values that stay from run to run are made once."""

    def __init__(self) -> None:
        self._made: dict[str, tuple[Any, Thumbnail | str]] = {}

    def shown_of(self, run: Run, tokens: Iterable[str] | None) -> tuple[dict[str, Thumbnail], dict[str, str]]:
        """Return pictures of tokens, and texts of those that have none. Never raises.

        None: pictures of all, texts of what functions have made. What was not computed has neither. Several threads
        may ask at once.
        """
        values, slots = run.tokens.values, run.tokens.program.slots
        pictures: dict[str, Thumbnail] = {}
        texts: dict[str, str] = {}
        for token in run.cg.tokens if tokens is None else tokens:
            if not run.tokens.is_readable(token):
                continue
            value, made = values[slots[token]], self._made.get(token)
            if made is None or made[0] is not value:
                self._made[token] = made = value, thumbnail_of(run, token)
            if isinstance(made[1], Thumbnail):
                pictures[token] = made[1]
            elif tokens is not None or token not in run.cg.source_tokens:
                texts[token] = made[1]
        return pictures, texts


# Neither, both, missing, extra. Blue and orange are told apart with any colour vision; the legend names them.
_DIFFERENCE_PALETTE: Final = bytes((0, 0, 0, 150, 150, 150, 40, 110, 220, 240, 140, 20))
DIFFERENCE_LEGEND: Final = "blue: expected and missing, orange: there and not expected, grey: both"


def comparison_thumbnails(value: Any, expected: Any, cg: CompGraph, token: str) -> dict[str, Thumbnail]:
    """Return small pictures of what has one: ``"expected"``, ``"got"``, and ``"difference"`` of two images.

    The difference of two masks has three colours, see DIFFERENCE_LEGEND; of other images it is the absolute difference,
    from black where there is none to white where it is largest.
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
    if all(image.ndim == 2 and image.dtype.kind in "biu" and len(np.unique(image)) <= 2 for image in (got, wanted)):
        return _mask_difference(got != 0, wanted != 0)
    distance = np.abs(got.astype(np.float32) - wanted.astype(np.float32))
    distance = distance.max(axis=2) if distance.ndim == 3 else distance
    largest = float(np.nanmax(distance, initial=0.0))
    if not largest or not np.isfinite(largest):
        return None
    return thumbnail_of_value((distance * (255 / largest)).astype(np.uint8))


def _mask_difference(got: Any, wanted: Any) -> Thumbnail:
    """Return a PNG in which one pixel that differs is seen: as JPEG, or averaged, it would be grey."""
    with optional_import("scale"):
        import numpy as np
        from PIL import Image
        from skimage.measure import block_reduce

    places = np.where(got & wanted, 1, np.where(wanted, 2, np.where(got, 3, 0))).astype(np.uint8)
    side = -(-max(places.shape) // THUMBNAIL_PX)
    picture = Image.fromarray(block_reduce(places, side, np.max)).convert("P")
    picture.putpalette(_DIFFERENCE_PALETTE)
    data = io.BytesIO()
    picture.save(data, "PNG", bits=2)
    pixels = np.count_nonzero(got != wanted)
    return Thumbnail("image/png", data.getvalue(), f"{pixels} of {got.size} pixels differ")


# -- on a page --------------------------------------------------------------------------------------------------

# What a smaller picture shows is hardly seen.
LEAST_BYTES: Final = 300
# The longer side in pixels, and the quality, of ever smaller files. A JPEG has 600 bytes before its first pixel.
_WEBP: Final = ((128, 60), (128, 35), (96, 35), (80, 35), (80, 20), (64, 25), (64, 12), (48, 15), (40, 10), (32, 5))


def picture_element(shown: Thumbnail, text: str, room: int, side_px: int | None = None) -> str:
    """Return a thumbnail as an image element of a page, described by a text of at most so many characters.

    With a side it fills a square of that size, so that pictures of many sizes stand in a row.
    """
    alt = escape(fitted(text, room))
    address = f"data:{shown.media_type};base64,{base64.b64encode(shown.data).decode()}"
    style = "" if side_px is None else f' style="width:{side_px}px;height:{side_px}px;object-fit:contain"'
    return f'<img src="{address}"{style} alt="{alt}" title="{alt}">'


def smaller(thumbnail: Thumbnail, most_bytes: int) -> Thumbnail | None:
    """Return a picture within so many bytes, a photograph as WebP; None if nothing would be seen on it."""
    if len(thumbnail.data) <= most_bytes:
        return thumbnail
    if most_bytes < LEAST_BYTES or thumbnail.media_type == "image/svg+xml":
        return None
    with optional_import("scale"):
        from PIL import Image, features

    with Image.open(io.BytesIO(thumbnail.data)) as opened:
        opened.load()
        if opened.mode in ("L", "RGB") and features.check("webp"):
            return replace(thumbnail, media_type="image/webp", data=_webp(opened, most_bytes))
        encoded = encode_small(opened, most_bytes)
    return replace(thumbnail, media_type=encoded.media_type, data=encoded.data)


def _webp(picture: Image.Image, most_bytes: int) -> bytes:
    """Return the largest WebP of a picture within so many bytes, or the smallest one."""

    def encoded(place: int) -> bytes:
        side, quality = _WEBP[place]
        shown, data = picture.copy(), io.BytesIO()
        shown.thumbnail((side, side))
        shown.save(data, "WEBP", quality=quality)
        return data.getvalue()

    fits = bisect_left(range(len(_WEBP) - 1), True, key=lambda place: len(encoded(place)) <= most_bytes)
    return encoded(fits)
