"""The values that a range of a hyperparameter stands for: counted, drawn at random, or searched.

``Span`` is a range of numbers. An axis is what a search varies: a span or choices, with what Optuna knows of it.
Steps are counted and added in decimals, as they are written: 0.1 and two steps of 0.1 are 0.3, for a reader and for
Optuna, which reads ranges that way too. Sums of floats are 0.30000000000000004.
"""

from __future__ import annotations

import enum
import math
import numbers
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from typing import TYPE_CHECKING, Any, Final

from epypes.catalog import parameter_names, plain, range_of
from epypes.errors import ScaleError, UnknownName
from epypes.hints import Param, Roi, as_param, odd_step, param_from_value
from epypes.optional import optional_import
from epypes.run import CompGraphRunner

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

# In steps: 2 / 3 is written a little smaller than it is, or larger, and three of them still end at 2.
_SLACK: Final = Decimal("1e-9")


@dataclass(frozen=True, slots=True)
class Span:
    """Numbers from ``low`` to ``high``, both included; integers if both ends and the step are.

    Attributes
    ----------
    low, high
        The ends.
    step
        The distance between two values; None for any number.
    log
        Whether small values are tried as often as large ones.
    """

    low: float
    high: float
    step: float | None
    log: bool

    @property
    def size(self) -> int:
        """The number of values; 0 if they can't be counted."""
        if self.step is None:
            return 0
        return math.floor((_written(self.high) - _written(self.low)) / _written(self.step) + _SLACK) + 1

    @property
    def ends_on_step(self) -> bool:
        """Whether the steps, as they are written, lead to ``high`` exactly."""
        return self.step is not None and (_written(self.high) - _written(self.low)) % _written(self.step) == 0

    def value(self, place: int) -> float:
        """Return the value so many steps above the lowest one; ``high`` itself if that is as near as is written."""
        if self.step is None:
            return self.low
        value = _written(self.low) + place * _written(self.step)
        if isinstance(self.low, numbers.Integral) and isinstance(self.step, numbers.Integral):
            return int(value)
        return float(self.high if _written(self.high) - value < _SLACK * _written(self.step) else value)

    def at(self, share: float) -> float:
        """Return the value at a share, from 0 to below 1, of the way from low to high."""
        if self.step is not None and not self.log:
            return self.value(min(int(share * self.size), self.size - 1))
        if self.log:
            value = min(self.low * math.exp(share * math.log(self.high / self.low)), self.high)
        else:
            value = self.low + share * (self.high - self.low)
        return self.nearest(float(f"{value:.12g}"))

    def nearest(self, value: float) -> float:
        """Return the value of the span that is nearest to a number."""
        return self._on_step(value, round)

    def at_most(self, value: float) -> float:
        """Return the largest value of the span up to a number; the smallest of all if there is none."""
        return self._on_step(value, math.floor)

    def _on_step(self, value: float, rounded: Callable[[float], int]) -> float:
        if self.step is None:
            return min(max(value, self.low), self.high)
        place = rounded(round((value - self.low) / self.step, 9))
        return self.value(min(max(place, 0), self.size - 1))


def _written(number: float) -> Decimal:
    return Decimal(int(number)) if isinstance(number, numbers.Integral) else Decimal(repr(float(number)))


@dataclass(frozen=True, slots=True)
class NumberAxis:
    """A hyperparameter that takes the numbers of a span; ``below`` is the one that it never exceeds, or empty."""

    token: str
    span: Span
    below: str = ""

    def values(self, most: int) -> Sequence[Any]:
        """Return all values; of more than ``most`` only a range of that length.

        Raises
        ------
        ScaleError
            They can't be counted.
        """
        span, token = self.span, self.token
        if span.step is None:
            raise ScaleError(
                f"Between {span.low:g} and {span.high:g} there is no end of values for {token!r}. Give a list, as "
                f"{token}=[...], a step, as ep.Param({span.low:g}, {span.high:g}, step=...), or how='random' with n=..."
            )
        return tuple(map(span.value, range(span.size))) if span.size <= most else range(span.size)

    def at(self, share: float) -> Any:
        """Return the value at a share from 0 to below 1."""
        return self.span.at(share)

    def value(self, suggested: Any) -> Any:
        """Return the value for what the sampler has suggested."""
        return self.span.nearest(suggested)

    def suggestion(self, value: Any) -> Any:
        """Return what the sampler would have to suggest for a value, or for the nearest one."""
        return self.span.nearest(plain(value))

    @property
    def distribution(self) -> BaseDistribution:
        """The span for Optuna, which has no steps on a logarithmic scale, nor any that end beside the range."""
        from optuna.distributions import FloatDistribution, IntDistribution

        low, high, log = self.span.low, self.span.high, self.span.log
        step = self.span.step if self.span.ends_on_step and not log else None
        if isinstance(low, int):
            return IntDistribution(low, int(high), log=log, step=int(step or 1))
        return FloatDistribution(low, high, log=log, step=step)


