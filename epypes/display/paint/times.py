"""Times of one run and of many: as bars, and as the rows of a table."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, Literal, NamedTuple

from epypes.display.paint.style import STYLE, page_style, paper_style
from epypes.display.text import content, cut_name, duration_text, escape, overhead_text, short_name
from epypes.run import FunctionTime, LogNormal, RunReport, TimingSummary
from epypes.wording import counted

BarKind = Literal["function", "rest", "overhead", "total"]

# More don't fit on a screen.
MOST_BARS: Final = 60
_TITLE_CHARACTERS: Final = 100
_REPORT_LEGEND: Final = "Bars: time of each function; the longest is drawn in full."
_SUMMARY_LEGEND: Final = "Bars: the median time of each function; lines: 5 % to 95 % of its times, if 5 or more."
# A range that is so many times as long as the longest median would leave nothing to be seen of the rest; it is cut.
_LONGEST_RANGE: Final = 4.0


class TimeBar(NamedTuple):
    """What is to be seen of one time, or of many of one kind.

    Attributes
    ----------
    text
        Stands beside the bar.
    title
        All of it in words.
    cells
        What stands beside the name in a table.
    length
        From 0 to 1, the longest one.
    low, high
        The range of many times, on the same scale; both 0 for a single one, and where fewer than 5 say nothing of it.
    is_reused
        Whether the function did not run.
    is_failed
        Whether it raised.
    """

    kind: BarKind
    name: str
    text: str
    title: str
    cells: tuple[str, ...]
    length: float = 0.0
    low: float = 0.0
    high: float = 0.0
    is_reused: bool = False
    is_failed: bool = False


class TimesView(NamedTuple):
    """What is to be seen of times: bars in run order, then graph overhead and total.

    Attributes
    ----------
    legend
        Explains the bars.
    head
        What stands above the names and cells in a table.
    """

    caption: str
    legend: str
    head: tuple[str, ...]
    bars: tuple[TimeBar, ...]


def times_of(shown: RunReport | TimingSummary, most: int = MOST_BARS) -> TimesView:
    """Look at the times of a run, or of many; of many functions at those that take longest."""
    return report_times(shown, most) if isinstance(shown, RunReport) else summary_times(shown, most)


def _named(kind: BarKind, name: str) -> str:
    return f"function {cut_name(name, _TITLE_CHARACTERS)}" if kind == "function" else name


# -- one run -------------------------------------------------------------------------------------------------------


def report_times(report: RunReport, most: int = MOST_BARS) -> TimesView:
    """Look at the times of a run; of many functions at those that took longest, and at the rest as one.

    A function that failed is always among them.
    """
    entries, total_ns = report.functions, max(report.total_ns, 1)
    longest = sorted(entries, key=lambda entry: (not entry.failed, -entry.duration_ns))
    kept, rest = {entry.function for entry in longest[:most]}, longest[most:]
    bars = [_function_bar(entry, total_ns) for entry in entries if entry.function in kept]
    if rest:
        text = f"{counted(len(rest), 'function')} more, {sum(entry.reused for entry in rest)} of them reused"
        bars.append(_bar("rest", text, sum(entry.duration_ns for entry in rest), total_ns))
    bars.append(_bar("overhead", overhead_text(report.side_by_side), report.overhead_ns, total_ns))
    scale = max((bar.length for bar in bars), default=0.0) or 1.0
    total = duration_text(report.total_ns)
    failed, skipped = sum(entry.failed for entry in entries), sum(entry.skipped for entry in entries)
    caption = f"{counted(sum(entry.ran for entry in entries) - failed, 'function')} ran"
    caption += f", {sum(entry.reused for entry in entries)} reused"
    caption += f", {skipped} skipped" * bool(skipped) + f", {failed} failed" * failed
    return TimesView(
        caption,
        _REPORT_LEGEND,
        ("function", "time", "share"),
        (
            *(bar._replace(length=bar.length / scale) for bar in bars),
            TimeBar("total", "in all", total, f"in all: {total}", (total, "")),
        ),
    )


def _function_bar(entry: FunctionTime, total_ns: int) -> TimeBar:
    named = _named("function", entry.function)
    if not entry.ran:
        text = "skipped" if entry.skipped else "reused"
        return TimeBar("function", entry.function, text, f"{named}: {text}", (text, ""), is_reused=True)
    bar = _bar("function", entry.function, entry.duration_ns, total_ns)
    if not entry.failed:
        return bar
    text = f"failed after {duration_text(entry.duration_ns)}"
    return bar._replace(text=text, title=f"{named}: {text}", cells=(text, bar.cells[1]), is_failed=True)


def _bar(kind: BarKind, name: str, spent_ns: int, total_ns: int) -> TimeBar:
    """Return a bar whose length is its part of the run's time."""
    cells = duration_text(spent_ns), f"{spent_ns / total_ns:.0%}"
    text = ", ".join(cells)
    return TimeBar(kind, name, text, f"{_named(kind, name)}: {text} of the run", cells, max(spent_ns / total_ns, 0.0))


