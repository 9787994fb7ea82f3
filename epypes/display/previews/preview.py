"""The preview of one value: a line of text, and a thumbnail if it can be drawn."""

from __future__ import annotations

import io
import itertools
import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final

from epypes.display.previews import arrays, objects
from epypes.display.previews.drawing import MOST_LINES, MOST_POINTS
from epypes.display.previews.encoding import encode_small, pillow
from epypes.display.previews.images import is_image
from epypes.display.previews.introspection import kind_name, plain_text, preview_context
from epypes.display.previews.model import THUMBNAIL_BYTES, THUMBNAIL_PX, Chart, Look, Picture, Preview, Scene, Sketch
from epypes.display.previews.registry import preview_function_of
from epypes.display.previews.short import reason
from epypes.display.text import cut
from epypes.images import Order

_TEXT_CHARACTERS: Final = 30
_DETAIL_CHARACTERS: Final = 290
_ROW_CHARACTERS: Final = 60
_MOST_ROWS: Final = 4
_CHARTS: Final = ("line", "bars", "points")
# To decode more takes longer than a thumbnail may.
_MOST_PIXELS: Final = 25_000_000

# Each of these modules registers the kinds that it knows.
_KINDS: Final = (arrays, objects)


def preview(value: Any, order: Order = "bgr") -> Preview:
    """Look at a value; never raises. ``order`` is that of its colours, if it is an image."""
    return finished(sketch(value, Look(order)))


def sketch(value: Any, look: Look) -> Sketch:
    """Look at a value without making its thumbnail; never raises. What is looked at meanwhile is but named."""
    with preview_context() as is_nested:
        return sketch_in_context(value, look, is_nested)


def sketch_in_context(value: Any, look: Look, is_nested: bool) -> Sketch:
    """Look at a value like ``sketch``, where several are looked at within one ``preview_context()``."""
    if is_nested:
        return Sketch(Preview(_kind(value), _kind(value)))
    try:
        return _checked(preview_function_of(type(value))(value, look), value, look)
    except Exception as error:
        return Sketch(_failed(Preview("", _kind(value)), "no preview", error))


def looked_closer(sketched: Sketch) -> Sketch:
    """Return what is shown once there is room for a thumbnail, which is not made yet. Never raises."""
    with preview_context():
        return _closer(sketched)


def _closer(sketched: Sketch) -> Sketch:
    try:
        return sketched if sketched.closer is None else _limited(sketched.closer())
    except Exception as error:
        return Sketch(_failed(sketched.shown, "no picture", error))


def finished(sketched: Sketch, most_bytes: int = THUMBNAIL_BYTES) -> Preview:
    """Return a preview with its thumbnail; one that can't be made gives the reason instead. Never raises."""
    with preview_context():
        return finished_in_context(sketched, most_bytes)


def finished_in_context(sketched: Sketch, most_bytes: int) -> Preview:
    """Return a preview like ``finished``, where several are made within one ``preview_context()``."""
    sketched = _closer(sketched)
    try:
        drawn = sketched.draw(most_bytes) if sketched.draw is not None else None
    except Exception as error:
        return _failed(sketched.shown, "no picture", error)
    if isinstance(drawn, Chart):
        return replace(sketched.shown, chart=drawn)
    return sketched.shown if drawn is None else replace(sketched.shown, picture=drawn)


def scene_in(sketched: Sketch) -> Scene | None:
    """Return the image of a sketch and what is drawn over it; None if it has none. Never raises."""
    with preview_context():
        try:
            found = sketched if sketched.closer is None else sketched.closer()
            return found.scene() if isinstance(found, Sketch) and found.scene is not None else None
        except Exception:  # the reason stands where the value is shown as text
            return None


def _limited(found: Sketch | Preview) -> Sketch:
    sketched = found if isinstance(found, Sketch) else Sketch(found)
    return replace(sketched, shown=_trimmed(sketched.shown))


def _failed(shown: Preview, what: str, error: Exception) -> Preview:
    message = f"{what}: {reason(error)}"
    text = shown.text or cut(message, _TEXT_CHARACTERS)
    return replace(shown, text=text, detail=cut(f"{shown.detail}, {message}", _DETAIL_CHARACTERS))


