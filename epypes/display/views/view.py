"""The view of a graph, a runner, a run, a plan or a pipeline.

Painters read the frozen GraphView and nothing else, so their colours and labels always agree.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, get_args

from epypes.display.previews.short import reason
from epypes.display.text import (
    CHARACTERS_OF_A_VERTEX,
    MOST_THUMBNAILS,
    THUMBNAIL_CHARACTERS,
    cut,
    duration_text,
    listed,
    overhead_text,
    short_name,
)
from epypes.display.views.graphview import Direction, FunctionView, GraphView, StageView, TokenState
from epypes.display.views.groups import MOST_SHOWN, collapsed, folded, groups_of, outside_tokens, twice_seen
from epypes.display.views.structure import structure_of
from epypes.display.views.tokens import ROOM, HyperparameterValues, Room, token_views
from epypes.errors import UnknownName, run_call
from epypes.graph import CompGraph, names_of
from epypes.run import CompGraphRunner, FunctionTime, Plan, Run
from epypes.run.plan import chosen_branches, wanted_steps
from epypes.wording import counted

# What is left to thumbnails, however many vertices are seen twice.
_LEAST_CHARACTERS: Final = THUMBNAIL_CHARACTERS // 3
_NAMED: Final = 8
_STAGE_KINDS: Final = ("queue", "loop", "function")
_STAGE_STATES: Final = ("static", "running", "stopped", "failed")
_NOTE_CHARACTERS: Final = 200
_MOST_STAGES: Final = 12
_MOST_NOTES: Final = 6


def view(
    shown: Any,
    *,
    direction: Direction = "down",
    thumbnails: int = MOST_THUMBNAILS,
    open: str | Iterable[str] = (),  # noqa: A002 - the word for what is done to a box
    collapse: bool = True,
) -> GraphView:
    """Look at a graph, a runner, a run, a plan or a pipeline; nothing is computed but previews.

    Parameters
    ----------
    shown
        What is looked at.
    direction, thumbnails, open, collapse
        As for ``ep.show``.

    Raises
    ------
    TypeError, ValueError
        An argument is of another kind, or none of these.
    UnknownName
        There is no such group.
    """
    _require_options(direction, thumbnails, collapse)
    cg = _graph_of(shown)
    groups = groups_of(cg.functions, cg.groups)
    grouped = {name for inside in groups.values() for name in inside}
    if len(cg.functions) - len(grouped) + len(groups) > MOST_SHOWN:
        groups |= folded(cg, grouped)
    opened = names_of("open", open)
    for name in opened:
        if name not in groups:
            raise UnknownName("group", name, groups, "in this picture")
    closed = {name: inside for name, inside in groups.items() if collapse and name not in opened}
    characters = THUMBNAIL_CHARACTERS - CHARACTERS_OF_A_VERTEX * twice_seen(cg, closed)
    graph = _whole(shown, Room(thumbnails, max(characters, _LEAST_CHARACTERS)), closed)
    graph = collapsed(graph if graph.direction == direction else replace(graph, direction=direction), closed)
    return graph if graph.draws_edges else _captioned(graph, f"{len(graph.edges):,} edges, too many to be drawn")


def _require_options(direction: object, thumbnails: object, collapse: object) -> None:
    if not isinstance(direction, str) or direction not in get_args(Direction):
        raise ValueError(f'direction must be "down" or "right", not {direction!r:.60}.')
    if isinstance(thumbnails, bool) or not isinstance(thumbnails, int):
        raise TypeError(f"thumbnails must be a number, of how many there are at most, not {thumbnails!r:.60}.")
    if thumbnails < 0:
        raise ValueError(f"thumbnails must be 0 or more, not {thumbnails}.")
    if not isinstance(collapse, bool):
        raise TypeError(f"collapse must be True or False, not {collapse!r:.60}; open=[...] names groups.")


def _graph_of(shown: Any) -> CompGraph:
    """Return the graph of what is shown; raise TypeError if it can't be shown."""
    if isinstance(shown, CompGraph):
        return shown
    if isinstance(shown, CompGraphRunner | Run | Plan):
        return shown.cg
    try:
        runner = shown.runner if hasattr(shown, "name") else None
    except Exception:  # an attribute of a user's class may do anything
        runner = None
    if not isinstance(runner, CompGraphRunner) or isinstance(shown, type):
        text = "What can be shown is a CompGraph, a CompGraphRunner, a Run, a Plan or a Pipeline"
        raise TypeError(f"{text}, not {type(shown).__name__!r}.")
    return runner.cg