# -- many runs -----------------------------------------------------------------------------------------------------


def summary_times(summary: TimingSummary, most: int = MOST_BARS) -> TimesView:
    """Look at the times of many runs; of many functions at those that take longest."""
    functions = summary.functions
    median_ns = {name: fitted.median_ns if fitted.is_fitted else 0.0 for name, fitted in functions.items()}
    kept = set(sorted(functions, key=lambda name: -median_ns[name])[:most])
    shown = [fitted for fitted in (*functions.values(), summary.overhead) if fitted.is_fitted]
    longest_ns = max((fitted.median_ns for fitted in shown), default=1.0)
    ranges_ns = [fitted.quantile_ns(0.95) for fitted in shown if fitted.has_range]
    scale = min(max([longest_ns, *ranges_ns]), _LONGEST_RANGE * longest_ns)
    bars = [_fitted_bar("function", name, functions[name], scale) for name in functions if name in kept]
    if len(functions) > len(kept):
        text = f"{counted(len(functions) - len(kept), 'function')} more, which take less"
        bars.append(TimeBar("rest", text, "", text, ("", "", "", "")))
    bars.append(_fitted_bar("overhead", overhead_text(summary.side_by_side), summary.overhead, scale))
    bars.append(_fitted_bar("total", "in all", summary.total, scale)._replace(length=0.0, low=0.0, high=0.0))
    left_out = f", {counted(summary.failed_runs, 'failed run')} left out" * bool(summary.failed_runs)
    caption = f"{counted(summary.runs, 'run')}{left_out}; log-normal distributions"
    return TimesView(caption, _SUMMARY_LEGEND, ("function", "runs", "mode", "median", "5 % to 95 %"), tuple(bars))


def _fitted_bar(kind: BarKind, name: str, fitted: LogNormal, scale_ns: float) -> TimeBar:
    named = _named(kind, name)
    if not fitted.is_fitted:
        cells = str(fitted.count), "no positive value", "", ""
        return TimeBar(kind, name, "no positive value", f"{named}: no positive value", cells)
    mode, median = (duration_text(round(time_ns)) for time_ns in (fitted.mode_ns, fitted.median_ns))
    count = f"{fitted.count}{f', {fitted.not_positive} not positive' * bool(fitted.not_positive)}"
    runs, length = f"in {counted(fitted.count, 'run')}", min(fitted.median_ns / scale_ns, 1.0)
    if not fitted.has_range:
        title = f"{named}: median {median}, {runs}"
        return TimeBar(kind, name, median, title, (count, mode, median, ""), length)
    ends_ns = [fitted.quantile_ns(share) for share in (0.05, 0.95)]
    span = " to ".join(duration_text(round(end)) for end in ends_ns)
    title = f"{named}: median {median}, 5 % to 95 % {span}, {runs}"
    low, high = (min(end / scale_ns, 1.0) for end in ends_ns)
    return TimeBar(kind, name, f"{median} ({span})", title, (count, mode, median, span), length, low, high)


# -- painting ------------------------------------------------------------------------------------------------------

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
_SCOPE: Final = ".epypes-graph.epypes-durations"
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
    names = [short_name(bar.name) if bar.kind == "function" else bar.name for bar in times.bars]
    left = _MARGIN_PX + max(map(len, names)) * _NAME_CHARACTER_PX + _GAP_PX
    texts = max(len(bar.text) for bar in times.bars) * _TEXT_CHARACTER_PX
    width, height = left + _LONGEST_PX + _GAP_PX + texts + _MARGIN_PX, _ROW_PX * len(times.bars) + _MARGIN_PX
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="epypes-graph epypes-durations" role="figure" '
        f'aria-label="{escape(times_alt_text(times))}" width="{width + 2:.0f}" height="{height + 2:.0f}" '
        f'viewBox="-1 -1 {width + 2:.0f} {height + 2:.0f}">'
    )
    paper = f'<rect class="shape" width="{width:.0f}" height="{height:.0f}" rx="8"/>'
    rows = (
        _paint_row(bar, name, left, _MARGIN_PX / 2 + place * _ROW_PX)
        for place, (bar, name) in enumerate(zip(times.bars, names, strict=True))
    )
    return "\n".join([head, f"<style>{_STYLE}</style>", paper, *rows, "</svg>"])


def _paint_row(bar: TimeBar, name: str, left: float, top: float) -> str:
    base = top + _ROW_PX / 2 + 4
    classes = f"{bar.kind}{' reused' * bar.is_reused}{' failed' * bar.is_failed}"
    return (
        f'<g class="time {classes}"><title>{content(bar.title)}</title>'
        f'<text class="name" x="{_MARGIN_PX}" y="{base:.0f}">{content(name)}</text>'
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
