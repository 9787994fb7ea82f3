"""How are the times of one run, and of many, painted as bars?"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from epypes.display.markup import content, escape
from epypes.display.paint.style import STYLE, page_style, paper_style
from epypes.display.views.times import TimeBar, TimesView

_ROW_PX: Final = 22
_BAR_PX: Final = 12
_LONGEST_PX: Final = 280
_MARGIN_PX: Final = 12
_GAP_PX: Final = 10
_NAME_CHARACTER_PX: Final = 7.0
_TEXT_CHARACTER_PX: Final = 6.8
_LINE_PX: Final = 2

# All lies on one filled shape, so that it is readable on paper of any colour. Both classes are named, since on a page
# the styles of a graph that comes later would count for more otherwise.
_SCOPE: Final = ".epypes-graph.epypes-times"
_RULES: Final = {
    " text": "text-anchor:start",
    " .track": "fill:@track;stroke:none",
    " .bar": "fill:@accent",
    " .reused .track": "fill:none;stroke:@line;stroke-width:1;stroke-dasharray:4 3",
    " .failed .track": "fill:@alarm;stroke:@error;stroke-width:1",
    " .failed .bar": "fill:@error",
    " .overhead .bar": "fill:@line",
    " .range": "stroke:@text;stroke-width:1.5",
    " .name": "font-weight:500",
}
_STYLE: Final = STYLE + paper_style(_SCOPE, _RULES) + page_style(_SCOPE, _RULES)


def times_alt_text(times: TimesView) -> str:
    """Return the times in one sentence, for screen readers."""
    return f"Times as bars: {times.caption}; {times.bars[-1].title}"


def paint_bars(times: TimesView) -> str:
    """Paint times as one bar below another; the same times give the same text."""
    names = max(len(bar.name) for bar in times.bars) * _NAME_CHARACTER_PX
    texts = max(len(bar.text) for bar in times.bars) * _TEXT_CHARACTER_PX
    left = _MARGIN_PX + names + _GAP_PX
    width, height = left + _LONGEST_PX + _GAP_PX + texts + _MARGIN_PX, _ROW_PX * len(times.bars) + _MARGIN_PX
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="epypes-graph epypes-times" role="figure" '
        f'aria-label="{escape(times_alt_text(times))}" width="{width + 2:.0f}" height="{height + 2:.0f}" '
        f'viewBox="-1 -1 {width + 2:.0f} {height + 2:.0f}">'
    )
    paper = f'<rect class="shape" width="{width:.0f}" height="{height:.0f}" rx="8"/>'
    rows = (_paint_row(bar, left, _MARGIN_PX / 2 + place * _ROW_PX) for place, bar in enumerate(times.bars))
    return "\n".join([head, f"<style>{_STYLE}</style>", paper, *rows, "</svg>"])


def _paint_row(bar: TimeBar, left: float, top: float) -> str:
    base = top + _ROW_PX / 2 + 4
    classes = f"{bar.kind}{' reused' * bar.is_reused}{' failed' * bar.is_failed}"
    return (
        f'<g class="time {classes}"><title>{content(bar.title)}</title>'
        f'<text class="name" x="{_MARGIN_PX}" y="{base:.0f}">{content(bar.name)}</text>'
        f"{''.join(_paint_bar(bar, left, top))}"
        f'<text x="{left + _LONGEST_PX + _GAP_PX:.0f}" y="{base:.0f}">{content(bar.text)}</text></g>'
    )


def _paint_bar(bar: TimeBar, left: float, top: float) -> Iterator[str]:
    """Give the track, the bar on it, and the range as a line; the total has none, being longer than all."""
    if bar.kind == "total" or not bar.text:
        return
    y, middle = top + (_ROW_PX - _BAR_PX) / 2, top + _ROW_PX / 2
    yield f'<rect class="track" x="{left:.0f}" y="{y:.0f}" width="{_LONGEST_PX}" height="{_BAR_PX}" rx="3"/>'
    if bar.length > 0:
        width = max(bar.length * _LONGEST_PX, 1.0)
        yield f'<rect class="bar" x="{left:.0f}" y="{y:.0f}" width="{width:.1f}" height="{_BAR_PX}" rx="3"/>'
    if bar.high > 0:
        start, end = (left + part * _LONGEST_PX for part in (bar.low, bar.high))
        yield f'<path class="range" d="M{start:.1f},{middle:.0f}H{max(end, start + _LINE_PX):.1f}"/>'
