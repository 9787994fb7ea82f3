"""Is what a user's preview function returned fit to be painted?"""

from __future__ import annotations

import io
import itertools
import math
from typing import TYPE_CHECKING, Any, Final

from epypes.display.previews.charts import MOST_LINES, MOST_POINTS
from epypes.display.previews.kinds import kind_name
from epypes.display.previews.raster import THUMBNAIL_PX, Picture, encode_small
from epypes.display.previews.shown import Chart
from epypes.optional import optional_import

if TYPE_CHECKING:
    from PIL import Image

_FORMATS: Final = {"image/png": "PNG", "image/jpeg": "JPEG"}
_CHARTS: Final = ("line", "bars", "points")
# To decode more takes longer than a thumbnail may.
_MOST_PIXELS: Final = 25_000_000


def checked_chart(chart: Any) -> Chart:
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


def checked_picture(picture: Any, most_bytes: int) -> Picture:
    """Return a picture within the limits of a thumbnail, that is what it says to be."""
    data, media_type, width, height = picture.data, picture.media_type, picture.width, picture.height
    if type(media_type) is not str or media_type not in _FORMATS:
        raise ValueError(f"media_type of a picture must be {' or '.join(_FORMATS)}")
    if type(data) is not bytes:
        raise TypeError(f"data of a picture must be bytes, not {kind_name(type(data))}")
    if not all(type(side) is int and side > 0 for side in (width, height)):
        raise ValueError("width and height of a picture must be whole and positive")
    opened = _opened(data, _FORMATS[media_type])
    if max(opened.size) <= THUMBNAIL_PX and len(data) <= most_bytes:
        # What is broken is found by decoding it, which of a thumbnail takes no time.
        opened.load()
        return Picture(data, media_type, *opened.size)
    opened.thumbnail((THUMBNAIL_PX, THUMBNAIL_PX))
    return encode_small(opened, most_bytes)


def _opened(data: bytes, file_format: str) -> Image.Image:
    with optional_import():
        from PIL import Image, UnidentifiedImageError

    try:
        opened = Image.open(io.BytesIO(data), formats=[file_format])
    except UnidentifiedImageError as error:
        raise ValueError(f"data of a picture is no {file_format}") from error
    if opened.width * opened.height > _MOST_PIXELS:
        raise ValueError(f"a picture of {opened.width} x {opened.height} is too large for a thumbnail")
    return opened
