"""Which states of a graph can be told only beside its runs: what is being run, what has changed since it was made?"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, Protocol, get_args

from epypes.display.previews.preview import preview
from epypes.display.previews.short import reason
from epypes.display.text import (
    CHARACTERS_OF_A_VERTEX,
    MOST_THUMBNAILS,
    THUMBNAIL_CHARACTERS,
    cut,
    duration_text,
    overhead_text,
    short_name,
)
from epypes.display.views.graphview import Direction, FunctionView, GraphView, StageView, TokenView
from epypes.display.views.groups import collapsed, groups_of, outside_tokens, twice_seen
from epypes.display.views.structure import structure_of, with_caption
from epypes.display.views.tokens import ROOM, Room, token_view, valueless_view, with_run_values, with_values
from epypes.errors import UnknownName, run_call
from epypes.graph import CompGraph
from epypes.graph.renaming import names_of
from epypes.run import CompGraphRunner, FunctionTime, Plan, Run
from epypes.run.need import chosen_branches, wanted_steps
from epypes.run.tokens import is_same_value
from epypes.wording import counted

_NAMED: Final = 8


def with_running(graph: GraphView, running: Collection[str]) -> GraphView:
    """Return a view in which these functions are being run."""
    if not running:
        return graph
    functions = tuple(
        replace(function, state="running", message="", duration_ns=None, share=0.0)
        if function.name in running
        else function
        for function in graph.functions
    )
    more = f" and {len(running) - _NAMED} more" * (len(running) > _NAMED)
    named = ", ".join(map(short_name, list(running)[:_NAMED])) + more
    return replace(graph, functions=functions, caption=with_caption(f"running: {named}", graph))


def with_first(graph: GraphView, values: Mapping[str, Any], first: Mapping[str, Any]) -> GraphView:
    """Return a view in which hyperparameters that have another value than their first one tell that."""
    changed = {
        token: first[token]
        for token, value in values.items()
        if token in first and first[token] is not value and not is_same_value(first[token], value)
    }
    if not changed:
        return graph
    return replace(graph, tokens=tuple(_with_first(token, changed) for token in graph.tokens))


def _with_first(token: TokenView, changed: Mapping[str, Any]) -> TokenView:
    if token.name not in changed:
        return token
    return replace(token, first=preview(changed[token.name], token.order).text)


_KINDS: Final = ("queue", "loop", "function")
_STATES: Final = ("static", "running", "stopped", "failed")
_NOTE_CHARACTERS: Final = 200
_MOST_STAGES: Final = 12
_MOST_NOTES: Final = 6


class PipelineLike(Protocol):
    """What is shown of a pipeline."""

    @property
    def name(self) -> str:
        """Stands on the frame."""

    @property
    def runner(self) -> CompGraphRunner:
        """Is shown inside the frame."""

    @property
    def stages(self) -> Any:
        """Has ``before`` and ``after``: records with kind, name, state and notes."""


def in_pipeline(graph: GraphView, pipeline: PipelineLike) -> GraphView:
    """Return the view of a pipeline's graph with the frame and the stages around it.

    Stages that can't be had are left out: they come from properties that users may override.
    """
    title = str(pipeline.name) or "pipeline"
    try:
        stages = pipeline.stages
        before, after = _stage_views(stages.before), _stage_views(stages.after)
    except Exception as error:
        caption = f"its stages can't be told: {reason(error, _NOTE_CHARACTERS)}"
        return replace(graph, title=title, caption=". ".join(filter(None, (graph.caption, caption))))
    return replace(graph, title=title, before=before, after=after)


def _stage_views(stages: Sequence[Any]) -> tuple[StageView, ...]:
    return tuple(
        StageView(
            _one_of(stage.kind, _KINDS, "function"),
            cut(str(stage.name), _NOTE_CHARACTERS),
            _one_of(stage.state, _STATES, "static"),
            _notes(stage.notes),
        )
        for stage in stages[:_MOST_STAGES]
    )


def _one_of(word: Any, known: Sequence[Any], otherwise: Any) -> Any:
    return word if word in known else otherwise


def _notes(notes: Iterable[Any]) -> tuple[str, ...]:
    return tuple(cut(str(note), _NOTE_CHARACTERS) for note in tuple(notes)[:_MOST_NOTES])


def plan_view(plan: Plan, room: Room = ROOM) -> GraphView:
    """Look at a plan; hyperparameters may be images, of which so many are shown."""
    structure = structure_of(plan.cg, plan.branches, plan.left_out)
    functions = tuple(_planned_view(function, plan) for function in structure.functions)
    missing = frozenset(plan.missing)
    every = [
        valueless_view(token, plan.hyperparameters, "missing" if token.name in missing else "static")
        for token in structure.tokens
    ]
    tokens, _ = with_values(every, plan.hyperparameters, plan.targets, room)
    return replace(structure, functions=functions, tokens=tokens, caption=with_caption(_plan_caption(plan), structure))


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
    parts = [f"{counted(to_run, 'function')} to run, {len(plan.reused)} reused"]
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


# What is left to thumbnails, however many vertices are seen twice.
_LEAST_CHARACTERS: Final = THUMBNAIL_CHARACTERS // 3

Shown = CompGraph | CompGraphRunner | Run | Plan | PipelineLike


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
    opened = names_of("open", open)
    for name in opened:
        if name not in groups:
            raise UnknownName("group", name, groups, "in this picture")
    closed = {name: inside for name, inside in groups.items() if collapse and name not in opened}
    characters = THUMBNAIL_CHARACTERS - CHARACTERS_OF_A_VERTEX * twice_seen(cg, closed)
    whole = _whole(shown, Room(thumbnails, max(characters, _LEAST_CHARACTERS)), closed)
    graph = collapsed(replace(whole, direction=direction), closed)
    if graph.draws_edges:
        return graph
    return replace(graph, caption=with_caption(f"{len(graph.edges):,} edges, too many to be drawn", graph))


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


def _whole(shown: Shown, room: Room, closed: Mapping[str, Sequence[str]]) -> GraphView:
    """Look at all functions; thumbnails that are in closed groups are dropped first."""
    if isinstance(shown, CompGraph):
        return _graph_view(shown, room)
    if isinstance(shown, CompGraphRunner):
        return _runner_view(shown, room, closed)
    if isinstance(shown, Plan):
        return with_first(plan_view(shown, room), shown.hyperparameters, shown.first_hyperparameters)
    if isinstance(shown, Run):
        return _run_view(shown, room, closed)
    return in_pipeline(_runner_view(shown.runner, room, closed), shown)


def _run_view(run: Run, room: Room, closed: Mapping[str, Sequence[str]]) -> GraphView:
    structure = run_structure(run)
    graph = with_run(structure, run, run.hyperparameters, frozenset(), room, _seen(structure, closed))
    return with_first(graph, run.hyperparameters, run.first_hyperparameters)


def _seen(structure: GraphView, closed: Mapping[str, Sequence[str]]) -> Sequence[str]:
    if not closed:
        return ()
    outside = outside_tokens(structure, closed)
    return [token.name for token in structure.tokens if token.name in outside]


def _graph_view(cg: CompGraph, room: Room) -> GraphView:
    """Look at a graph; tokens with a default are shown as the hyperparameters that a runner makes of them."""
    structure = structure_of(cg, {}, ())
    every = [valueless_view(token, cg.defaults, "static") for token in structure.tokens]
    tokens, _ = with_values(every, cg.defaults, (), room)
    return replace(structure, tokens=tokens)


def _runner_view(runner: CompGraphRunner, room: Room, closed: Mapping[str, Sequence[str]]) -> GraphView:
    # First, so that what ends meanwhile shows as running, not as never run.
    running, last, plan = runner.running, runner.last, runner.plan()
    graph = _between_runs(last, plan, room, closed)
    return with_running(with_first(graph, plan.hyperparameters, plan.first_hyperparameters), running)


def _between_runs(last: Run | None, plan: Plan, room: Room, closed: Mapping[str, Sequence[str]]) -> GraphView:
    structure = structure_of(plan.cg, plan.branches, plan.left_out)
    if last is not None:
        seen = _seen(structure, closed)
        return with_run(structure, last, plan.hyperparameters, frozenset(plan.order), room, seen)
    functions = tuple(
        function if function.state == "left out" else replace(function, state="not run")
        for function in structure.functions
    )
    every = [valueless_view(token, plan.hyperparameters, "not computed") for token in structure.tokens]
    tokens, _ = with_values(every, plan.hyperparameters, (), room)
    return replace(structure, functions=functions, tokens=tokens, caption=with_caption("not run yet", structure))
