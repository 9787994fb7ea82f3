"""What do the annotations of a graph's functions say of a token?"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from epypes.graph.compgraph import CompGraph
from epypes.hints import Param, Roi, annotated_param
from epypes.images import Contracts, Image, Order

_NOTHING: Final[Contracts] = ((), ())


def annotated_params(cg: CompGraph, token: str) -> Iterator[Param | Roi]:
    """Give the hints in the annotations of the functions that take a token, in run order."""
    for function in cg.digraph.consumers.get(token, ()):
        found = annotated_param(cg.functions[function], cg.func_inputs(function).index(token))
        if found is not None:
            yield found


def image_hint(cg: CompGraph, token: str) -> Image | None:
    """Return what is said of a token as an image.

    It is the mark on the output of the function that makes it, else the first one with an order on an input of those
    that take it.
    """
    cg.require_token(token)
    made = _made_as(cg, token)
    if made is not None and made.order is not None:
        return made
    return next((mark for mark in _taken_as(cg, token) if mark.order is not None), made)


def colour_order(cg: CompGraph, token: str) -> Order:
    """Return what three and four channels of a token are: BGR, unless an annotation says otherwise."""
    hint = image_hint(cg, token)
    return (hint and hint.order) or "bgr"


def _made_as(cg: CompGraph, token: str) -> Image | None:
    function = cg.digraph.producer.get(token)
    if function is None:
        return None
    _, made = cg.contracts.get(function, _NOTHING)
    return made[cg.func_outputs(function).index(token)] if made else None


def _taken_as(cg: CompGraph, token: str) -> Iterator[Image]:
    for function in cg.digraph.consumers.get(token, ()):
        taken, _ = cg.contracts.get(function, _NOTHING)
        tokens = cg.func_inputs(function)
        yield from (mark for name, mark in zip(tokens, taken, strict=False) if name == token and mark is not None)
