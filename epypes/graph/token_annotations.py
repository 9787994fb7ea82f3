"""Annotations of tokens: the images and the hyperparameter ranges that functions' annotations declare."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Any

from epypes.errors import Finding
from epypes.graph.bipartite import BipartiteDigraph
from epypes.graph.signature import distinct
from epypes.hints import Param, Roi, annotated_param
from epypes.images import Contracts, Image, contracts_of, is_marked

if TYPE_CHECKING:
    from epypes.graph.compgraph import CompGraph


def annotated_params(cg: CompGraph, token: str) -> Iterator[Param | Roi]:
    """Give the hints in the annotations of the functions that take a token, in run order."""
    for function in cg.digraph.consumers.get(token, ()):
        found = annotated_param(cg.functions[function], cg.func_inputs(function).index(token))
        if found is not None:
            yield found


def read_contracts(functions: Mapping[str, Callable[..., Any]], digraph: BipartiteDigraph) -> dict[str, Contracts]:
    """Return the marks of images in the annotations of functions, by name; functions without any are left out."""
    marked = {key for key, function in distinct(functions).items() if is_marked(function)}
    return {
        name: contracts_of(functions[name], len(tokens), len(digraph.outputs[name]))
        for name, tokens in digraph.inputs.items()
        if id(functions.get(name)) in marked
    }


def check_images(contracts: Mapping[str, Contracts], digraph: BipartiteDigraph) -> Iterable[Finding]:
    """Find tokens that two functions want as images that no image is both."""
    made: dict[str, tuple[str, Image]] = {}
    for name, token, mark, verb in marks_of(contracts, digraph):
        if verb == "makes":
            made[token] = name, mark
        elif token in made and not made[token][1].fits(mark):
            maker, as_made = made[token]
            text = (
                f"Function {maker!r} makes token {token!r} as {as_made}, but {name!r} takes it as {mark}, and no image "
                "is both. Change one of the annotations, or build the graph with types=False."
            )
            yield Finding("types", text, (token, maker, name))


def marks_of(contracts: Mapping[str, Contracts], digraph: BipartiteDigraph) -> Iterator[tuple[str, str, Image, str]]:
    """Give every mark: function, token, mark and ``"makes"`` or ``"takes"``, makers first."""
    for side, verb, tokens_of in ((1, "makes", digraph.outputs), (0, "takes", digraph.inputs)):
        for name, marks in contracts.items():
            for token, mark in zip(tokens_of[name], marks[side], strict=False):
                if mark is not None:
                    yield name, token, mark, verb
