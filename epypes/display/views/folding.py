"""Folding of a graph that is too large for a page, where neither ``ep.group`` nor names say what belongs together."""

from __future__ import annotations

from collections.abc import Collection
from itertools import accumulate
from typing import Final

from epypes.graph import CompGraph

# The functions of a large graph become so many boxes, roughly.
_BOXES: Final = 10


def folded(cg: CompGraph, grouped: Collection[str]) -> dict[str, tuple[str, ...]]:
    """Return groups of the functions that are in none: stretches of the way that the data takes.

    They are cut from an order in which each function follows what it depends on, so no two depend on each other, and
    branches come one after the other: where a branch ends, else where few tokens go from one to the next.
    """
    makers = {
        name: {cg.digraph.producer[token] for token in cg.func_inputs(name) if token in cg.digraph.producer}
        for name in cg.functions
    }
    order = [name for name in _depth_first(cg, makers) if name not in grouped]
    place = {name: index for index, name in enumerate(order)}
    # By place, how many tokens go from what is before it to it and what is after it.
    changes = [0] * (len(order) + 2)
    for token, maker in cg.digraph.producer.items():
        last = max((place.get(name, 0) for name in cg.digraph.consumers.get(token, ())), default=0)
        if place.get(maker, last) < last:
            changes[place[maker] + 1] += 1
            changes[last + 1] -= 1
    passing = list(accumulate(changes))
    usual, start, groups = max(2, -(-len(order) // _BOXES)), 0, dict[str, tuple[str, ...]]()

    def badness(end: int) -> tuple[bool, int, int]:
        return order[end - 1] in makers[order[end]], passing[end], abs(end - start - usual)

    while start < len(order):
        # The last stretch may be longer, rather than a short one more.
        longest = usual + usual // 2
        is_last = len(order) - start <= longest
        end = len(order) if is_last else min(range(start + (usual + 1) // 2, start + longest + 1), key=badness)
        if end - start > 1:
            groups[f"{order[start]} … {order[end - 1]}"] = tuple(order[start:end])
        start = end
    return groups


def _depth_first(cg: CompGraph, makers: dict[str, set[str]]) -> list[str]:
    """Return the functions, each after all that it depends on, and as soon after the last of these as can be."""
    left = {name: len(before) for name, before in makers.items()}
    ready, order = [name for name in reversed(list(cg.functions)) if not left[name]], list[str]()
    while ready:
        name = ready.pop()
        order.append(name)
        takers = (taker for token in cg.func_outputs(name) for taker in cg.digraph.consumers.get(token, ()))
        for taker in reversed(dict.fromkeys(takers)):
            left[taker] -= 1
            if not left[taker]:
                ready.append(taker)
    return order
