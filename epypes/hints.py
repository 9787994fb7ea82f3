"""The values that a hyperparameter may take.

One vocabulary for panels, bundles and sweeps. A hint is given to the panel, or stands in the function's
annotation: ``Annotated[int, Param(1, 31, odd=True)]``.
"""

from __future__ import annotations

import enum
import math
import numbers
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args, get_origin

from epypes.errors import InvalidValue


@dataclass(frozen=True, slots=True)
class Param:
    """The values that a hyperparameter may take.

    Attributes
    ----------
    low, high
        The range, both ends included; None where it is open.
    step
        The distance between two values.
    odd
        Whether only odd integers are allowed, as for kernel sizes.
    log
        Whether the scale is logarithmic; the range is then positive.
    choices
        The only values allowed.
    unit
        For the label, as ``"px"``.
    soft
        A narrower range that is offered first.
    labels
        Names of the choices, as ``("INTER_NEAREST", "INTER_LINEAR")``.
    below
        A token, or parameter of the function, whose value this one never exceeds. Both get one slider with two ends.
    cuts
        The token, or parameter of the function, with whose values this one is compared. It is drawn as a line on the
        histogram of that token.
    about
        One sentence on what it does.

    Raises
    ------
    ValueError
        The range is empty, or does not fit ``odd``, ``log`` or ``soft``; or choices go with what only a range has.

    Examples
    --------
    >>> Param(1, 31, odd=True).allows(10)
    False
    """

    low: float | None = None
    high: float | None = None
    step: float | None = None
    odd: bool = False
    log: bool = False
    choices: tuple[Any, ...] | None = None
    unit: str = ""
    soft: tuple[float, float] | None = None
    labels: tuple[str, ...] | None = None
    below: str = ""
    cuts: str = ""
    about: str = ""

    def __post_init__(self) -> None:
        self._check_numbers()
        self._check_choices()
        self._check_soft()
        if self.low is not None and self.high is not None and self.low > self.high:
            raise InvalidValue(f"low ({self.low}) is above high ({self.high}). Exchange them.")
        if self.step is not None and self.step <= 0:
            raise InvalidValue(f"step must be positive, not {self.step}.")
        if self.log and (self.low is None or self.low <= 0):
            raise InvalidValue("A logarithmic range needs a positive low.")
        if self.odd and self.low is not None and self.low == self.high and self.low % 2 != 1:
            raise InvalidValue(f"There is no odd value between {self.low} and {self.high}.")

    def _check_numbers(self) -> None:
        for setting in ("low", "high", "step"):
            value = getattr(self, setting)
            if value is None or self.choices is not None:
                continue
            if not isinstance(value, numbers.Real) or not _is_end(value, is_step=setting == "step"):
                raise InvalidValue(f"{setting} must be a number that a float can hold, not {value!r:.60}.")
        for setting in ("unit", "below", "cuts", "about"):
            if not isinstance(getattr(self, setting), str):
                raise InvalidValue(f"{setting} is a text, not {getattr(self, setting)!r:.60}.")

    def _check_choices(self) -> None:
        if self.choices is None:
            if self.labels is not None:
                raise InvalidValue("labels name choices, and there are none. Give choices too, or leave labels out.")
            return
        object.__setattr__(self, "choices", tuple(self.choices))
        if not self.choices:
            raise InvalidValue("There are no choices. Give at least one value.")
        if self.labels is not None:
            object.__setattr__(self, "labels", tuple(self.labels))
            if len(self.labels) != len(self.choices):
                told = f"labels has {len(self.labels)} names, and there are {len(self.choices)} choices."
                raise InvalidValue(f"{told} Name each choice once.")
        for setting in ("below", "cuts"):
            if getattr(self, setting):
                raise InvalidValue(f"{setting} is for a range, and this hint has choices. Leave one of them out.")

    def _check_soft(self) -> None:
        if self.soft is None:
            return
        soft_low, soft_high = self.soft
        if soft_low > soft_high:
            raise InvalidValue(f"soft begins at {soft_low}, above its end at {soft_high}. Exchange them.")
        if (self.low is not None and soft_low < self.low) or (self.high is not None and soft_high > self.high):
            raise InvalidValue(
                f"soft ({soft_low} to {soft_high}) reaches beyond low or high. Narrow it, or widen those."
            )

    def allows(self, value: Any) -> bool:
        """Whether a value is within the hint."""
        if self.choices is not None:
            return value in self.choices
        if self.low is not None and value < self.low:
            return False
        if self.high is not None and value > self.high:
            return False
        return not self.odd or value % 2 == 1

    def describe(self) -> str:
        """Return the values in words.

        Examples
        --------
        >>> Param(1, 31, odd=True).describe()
        'an odd number from 1 to 31'
        """
        if self.choices is not None:
            return f"one of {', '.join(map(repr, self.choices))}"
        number = "an odd number" if self.odd else "a number"
        if self.low is not None and self.high is not None:
            return f"{number} from {self.low} to {self.high}"
        ends = ((self.low, "or more"), (self.high, "or less"))
        return ", ".join([number, *(f"{end} {side}" for end, side in ends if end is not None)])


