"""Pipelines in a graph: what is inside them, in a frame in the picture of the graph or as a picture of its own."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, TypeVar

from epypes.display.views.graphview import EdgeView, FrameView, FunctionView, GraphView, TokenView
from epypes.graph import CompGraph
from epypes.run import CompGraphRunner, Run
from epypes.run.nested import tokens_inside
from epypes.run.program import RUNNER
from epypes.run.staleness import TokenManager

# Between the name of a pipeline and what is inside, as in ``rerun(geometry__threshold=2)``.
_WITHIN: Final = "__"

View = TypeVar("View", FunctionView, TokenView)


@dataclass(frozen=True, slots=True)
class Inside:
    """A pipeline in a graph.

    Attributes
    ----------
    name
        That of its function; in a pipeline, after that one's: ``"geometry__pose"``.
    depth
        In how many pipelines it is.
    inputs, outputs
        The tokens around it that it takes and makes, by their names in the picture.
    runner
        The pipeline's own.
    tokens
        The tokens inside as they are to be read now; None if nothing has been run.
    run
        The last run inside.
    values, first
        Hyperparameters by token.
    """

    name: str
    depth: int
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    runner: CompGraphRunner
    tokens: TokenManager | None
    run: Run | None
    values: Mapping[str, Any]
    first: Mapping[str, Any]

    @property
    def ends(self) -> dict[str, str]:
        """The tokens inside that are those around it, by name; empty if its values are not tokens of their own."""
        sources, sinks = self.runner.free_source_tokens, self.runner.cg.sink_tokens
        if len(sources) != len(self.inputs) or len(sinks) != len(self.outputs):
            return {}
        return dict(zip((*sources, *sinks), (*self.inputs, *self.outputs), strict=True))

    def shown(self, token: str) -> str:
        """Return what a token inside is called in the picture."""
        return self.ends.get(token, f"{self.name}{_WITHIN}{token}")


def insides_of(
    cg: CompGraph,
    values: Mapping[str, Any],
    first: Mapping[str, Any],
    now: TokenManager | None,
    around: Inside | None = None,
) -> Iterator[Inside]:
    """Give the pipelines in a graph, and those inside them.

    Parameters
    ----------
    values, first
        All hyperparameters of the graph by token.
    now
        The tokens of the graph; None without a run.
    around
        The pipeline that has this graph.
    """
    for function, made in cg.functions.items():
        if not hasattr(type(made), RUNNER):
            continue
        runner: CompGraphRunner = getattr(made, RUNNER)
        names = {token: f"{function}{_WITHIN}{token}" for token in runner.hyperparameters}
        own, own_first = runner.hyperparameters, runner.first_hyperparameters
        inner_values = {token: values.get(name, own[token]) for token, name in names.items()}
        inner_first = {token: first.get(name, own_first.get(token)) for token, name in names.items()}
        found = tokens_inside(now, function) if now is not None else None
        run, tokens = found if found is not None else (None, None)
        inputs, outputs = cg.func_inputs(function), cg.func_outputs(function)
        if around is None:
            inside = Inside(function, 0, inputs, outputs, runner, tokens, run, inner_values, inner_first)
        else:
            name = f"{around.name}{_WITHIN}{function}"
            inputs, outputs = tuple(map(around.shown, inputs)), tuple(map(around.shown, outputs))
            inside = Inside(name, around.depth + 1, inputs, outputs, runner, tokens, run, inner_values, inner_first)
        yield inside
        yield from insides_of(runner.cg, inner_values, inner_first, tokens, inside)


def opened(graph: GraphView, inside: Inside, inner: GraphView) -> GraphView:
    """Draw what is inside a pipeline in its place, in a frame; as it is if its values are not tokens of their own."""
    names = [function.name for function in graph.functions]
    ends = inside.ends
    if inside.name not in names or not ends:
        return graph
    at, more = names.index(inside.name), len(inner.functions) - 1
    place = {token.name: index for index, token in enumerate(graph.tokens)}
    kept = [token for token in inner.tokens if token.name not in ends]
    at_token = {token.name: len(graph.tokens) + index for index, token in enumerate(kept)}
    at_token |= {token: place[end] for token, end in ends.items()}
    functions = tuple(_inner(function, inside.name) for function in inner.functions)
    tokens = tuple(_inner(token, inside.name) for token in kept)
    edges = {
        edge._replace(function=edge.function + more if edge.function > at else edge.function)
        for edge in graph.edges
        if edge.function != at
    }
    edges |= {
        EdgeView(at + edge.function, at_token[inner.tokens[edge.token].name], edge.is_input, edge.is_live)
        for edge in inner.edges
    }
    delays = tuple((inside.shown(token), inside.shown(to)) for token, to in inner.delays)
    frame = FrameView(inside.name, tuple(each.name for each in functions), tuple(each.name for each in tokens))
    around = tuple(_grown(each, frame) if inside.name in each.function_names else each for each in graph.frames)
    return replace(
        graph,
        functions=(*graph.functions[:at], *functions, *graph.functions[at + 1 :]),
        tokens=(*graph.tokens, *tokens),
        edges=tuple(sorted(edges, key=lambda edge: (edge.function, not edge.is_input, edge.token))),
        delays=(*graph.delays, *delays),
        frames=(*around, frame),
    )


def _inner(view: View, name: str) -> View:
    return view._replace(name=f"{name}{_WITHIN}{view.name}", label=view.name)


def _grown(frame: FrameView, inner: FrameView) -> FrameView:
    functions: Collection[str] = [name for name in frame.function_names if name != inner.name]
    return FrameView(frame.name, (*functions, *inner.function_names), (*frame.token_names, *inner.token_names))
