"""The values of one hyperparameter along a slider: which position a value has, and which value a position means."""

from __future__ import annotations

import math
import numbers
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, Final

from epypes.display.previews.short import short_repr
from epypes.errors import InvalidValue
from epypes.hints import Param, odd_step
from epypes_widgets.controls.ranges import allows, range_text
from epypes_widgets.values import is_integer, is_number, numpy_type

# A browser's numbers are floats: whole ones beyond this are the same as their neighbours.
_LAST_WHOLE: Final = 2**53
# What a power of ten may be, so that neither it nor what is near to it is 0 or infinite.
_EXPONENTS: Final = (-300.0, 308.0)


@dataclass(frozen=True, slots=True)
class Scale:
    """The values of one hyperparameter along a slider.

    Attributes
    ----------
    name
        The token.
    param
        Its range.
    first
        A value of the type that all others get.
    integer
        Whether all values are whole.
    low, high
        The ends that are offered.
    bottom, top
        The ends that no value passes, of the range and of the type.
    step
        The distance between two places; on a logarithmic scale that of two exponents of ten.
    """

    name: str
    param: Param
    first: Any
    integer: bool
    low: float
    high: float
    bottom: float
    top: float
    step: float

    def along(self, value: Any) -> float:
        """Return how far along the slider a value is, in the unit of ``step``."""
        return exponent(value) if self.param.log else float(value)

    def place(self, value: Any) -> int | float:
        """Return the number that the slider is set to for a value."""
        return int(value) if self.integer else float(value)

    def meant(self, place: float) -> Any:
        """Return the value that a user means by moving the slider to a position."""
        number = round(place) if self.integer else self._rounded(place)
        if self.param.odd:
            number = round(number) | 1
        return same_type(self.first)(min(max(number, self.bottom), self.top))

    def _rounded(self, place: float) -> float:
        """Return the shortest decimal number that is surely meant by a place."""
        if not self.param.log:
            return without_noise(place, self.step)
        # Two places differ by this share of them; digits far below it are of the scale, not of the user.
        share = math.expm1(self.step * math.log(10))
        return float(f"{place:.{max(3, 2 - math.floor(math.log10(share)))}g}")

    def checked(self, value: Any) -> Any:
        """Return a value as the hyperparameter takes it.

        Raises
        ------
        ValueError
            It takes no such value.
        """
        if not is_number(value):
            text = f"{self.name!r} can't be {short_repr(value)}: it takes numbers, {range_text(self.param)}."
            raise InvalidValue(text)
        if self.integer and value != int(value):
            way_out = f"Give tune() a range of floats for it, as ({self.bottom:.1f}, {self.top:.1f})."
            raise InvalidValue(f"{self.name!r} takes whole numbers, not {short_repr(value)}. {way_out}")
        number = int(value) if self.integer else _item(value)
        if not allows(self.param, number):
            raise refused(self.name, value, self.param)
        least, greatest = _limits(self.first)
        if not least <= number <= greatest:
            kind = type(self.first).__name__
            way_out = f"Set the runner to a number of Python first: runner[{self.name!r}] = {self.first.item()!r}"
            raise InvalidValue(f"{self.name!r} can't be {short_repr(value)}: it is of type {kind}. {way_out}")
        return same_type(self.first)(number)

    def grown(self, low: float, high: float, value: Any) -> tuple[float, float]:
        """Return ends of a slider that hold a value, by whole steps, so that the places between stay where they are."""
        at = self.along(value)
        if self.param.log:
            return min(low, at), max(high, at)
        if at < low:
            low = min(max(low - math.ceil((low - at) / self.step) * self.step, self.bottom), self.place(value))
        if at > high:
            high = max(min(high + math.ceil((at - high) / self.step) * self.step, self.top), self.place(value))
        return low, high


