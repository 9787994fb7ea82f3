"""What is to be seen of a graph, a runner, a run or a plan, whoever paints it?

Painters read the frozen GraphView and nothing else, so their colours and labels always agree.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import Any, Final

from epypes.display.graphview import FunctionView, GraphView, TokenState, TokenView
from epypes.display.preview import preview
from epypes.display.structure import structure_of
from epypes.errors import run_call
from epypes.graph import CompGraph
from epypes.run import CompGraphRunner, FunctionTime, Plan, Run
from epypes.run.need import chosen_branches, wanted_steps

Shown = CompGraph | CompGraphRunner | Run | Plan

# Base64 makes four characters of three bytes; together the thumbnails of one picture take at most this many.
THUMBNAIL_CHARACTERS: Final = 80_000
_NAMED: Final = 8


def view(shown: Shown) -> GraphView:
    """Look at a graph, a runner, a run or a plan; nothing is computed but previews."""
    if isinstance(shown, CompGraph):
        return _graph_view(shown)
    if isinstance(shown, CompGraphRunner):
        return _runner_view(shown)
    if isinstance(shown, Plan):
        return _plan_view(shown)
    return _with_run(_run_structure(shown), shown, shown.hyperparameters, frozenset())


def _graph_view(cg: CompGraph) -> GraphView:
    """Look at a graph; tokens with a default are shown as the hyperparameters that a runner makes of them."""
    structure = structure_of(cg, {}, ())
    every = [_valueless_view(token, cg.defaults, "static") for token in structure.tokens]
    tokens, _ = within_budget(every, ())
    return replace(structure, tokens=tokens)


def _runner_view(runner: CompGraphRunner) -> GraphView:
    last, plan = runner.last, runner.plan()
    structure = structure_of(plan.cg, plan.branches, plan.left_out)
    if last is not None:
        return _with_run(structure, last, plan.hyperparameters, frozenset(plan.order))
    functions = tuple(
        function if function.state == "left out" else replace(function, state="not run")
        for function in structure.functions
    )
    tokens = tuple(_valueless_view(token, plan.hyperparameters, "not computed") for token in structure.tokens)
    return replace(structure, functions=functions, tokens=tokens, caption=_caption("not run yet", structure))


def _run_structure(run: Run) -> GraphView:
    """Look at a run's graph with the branches that it chose; what ran is not left out, whoever asked for it."""
    program, values = run.tokens.program, run.tokens.values
    wanted = wanted_steps(program, values, ())
    ran = run.report.durations_ns
    left_out = [step.name for step in program.steps if wanted and not wanted[step.place] and step.name not in ran]
    return structure_of(run.cg, chosen_branches(program, values), left_out)


def _with_run(structure: GraphView, run: Run, hparams: Mapping[str, Any], stale: frozenset[str]) -> GraphView:
    """Add a run to a graph's structure; ``stale`` are functions out of date since the run."""
    steps, report = run.tokens.program.steps, run.report
    stale |= {steps[index].name for index in run.tokens.stale}
    spent = {entry.function: entry for entry in report.functions}
    functions = tuple(
        _function_view(function, run, stale, spent.get(function.name)) for function in structure.functions
    )
    every = [_token_view(token, run, hparams, stale) for token in structure.tokens]
    tokens, dropped = within_budget(every, run.cg.sink_tokens)
    overhead = f"{overhead_text(report.side_by_side)} {duration_text(report.overhead_ns)}"
    caption = f"{duration_text(report.total_ns)} in all, {overhead}"
    if dropped:
        caption += f"; {dropped} thumbnails left out to keep the picture small"
    return replace(structure, functions=functions, tokens=tokens, caption=_caption(caption, structure))


def _function_view(function: FunctionView, run: Run, stale: frozenset[str], entry: FunctionTime | None) -> FunctionView:
    name = function.name
    if run.failure and run.failure.function == name:
        message = run.failure.message or type(run.failure.exception).__name__
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


def _token_view(token: TokenView, run: Run, hparams: Mapping[str, Any], stale: frozenset[str]) -> TokenView:
    if token.name in hparams or not run.tokens.is_computed(token.name):
        return _valueless_view(token, hparams, "not computed")
    value = run.tokens.values[run.tokens.program.slots[token.name]]
    is_old = run.cg.digraph.producer.get(token.name) in stale
    return replace(_in_state(token, "stale" if is_old else "fresh"), preview=preview(value, token.order))