def _whole(shown: Any, room: Room, closed: Mapping[str, Sequence[str]]) -> GraphView:
    """Look at all functions; thumbnails that are in closed groups are dropped first."""
    if isinstance(shown, CompGraph):
        # Tokens with a default are shown as the hyperparameters that a runner makes of them.
        structure, hparams = structure_of(shown, {}, ()), HyperparameterValues(shown.defaults)
        return replace(structure, tokens=token_views(structure, hparams, lambda name: "static", room)[0])
    if isinstance(shown, Plan):
        return plan_view(shown, room)
    if isinstance(shown, Run):
        hparams = HyperparameterValues(shown.hyperparameters, shown.first_hyperparameters)
        return _run_view(shown, _run_structure(shown), hparams, frozenset(), room, closed)
    if isinstance(shown, CompGraphRunner):
        return _runner_view(shown, room, closed)
    return _in_pipeline(_runner_view(shown.runner, room, closed), shown)


def _captioned(graph: GraphView, text: str, **changes: Any) -> GraphView:
    """Return a view whose caption begins with this text and goes on with the one that it has."""
    return replace(graph, caption=f"{text}. {graph.caption}" if graph.caption else text, **changes)


# -- runs and runners ----------------------------------------------------------------------------------------------


def _run_structure(run: Run) -> GraphView:
    """Look at a run's graph with the branches that it chose; what ran is not left out, whatever it was asked for."""
    program, values = run.tokens.program, run.tokens.values
    wanted = wanted_steps(program, values, ())
    ran = run.report.durations_ns
    left_out = [step.name for step in program.steps if wanted and not wanted[step.place] and step.name not in ran]
    return structure_of(run.cg, chosen_branches(program, values), left_out)


def _run_view(
    run: Run,
    structure: GraphView,
    hparams: HyperparameterValues,
    stale: frozenset[str],
    room: Room,
    closed: Mapping[str, Sequence[str]],
) -> GraphView:
    """Add a run to a graph's structure; ``stale`` are functions out of date since the run."""
    program, report = run.tokens.program, run.report
    stale |= {program.steps[index].name for index in run.tokens.stale}
    seen = outside_tokens(structure, closed) if closed else ()
    producer = run.cg.digraph.producer

    def state_of(token: str) -> TokenState:
        if not run.tokens.is_computed(token):
            return "not computed"
        if producer.get(token) in stale:
            return "stale"
        return "nothing found" if run.tokens.is_nothing(token) else "fresh"

    tokens, dropped = token_views(structure, hparams, state_of, room, seen, run)
    overhead = f"{overhead_text(report.side_by_side)} {duration_text(report.overhead_ns)}"
    caption = f"{duration_text(report.total_ns)} in all, {overhead}"
    if dropped:
        caption += f"; {dropped} thumbnails left out to keep the picture small"
    functions, edges = _run_functions(run, structure.functions, stale), structure.edges
    if program.has_skipped:
        skipped = {place for place, function in enumerate(functions) if function.state == "skipped"}
        edges = tuple(edge._replace(is_live=edge.is_live and edge.function not in skipped) for edge in edges)
    return _captioned(structure, caption, functions=functions, tokens=tokens, edges=edges)


def _run_functions(run: Run, functions: Iterable[FunctionView], stale: Collection[str]) -> tuple[FunctionView, ...]:
    report, failure = run.report, run.failure
    entries: Mapping[str, FunctionTime] = {entry.function: entry for entry in report.functions}
    total_ns = max(report.total_ns, 1)
    lacking = run.tokens.lacking() if report.skipped else {}
    seen = []
    for function in functions:
        name, entry = function.name, entries.get(function.name)
        if failure and failure.function == name:
            duration_ns, message = entry.duration_ns if entry else None, failure.message or failure.kind
            function = function._replace(state="failed", duration_ns=duration_ns, message=message)
        elif function.state == "left out":
            pass
        elif name in stale:
            made = run.cg.func_outputs(name)
            is_new = made and not any(map(run.tokens.is_computed, made))
            function = function._replace(state="not run" if is_new else "stale")
        elif entry is not None and entry.skipped:
            message = f"{', '.join(map(repr, lacking[name]))}: nothing found"
            function = function._replace(state="skipped", message=message)
        elif entry is None or not entry.ran:
            function = function._replace(state="reused")
        else:
            share = entry.duration_ns / total_ns
            function = function._replace(state="ran", duration_ns=entry.duration_ns, share=share)
        seen.append(function)
    return tuple(seen)