def _kind(value: Any) -> str:
    return cut(kind_name(type(value)), _TEXT_CHARACTERS)


# -- what a user's preview function returned -----------------------------------------------------------------------


def _checked(found: Any, value: Any, look: Look) -> Sketch:
    """Return what a preview function returned, within the limits."""
    kind = type(found)
    if issubclass(kind, Sketch):
        return _limited(found)
    if issubclass(kind, Preview):
        detail = found.detail if found.detail != "" else _kind(value)
        shown = _trimmed(Preview(found.text, detail, rows=found.rows))
        if is_image(found.picture):
            return replace(arrays.image_sketch(arrays.plain_array(found.picture), look), shown=shown, is_image=False)
        return Sketch(shown, _drawing(found.picture, found.chart))
    if issubclass(kind, str):
        return Sketch(_trimmed(Preview(found, f"{_kind(value)}, {plain_text(found)[:_DETAIL_CHARACTERS]}")))
    if is_image(found):
        image = arrays.image_sketch(arrays.plain_array(found), look)
        detail = f"{_kind(value)}, shown as {image.shown.detail}"
        shown = _trimmed(replace(image.shown, text=_kind(value), detail=detail))
        return replace(image, shown=shown, is_image=False)
    raise TypeError(f"a preview must be a text, an image or an ep.Preview, not {_kind(found)}")


def _trimmed(shown: Preview) -> Preview:
    """Return a preview whose texts are plain texts, on one line, and within the limits."""
    rows = tuple(itertools.islice(shown.rows, _MOST_ROWS))
    for line in (shown.text, shown.detail, *rows):
        if not issubclass(type(line), str):
            raise TypeError("text, detail and rows of a preview must be texts")
    text = cut(plain_text(shown.text)[:500], _TEXT_CHARACTERS)
    detail = cut(plain_text(shown.detail)[:1000], _DETAIL_CHARACTERS)
    return Preview(text or "(empty text)", detail, shown.picture, shown.chart, tuple(map(_on_one_line, rows)))


def _on_one_line(row: str) -> str:
    return "".join(mark if mark.isprintable() else " " for mark in plain_text(row)[:_ROW_CHARACTERS])


def _drawing(picture: Any, chart: Any) -> Callable[[int], Picture | Chart] | None:
    """Return what draws the picture or chart that a user's preview has."""
    if picture is not None:
        if not issubclass(type(picture), Picture):
            raise TypeError("picture must be an image: an array of at least 8 x 8 pixels")
        return lambda most_bytes: _checked_picture(picture, most_bytes)
    if chart is None:
        return None
    checked = _checked_chart(chart)
    return (lambda most_bytes: checked) if checked.series else None


def _checked_chart(chart: Any) -> Chart:
    """Return a chart within the limits: of finite points, each between 0 and 1."""
    if type(chart) is not Chart or chart.kind not in _CHARTS:
        raise TypeError(f"chart of a preview must be a Chart of kind {', '.join(_CHARTS)}")
    room, series = MOST_POINTS, []
    for points in itertools.islice(chart.series, MOST_POINTS):
        pairs = [(float(x), float(y)) for x, y in itertools.islice(points, room)]
        room -= len(pairs)
        kept = tuple((min(max(x, 0.0), 1.0), min(max(y, 0.0), 1.0)) for x, y in pairs if math.isfinite(x + y))
        series += [kept] * bool(kept)
    return Chart(chart.kind, tuple(series[:MOST_LINES]))


def _checked_picture(picture: Picture, most_bytes: int) -> Picture:
    """Return a picture within the limits of a thumbnail; what it is, its bytes decide."""
    with pillow().open(io.BytesIO(picture.data), formats=["PNG", "JPEG"]) as opened:
        if opened.width * opened.height > _MOST_PIXELS:
            raise ValueError(f"a picture of {opened.width} x {opened.height} is too large for a thumbnail")
        # What is broken is found by decoding it.
        opened.load()
        if max(opened.size) <= THUMBNAIL_PX and len(picture.data) <= most_bytes:
            return Picture(picture.data, f"image/{opened.format}".lower(), *opened.size)
        opened.thumbnail((THUMBNAIL_PX, THUMBNAIL_PX))
        return encode_small(opened, most_bytes)
