"""How is the thumbnail of a value painted: an encoded picture, or a chart?"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from typing import Final

from epypes.display.layout.geometry import Point
from epypes.display.markup import escape
from epypes.display.previews.raster import Picture
from epypes.display.previews.shown import Chart, Preview

THUMB_WIDTH: Final = 128
THUMB_HEIGHT: Final = 96
# So that lines and dots at the ends of a chart stay within it.
_INSET_PX: Final = 4
_WIDEST_BAR_PX: Final = 12.0


def paint_thumbnail(shown: Preview, top: Point) -> str:
    """Paint what a preview has, below the middle of the upper edge of its frame."""
    if shown.picture is not None:
        return _picture(shown.picture, top)
    return _chart(shown.chart, top) if shown.chart is not None else ""


def _picture(picture: Picture, top: Point) -> str:
    scale = min(THUMB_WIDTH / picture.width, THUMB_HEIGHT / picture.height)
    width, height = picture.width * scale, picture.height * scale
    data = base64.b64encode(picture.data).decode()
    return (
        f'<image x="{top[0] - width / 2:.1f}" y="{top[1] + (THUMB_HEIGHT - height) / 2:.1f}" width="{width:.1f}" '
        f'height="{height:.1f}" href="data:{escape(picture.media_type)};base64,{data}"/>'
    )


def _chart(chart: Chart, top: Point) -> str:
    left, floor = top[0] - THUMB_WIDTH / 2 + _INSET_PX, top[1] + THUMB_HEIGHT - _INSET_PX
    width, height = THUMB_WIDTH - 2 * _INSET_PX, THUMB_HEIGHT - 2 * _INSET_PX
    series = [[(left + x * width, floor - y * height) for x, y in points] for points in chart.series]
    at = f'x="{top[0] - THUMB_WIDTH / 2:.1f}" y="{top[1]:.1f}"'
    frame = f'<rect class="paper" {at} width="{THUMB_WIDTH}" height="{THUMB_HEIGHT}"/>'
    if chart.kind == "line":
        return f'<g class="chart">{frame}{"".join(map(_line, series))}</g>'
    if chart.kind == "points":
        # A line without length has round ends: a dot in fewer characters than a circle.
        dots = "".join(f"M{x:.1f} {y:.1f}h0" for points in series for x, y in points)
        return f'<g class="chart">{frame}<path class="dots" d="{dots}"/></g>'
    bars = "".join(f"M{x:.1f} {floor:.1f}V{y:.1f}" for points in series for x, y in points)
    thickness = min(0.8 * width / max(map(len, series), default=1), _WIDEST_BAR_PX) if any(series) else 1
    return f'<g class="chart">{frame}<path class="bars" style="stroke-width:{thickness:.1f}" d="{bars}"/></g>'


def _line(points: Sequence[Point]) -> str:
    places = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polyline points="{places}"/>'
