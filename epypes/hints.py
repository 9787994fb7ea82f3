"""Which values may a hyperparameter take?

One vocabulary for panels, bundles and sweeps. A hint is given to the panel, or stands in the function's
annotation: ``Annotated[int, Param(1, 31, odd=True)]``.
"""

from __future__ import annotations

import enum
import numbers
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args, get_origin

from epypes.annotations import hints_of


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
        The names of the choices, as many as there are choices.
    below
        A token whose value this one never exceeds: both get one slider with two ends.
    cuts
        The token with whose values this one is compared.
    about
        What it does, in one sentence.

    Raises
    ------
    ValueError
        The range is empty, or does not fit ``odd`` or ``log``.

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
        if self.choices is not None:
            object.__setattr__(self, "choices", tuple(self.choices))
            if not self.choices:
                raise ValueError("choices is empty. Name at least one value.")
        if self.low is not None and self.high is not None and self.low > self.high:
            raise ValueError(f"low ({self.low}) is above high ({self.high}). Exchange them.")
        if self.step is not None and self.step <= 0:
            raise ValueError(f"step must be positive, not {self.step}.")
        if self.log and (self.low is None or self.low <= 0):
            raise ValueError("A logarithmic range needs a positive low.")
        if self.odd and self.low is not None and self.low == self.high and self.low % 2 != 1:
            raise ValueError(f"There is no odd value between {self.low} and {self.high}.")

    def allows(self, value: Any) -> bool:
        """Whether a value is within the hint."""
        if self.choices is not None:
            return value in self.choices
        if self.low is not None and value < self.low:
            return False
        if self.high is not None and value > self.high:
            return False
        return not self.odd or value % 2 == 1


@dataclass(frozen=True, slots=True)
class Roi:
    """A rectangle of a picture: the value is (x, y, width, height), whole pixels.

    Attributes
    ----------
    on
        The token of the picture; empty for the first image among the inputs of the function that takes the rectangle.
    """

    on: str = ""

    def allows(self, value: Any) -> bool:
        """Whether a value is four whole numbers that are not negative."""
        whole = isinstance(value, tuple | list) and len(value) == 4
        return whole and all(isinstance(side, numbers.Integral) and int(side) >= 0 for side in value)


@dataclass(frozen=True, slots=True)
class Text:
    """Any text."""

    def allows(self, value: Any) -> bool:
        """Whether a value is a text."""
        return isinstance(value, str)


def as_param(hint: Any) -> Param | Roi | None:
    """Read a hint: a Param, a tuple as a range (low, high[, step]), a list as choices; None if it is neither.

    Examples
    --------
    >>> as_param((0, 255))
    Param(low=0, high=255, ...)
    >>> as_param(["canny", "sobel"]).choices
    ('canny', 'sobel')
    """
    if isinstance(hint, Param | Roi):
        return hint
    if isinstance(hint, tuple) and len(hint) in (2, 3) and all(isinstance(end, int | float) for end in hint):
        return Param(*hint)
    if isinstance(hint, list):
        return Param(choices=tuple(hint))
    return None


def annotated_param(function: Callable[..., Any], position: int) -> Param | None:
    """Read the hint in the annotation of a function's positional parameter, if there is one.

    ``Annotated`` with a Param or with the Ge, Gt, Le, Lt, Interval and MultipleOf of ``annotated_types``,
    ``Literal``, an ``Enum`` and ``bool`` are understood.
    """
    hints = hints_of(function)
    try:
        name = tuple(function.__code__.co_varnames[: function.__code__.co_argcount])[position]
    except (AttributeError, IndexError):
        return None  # a C function: the value must do
    return _from_annotation(hints.get(name))


def _from_annotation(annotation: Any) -> Param | None:
    if get_origin(annotation) is Annotated:
        plain, *marks = get_args(annotation)
        found = next((mark for mark in marks if isinstance(mark, Param)), None)
        return found or _from_marks(marks) or _from_annotation(plain)
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
    if isinstance(value, float) and abs(value) < float("inf"):
        reach = 3 * abs(value) or 1.0
        return Param(-reach if value < 0 else 0.0, reach if value >= 0 else 0.0)
    return None
