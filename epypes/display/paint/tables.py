"""Graphs, plans and times as tables, on a page and where text is printed."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Final, NamedTuple

from epypes.display.paint.times import times_of
from epypes.display.paint.vertices import stage_words
from epypes.display.previews.short import reason
from epypes.display.text import content, cut, cut_name, duration_text, fitted, size
from epypes.display.views.graphview import FunctionView, GraphView, StageView, TokenView
from epypes.display.views.view import plan_view
from epypes.run import Plan, RunReport, TimingSummary, summarize
from epypes.run.timing import Reports
from epypes.wording import counted

# Below them stand the rest, the total and the graph overhead: a hundred rows in all.
_MOST_FUNCTIONS: Final = 97
_PLANNED: Final = {"missing": "placeholder", "planned": "runs"}
_NO_REPORTS: Final = "No run has ended yet, so there are no times. Call run(...) first."
_LEFT: Final = ' style="text-align:left"'
_CELL_CHARACTERS: Final = 60
_CELL_ROOM: Final = 100
_REPR_CHARACTERS: Final = 99

Tabular = Plan | RunReport | TimingSummary | Reports


class Table(NamedTuple):
    """Rows of texts; of the columns the first ``texts`` hold words, the others quantities."""

    caption: str
    head: tuple[str, ...]
    rows: Sequence[tuple[str, ...]]
    texts: int = 1


def table_of(shown: Tabular) -> Table:
    """Return a plan, a report, reports or their summary as a table; functions in run order.

    Of many functions, those that would run or took longest, and the rest in one row.
    """
    if isinstance(shown, Plan):
        return _plan_table(plan_view(shown))
    if isinstance(shown, Reports):
        summary = summary_of(shown)
        return Table(summary, (), ()) if isinstance(summary, str) else table_of(summary)
    times = times_of(shown, _MOST_FUNCTIONS)
    *bars, overhead, total = times.bars
    return Table(times.caption, times.head, [(bar.name, *bar.cells) for bar in (*bars, total, overhead)])


def summary_of(reports: Reports) -> TimingSummary | str:
    """Return the summary of reports, or, where there is none, a sentence that says why."""
    given = list(reports)
    if not given:
        return _NO_REPORTS
    try:
        return summarize(given)
    except ValueError as error:  # all runs have failed
        return str(error)


def _plan_table(graph: GraphView) -> Table:
    """Return the view of a plan as a table: per function what would be done, and why."""
    order = {"missing": 0, "planned": 1, "reused": 2}
    by_weight = sorted(graph.functions, key=lambda function: order.get(function.state, 3))
    kept, rest = {function.name for function in by_weight[:_MOST_FUNCTIONS]}, by_weight[_MOST_FUNCTIONS:]
    rows: list[tuple[str, ...]] = [
        (function.name, _PLANNED.get(function.state, function.state), function.message)
        for function in graph.functions
        if function.name in kept
    ]
    if rest:
        counts = Counter(_PLANNED.get(function.state, function.state) for function in rest)
        plans = ", ".join(f"{count} {plan}" for plan, count in counts.items())
        rows.append((f"{counted(len(rest), 'function')} more", plans, ""))
    return Table(graph.caption, ("function", "plan", "why"), rows, texts=3)


def paint_table(table: Table) -> str:
    """Write a table; what holds words stands to the left, where JupyterLab has everything to the right."""
    above = f"<caption>{content(table.caption)}</caption>" if table.caption else ""
    lines = (
        _row("td", [content(fitted(cut(cell, _CELL_CHARACTERS), _CELL_ROOM)) for cell in cells], table.texts)
        for cells in table.rows
    )
    return f"<table>{above}{_row('th', table.head, table.texts)}{''.join(lines)}</table>"


def _row(tag: str, cells: Sequence[str], texts: int = 0) -> str:
    written = [f"<{tag}{_LEFT * (column < texts)}>{cell}</{tag}>" for column, cell in enumerate(cells)]
    return f"<tr>{''.join(written)}</tr>"


# -- where text is printed -----------------------------------------------------------------------------------------

_MOST_LINES: Final = 40
_UNWRITTEN: Final = ("static", "ran", "not run", "missing")


def text_table(table: Table) -> str:
    """Write a table as aligned lines: its caption, its head, its rows."""
    if not table.head:
        return table.caption
    lines = [[cut(cell, _CELL_CHARACTERS) for cell in cells] for cells in (table.head, *table.rows)]
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    lines.insert(1, ["-" * width for width in widths])
    aligned = [
        "  ".join(
            cell.ljust(width) if column < table.texts else cell.rjust(width)
            for column, (cell, width) in enumerate(zip(cells, widths, strict=True))
        ).rstrip()
        for cells in lines
    ]
    # Without what would steer a terminal.
    return "\n".join(
        "".join(mark if mark.isprintable() else "\ufffd" for mark in line)
        for line in ([table.caption, *aligned] if table.caption else aligned)
    )


def paint_text(graph: GraphView) -> str:
    """Paint a graph as one line per function, in run order: ``canny(image_blurred, canny_lo, canny_hi) -> edges``."""
    before, after = (
        [f"{stage.kind} {stage.name}  [{'; '.join(stage_words(stage))}]" for stage in stages]
        for stages in (graph.before, graph.after)
    )
    lines = [f"pipeline {graph.title}", *before] if graph.title else before
    for (inputs, outputs), function in zip(graph.io(), graph.functions[:_MOST_LINES], strict=False):
        line, mark = f"{function.name}({', '.join(inputs)}) -> {', '.join(outputs) or 'nothing'}", ""
        if function.duration_ns is not None:
            mark = f"[{duration_text(function.duration_ns)}]"
        elif function.state not in _UNWRITTEN:
            mark = f"[{'to run' if function.state == 'planned' else function.state}]"
        lines.append("  ".join(filter(None, (line, mark, *function.notes, function.message))))
    if len(graph.functions) > _MOST_LINES:
        lines.append(f"... and {len(graph.functions) - _MOST_LINES} functions more")
    lines += after
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


def repr_text(shown: object) -> str:
    """Return the repr of what is shown, which in a subclass may be of any length, or raise."""
    try:
        return cut(repr(shown), _REPR_CHARACTERS)
    except Exception as error:
        return f"<{type(shown).__name__}: no repr: {reason(error)}>"


# -- for screen readers --------------------------------------------------------------------------------------------

_TWIN_CHARACTERS: Final = 200
# What is kept for saying how many rows do not fit.
_LAST_ROW: Final = 60
_HIDDEN: Final = "position:absolute;width:1px;height:1px;overflow:hidden;clip-path:inset(50%);white-space:nowrap"
_MOST_KEPT: Final = 1_000


def paint_twin(graph: GraphView, title: str, room: int) -> str:
    """Paint a graph as tables for screen readers; they also stay where a page strips the picture.

    First the functions, with the stages around them, then the tokens, so many of them as fit in ``room`` characters;
    how many don't is stated.
    """
    functions = [
        _function_row(function, ", ".join(inputs), ", ".join(outputs))
        for (inputs, outputs), function in zip(graph.io(), graph.functions, strict=True)
    ]
    rows = (*map(_stage_row, graph.before), *functions, *map(_stage_row, graph.after))
    start, end = f'<div style="{_HIDDEN}">', "</div>"
    room -= len(start) + len(end)
    first = _twin(title, ("function", "inputs", "outputs", "state"), rows, room)
    second = _twin("Its tokens", ("token", "value", "state"), map(_token_row, graph.tokens), room - size(first))
    return start + first + second + end


def _twin(caption: str, head: Sequence[str], rows: Iterable[str], room: int) -> str:
    start = f"<table><caption>{content(caption)}</caption>{_row('th', head)}"
    room -= size(start) + _LAST_ROW
    kept: list[str] = []
    left_out = 0
    for row in rows:
        room -= len(row.encode())
        if room >= 0 and not left_out:
            kept.append(row)
        else:
            left_out += 1
    more = _row("td", [f"and {left_out} more"]) if left_out else ""
    return f"{start}{''.join(kept)}{more}</table>" if kept else ""


def _twin_row(*cells: str) -> str:
    return _row("td", [content(cut_name(cell, _TWIN_CHARACTERS)) for cell in cells])


@lru_cache(_MOST_KEPT)
def _function_row(function: FunctionView, inputs: str, outputs: str) -> str:
    time = "" if function.duration_ns is None else duration_text(function.duration_ns)
    words = filter(None, (function.state, time, function.message, *function.notes))
    return _twin_row(function.name, inputs, outputs, "; ".join(words))


@lru_cache(_MOST_KEPT)
def _token_row(token: TokenView) -> str:
    role = f"value of {token.delayed!r} in the run before" if token.delayed else token.role
    return _twin_row(token.name, token.preview.detail if token.preview else "", f"{role}, {token.state}")


def _stage_row(stage: StageView) -> str:
    return _twin_row(f"{stage.kind} {stage.name}", "", "", "; ".join(stage_words(stage)))
