"""What stands in the tables of a plan, and of the times of one run and of many, on a page and where text is printed?"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

from epypes.display.durations import duration_text, overhead_text
from epypes.display.views.graphview import FunctionView, GraphView
from epypes.display.views.plans import plan_view
from epypes.display.views.times import (
    failed_text,
    longest_first,
    median_ns,
    range_text,
    report_caption,
    rest_text,
    summary_caption,
)
from epypes.run import FunctionTime, LogNormal, Plan, RunReport, TimingSummary, summarize
from epypes.run.timing import Reports
from epypes.wording import counted

# Below them stand the rest, the total and the graph overhead: a hundred rows in all.
_MOST_FUNCTIONS: Final = 97
_DONE: Final = {"missing": "placeholder", "planned": "runs"}
_NO_REPORTS: Final = "No run has ended yet, so there are no times. Call run(...) first."

Tabular = Plan | RunReport | TimingSummary | Reports


class Table(NamedTuple):
    """Rows of texts; of the columns the first ``texts`` hold words, the others quantities."""

    caption: str
    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    texts: int = 1


def table_of(shown: Tabular) -> Table:
    """Return a plan, a report, reports or their summary as a table."""
    if isinstance(shown, Plan):
        return plan_table(plan_view(shown))
    if isinstance(shown, RunReport):
        return report_table(shown)
    if isinstance(shown, TimingSummary):
        return summary_table(shown)
    summary = summary_of(shown)
    return Table(summary, (), ()) if isinstance(summary, str) else summary_table(summary)


def summary_of(reports: Reports) -> TimingSummary | str:
    """Return the summary of reports, or, where there is none, a sentence that says why."""
    given = list(reports)
    if not given:
        return _NO_REPORTS
    try:
        return summarize(given)
    except ValueError as error:  # all runs have failed
        return str(error)


def plan_table(graph: GraphView) -> Table:
    """Return the view of a plan as a table: per function what would be done, and why.

    The functions stand in run order; of many those that would run, the rest in one row.
    """
    order = {"missing": 0, "planned": 1, "reused": 2}
    by_weight = sorted(graph.functions, key=lambda function: order.get(function.state, 3))
    kept = {function.name for function in by_weight[:_MOST_FUNCTIONS]}
    rows: list[tuple[str, ...]] = [
        (function.name, _DONE.get(function.state, function.state), function.message)
        for function in graph.functions
        if function.name in kept
    ]
    rows += _other_plans(by_weight[_MOST_FUNCTIONS:])
    return Table(graph.caption, ("function", "plan", "why"), rows, texts=3)


def _other_plans(rest: Sequence[FunctionView]) -> Iterable[tuple[str, ...]]:
    """Sum up what has no row of its own."""
    if rest:
        counts = Counter(_DONE.get(function.state, function.state) for function in rest)
        yield (
            f"{counted(len(rest), 'function')} more",
            ", ".join(f"{count} {done}" for done, count in counts.items()),
            "",
        )


def report_table(report: RunReport) -> Table:
    """Return a report as a table: per function its time and its share of the whole.

    The functions stand in run order; of many those that took longest and the one that failed, the rest in one row.
    """
    total_ns = max(report.total_ns, 1)
    entries = report.functions
    longest = longest_first(entries)
    kept = {entry.function for entry in longest[:_MOST_FUNCTIONS]}
    rows = [_time_row(entry, total_ns) for entry in entries if entry.function in kept]
    rows += _rest_row(longest[_MOST_FUNCTIONS:], total_ns)
    rows.append(("in all", duration_text(report.total_ns), ""))
    overhead = duration_text(report.overhead_ns), f"{report.overhead_ns / total_ns:.0%}"
    rows.append((overhead_text(report.side_by_side), *overhead))
    return Table(report_caption(report), ("function", "time", "share"), rows)


def summary_table(summary: TimingSummary) -> Table:
    """Return a summary as a table: per function in how many runs it ran, and how long it takes."""
    functions = summary.functions
    kept = set(sorted(functions, key=lambda name: -median_ns(functions[name]))[:_MOST_FUNCTIONS])
    rows = [_summary_row(name, functions[name]) for name in functions if name in kept]
    if len(functions) > len(kept):
        rows.append((f"{counted(len(functions) - len(kept), 'function')} more, which take less", "", "", "", ""))
    rows.append(_summary_row("in all", summary.total))
    rows.append(_summary_row(overhead_text(summary.side_by_side), summary.overhead))
    return Table(summary_caption(summary), ("function", "runs", "mode", "median", "5 % to 95 %"), rows)


def _time_row(entry: FunctionTime, total_ns: int) -> tuple[str, ...]:
    if not entry.ran:
        return entry.function, "reused", ""
    time = failed_text(entry) if entry.failed else duration_text(entry.duration_ns)
    return entry.function, time, f"{entry.duration_ns / total_ns:.0%}"


def _rest_row(rest: Sequence[FunctionTime], total_ns: int) -> Iterable[tuple[str, ...]]:
    """Sum up what has no row of its own."""
    if rest:
        spent_ns = sum(entry.duration_ns for entry in rest)
        yield rest_text(rest), duration_text(spent_ns), f"{spent_ns / total_ns:.0%}"


def _summary_row(name: str, fitted: LogNormal) -> tuple[str, ...]:
    if not fitted.is_fitted:
        return name, str(fitted.count), "no positive value", "", ""
    mode, median = (duration_text(round(time_ns)) for time_ns in (fitted.mode_ns, fitted.median_ns))
    left_out = f", {fitted.not_positive} not positive" * bool(fitted.not_positive)
    shown_range = range_text(fitted) if fitted.has_range else ""
    return name, f"{fitted.count}{left_out}", mode, median, shown_range
