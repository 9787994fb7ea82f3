"""Which values of a range are tried, one after another or drawn by chance?"""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from epypes.batch.steps import at_place, last_place, odd_from
from epypes.errors import ScaleError
from epypes.hints import Param, odd_step
from epypes.optional import optional_import


@dataclass(frozen=True, slots=True)
class Span:
    """The values from one end to the other.

    Attributes
    ----------
    low, high
        Both are values.
    step
        The distance between two values; None if all between the ends are.
    log
        Whether as many values are drawn below the geometric mean of the ends as above it.
    """

    low: float
    high: float
    step: float | None
    log: bool

    @property
    def size(self) -> int:
        """How many values there are; 0 if they can't be counted."""
        return 0 if self.step is None else last_place(self.low, self.high, self.step) + 1

    def value(self, place: int) -> float:
        """Return the value of this place, for a span that has steps."""
        return self.low if self.step is None else at_place(self.low, self.high, self.step, place)

    def at(self, share: float) -> float:
        """Return the value that lies so far, from 0 to below 1, on the way from low to high."""
        if self.step is not None and not self.log:
            return self.value(min(int(share * self.size), self.size - 1))
        value = self._between(share)
        return min(max(float(f"{value:.12g}"), self.low), self.high) if self.step is None else self._near(value, round)

    def at_most(self, value: float) -> float:
        """Return the largest value that does not exceed a number; the smallest of all if none does."""
        return min(max(value, self.low), self.high) if self.step is None else self._near(value, math.floor)

    def _near(self, value: float, rounded: Callable[[float], int]) -> float:
        steps = round((value - self.low) / (self.step or 1), 9)
        return self.value(min(max(rounded(steps), 0), self.size - 1))

    def _between(self, share: float) -> float:
        if self.log:
            return min(self.low * math.exp(share * math.log(self.high / self.low)), self.high)
        return self.low + share * (self.high - self.low)


def values_of(name: str, param: Param, present: Any, most: int) -> Sequence[Any]:
    """Return all values that a hyperparameter may take; of more than ``most`` only as many as there are.

    Raises
    ------
    ScaleError
        They can't be counted.
    """
    if param.choices is not None:
        return param.choices
    span = span_of(name, param, present)
    if span.step is None:
        raise ScaleError(
            f"Between {span.low:g} and {span.high:g} there is no end of values for {name!r}. Give a list, as "
            f"{name}=[...], a step, as ep.Param({span.low:g}, {span.high:g}, step=...), or how='random' with n=..."
        )
    return tuple(map(span.value, range(span.size))) if span.size <= most else range(span.size)


def drawn_by(name: str, param: Param, present: Any) -> Callable[[float], Any]:
    """Return what gives the value for a share from 0 to below 1, all values being equally likely.

    Raises
    ------
    ScaleError
        The range is open.
    """
    if param.choices is not None:
        choices = param.choices
        return lambda share: choices[min(int(share * len(choices)), len(choices) - 1)]
    return span_of(name, param, present).at


def span_of(name: str, param: Param, present: Any) -> Span:
    """Return the range of a hyperparameter that is ``present`` now; the part that is offered first, if there is one.

    Raises
    ------
    ScaleError
        An end is open.
    """
    low, high = param.soft or (param.low, param.high)
    if low is None or high is None or not math.isfinite(low) or not math.isfinite(high):
        raise ScaleError(f"The range of {name!r} is open. Give both ends, as {name}=(low, high), or a list of values.")
    whole = param.odd or _is_whole(low, high, param.step, present)
    step = param.step or (1 if whole else None)
    if param.odd:
        step, low = odd_step(param.step), odd_from(low)
    if low > high:
        raise ScaleError(f"There is no odd value between {low} and {high} for {name!r}. Widen its range.")
    return Span(low, high, step, param.log)


def _is_whole(low: float, high: float, step: float | None, present: Any) -> bool:
    """Whether a range is one of integers: all that is known of it is an integer, and so is the present value."""
    ends = (low, high, 1 if step is None else step)
    if not all(isinstance(end, numbers.Integral) for end in ends):
        return False
    return isinstance(present, numbers.Integral) or not isinstance(present, numbers.Real)


def shares(how: str, n: int, dimensions: int, seed: int) -> Sequence[Sequence[float]]:
    """Return n rows of shares from 0 to below 1: each by chance, or, as Latin hypercubes, each n-th part once."""
    import numpy as np

    generator = np.random.default_rng(seed)
    if how == "random":
        rows: Sequence[Sequence[float]] = generator.random((n, dimensions)).tolist()
        return rows
    with optional_import():
        from scipy.stats import qmc
    drawn: Sequence[Sequence[float]] = qmc.LatinHypercube(dimensions, seed=generator).random(n).tolist()
    return drawn
