"""What is shown of one value: a line of text, and a thumbnail if it can be drawn?"""

from __future__ import annotations

import io
import math
from dataclasses import replace
from typing import Any, Final

from epypes.display.markup import cut
from epypes.display.previews import arrays, objects, tables
from epypes.display.previews.charts import MOST_POINTS
from epypes.display.previews.imagekinds import is_image
from epypes.display.previews.raster import THUMBNAIL_BYTES, THUMBNAIL_PX, Picture, encode_small
from epypes.display.previews.registry import looker_of
from epypes.display.previews.short import reason
from epypes.display.previews.shown import Chart, Look, Preview, Sketch
from epypes.images import Order

__all__ = ["THUMBNAIL_PX", "Chart", "Preview", "finished", "preview", "sketch"]

TEXT_CHARACTERS: Final = 30
_DETAIL_CHARACTERS: Final = 290
_ROW_CHARACTERS: Final = 60
_MOST_ROWS: Final = 4
_CHARTS: Final = ("line", "bars", "points")

# Each of these modules registers the kinds that it knows.
_KINDS: Final = (arrays, objects, tables)


def preview(value: Any, order: Order = "bgr") -> Preview:
    """Look at a value; never raises. ``order`` is that of its colours, if it is an image."""
    return finished(sketch(value, Look(order)))


def sketch(value: Any, look: Look) -> Sketch:
    """Look at a value without making its thumbnail; never raises."""
    try:
        return _checked(looker_of(type(value))(value, look), value, look)
    except Exception as error:
        return Sketch(_failed(Preview("", _kind(value)), "no preview", error))


def finished(sketched: Sketch, most_bytes: int = THUMBNAIL_BYTES) -> Preview:
    """Return a preview with its thumbnail; one that can't be made gives the reason instead. Never raises."""
    try:
        if sketched.closer is not None:
            sketched = _limited(sketched.closer())
        drawn = sketched.draw(most_bytes) if sketched.draw is not None else None
    except Exception as error:
        return _failed(sketched.shown, "no picture", error)
    if isinstance(drawn, Chart):
        return replace(sketched.shown, chart=drawn)
    return replace(sketched.shown, picture=drawn)


def _limited(found: Sketch | Preview) -> Sketch:
    sketched = found if isinstance(found, Sketch) else Sketch(found)
    return replace(sketched, shown=_trimmed(sketched.shown))


def _failed(shown: Preview, what: str, error: Exception) -> Preview:
    said = f"{what}: {reason(error)}"
    text = cut(said, TEXT_CHARACTERS) if not shown.text else shown.text
    return replace(shown, text=text, detail=cut(f"{shown.detail}, {said}", _DETAIL_CHARACTERS))


def _kind(value: Any) -> str:
    return cut(type(value).__name__, TEXT_CHARACTERS)


def _checked(found: Any, value: Any, look: Look) -> Sketch:
    """Return what a preview function returned, within the limits."""
    if isinstance(found, Sketch):
        return _limited(found)
    if isinstance(found, Preview):
        draw = _drawing(found)
        detail = _kind(value) if found.detail == "" else found.detail
        return Sketch(_trimmed(replace(found, picture=None, chart=None, detail=detail)), draw)
    if type(found) is str:
        return Sketch(_trimmed(Preview(found, f"{_kind(value)}, {found}")))
    if is_image(found):
        image = arrays.image_sketch(found, look)
        detail = f"{_kind(value)}, shown as {image.shown.detail}"
        return replace(image, shown=_trimmed(replace(image.shown, text=_kind(value), detail=detail)))
    raise TypeError(f"a preview must be a text, an image or an ep.Preview, not {_kind(found)}")


def _trimmed(shown: Preview) -> Preview:
    """Return a preview whose texts are texts, on one line, and within the limits."""
    if not all(isinstance(line, str) for line in (shown.text, shown.detail, *shown.rows)):
        raise TypeError("text, detail and rows of a preview must be texts")
    rows = tuple(map(_on_one_line, shown.rows[:_MOST_ROWS]))
    text, detail = cut(shown.text[:500], TEXT_CHARACTERS), cut(shown.detail[:1000], _DETAIL_CHARACTERS)
    return replace(shown, text=text or "(empty text)", detail=detail, rows=rows)


def _on_one_line(row: str) -> str:
    return "".join(character if character.isprintable() else " " for character in row[:_ROW_CHARACTERS])


def _drawing(found: Preview) -> Any:
    """Return what draws the picture or chart that a user's preview has."""
    if found.picture is None and found.chart is None:
        return None
    if found.picture is not None:
        if not isinstance(found.picture, Picture):
            raise TypeError("the picture of a preview comes from epypes.display.encode_image")
        return lambda most_bytes: _small(found.picture, most_bytes)
    chart = _checked_chart(found.chart)
    return lambda most_bytes: chart


def _checked_chart(chart: Any) -> Chart:
    if not isinstance(chart, Chart) or chart.kind not in _CHARTS:
        raise TypeError(f"chart of a preview must be a Chart of kind {', '.join(_CHARTS)}")
    room, series = MOST_POINTS, []
    for points in chart.series:
        kept = [(float(x), float(y)) for x, y in points[:room]]
        series.append(tuple((min(max(x, 0.0), 1.0), min(max(y, 0.0), 1.0)) for x, y in kept if math.isfinite(x + y)))
        room -= len(kept)
    return Chart(chart.kind, tuple(series))


def _small(picture: Any, most_bytes: int) -> Picture:
    """Return a picture within the limits of a thumbnail."""
    if max(picture.width, picture.height) <= THUMBNAIL_PX and len(picture.data) <= most_bytes:
        return Picture(picture.data, picture.media_type, picture.width, picture.height)
    from PIL import Image

    opened = Image.open(io.BytesIO(picture.data))
    opened.thumbnail((THUMBNAIL_PX, THUMBNAIL_PX))
    return encode_small(opened, most_bytes)
