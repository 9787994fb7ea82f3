"""Graphs and tables as text and as HTML tables."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Final, NamedTuple

from epypes.display.paint.stages import stage_words
from epypes.display.paint.times import (
    failed_text,
    longest_first,
    median_ns,
    range_text,
    report_caption,
    rest_text,
    summary_caption,
)
from epypes.display.previews.short import reason
from epypes.display.text import content, cut, cut_name, duration_text, fitted, overhead_text, size
from epypes.display.views.graphview import FunctionView, GraphView, StageView, TokenView
from epypes.display.views.view import plan_view
from epypes.run import FunctionTime, LogNormal, Plan, RunReport, TimingSummary, summarize
from epypes.run.report import Reports
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


_LEFT: Final = ' style="text-align:left"'
CELL_CHARACTERS: Final = 60
_CELL_ROOM: Final = 100
_TWIN_CHARACTERS: Final = 200
# What is kept for saying how many rows do not fit.
_LAST_ROW: Final = 60
_HIDDEN: Final = "position:absolute;width:1px;height:1px;overflow:hidden;clip-path:inset(50%);white-space:nowrap"


def paint_twin(graph: GraphView, title: str, room: int) -> str:
    """Paint a graph as tables for screen readers; they also stay where a page strips the picture.

    First the functions, with the stages around them, then the tokens, so many of them as fit in ``room`` characters;
    how many don't is said.
    """
    functions = (
        (function.name, ", ".join(inputs), ", ".join(outputs), "; ".join((*_state(function), *function.notes)))
        for (inputs, outputs), function in zip(graph.io(), graph.functions, strict=True)
    )
    rows = (*map(_stage_cells, graph.before), *functions, *map(_stage_cells, graph.after))
    tokens = ((token.name, *_value(token)) for token in graph.tokens)
    start, end = f'<div style="{_HIDDEN}">', "</div>"
    room -= size(start) + size(end)
    first = _twin(title, ("function", "inputs", "outputs", "state"), rows, room)
    return start + first + _twin("Its tokens", ("token", "value", "state"), tokens, room - size(first)) + end


def _twin(caption: str, head: Sequence[str], rows: Iterable[Sequence[str]], room: int) -> str:
    start = f"<table><caption>{content(caption)}</caption>{_row('th', head, 0)}"
    room -= size(start) + _LAST_ROW
    kept: list[str] = []
    left_out = 0
    for cells in rows:
        row = _row("td", [content(cut_name(cell, _TWIN_CHARACTERS)) for cell in cells], 0)
        room -= size(row)
        if room >= 0 and not left_out:
            kept.append(row)
        else:
            left_out += 1
    more = _row("td", [f"and {left_out} more"], 0) if left_out else ""
    return f"{start}{''.join(kept)}{more}</table>" if kept else ""


def _state(function: FunctionView) -> Iterable[str]:
    yield function.state
    if function.duration_ns is not None:
        yield duration_text(function.duration_ns)
    if function.message:
        yield function.message


def _value(token: TokenView) -> tuple[str, str]:
    return token.preview.detail if token.preview else "", f"{token.role}, {token.state}"


def _stage_cells(stage: StageView) -> tuple[str, ...]:
    return f"{stage.kind} {stage.name}", "", "", "; ".join(stage_words(stage))


def paint_table(table: Table) -> str:
    """Write a table; what holds words stands to the left, where JupyterLab has everything to the right."""
    above = f"<caption>{content(table.caption)}</caption>" if table.caption else ""
    lines = (_row("td", list(map(_cell, cells)), table.texts) for cells in table.rows)
    return f"<table>{above}{_row('th', table.head, table.texts)}{''.join(lines)}</table>"


def _cell(text: str) -> str:
    return content(fitted(cut(text, CELL_CHARACTERS), _CELL_ROOM))


def _row(tag: str, cells: Sequence[str], texts: int) -> str:
    written = (f"<{tag}{_LEFT * (column < texts)}>{cell}</{tag}>" for column, cell in enumerate(cells))
    return f"<tr>{''.join(written)}</tr>"


_MOST_LINES = 40
_REPR_CHARACTERS = 99
_STATES = {
    "planned": "[to run]",
    "reused": "[reused]",
    "stale": "[stale]",
    "left out": "[left out]",
    "running": "[running]",
    "failed": "[failed]",
}


def paint_text(graph: GraphView) -> str:
    """Paint a graph as one line per function, in run order: ``canny(image_blurred, canny_lo, canny_hi) -> edges``."""
    lines = [f"pipeline {graph.title}"] if graph.title else []
    lines += map(_stage_line, graph.before)
    for (inputs, outputs), function in zip(graph.io(), graph.functions[:_MOST_LINES], strict=False):
        line = f"{function.name}({', '.join(inputs)}) -> {', '.join(outputs) or 'nothing'}"
        lines.append("  ".join(filter(None, (line, _state_text(function), *function.notes, function.message))))
    if len(graph.functions) > _MOST_LINES:
        lines.append(f"... and {len(graph.functions) - _MOST_LINES} functions more")
    lines += map(_stage_line, graph.after)
    values = [
        f"{token.name} = {token.preview.text}{f' (first {token.first})' * bool(token.first)}"
        for token in graph.tokens
        if token.role == "hyperparameter" and token.preview
    ]
    missing = [token.name for token in graph.tokens if token.state == "missing"]
    for start, names in (("with", values), ("missing", missing)):
        if names:
            lines.append(f"{start} {', '.join(names[:_MOST_LINES])}")
    return "\n".join(lines)


def text_table(table: Table) -> str:
    """Write a table as aligned lines: its caption, its head, its rows."""
    if not table.head:
        return table.caption
    lines = [[_printable(cut(cell, CELL_CHARACTERS)) for cell in cells] for cells in (table.head, *table.rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    lines.insert(1, ["-" * width for width in widths])
    aligned = [
        "  ".join(
            cell.ljust(width) if column < table.texts else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(cells, widths, strict=True))
        ).rstrip()
        for cells in lines
    ]
    return "\n".join([*([_printable(table.caption)] if table.caption else []), *aligned])


def _printable(text: str) -> str:
    """Return text without what would steer a terminal."""
    return "".join(character if character.isprintable() else "\ufffd" for character in text)


def _stage_line(stage: StageView) -> str:
    return f"{stage.kind} {stage.name}  [{'; '.join(stage_words(stage))}]"


def _state_text(function: FunctionView) -> str:
    if function.duration_ns is not None:
        return f"[{duration_text(function.duration_ns)}]"
    return _STATES.get(function.state, "")


def repr_text(shown: object) -> str:
    """Return the repr of what is shown, which in a subclass may be of any length, or raise."""
    try:
        return cut(repr(shown), _REPR_CHARACTERS)
    except Exception as error:
        return f"<{type(shown).__name__}: no repr: {reason(error)}>"
