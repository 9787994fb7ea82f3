"""What is to be seen of a run: which functions ran, how long, what failed, and what is out of date since?"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from epypes.display.durations import duration_text, overhead_text
from epypes.display.views.graphview import FunctionView, GraphView
from epypes.display.views.structure import structure_of, with_caption
from epypes.display.views.tokens import ROOM, Room, token_view, with_run_values
from epypes.run import FunctionTime, Run
from epypes.run.plan import chosen_branches, wanted_steps


def run_structure(run: Run) -> GraphView:
    """Look at a run's graph with the branches that it chose; what ran is not left out, whoever asked for it."""
    program, values = run.tokens.program, run.tokens.values
    wanted = wanted_steps(program, values, ())
    ran = run.report.durations_ns
    left_out = [step.name for step in program.steps if wanted and not wanted[step.place] and step.name not in ran]
    return structure_of(run.cg, chosen_branches(program, values), left_out)


def with_run(
    structure: GraphView,
    run: Run,
    hparams: Mapping[str, Any],
    stale: frozenset[str],
    room: Room = ROOM,
    seen: Sequence[str] = (),
) -> GraphView:
    """Add a run to a graph's structure; ``stale`` are functions out of date since the run.

    If only some of its tokens are ``seen`` at once, these get thumbnails before others.
    """
    steps, report = run.tokens.program.steps, run.report
    stale |= {steps[index].name for index in run.tokens.stale}
    spent = {entry.function: entry for entry in report.functions}
    functions = tuple(
        _function_view(function, run, stale, spent.get(function.name)) for function in structure.functions
    )
    every = [token_view(token, run, hparams, stale) for token in structure.tokens]
    tokens, dropped = with_run_values(every, run, hparams, room, frozenset(seen))
    overhead = f"{overhead_text(report.side_by_side)} {duration_text(report.overhead_ns)}"
    caption = f"{duration_text(report.total_ns)} in all, {overhead}"
    if dropped:
        caption += f"; {dropped} thumbnails left out to keep the picture small"
    return replace(structure, functions=functions, tokens=tokens, caption=with_caption(caption, structure))


def _function_view(function: FunctionView, run: Run, stale: frozenset[str], entry: FunctionTime | None) -> FunctionView:
    name = function.name
    if run.failure and run.failure.function == name:
        message = run.failure.message or run.failure.kind
        return replace(function, state="failed", duration_ns=entry.duration_ns if entry else None, message=message)
    if function.state == "left out":
        return function
    if name in stale:
        made = run.cg.func_outputs(name)
        is_new = made and not any(map(run.tokens.is_computed, made))
        return replace(function, state="not run" if is_new else "stale")
    if entry is None or not entry.ran:
        return replace(function, state="reused")
    share = entry.duration_ns / max(run.report.total_ns, 1)
    return replace(function, state="ran", duration_ns=entry.duration_ns, share=share)
