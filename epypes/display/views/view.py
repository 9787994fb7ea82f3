"""The view of a graph, a runner, a run, a plan or a pipeline.

Painters read the frozen GraphView and nothing else, so their colours and labels always agree.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, get_args

from epypes.display.previews.images import is_image
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
from epypes.display.views.graphview import Direction, FunctionView, GraphView, GroupView, StageView, TokenState
from epypes.display.views.groups import MOST_SHOWN, collapsed, folded, groups_of, outside_tokens, twice_seen
from epypes.display.views.pipelines import Inside, insides_of
from epypes.display.views.pipelines import opened as with_inside
from epypes.display.views.structure import structure_of
from epypes.display.views.tokens import ROOM, HyperparameterValues, Room, token_views
from epypes.errors import InvalidType, InvalidValue, UnknownName, run_call
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
    depth: int = 0,
) -> GraphView:
    """Look at a graph, a runner, a run, a plan or a pipeline; nothing is computed but previews.

    Parameters
    ----------
    shown
        What is looked at.
    direction, thumbnails, open, collapse, depth
        As for ``ep.show``.

    Raises
    ------
    TypeError, ValueError
        An argument is of another kind, or none of these.
    UnknownName
        There is no such group, and no such pipeline.
    """
    _require_options(direction, thumbnails, collapse, depth)
    cg = _graph_of(shown)
    groups = groups_of(cg.functions, cg.groups)
    grouped = {name for inside in groups.values() for name in inside}
    if len(cg.functions) - len(grouped) + len(groups) > MOST_SHOWN:
        groups |= folded(cg, grouped)
    opened, pipelines = names_of("open", open), {inside.name: inside for inside in _insides(shown)}
    for name in opened:
        if name not in groups and name not in pipelines:
            kind = "group or pipeline" if pipelines else "group"
            raise UnknownName(kind, name, (*groups, *pipelines), "in this picture")
    closed = {name: inside for name, inside in groups.items() if collapse and name not in opened}
    characters = THUMBNAIL_CHARACTERS - CHARACTERS_OF_A_VERTEX * twice_seen(cg, closed)
    room = Room(thumbnails, max(characters, _LEAST_CHARACTERS))
    to_open = [name for name in pipelines if _is_open(name, pipelines[name], opened, depth)]
    to_open = [name for name in to_open if not any(name in inside for inside in closed.values())]
    part = Room(thumbnails, room.characters // (len(to_open) + 1))
    graph = _whole(shown, part, closed)
    for name in to_open:
        graph = with_inside(graph, pipelines[name], _inside_view(shown, pipelines[name], part))
    drawn = [frame.name for frame in graph.frames]
    graph = collapsed(graph if graph.direction == direction else replace(graph, direction=direction), closed)
    if pipelines:
        graph = _with_closed(shown, graph, [inside for name, inside in pipelines.items() if name not in drawn], room)
    return graph if graph.draws_edges else _captioned(graph, f"{len(graph.edges):,} edges, too many to be drawn")


def _require_options(direction: object, thumbnails: object, collapse: object, depth: object) -> None:
    if not isinstance(direction, str) or direction not in get_args(Direction):
        raise InvalidValue(f'direction must be "down" or "right", not {direction!r:.60}.')
    if isinstance(thumbnails, bool) or not isinstance(thumbnails, int):
        raise InvalidType(f"thumbnails must be a number, of how many there are at most, not {thumbnails!r:.60}.")
    if thumbnails < 0:
        raise InvalidValue(f"thumbnails must be 0 or more, not {thumbnails}.")
    if not isinstance(collapse, bool):
        raise InvalidType(f"collapse must be True or False, not {collapse!r:.60}; open=[...] names groups.")
    if isinstance(depth, bool) or not isinstance(depth, int) or depth < 0:
        raise InvalidValue(f"depth is how many levels of pipelines are drawn open, 0 or more, not {depth!r:.60}.")


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
        text = "ep.show() draws a CompGraph, a CompGraphRunner, a Run, a Plan or a Pipeline"
        way_out = " An image is in the picture of its run: ep.show(runner.run(...))." * is_image(shown)
        raise InvalidType(f"{text}, not {type(shown).__name__!r}.{way_out}")
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


# -- what is inside pipelines ---------------------------------------------------------------------------------------


def _insides(shown: Any) -> Iterator[Inside]:
    if isinstance(shown, CompGraph):
        yield from insides_of(shown, {}, {}, None)
    elif isinstance(shown, Run):
        yield from insides_of(shown.cg, shown.hyperparameters, shown.first_hyperparameters, shown.tokens)
    elif isinstance(shown, Plan):
        yield from insides_of(shown.cg, shown.hyperparameters, shown.first_hyperparameters, None)
    else:
        runner = shown if isinstance(shown, CompGraphRunner) else shown.runner
        yield from insides_of(runner.cg, runner.hyperparameters, runner.first_hyperparameters, runner.tokens_now)


def _is_open(name: str, inside: Inside, opened: Collection[str], depth: int) -> bool:
    return inside.depth < depth or any(each == name or each.startswith(f"{name}__") for each in opened)


def _inside_view(shown: Any, inside: Inside, room: Room) -> GraphView:
    """Look at what is inside a pipeline."""
    hparams, run = HyperparameterValues(inside.values, inside.first), inside.run
    if run is None or inside.tokens is None:
        structure = structure_of(inside.runner.cg, {}, ())
        is_static = isinstance(shown, CompGraph | Plan)
        tokens, _ = token_views(structure, hparams, lambda _: "static" if is_static else "not computed", room)
        if is_static:
            return replace(structure, tokens=tokens)
        functions = tuple(function._replace(state="not run") for function in structure.functions)
        return replace(structure, functions=functions, tokens=tokens)
    steps = inside.tokens.program.steps
    stale = frozenset(steps[place].name for place in inside.tokens.stale)
    graph = _run_view(run, _run_structure(run), hparams, stale, room, {})
    return _running(graph, inside.runner.running) if isinstance(shown, CompGraphRunner) else graph


def _with_closed(shown: Any, graph: GraphView, closed: Sequence[Inside], room: Room) -> GraphView:
    """Add what is inside pipelines that are drawn closed, with thumbnails as far as the picture has left room."""
    seen = {function.name for part in (graph, *(group.graph for group in graph.groups)) for function in part.functions}
    closed = [inside for inside in closed if inside.name in seen]
    if not closed:
        return graph
    shown_now = [token.preview.picture for token in graph.tokens if token.preview is not None]
    left = room.characters - sum(len(picture.data) * 4 // 3 for picture in shown_now if picture is not None)
    part = Room(room.thumbnails, max(left, 0) // len(closed))
    views = ((inside.name, _inside_view(shown, inside, part)) for inside in closed)
    more = tuple(GroupView(name, replace(inner, direction=graph.direction)) for name, inner in views)
    return replace(graph, groups=(*graph.groups, *more))


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
            duration_ns, message = entry.duration_ns if entry else None, failure_text(run)
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


def failure_text(run: Run) -> str:
    """Return the message of a run's failure; of one inside a pipeline, after the name of the function that failed."""
    failure = run.failure
    if failure is None:
        return ""
    inner = run.nested.get(failure.function)
    text = failure_text(inner) if inner is not None else ""
    if inner is not None and inner.failure is not None and text:
        return f"{inner.failure.function}: {text}"
    return failure.message or failure.kind


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
    return _running(graph, running)


def _running(graph: GraphView, running: Collection[str]) -> GraphView:
    """Mark the functions that are being run at this moment."""
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
