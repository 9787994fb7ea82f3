"""Which two hyperparameters are the ends of one range?"""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping
from dataclasses import replace
from typing import Any, Final, TypeVar

from epypes.hints import Param
from epypes_widgets.guesses import takers, words
from epypes_widgets.movable import is_integer, is_movable
from epypes_widgets.places import Tunable

_UPPER: Final = {"lo": "hi", "low": "high", "min": "max", "lower": "upper", "minimum": "maximum"}
_NUMBERED: Final = frozenset(("threshold", "thresh"))

_R = TypeVar("_R")


def paired(runner: Tunable, found: Mapping[str, _R], given: Container[str]) -> dict[str, _R]:
    """Return ranges in which the lower one of two tokens says so.

    A hint's ``below`` is kept. Else two tokens are a pair if they go into one function, neither has a hint, their names
    or those of their parameters differ by low and high, and their values are of one type and in order.

    Raises
    ------
    ValueError
        A hint's ``below`` names a token that can't be moved along a range, or whose value is smaller.
    """
    ranges = dict(found)
    taken: set[str] = set()
    for token, param in found.items():
        if isinstance(param, Param) and param.below:
            _check(runner, token, param.below, ranges, given, taken)
    for low, high in _named_pairs(runner, [token for token in ranges if token not in given]):
        if not {low, high} & taken and _is_pair(runner.hyperparameters, low, high, ranges):
            ranges[low] = replace(ranges[low], below=high)  # type: ignore[type-var]
            taken |= {low, high}
    return ranges


def _check(
    runner: Tunable, token: str, high: str, ranges: dict[str, Any], given: Container[str], taken: set[str]
) -> None:
    fits = token != high and not {token, high} & taken and _is_pair(runner.hyperparameters, token, high, ranges)
    if fits:
        taken |= {token, high}
    elif token in given:
        values = runner.hyperparameters
        raise ValueError(
            f"{token!r} ({values[token]!r:.60}) is hinted to stay below {high!r} ({values[high]!r:.60}). Both must be "
            "numbers of one type, in order, and in no other pair. Set them so, or leave below out."
        )
    else:
        ranges[token] = replace(ranges[token], below="")


def _is_pair(values: Mapping[str, Any], low: str, high: str, ranges: Mapping[str, Any]) -> bool:
    if not all(isinstance(ranges.get(token), Param) and ranges[token].choices is None for token in (low, high)):
        return False
    if not is_movable(values[low]) or not is_movable(values[high]):
        return False
    return is_integer(values[low]) == is_integer(values[high]) and bool(values[low] <= values[high])


def _named_pairs(runner: Tunable, tokens: list[str]) -> Iterator[tuple[str, str]]:
    """Give the tokens whose names differ by low and high, and those whose parameters do."""
    for token in tokens:
        for taker in takers(runner.cg, token):
            inputs = runner.cg.func_inputs(taker.name)
            parameters = {name: taken for name, taken in taker.tokens.items() if taken in tokens}
            by_name = (other for other in inputs if other in tokens and words(other) in _uppers(token))
            by_parameter = (taken for name, taken in parameters.items() if words(name) in _uppers(taker.parameter))
            yield from ((token, other) for other in (*by_name, *by_parameter))


def _uppers(name: str) -> list[tuple[str, ...]]:
    """Return the words that the name of the upper end would have."""
    own = words(name)
    found = [(*own[:place], _UPPER[word], *own[place + 1 :]) for place, word in enumerate(own) if word in _UPPER]
    if len(own) > 1 and own[-1] == "1" and own[-2] in _NUMBERED:
        found.append((*own[:-1], "2"))
    return found