@dataclass(frozen=True, slots=True)
class ChoiceAxis:
    """A hyperparameter that takes one of some values; each has a label of its own, for the database."""

    token: str
    choices: tuple[Any, ...]
    labels: tuple[str, ...]

    def values(self, most: int) -> Sequence[Any]:
        """Return all values."""
        return self.choices

    def at(self, share: float) -> Any:
        """Return the value at a share from 0 to below 1."""
        return self.choices[min(int(share * len(self.choices)), len(self.choices) - 1)]

    def value(self, suggested: Any) -> Any:
        """Return the value of a label."""
        return self.choices[self.labels.index(suggested)]

    def suggestion(self, value: Any) -> str:
        """Return the label of a value; the first label if the value is none of them."""
        same = (label for label, known in zip(self.labels, self.choices, strict=True) if _is_one(known, value))
        return next(same, self.labels[0])

    @property
    def distribution(self) -> BaseDistribution:
        """The labels for Optuna."""
        from optuna.distributions import CategoricalDistribution

        return CategoricalDistribution(self.labels)


Axis = NumberAxis | ChoiceAxis


def axis_of(runner: CompGraphRunner, token: str, param: Param) -> Axis:
    """Return the values that a hyperparameter may take; of a range its soft part, if it has one.

    They are integers if the range is one of odd numbers, or if its ends and step are integers and the present value is
    one, or no number: 1.0 is a float on purpose, and so is what it ranges over.

    Raises
    ------
    ScaleError
        An end is open, or there is no such number.
    """
    if param.choices is not None:
        names = (one.name if isinstance(one, enum.Enum) else f"{one!r:.80}" for one in param.choices)
        labels = tuple(param.labels or names)
        if len(set(labels)) < len(labels):  # texts that are alike are numbered
            labels = tuple(f"{text} #{number}" for number, text in enumerate(labels))
        return ChoiceAxis(token, param.choices, labels)
    low, high = _ends(param)
    if not (_is_number(low) and _is_number(high)):
        raise ScaleError(f"The range of {token!r} is open. Give both ends, as (low, high), or a list of values.")
    step, present = param.step, plain(runner.hyperparameters[token])
    given = (low, high, 1 if step is None else step)
    is_whole = isinstance(present, numbers.Integral) or not isinstance(present, numbers.Real)
    if param.odd:
        low, high, step = math.ceil(low) | 1, math.floor(high), odd_step(step)
        if low > high:
            raise ScaleError(f"There is no odd number in the range of {token!r}. Widen it.")
    elif is_whole and all(isinstance(number, numbers.Integral) for number in given):
        low, high, step = int(low), int(high), int(step or 1)
    else:
        low, high, step = float(low), float(high), None if step is None else float(step)
    span = Span(low, high, step, param.log)
    if step is not None:
        span = replace(span, high=span.value(span.size - 1))
    return NumberAxis(token, span, _token_below(runner, token, param.below))


def _ends(param: Param) -> tuple[Any, Any]:
    return param.soft or (param.low, param.high)


def _is_number(value: Any) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool) and math.isfinite(value)


def bounded(axes: Sequence[Axis], values: Mapping[str, Any], present: Mapping[str, Any]) -> dict[str, Any]:
    """Return values of which none exceeds the one that it is to stay below.

    Parameters
    ----------
    axes
        What varies.
    values
        Of what varies, by token.
    present
        The values of the other hyperparameters.
    """
    kept = dict(values)
    bounds = [axis for axis in axes if isinstance(axis, NumberAxis) and axis.below]
    for _ in bounds:  # a bound may have one itself
        for axis in bounds:
            bound = kept.get(axis.below, present.get(axis.below))
            if isinstance(bound, numbers.Real) and kept[axis.token] > bound:
                kept[axis.token] = axis.span.at_most(float(bound))
    return kept


