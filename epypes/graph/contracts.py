"""What do annotations say of a graph's images, and do the functions agree?"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

from epypes.errors import Finding
from epypes.graph.bipartite import BipartiteDigraph
from epypes.graph.checks import distinct
from epypes.images import Contracts, Image, Order, contracts_of, is_marked


def read_contracts(functions: Mapping[str, Callable[..., Any]], graph: BipartiteDigraph) -> dict[str, Contracts]:
    """Return what the annotations of functions say of the images that they take and make, by name.

    Functions that say nothing are left out.
    """
    marked = {key for key, function in distinct(functions).items() if is_marked(function)}
    if not marked:
        return {}
    return {
        name: contracts_of(functions[name], len(tokens), len(graph.outputs[name]))
        for name, tokens in graph.inputs.items()
        if id(functions.get(name)) in marked
    }


def check_colours(contracts: Mapping[str, Contracts], graph: BipartiteDigraph) -> Iterable[Finding]:
    """Find tokens that two functions want in different orders of colours."""
    said: dict[str, tuple[str, str, Order]] = {}
    for name, token, mark, verb in _marks(contracts, graph):
        if mark.order is None:
            continue
        other, other_verb, order = said.setdefault(token, (name, verb, mark.order))
        if order != mark.order:
            yield _disagreement(token, (other, other_verb, order), (name, verb, mark.order))


def check_images(contracts: Mapping[str, Contracts], graph: BipartiteDigraph) -> Iterable[Finding]:
    """Find tokens that one function makes as an image that another one can't take."""
    made: dict[str, tuple[str, Image]] = {}
    for name, token, mark, verb in _marks(contracts, graph):
        if verb == "makes":
            made[token] = name, mark
            continue
        maker, as_made = made.get(token, ("", mark))
        if not as_made.fits(mark):
            text = (
                f"Function {maker!r} makes token {token!r} as {as_made}, but {name!r} takes it as {mark}, and no image "
                "is both. Change one of the annotations, or build the graph with types=False."
            )
            yield Finding("types", text, (token, maker, name))


def _marks(contracts: Mapping[str, Contracts], graph: BipartiteDigraph) -> Iterator[tuple[str, str, Image, str]]:
    """Give every mark: function, token, mark and ``"makes"`` or ``"takes"``, makers first."""
    for side, (verb, tokens_of) in ((1, ("makes", graph.outputs)), (0, ("takes", graph.inputs))):
        for name, said in contracts.items():
            for token, mark in zip(tokens_of[name], said[side], strict=False):
                if mark is not None:
                    yield name, token, mark, verb


def _disagreement(token: str, one: tuple[str, str, Order], two: tuple[str, str, Order]) -> Finding:
    (first, first_verb, first_order), (second, second_verb, second_order) = one, two
    place = "between them" if first_verb == "makes" else f"before {second!r}"
    text = (
        f"Function {first!r} {first_verb} token {token!r} as {first_order}, but {second!r} {second_verb} it as "
        f"{second_order}. Convert it in a function {place}: "
        f"cv2.cvtColor({token}, cv2.COLOR_{first_order.upper()}2{second_order.upper()})."
    )
    return Finding("colour", text, (token, first, second))
