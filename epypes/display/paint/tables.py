"""How do a graph, a plan, and the times of one run and of many, look as tables?"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Final

from epypes.display.durations import duration_text, overhead_text
from epypes.display.markup import cut, escape
from epypes.display.paint.stagemarks import stage_words
from epypes.display.views.graphview import FunctionView, GraphView, StageView
from epypes.run import FunctionTime, LogNormal, RunReport, TimingSummary

# Below them stand the rest, the total and the graph overhead: a hundred rows in all.
_MOST_FUNCTIONS: Final = 97
_LEFT: Final = ' style="text-align:left"'
_CELL_CHARACTERS: Final = 200
_NAME_CHARACTERS: Final = 60
_DONE: Final = {"missing": "placeholder", "planned": "runs"}
_HIDDEN: Final = "position:absolute;width:1px;height:1px;overflow:hidden;clip-path:inset(50%);white-space:nowrap"


def paint_twin(graph: GraphView, title: str) -> str:
    """Paint a graph as a table for screen readers; it also stays where a page strips the picture."""
    rows = "".join(
        "<tr>" + "".join(f"<td>{escape(cell[:_CELL_CHARACTERS])}</td>" for cell in cells) + "</tr>"
        for cells in (
            *map(_stage_cells, graph.before),
            *(
                (function.name, ", ".join(inputs), ", ".join(outputs), "; ".join((function.state, *function.notes)))
                for (inputs, outputs), function in zip(graph.io(), graph.functions, strict=True)
            ),
            *map(_stage_cells, graph.after),
        )
    )
    return (
        f'<table style="{_HIDDEN}"><caption>{escape(title)}</caption>'
        f"<tr><th>function</th><th>inputs</th><th>outputs</th><th>state</th></tr>{rows}</table>"
    )


def _stage_cells(stage: StageView) -> tuple[str, ...]:
    return f"{stage.kind} {stage.name}", "", "", "; ".join(stage_words(stage))


def paint_plan(graph: GraphView) -> str:
    """Paint the view of a plan as an HTML table: per function what would be done, and why.

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
    return _table("", ("function", "plan", "why"), rows, texts=3)


def _other_plans(rest: Sequence[FunctionView]) -> Iterable[tuple[str, ...]]:
    """Sum up what has no row of its own."""
    if rest:
        counts = Counter(_DONE.get(function.state, function.state) for function in rest)
        yield f"{_functions(len(rest))} more", ", ".join(f"{count} {done}" for done, count in counts.items()), ""


def paint_report(report: RunReport) -> str:
    """Paint a report as an HTML table: per function its time and its share of the whole.

    The functions stand in run order; of many those that took longest, the rest in one row.
    """
    total_ns = max(report.total_ns, 1)
    entries = report.functions
    ran = sum(entry.ran for entry in entries)
    longest = sorted(entries, key=lambda entry: -entry.duration_ns)
    kept = {entry.function for entry in longest[:_MOST_FUNCTIONS]}
    rows = [_time_row(entry, total_ns) for entry in entries if entry.function in kept]
    rows += _rest_row(longest[_MOST_FUNCTIONS:], total_ns)
    rows.append(("in all", duration_text(report.total_ns), ""))
    overhead = duration_text(report.overhead_ns), f"{report.overhead_ns / total_ns:.0%}"
    rows.append((overhead_text(report.side_by_side), *overhead))
    caption = f"{_functions(ran)} ran, {len(entries) - ran} reused"
    return _table(caption, ("function", "time", "share"), rows)


def paint_summary(summary: TimingSummary) -> str:
    """Paint a summary as an HTML table: per function in how many runs it ran, and how long it takes."""
    functions = summary.functions
    kept = set(sorted(functions, key=lambda name: -_median_ns(functions[name]))[:_MOST_FUNCTIONS])
    rows = [_summary_row(name, functions[name]) for name in functions if name in kept]
    if len(functions) > len(kept):
        rows.append((f"{_functions(len(functions) - len(kept))} more, which take less", "", "", "", ""))
    rows.append(_summary_row("in all", summary.total))
    rows.append(_summary_row(overhead_text(summary.side_by_side), summary.overhead))
    caption = f"{summary.runs} run{'s' * (summary.runs != 1)}; log-normal distributions"
    return _table(caption, ("function", "runs", "mode", "median", "5 % to 95 %"), rows)


def _median_ns(fitted: LogNormal) -> float:
    return fitted.median_ns if fitted.is_fitted else 0.0


def _time_row(entry: FunctionTime, total_ns: int) -> tuple[str, ...]:
    if not entry.ran:
        return entry.function, "reused", ""
    return entry.function, duration_text(entry.duration_ns), f"{entry.duration_ns / total_ns:.0%}"


def _rest_row(rest: Sequence[FunctionTime], total_ns: int) -> Iterable[tuple[str, ...]]:
    """Sum up what has no row of its own."""
    if rest:
        spent_ns, reused = sum(entry.duration_ns for entry in rest), sum(not entry.ran for entry in rest)
        name = f"{_functions(len(rest))} more, {reused} of them reused"
        yield name, duration_text(spent_ns), f"{spent_ns / total_ns:.0%}"


def _summary_row(name: str, fitted: LogNormal) -> tuple[str, ...]:
    if not fitted.is_fitted:
        return name, str(fitted.count), "no positive value", "", ""
    mode, median, low, high = (
        duration_text(round(time_ns))
        for time_ns in (fitted.mode_ns, fitted.median_ns, fitted.quantile_ns(0.05), fitted.quantile_ns(0.95))
    )
    left_out = f", {fitted.not_positive} not positive" * bool(fitted.not_positive)
    return name, f"{fitted.count}{left_out}", mode, median, f"{low} to {high}"


def _functions(count: int) -> str:
    return f"{count} function{'s' * (count != 1)}"


def _table(caption: str, head: Sequence[str], rows: Iterable[Sequence[str]], texts: int = 1) -> str:
    """Write a table; of its columns so many hold texts, to the left, where JupyterLab has everything to the right."""
    above = f"<caption>{escape(caption)}</caption>" if caption else ""
    lines = (_row("td", [escape(cut(cell, _NAME_CHARACTERS)) for cell in cells], texts) for cells in rows)
    return f"<table>{above}{_row('th', head, texts)}{''.join(lines)}</table>"


def _row(tag: str, cells: Sequence[str], texts: int) -> str:
    written = (f"<{tag}{_LEFT * (column < texts)}>{cell}</{tag}>" for column, cell in enumerate(cells))
    return f"<tr>{''.join(written)}</tr>"