def _runner_view(runner: CompGraphRunner, room: Room, closed: Mapping[str, Sequence[str]]) -> GraphView:
    # First, so that what ends meanwhile shows as running, not as never run.
    running, last, plan = runner.running, runner.last, runner.plan()
    structure = structure_of(plan.cg, plan.branches, plan.left_out)
    hparams = HyperparameterValues(plan.hyperparameters, plan.first_hyperparameters)
    if last is not None:
        graph = _run_view(last, structure, hparams, frozenset(plan.order), room, closed)
    else:
        functions = tuple(
            function if function.state == "left out" else function._replace(state="not run")
            for function in structure.functions
        )
        tokens, _ = token_views(structure, hparams, lambda name: "not computed", room)
        graph = _captioned(structure, "not run yet", functions=functions, tokens=tokens)
    if not running:
        return graph
    functions = tuple(
        each._replace(state="running", message="", duration_ns=None, share=0.0) if each.name in running else each
        for each in graph.functions
    )
    names = listed([short_name(name) for name in running], _NAMED)
    return _captioned(graph, f"running: {names}", functions=functions)


# -- plans ---------------------------------------------------------------------------------------------------------


def plan_view(plan: Plan, room: Room = ROOM) -> GraphView:
    """Look at a plan; hyperparameters may be images, of which so many are shown."""
    structure, missing = structure_of(plan.cg, plan.branches, plan.left_out), frozenset(plan.missing)
    hparams = HyperparameterValues(plan.hyperparameters, plan.first_hyperparameters)
    tokens, _ = token_views(
        structure, hparams, lambda name: "missing" if name in missing else "static", room, plan.targets
    )
    functions = tuple(_planned_view(function, plan) for function in structure.functions)
    return _captioned(structure, _plan_caption(plan), functions=functions, tokens=tokens)


def _planned_view(function: FunctionView, plan: Plan) -> FunctionView:
    name = function.name
    if function.state == "left out":
        return function._replace(
            message="not needed for these targets" if plan.targets else "only for a branch that is not chosen"
        )
    if name in plan.placeholders:
        return function._replace(state="missing", message="still to be written; ep.extend fills it")
    if name in plan.why:
        return function._replace(state="planned", message=plan.why[name])
    return function._replace(state="reused", message="up to date")


def _plan_caption(plan: Plan) -> str:
    placeholders = len(plan.placeholders)
    parts = [f"{counted(len(plan.order) - placeholders, 'function')} to run, {len(plan.reused)} reused"]
    if plan.left_out:
        parts.append(f"{len(plan.left_out)} left out")
    if placeholders:
        parts.append(f"{placeholders} still to be written")
    text = ", ".join(parts)
    if plan.targets:
        text += f"; asked for: {listed(plan.targets, _NAMED)}"
    if plan.missing:
        text += f"; missing: {listed(plan.missing, _NAMED)}: call {run_call(plan.missing[:_NAMED])}"
    return text


# -- pipelines -----------------------------------------------------------------------------------------------------


def _in_pipeline(graph: GraphView, pipeline: Any) -> GraphView:
    """Return the view of a pipeline's graph with the frame and the stages around it.

    Stages that can't be had are left out: they come from properties that users may override.
    """
    title = str(pipeline.name) or "pipeline"
    try:
        stages = pipeline.stages
        before, after = _stage_views(stages.before), _stage_views(stages.after)
    except Exception as error:
        caption = f"its stages can't be read: {reason(error, _NOTE_CHARACTERS)}"
        return replace(graph, title=title, caption=". ".join(filter(None, (graph.caption, caption))))
    return replace(graph, title=title, before=before, after=after)


def _stage_views(stages: Sequence[Any]) -> tuple[StageView, ...]:
    return tuple(
        StageView(
            stage.kind if stage.kind in _STAGE_KINDS else "function",
            cut(str(stage.name), _NOTE_CHARACTERS),
            stage.state if stage.state in _STAGE_STATES else "static",
            tuple(cut(str(note), _NOTE_CHARACTERS) for note in tuple(stage.notes)[:_MOST_NOTES]),
        )
        for stage in stages[:_MOST_STAGES]
    )