@dataclass(frozen=True, slots=True)
class Roi:
    """A rectangle on a picture: ``(x, y, width, height)``, in pixels of the image, as integers.

    Attributes
    ----------
    on
        The token of the image; empty for the first image that the function takes.

    Examples
    --------
    >>> Roi(on="image").allows((10, 20, 64, 48))
    True
    """

    on: str = ""

    def allows(self, value: Any) -> bool:
        """Whether a value is a rectangle: a tuple or list of four integers, none of them negative."""
        return isinstance(value, tuple | list) and len(value) == 4 and all(map(_is_length, value))

    def describe(self) -> str:
        """Return the values in words."""
        return "a rectangle (x, y, width, height) of four integers, none negative"


@dataclass(frozen=True, slots=True)
class Text:
    """Any text, typed in a box."""

    def allows(self, value: Any) -> bool:
        """Whether a value is a text."""
        return isinstance(value, str)


def _is_length(value: Any) -> bool:
    return isinstance(value, numbers.Integral) and not isinstance(value, bool) and int(value) >= 0


def _is_end(value: numbers.Real, *, is_step: bool) -> bool:
    """Whether a number can be an end of a range, which may be infinite, or a step, which may not."""
    try:
        number = float(value)
    except OverflowError:  # a whole number that no slider has
        return False
    return math.isfinite(number) if is_step else not math.isnan(number)


def odd_step(step: float | None) -> int:
    """Return the distance between the values of a range of odd numbers: the least even one that is not below a step.

    Examples
    --------
    >>> odd_step(3)
    4
    """
    whole = max(1, math.ceil(step or 1))
    return whole + whole % 2


def as_param(hint: Any) -> Param | Roi | None:
    """Read a hint: a Param or Roi, a tuple as a range (low, high[, step]), a list or ``range`` as choices; else None.

    A dict has choices by their labels.

    Examples
    --------
    >>> as_param((0, 255))
    Param(low=0, high=255, ...)
    >>> as_param(["canny", "sobel"]).choices
    ('canny', 'sobel')
    """
    if isinstance(hint, Param | Roi):
        return hint
    if isinstance(hint, tuple) and len(hint) in (2, 3) and all(isinstance(end, numbers.Real) for end in hint):
        return Param(*hint)
    if isinstance(hint, list | range):
        return Param(choices=tuple(hint))
    if isinstance(hint, dict):
        return Param(choices=tuple(hint.values()), labels=tuple(map(str, hint)))
    return None


def param_of(annotation: Any) -> Param | Roi | None:
    """Read the hint in an annotation, if there is one.

    ``Annotated`` with a Param, a Roi or with the Ge, Gt, Le, Lt, Interval and MultipleOf of ``annotated_types``,
    ``Literal``, an ``Enum`` and ``bool`` are understood.
    """
    if get_origin(annotation) is Annotated:
        plain, *marks = get_args(annotation)
        found = next((mark for mark in marks if isinstance(mark, Param | Roi)), None)
        return found or _from_marks(marks) or param_of(plain)
    if get_origin(annotation) is Literal:
        return Param(choices=get_args(annotation))
    if isinstance(annotation, type) and issubclass(annotation, enum.Enum):
        return Param(choices=tuple(annotation))
    if annotation is bool:
        return Param(choices=(False, True))
    return None


def _from_marks(marks: Sequence[Any]) -> Param | None:
    """Read the marks of annotated_types by their attributes, so that the package need not be there."""
    found: dict[str, Any] = {}
    for mark in marks:
        for attribute, key in (
            ("ge", "low"), ("gt", "low"), ("le", "high"), ("lt", "high"), ("multiple_of", "step"),
        ):  # fmt: skip
            value = getattr(mark, attribute, None)
            if value is not None:
                found[key] = value
    return Param(**found) if found else None


def param_from_value(value: Any) -> Param | None:
    """Guess a range from a value: from 0 to three times it; a value that is not negative never gets a negative range.

    Examples
    --------
    >>> param_from_value(70)
    Param(low=0, high=210, ...)
    """
    if isinstance(value, bool):
        return Param(choices=(False, True))
    if isinstance(value, enum.Enum):
        return Param(choices=tuple(type(value)))
    if isinstance(value, int):
        span = max(3 * abs(value), 10)
        return Param(-span if value < 0 else 0, span if value >= 0 else 0, 1)
    if isinstance(value, float) and 3 * abs(value) < float("inf"):
        reach = 3 * abs(value) or 1.0
        return Param(-reach if value < 0 else 0.0, reach if value >= 0 else 0.0)
    return None