def shares(how: str, n: int, dimensions: int, seed: int) -> Sequence[Sequence[float]]:
    """Return n rows of shares from 0 to below 1: random ones, or Latin hypercubes, with each n-th part once."""
    import numpy as np

    generator = np.random.default_rng(seed)
    if how == "random":
        rows: Sequence[Sequence[float]] = generator.random((n, dimensions)).tolist()
        return rows
    with optional_import():
        from scipy.stats import qmc
    drawn: Sequence[Sequence[float]] = qmc.LatinHypercube(dimensions, seed=generator).random(n).tolist()
    return drawn


# -- the axes of a search ---------------------------------------------------------------------------------------


def axes_of(runner: CompGraphRunner, ranges: Mapping[str, Any] | None = None) -> tuple[Axis, ...]:
    """Return what is searched, in graph order.

    Parameters
    ----------
    runner
        Its hyperparameters and their values are read.
    ranges
        By hyperparameter: an ``ep.Param``, a tuple as a range (low, high[, step]), or a list of choices; only these
        vary. Without, all those vary for which an annotation, a switch, or the tables of OpenCV and scikit-image give
        choices or both ends of a range, hard or usual. A range that is usual is widened to hold the present value.

    Raises
    ------
    UnknownName
        A range is for what is no hyperparameter of the runner.
    ScaleError
        A range can't be searched, or there is none.
    """
    present = runner.hyperparameters
    if ranges is None:
        found = tuple(_hinted(runner))
        if not found:
            raise ScaleError(_why_none(present))
        return found
    for token in ranges:
        if token not in present:
            raise UnknownName("hyperparameter", token, present, "of this runner")
    if not ranges:
        raise ScaleError('ranges is empty, so nothing would vary. Name hyperparameters: ranges={"name": (low, high)}.')
    order = [token for token in runner.cg.source_tokens if token in ranges]
    return tuple(axis_of(runner, token, _given(token, ranges[token], present[token])) for token in order)


def _hinted(runner: CompGraphRunner) -> Iterator[Axis]:
    for token in runner.cg.source_tokens:
        if token not in runner.hyperparameters:
            continue
        value = runner.hyperparameters[token]
        param = range_of(runner.cg, token, value)
        if param is None and isinstance(value, bool | enum.Enum):
            param = param_from_value(value)
        if not isinstance(param, Param):
            continue
        if param.soft is not None:
            low, high = param.soft
            param = replace(param, low=min(low, plain(value)), high=max(high, plain(value)), soft=None)
        if param.choices is not None or all(map(_is_number, _ends(param))):
            yield axis_of(runner, token, param)


def _given(token: str, hint: Any, value: Any) -> Param:
    """Return the range that the caller gives for a hyperparameter."""
    try:
        param = as_param(hint)
    except (TypeError, ValueError) as error:
        raise ScaleError(f"ranges[{token!r}]: {error}") from error
    if param is None or isinstance(param, Roi):
        text = f"ranges[{token!r}] is {hint!r:.60}. Give an ep.Param, a tuple (low, high), or a list of choices."
        raise ScaleError(text)
    if param.choices is None and not _is_number(plain(value)):
        text = f"{token!r} is {value!r:.60}, so it has no range of numbers."
        raise ScaleError(f"{text} Give a list of choices: ranges={{{token!r}: [...]}}.")
    return param


def _token_below(runner: CompGraphRunner, token: str, name: str) -> str:
    """Return the hyperparameter that a hint calls by its own name or by that of a function's parameter."""
    if not name or name in runner.hyperparameters:
        return name
    cg = runner.cg
    for function in cg.digraph.consumers.get(token, ()):
        parameters = parameter_names(cg.functions[function])
        for given, parameter in zip(cg.func_inputs(function), parameters, strict=False):
            if parameter == name and given in runner.hyperparameters:
                return given
    return ""


def _is_one(known: Any, value: Any) -> bool:
    """Whether two values are one, whatever comparing them gives: 1 is not True."""
    if isinstance(known, bool) != isinstance(value, bool):
        return False
    try:
        return known is value or bool(known == value)
    except Exception:  # arrays, for example
        return False


def _why_none(present: Iterable[str]) -> str:
    names = ", ".join(map(repr, present))
    if not names:
        return "The runner has no hyperparameters, so nothing can vary. Freeze some: runner.freeze(name=value)."
    return f"No hint gives a range for {names}. Give some: ranges={{'name': (low, high)}}, or annotate the functions."