def _valueless_view(token: TokenView, hparams: Mapping[str, Any], state: TokenState) -> TokenView:
    """Look at a token of which only a hyperparameter's value is known; any other has this state."""
    if token.name not in hparams:
        return _in_state(token, state)
    token = replace(_in_state(token, "fresh"), role="hyperparameter")
    return replace(token, preview=preview(hparams[token.name], token.order))


def _in_state(token: TokenView, state: TokenState) -> TokenView:
    """Return a token in this state, unless it is left out."""
    return token if token.state == "left out" else replace(token, state=state)


def _caption(text: str, structure: GraphView) -> str:
    return f"{text}. {structure.caption}" if structure.caption else text


def _plan_view(plan: Plan) -> GraphView:
    structure = structure_of(plan.cg, plan.branches, plan.left_out)
    functions = tuple(_planned_view(function, plan) for function in structure.functions)
    missing = frozenset(plan.missing)
    every = [
        _valueless_view(token, plan.hyperparameters, "missing" if token.name in missing else "static")
        for token in structure.tokens
    ]
    tokens, _ = within_budget(every, plan.targets)
    return replace(structure, functions=functions, tokens=tokens, caption=_caption(_plan_caption(plan), structure))


def _planned_view(function: FunctionView, plan: Plan) -> FunctionView:
    name = function.name
    if function.state == "left out":
        message = "not needed for these targets" if plan.targets else "only for a branch that is not chosen"
        return replace(function, message=message)
    if name in plan.placeholders:
        return replace(function, state="missing", message="still to be written; ep.extend fills it")
    if name in plan.why:
        return replace(function, state="planned", message=plan.why[name])
    return replace(function, state="reused", message="up to date")


def _plan_caption(plan: Plan) -> str:
    placeholders = len(plan.placeholders)
    to_run = len(plan.order) - placeholders
    parts = [f"{to_run} function{'s' * (to_run != 1)} to run, {len(plan.reused)} reused"]
    if plan.left_out:
        parts.append(f"{len(plan.left_out)} left out")
    if placeholders:
        parts.append(f"{placeholders} still to be written")
    text = ", ".join(parts)
    if plan.targets:
        text += f"; asked for: {_some(plan.targets)}"
    if plan.missing:
        text += f"; missing: {_some(plan.missing)}: call {run_call(plan.missing[:_NAMED])}"
    return text


def _some(names: tuple[str, ...]) -> str:
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    return ", ".join(names[:_NAMED]) + more


def within_budget(tokens: list[TokenView], first: Iterable[str]) -> tuple[tuple[TokenView, ...], int]:
    """Drop thumbnails until the rest fit; those of ``first`` are kept longest, then the others in order.

    Returns
    -------
    tuple
        The tokens, and how many thumbnails were dropped.
    """
    important = set(first)
    spent = dropped = 0
    kept: dict[str, TokenView] = {}
    for token in sorted(tokens, key=lambda token: token.name not in important):
        picture = token.preview.picture if token.preview else None
        size = len(picture.data) * 4 // 3 + 100 if picture else 0
        if token.preview and picture and spent + size > THUMBNAIL_CHARACTERS:
            dropped += 1
            token = replace(token, preview=replace(token.preview, picture=None))
        else:
            spent += size
        kept[token.name] = token
    return tuple(kept[token.name] for token in tokens), dropped


def overhead_text(side_by_side: bool) -> str:
    """Return what graph overhead is called; where functions ran side by side it is another quantity."""
    return "graph overhead (wall time less critical path)" if side_by_side else "graph overhead"


def duration_text(duration_ns: int) -> str:
    """Return a duration with its unit, to three digits.

    Examples
    --------
    >>> duration_text(5_230_000), duration_text(740)
    ('5.23 ms', '740 ns')
    """
    for limit, unit in ((1e9, "s"), (1e6, "ms"), (1e3, "µs")):
        if abs(duration_ns) >= limit:
            return f"{duration_ns / limit:.3g} {unit}"
    return f"{duration_ns} ns"
