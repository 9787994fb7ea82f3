"""Which values of which hyperparameters are searched?

What the hints of a hyperparameter offer, or what the caller names, becomes an axis: a span of numbers, or choices.
"""

from __future__ import annotations

import enum
import math
import numbers
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from epypes.batch.steps import at_place, kept_below, last_place, odd_from
from epypes.bundle.hyperparameters import plain, range_of
from epypes.catalog import parameter_names
from epypes.errors import ScaleError, UnknownName
from epypes.graph import CompGraph
from epypes.hints import Param, Roi, as_param, odd_step, param_from_value
from epypes.optional import optional_import
from epypes.run import CompGraphRunner


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


@dataclass(frozen=True, slots=True)
class SearchSpan:
    """Numbers from ``low`` to ``high``, both included.

    Attributes
    ----------
    token
        The hyperparameter.
    low, high
        Both are on the grid of ``step``.
    step
        The distance between two values; None for any number.
    log
        Whether small values are tried as often as large ones.
    is_integer
        Whether the values are whole numbers.
    below
        The hyperparameter that this one never exceeds; empty for none.
    """

    token: str
    low: float
    high: float
    step: float | None
    log: bool
    is_integer: bool
    below: str = ""

    def nearest(self, value: float) -> Any:
        """Return the value of the span that is nearest to a number."""
        return self._on_grid(min(max(value, self.low), self.high), round)

    def at_most(self, value: float) -> Any:
        """Return the largest value of the span that does not exceed a number; the smallest of all if none does."""
        return self._on_grid(min(max(value, self.low), self.high), math.floor)

    def _on_grid(self, value: float, rounded: Any) -> Any:
        if self.step is not None:
            place = rounded(round((value - self.low) / self.step, 9))
            value = at_place(self.low, self.high, self.step, place)
        return int(value) if self.is_integer else float(value)


@dataclass(frozen=True, slots=True)
class Choices:
    """Some values.

    Attributes
    ----------
    token
        The hyperparameter.
    values
        Any objects.
    labels
        A text for each, all different: what a database knows it by.
    """

    token: str
    values: tuple[Any, ...]
    labels: tuple[str, ...]

    def label_of(self, value: Any) -> str:
        """Return the label of a value; that of the first one if it is none of them."""
        same = (label for label, known in zip(self.labels, self.values, strict=True) if _is_one(known, value))
        return next(same, self.labels[0])


Axis = SearchSpan | Choices


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
        Values are whole numbers where the present one is.

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
    return tuple(_given(runner, token, ranges[token]) for token in order)


def setting_of(axes: Sequence[Axis], suggested: Mapping[str, Any], present: Mapping[str, Any]) -> dict[str, Any]:
    """Return the values of the hyperparameters that a sampler has suggested, by token.

    Parameters
    ----------
    axes
        What varies.
    suggested
        By token: a number, or a label.
    present
        The values of the other hyperparameters.
    """
    values = {axis.token: _value(axis, suggested[axis.token]) for axis in axes}
    bounds = {axis.token: (axis.below, axis.at_most) for axis in axes if isinstance(axis, SearchSpan) and axis.below}
    return kept_below(values, bounds, present)


def suggestion_of(axes: Sequence[Axis], setting: Mapping[str, Any]) -> dict[str, Any]:
    """Return what a sampler would have to suggest for a setting, or for the nearest one within the axes."""
    return {
        axis.token: axis.label_of(setting[axis.token])
        if isinstance(axis, Choices)
        else axis.nearest(plain(setting[axis.token]))
        for axis in axes
    }


def _value(axis: Axis, suggested: Any) -> Any:
    if isinstance(axis, Choices):
        return axis.values[axis.labels.index(suggested)]
    return axis.nearest(suggested)


def _hinted(runner: CompGraphRunner) -> Iterator[Axis]:
    for token in runner.cg.source_tokens:
        if token not in runner.hyperparameters:
            continue
        value = runner.hyperparameters[token]
        param = range_of(runner.cg, token, value) or _of_type(value)
        if isinstance(param, Param) and (param.choices is not None or _is_closed(param)):
            yield _axis(runner, token, param, is_given=False)


def _of_type(value: Any) -> Param | None:
    """Return all values that a type has, if these are few."""
    return param_from_value(value) if isinstance(value, bool | enum.Enum) else None


