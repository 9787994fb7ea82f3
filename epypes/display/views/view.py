"""What is to be seen of a graph, a runner, a run, a plan or a pipeline, whoever paints it?

Painters read the frozen GraphView and nothing else, so their colours and labels always agree.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final, get_args

from epypes.display.limits import CHARACTERS_OF_A_VERTEX, MOST_THUMBNAILS, THUMBNAIL_CHARACTERS
from epypes.display.views.graphview import Direction, GraphView
from epypes.display.views.groups import collapsed, groups_of, outside_tokens, twice_seen
from epypes.display.views.pipelines import PipelineLike, in_pipeline
from epypes.display.views.plans import plan_view
from epypes.display.views.runs import run_structure, with_run
from epypes.display.views.states import with_first, with_running
from epypes.display.views.structure import structure_of, with_caption
from epypes.display.views.tokens import Room, valueless_view, with_values
from epypes.errors import UnknownName
from epypes.graph import CompGraph, names_of
from epypes.run import CompGraphRunner, Plan, Run

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
