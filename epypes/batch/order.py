"""In which order are settings run, so that what they share is computed seldom?"""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable, Mapping, Sequence
from itertools import pairwise
from typing import Any

from epypes.graph import CompGraph


def running_order(cg: CompGraph, settings: Sequence[Mapping[str, Any]]) -> list[int]:
    """Return the places of settings in the order in which they are best run.

    There is one at least. Each is run after the one before by running only what depends on what is different. So the
    hyperparameter on which most functions depend changes least often.
    """
    slowest_first = _slowest_first(cg, settings)
    ranks: dict[str, dict[Hashable, int]] = {name: {} for name in slowest_first}

    def rank(place: int) -> tuple[int, ...]:
        setting = settings[place]
        return tuple(ranks[name].setdefault(identity(setting[name]), len(ranks[name])) for name in slowest_first)

    return sorted(range(len(settings)), key=rank)


def steps(cg: CompGraph, settings: Sequence[Mapping[str, Any]]) -> list[int]:
    """Return where, in running order, the hyperparameter that changes least often has a new value: 0, and others."""
    slowest = _slowest_first(cg, settings)[0]
    of_slowest = [identity(setting[slowest]) for setting in settings]
    return [0, *(place for place, (one, other) in enumerate(pairwise(of_slowest), 1) if one != other)]


def _slowest_first(cg: CompGraph, settings: Sequence[Mapping[str, Any]]) -> list[str]:
    return sorted(settings[0], key=lambda name: -len(functions_after(cg, name)))


def functions_after(cg: CompGraph, token: str) -> frozenset[str]:
    """Return the functions that depend on a token, directly or by what others make of it."""
    waiting, found = deque(cg.digraph.consumers.get(token, ())), set[str]()
    while waiting:
        function = waiting.popleft()
        if function not in found:
            found.add(function)
            waiting.extend(cg.digraph.successors(function))
    return frozenset(found)


def identity(value: Any) -> Hashable:
    """Return what is equal for values that are one and the same: 1 is not True, and arrays are not compared.

    0.0 is not -0.0, since a runner computes both.
    """
    try:
        hash(value)
    except TypeError:
        return (type(value), id(value))
    if type(value) is tuple:
        return (tuple, *map(identity, value))
    return (type(value), repr(value) if isinstance(value, float | complex) else value)
