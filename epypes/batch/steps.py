"""Which numbers lie on the steps of a range?

They are counted and added as they are written, in decimals: 0.1 and two steps of 0.1 are 0.3, as for who reads them,
and as for Optuna, which reads ranges that way too. Sums of floats are 0.30000000000000004.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable, Mapping
from decimal import Decimal
from typing import Any, Final

# In steps: 2 / 3 is written a little smaller than it is, or larger, and three of them still end at 2.
_SLACK: Final = Decimal("1e-9")


def last_place(low: float, high: float, step: float) -> int:
    """Return how many steps there are from low to high."""
    return math.floor((_written(high) - _written(low)) / _written(step) + _SLACK)


def at_place(low: float, high: float, step: float, place: int) -> float:
    """Return the number that lies so many steps above low; high itself if that is as near as numbers are written."""
    value = _written(low) + place * _written(step)
    if _is_whole(low) and _is_whole(step):
        return int(value)
    return float(high if _written(high) - value < _SLACK * _written(step) else value)


def ends_on_step(low: float, high: float, step: float) -> bool:
    """Whether the steps, as they are written, lead to high exactly."""
    return (_written(high) - _written(low)) % _written(step) == 0


def odd_from(low: float) -> int:
    """Return the least odd number that is not below a number."""
    return math.ceil(low) | 1


def kept_below(
    values: Mapping[str, Any],
    bounds: Mapping[str, tuple[str, Callable[[float], Any]]],
    present: Mapping[str, Any],
) -> dict[str, Any]:
    """Return values of which none exceeds the one that it is to stay below.

    Parameters
    ----------
    values
        Of what varies, by token.
    bounds
        By token that has one: the token that it never exceeds, and what gives the largest value up to a number.
    present
        The values of what does not vary.
    """
    kept = dict(values)
    for _ in bounds:  # a bound may have one itself
        for token, (above, at_most) in bounds.items():
            bound = kept.get(above, present.get(above))
            if isinstance(bound, numbers.Real) and kept[token] > bound:
                kept[token] = at_most(float(bound))
    return kept


def _written(number: float) -> Decimal:
    return Decimal(int(number)) if _is_whole(number) else Decimal(repr(float(number)))


def _is_whole(number: float) -> bool:
    return isinstance(number, numbers.Integral)