def scale_of(name: str, value: Any, param: Param) -> Scale | None:
    """Return the scale of a hyperparameter; None if there is nothing to be moved, or no slider could do it."""
    if param.choices is not None or not is_number(value) or not allows(param, _item(value)):
        return None
    whole = all(end is None or is_integer(end) for end in (param.low, param.high, param.step))
    integer = param.odd or (is_integer(value) and whole)
    least, greatest = _limits(value)
    bottom, top = _inner(
        least if param.low is None else max(param.low, least),
        greatest if param.high is None else min(param.high, greatest),
        integer,
        param.odd,
    )
    for ends in filter(None, (param.soft, (bottom, top))):
        low, high = _inner(max(ends[0], bottom), min(ends[1], top), integer, param.odd)
        if _is_span(param, low, high):
            break
    else:
        return None
    if integer and max(abs(low), abs(high)) > _LAST_WHOLE:
        return None
    found = Scale(name, param, value, integer, low, high, bottom, top, _step(param, low, high, integer))
    if param.log:
        return found
    low, high = found.grown(low, high, value)
    return replace(found, low=low, high=high)


def same_type(value: Any) -> Callable[[Any], Any]:
    """Return what converts a new value to the type of ``value``, if that is a scalar of NumPy."""
    return numpy_type(value) or (lambda new: new)


def refused(name: str, value: Any, param: Any) -> ValueError:
    """Return the error for a value outside of a range."""
    way_out = "Give tune() a wider hint for it."
    if isinstance(param, Param) and param.odd and is_integer(value):
        near = [str(odd) for odd in (value - 1, value + 1) if allows(param, odd)]
        way_out = f"Set {' or '.join(near)}." if near else way_out
    return InvalidValue(f"{name!r} can't be {short_repr(value)}: its range is {range_text(param)}. {way_out}")


def exponent(value: Any) -> float:
    """Return the power of ten that a positive value is, as far as a slider can go."""
    low, high = _EXPONENTS
    return min(max(math.log10(value), low), high) if value > 0 else low


def without_noise(place: float, step: float) -> float:
    """Return what a user of a slider means: 0.3, where adding up steps gives 0.30000000000000004."""
    near = float(f"{place:.12g}")
    return near if abs(near - place) <= min(step / 4, 64 * math.ulp(place)) else place


def _item(number: Any) -> Any:
    """Return a number of NumPy as Python's: NumPy's overflow when compared with greater ones."""
    return number if numpy_type(number) is None else number.item()


def _limits(value: Any) -> tuple[float, float]:
    """Return the least and the greatest number of a value's type."""
    kind = numpy_type(value)
    if kind is None or not isinstance(value, numbers.Real):
        return -math.inf, math.inf
    import numpy as np

    if issubclass(kind, np.integer):
        return int(np.iinfo(kind).min), int(np.iinfo(kind).max)
    ends: Any = np.finfo(kind)
    return float(ends.min), float(ends.max)


def _inner(low: float, high: float, integer: bool, odd: bool) -> tuple[float, float]:
    """Return the first and the last value between two ends that is of the kind of number."""
    if integer:
        low = low if math.isinf(low) else math.ceil(low)
        high = high if math.isinf(high) else math.floor(high)
    return (low + (low % 2 == 0), high - (high % 2 == 0)) if odd else (low, high)


def _is_span(param: Param, low: float, high: float) -> bool:
    """Whether a slider can stand at several places between two ends."""
    is_finite = low < high and math.isfinite(float(high) - float(low))
    return is_finite and (not param.log or exponent(low) < exponent(high))


def _step(param: Param, low: float, high: float, integer: bool) -> float:
    if param.log:
        span = exponent(high) - exponent(low)
        return min(max(span / 200, 1e-3), span / 20)
    if integer:
        return odd_step(param.step) if param.odd else max(int(param.step or 1), 1)
    # Smaller than what the greatest numbers of the range differ by, a step would lead nowhere.
    least = math.ulp(max(abs(low), abs(high)))
    return max(float(param.step or 10.0 ** math.floor(math.log10(max((high - low) / 100, least)))), least)