def _given(runner: CompGraphRunner, token: str, hint: Any) -> Axis:
    try:
        param = as_param(hint)
    except (TypeError, ValueError) as error:
        raise ScaleError(f"ranges[{token!r}]: {error}") from error
    if param is None or isinstance(param, Roi):
        text = f"ranges[{token!r}] is {hint!r:.60}. Give an ep.Param, a tuple (low, high), or a list of choices."
        raise ScaleError(text)
    if param.choices is None:
        _require_numbers(token, param, runner.hyperparameters[token])
    return _axis(runner, token, param, is_given=True)


def _require_numbers(token: str, param: Param, value: Any) -> None:
    if not _is_closed(param):
        raise ScaleError(f"The range of {token!r} has an open end. Give both: ranges={{{token!r}: (low, high)}}.")
    if not _is_number(plain(value)):
        text = f"{token!r} is {value!r:.60}, so it has no range of numbers."
        raise ScaleError(f"{text} Give a list of choices: ranges={{{token!r}: [...]}}.")


def _axis(runner: CompGraphRunner, token: str, param: Param, *, is_given: bool) -> Axis:
    if param.choices is not None:
        return Choices(token, param.choices, _labels(param))
    value = plain(runner.hyperparameters[token])
    low, high = _ends(param)
    if param.soft is not None and not is_given:
        low, high = min(low, value), max(high, value)
    # 1.0 is a float on purpose, and so is what it ranges over, unless that is odd.
    is_whole = param.odd or isinstance(value, numbers.Integral)
    span = _stepped(SearchSpan(token, low, high, param.step, param.log, is_whole), is_odd=param.odd)
    return replace(span, below=token_below(runner, token, param.below))


def _ends(param: Param) -> tuple[Any, Any]:
    """Return the ends of a range: those that are usual, if they are told."""
    return param.soft if param.soft is not None else (param.low, param.high)


def _stepped(span: SearchSpan, *, is_odd: bool) -> SearchSpan:
    """Return a span whose ends are on its grid."""
    low, high, step = span.low, span.high, span.step
    if span.is_integer:
        low, high = odd_from(low) if is_odd else math.ceil(low), math.floor(high)
        step = odd_step(step) if is_odd else max(1, round(step or 1))
    if low > high:
        raise ScaleError(f"There is no {'odd' if is_odd else 'whole'} number in the range of {span.token!r}.")
    if step is not None:
        high = at_place(low, high, step, last_place(low, high, step))
    return replace(span, low=low, high=high, step=step)


def token_below(runner: CompGraphRunner, token: str, name: str) -> str:
    """Return the hyperparameter that a hint calls by its own name or by that of a function's parameter."""
    if not name or name in runner.hyperparameters:
        return name
    return next((found for found in _called(runner.cg, token, name) if found in runner.hyperparameters), "")


def _called(cg: CompGraph, token: str, name: str) -> Iterator[str]:
    for function in cg.digraph.consumers.get(token, ()):
        inputs = cg.func_inputs(function)
        names = parameter_names(cg.functions[function])
        yield from (given for given, called in zip(inputs, names, strict=False) if called == name)


def _labels(param: Param) -> tuple[str, ...]:
    """Return a text for each choice; those that are alike are numbered."""
    choices = param.choices or ()
    texts = [_text(choice) for choice in choices] if param.labels is None else list(param.labels)
    if len(set(texts)) == len(texts):
        return tuple(texts)
    return tuple(f"{text} #{number}" for number, text in enumerate(texts))


def _text(choice: Any) -> str:
    return choice.name if isinstance(choice, enum.Enum) else f"{choice!r:.80}"


def _is_one(known: Any, value: Any) -> bool:
    """Whether two values are one, whatever comparing them gives: 1 is not True."""
    if isinstance(known, bool) != isinstance(value, bool):
        return False
    try:
        return known is value or bool(known == value)
    except Exception:  # arrays, for example
        return False


def _is_closed(param: Param) -> bool:
    return all(_is_number(end) for end in _ends(param))


def _is_number(value: Any) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool) and math.isfinite(value)


def _why_none(present: Iterable[str]) -> str:
    names = ", ".join(map(repr, present))
    if not names:
        return "The runner has no hyperparameters, so nothing can vary. Freeze some: runner.freeze(name=value)."
    return f"No hint gives a range for {names}. Give some: ranges={{'name': (low, high)}}, or annotate the functions."
