"""How do a graph, a plan, and the times of one run and of many, look as tables?"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Final

from epypes.display.durations import duration_text, overhead_text
from epypes.display.markup import cut, cut_name, escape
from epypes.display.views.graphview import FunctionView, GraphView, TokenView
from epypes.run import FunctionTime, LogNormal, RunReport, TimingSummary

# Below them stand the rest, the total and the graph overhead: a hundred rows in all.
_MOST_FUNCTIONS: Final = 97
_LEFT: Final = ' style="text-align:left"'
_CELL_CHARACTERS: Final = 200
_NAME_CHARACTERS: Final = 60
_DONE: Final = {"missing": "placeholder", "planned": "runs"}
_TWIN_CHARACTERS: Final = 200
# What is kept for saying how many rows do not fit.
_LAST_ROW: Final = 60
_HIDDEN: Final = "position:absolute;width:1px;height:1px;overflow:hidden;clip-path:inset(50%);white-space:nowrap"


def paint_twin(graph: GraphView, title: str, room: int) -> str:
    """Paint a graph as tables for screen readers; they also stay where a page strips the picture.

    First the functions, then the tokens, so many of them as fit in ``room`` characters; how many don't is said.
    """
    functions = (
        (function.name, ", ".join(inputs), ", ".join(outputs), "; ".join((*_state(function), *function.notes)))
        for (inputs, outputs), function in zip(graph.io(), graph.functions, strict=True)
    )
    tokens = ((token.name, *_value(token)) for token in graph.tokens)
    start, end = f'<div style="{_HIDDEN}">', "</div>"
    room -= len(start) + len(end)
    first = _twin(title, ("function", "inputs", "outputs", "state"), functions, room)
    return start + first + _twin("Its tokens", ("token", "value", "state"), tokens, room - len(first)) + end


def _twin(caption: str, head: Sequence[str], rows: Iterable[Sequence[str]], room: int) -> str:
    start = f"<table><caption>{escape(caption)}</caption>{_row('th', head, 0)}"
    room -= len(start) + _LAST_ROW
    kept: list[str] = []
    left_out = 0
    for cells in rows:
        row = _row("td", [escape(cut_name(cell, _TWIN_CHARACTERS)) for cell in cells], 0)
        room -= len(row)
        if room >= 0 and not left_out:
            kept.append(row)
        else:
            left_out += 1
    more = _row("td", [f"and {left_out} more"], 0) if left_out else ""
    return f"{start}{''.join(kept)}{more}</table>" if kept or not left_out else ""


def _state(function: FunctionView) -> Iterable[str]:
    yield function.state
    if function.duration_ns is not None:
        yield duration_text(function.duration_ns)
    if function.message:
        yield function.message


def _value(token: TokenView) -> tuple[str, str]:
    return token.preview.detail if token.preview else "", f"{token.role}, {token.state}"


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
