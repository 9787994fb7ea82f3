"""Values of hyperparameters: the axes that a sweep or a search varies, and the settings made of them.

A sweep and a search read ranges by one rule. Steps are counted and added in decimals, as they are written: 0.1 and two
steps of 0.1 are 0.3, for a reader and for Optuna, which reads ranges that way too; sums of floats are
0.30000000000000004. Settings are counted before any is written out, so that a grid which is too large costs nothing.
"""

from __future__ import annotations

import enum
import math
import numbers
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from itertools import islice, pairwise, product
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

from epypes.catalog import parameter_names, plain, range_of
from epypes.errors import ScaleError, UnknownName
from epypes.graph import CompGraph
from epypes.hints import Param, as_param, odd_step, param_from_value
from epypes.optional import optional_import
from epypes.run import CompGraphRunner
from epypes.run.runner import branched

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution

How = Literal["product", "zip", "random", "latin"]
Setting = Mapping[str, Any]

# More outcomes are too many to hold, and to look at.
MOST_OUTCOMES: Final = 100_000
# In steps: 2 / 3 is written a little smaller than it is, or larger, and three of them still end at 2.
_SLACK: Final = Decimal("1e-9")


# -- axes ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class NumberAxis:
    """A hyperparameter that takes numbers from ``low`` to ``high``: integers if both ends and the step are.

    Attributes
    ----------
    token
        The hyperparameter.
    low, high
        The ends, both included.
    step
        The distance between two values; None for any number.
    log
        Whether small values are tried as often as large ones.
    below
        The hyperparameter whose value this one never exceeds, or empty.
    """

    token: str
    low: float
    high: float
    step: float | None = None
    log: bool = False
    below: str = ""

    @property
    def size(self) -> int:
        """The number of values; 0 if they can't be counted."""
        if self.step is None:
            return 0
        return math.floor((_written(self.high) - _written(self.low)) / _written(self.step) + _SLACK) + 1

    def __str__(self) -> str:
        options = {"step": self.step, "log": self.log or None, "below": self.below or None}
        return f"{self.low} to {self.high}" + "".join(f" {name} {given}" for name, given in options.items() if given)

    def values(self) -> Sequence[Any]:
        """Return all values; if they are too many to hold, only a range of that length.

        Raises
        ------
        ScaleError
            They can't be counted.
        """
        if self.step is None:
            low, high, token = f"{self.low:g}", f"{self.high:g}", self.token
            raise ScaleError(
                f"Between {low} and {high} there is no end of values for {token!r}. Give a list, as {token}=[...], a "
                f"step, as ep.Param({low}, {high}, step=...), or how='random' with n=..."
            )
        return tuple(map(self._value, range(self.size))) if self.size <= MOST_OUTCOMES else range(self.size)

    def at(self, share: float) -> float:
        """Return the value at a share, from 0 to below 1, of the way from low to high."""
        if self.log:
            value = min(self.low * math.exp(share * math.log(self.high / self.low)), self.high)
        elif self.step is not None:
            return self._value(min(int(share * self.size), self.size - 1))
        else:
            value = self.low + share * (self.high - self.low)
        return self.value(float(f"{value:.12g}"))

    def value(self, suggested: float, rounded: Callable[[float], int] = round) -> float:
        """Return the value of the axis that is nearest to a number; with ``math.floor`` the largest one up to it."""
        if self.step is None:
            return min(max(suggested, self.low), self.high)
        place = rounded(round((suggested - self.low) / self.step, 9))
        return self._value(min(max(place, 0), self.size - 1))

    def suggestion(self, value: Any) -> float:
        """Return what the sampler would have to suggest for a value, or for the nearest one."""
        return self.value(plain(value))

    @property
    def distribution(self) -> BaseDistribution:
        """The axis for Optuna, which has no steps on a logarithmic scale, nor any that end beside the range."""
        from optuna.distributions import FloatDistribution, IntDistribution

        low, high, step = self.low, self.high, None if self.log else self.step
        if isinstance(low, int):
            return IntDistribution(low, int(high), log=self.log, step=int(step or 1))
        if step is not None and (_written(high) - _written(low)) % _written(step):
            step = None
        return FloatDistribution(low, high, log=self.log, step=step)

    def _value(self, place: int) -> float:
        """Return the value so many steps above the lowest one; ``high`` itself if that is as near as is written."""
        low, high, step = _written(self.low), _written(self.high), _written(self.step or 0)
        value = low + place * step
        if isinstance(self.low, int):
            return int(value)
        return float(self.high if high - value < _SLACK * step else value)


def _written(number: float) -> Decimal:
    return Decimal(int(number)) if isinstance(number, numbers.Integral) else Decimal(repr(float(number)))


@dataclass(frozen=True, slots=True)
class ChoiceAxis:
    """A hyperparameter that takes one of some values; each has a label of its own, for the database."""

    token: str
    choices: tuple[Any, ...]
    labels: tuple[str, ...]

    def __str__(self) -> str:
        return " or ".join(self.labels)

    def at(self, share: float) -> Any:
        """Return the value at a share from 0 to below 1."""
        return self.choices[int(share * len(self.choices))]

    def value(self, suggested: str) -> Any:
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


def _is_one(known: Any, value: Any) -> bool:
    """Whether two values are one, whatever comparing them gives: 1 is not True."""
    if isinstance(known, bool) != isinstance(value, bool):
        return False
    try:
        return known is value or bool(known == value)
    except Exception:  # arrays, for example
        return False


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
    return _number_axis(runner, token, param)


def _number_axis(runner: CompGraphRunner, token: str, param: Param) -> NumberAxis:
    low: Any
    high: Any
    low, high = param.soft or (param.low, param.high)
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
    axis = NumberAxis(token, low, high, step, param.log, _token_below(runner, token, param.below))
    return axis if step is None else replace(axis, high=axis._value(axis.size - 1))


def _is_number(value: Any) -> bool:
    return isinstance(value, numbers.Real) and not isinstance(value, bool) and math.isfinite(value)


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


def bounded(axes: Sequence[Axis], values: Setting, present: Setting) -> dict[str, Any]:
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
                kept[axis.token] = axis.value(float(bound), math.floor)
    return kept


# -- ranges as the caller gives them ------------------------------------------------------------------------------


def _require_settable(runner: CompGraphRunner, settings: Iterable[Setting]) -> None:
    """Raise, as the runner does, unless all these values could be set: for a wrong name, or a branch that is none."""
    trial = branched(runner)
    for setting in settings:
        trial.set(**setting)


def _param(runner: CompGraphRunner, name: str, given: Any) -> Param:
    """Return the range or the choices that are given for a hyperparameter; None stands for its hint."""
    _require_settable(runner, [{name: runner.hyperparameters.get(name)}])
    if given is None:
        found = range_of(runner.cg, name, runner.hyperparameters[name])
        if isinstance(found, Param):
            return found
        raise ScaleError(
            f"No hint gives the values that {name!r} may take. Give a list of values, or a range, as (low, high)."
        )
    values = given
    if hasattr(given, "tolist"):  # of numpy, as numbers of Python; of an array without axes the one that it holds
        values = given.tolist()
    elif isinstance(given, Iterable) and not isinstance(given, str | bytes | Mapping | tuple):
        values = list(islice(given, MOST_OUTCOMES + 1))
    if isinstance(values, list) and not values:
        raise ScaleError(f"{name}={given!r:.60} has no values. Give at least one, as {name}=[...].")
    try:
        param = as_param(values)
    except (TypeError, ValueError) as error:
        raise ScaleError(f"{name}={given!r:.60}: {error}") from error
    if not isinstance(param, Param):
        raise ScaleError(
            f"{name}={given!r:.60} is neither a range, as (low, high), nor a list of values. Write {name}=[...]."
        )
    _require_settable(runner, ({name: choice} for choice in param.choices or ()))
    return param


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
    UnknownName, HyperparameterError
        A range is for what is no hyperparameter of the runner.
    ScaleError
        A range can't be searched, or there is none.
    """
    present = runner.hyperparameters
    if ranges is None:
        found = tuple(_hinted_axes(runner))
        if found:
            return found
        if not present:
            raise ScaleError(
                "The runner has no hyperparameters, so nothing can vary. Freeze some: runner.freeze(name=value)."
            )
        text = f"No hint gives a range for {', '.join(map(repr, present))}."
        raise ScaleError(f"{text} Give some: ranges={{'name': (low, high)}}, or annotate the functions.")
    if not ranges:
        raise ScaleError('ranges is empty, so nothing would vary. Name hyperparameters: ranges={"name": (low, high)}.')
    params = {token: _param(runner, token, given) for token, given in ranges.items()}
    for token, param in params.items():
        if param.choices is None and not _is_number(plain(present[token])):
            text = f"{token!r} is {present[token]!r:.60}, so it has no range of numbers."
            raise ScaleError(f"{text} Give a list of choices: ranges={{{token!r}: [...]}}.")
    return tuple(
        axis_of(runner, token, params[token]) for token in _in_graph_order(present, runner.cg) if token in params
    )


def _in_graph_order(hyperparameters: Iterable[str], cg: CompGraph) -> list[str]:
    """Return the graph's own hyperparameters in its order, then those of pipelines in it."""
    places = {token: place for place, token in enumerate(cg.source_tokens)}
    return sorted(hyperparameters, key=lambda token: places.get(token, len(places)))


def _hinted_axes(runner: CompGraphRunner) -> Iterator[Axis]:
    present = runner.hyperparameters
    for token in _in_graph_order(present, runner.cg):
        value = present[token]
        param = range_of(runner.cg, token, value)
        if param is None and isinstance(value, bool | enum.Enum):
            param = param_from_value(value)
        if not isinstance(param, Param):
            continue
        if param.soft is not None:
            low, high = param.soft
            param = replace(param, low=min(low, plain(value)), high=max(high, plain(value)), soft=None)
        if param.choices is not None or (_is_number(param.low) and _is_number(param.high)):
            yield axis_of(runner, token, param)


# -- grids --------------------------------------------------------------------------------------------------------


def require_room(size: int, names: Iterable[str], images: int = 1) -> None:
    """Raise ScaleError if the outcomes of so many settings, each on so many images, are too many to hold."""
    if size * images > MOST_OUTCOMES:
        each = f" on {images:,} images" if images != 1 else ""
        raise ScaleError(
            f"The grid has {size:,} settings of {', '.join(names)}{each}: {size * images:,} outcomes, "
            f"and at most {MOST_OUTCOMES:,} can be held. Take fewer values, or how='random' with n=..."
        )


def settings_of(
    runner: CompGraphRunner, grid: Any, *, how: str = "product", n: int | None = None, seed: int = 0
) -> tuple[Setting, ...]:
    """Return the settings of a grid, each with a value for every hyperparameter that varies; see ``sweep``.

    Raises
    ------
    ScaleError
        It does not tell which settings are meant, is empty, or has too many settings to hold.
    UnknownName, HyperparameterError
        A name is not a hyperparameter of the runner, or a value none that the runner can have.
    """
    if how not in get_args(How):
        raise UnknownName("way to read a grid", how, get_args(How), "for how=")
    is_drawn = how in ("random", "latin")
    if is_drawn and (type(n) is not int or n < 1):
        raise ScaleError(f"how={how!r} draws n settings. Say how many, as n=50, not {n!r}.")
    if n is not None and not is_drawn:
        raise ScaleError(
            f"n={n!r} goes with how='random' or how='latin'. A {how} has as many settings as its values make."
        )
    if _is_list_of(grid, Mapping):
        return _listed(runner, grid)
    given = dict.fromkeys(grid) if _is_list_of(grid, str) else grid
    if not isinstance(given, Mapping) or not given:
        raise ScaleError(
            f"grid is a mapping of hyperparameters to values, as {{'threshold': [50, 70]}}, not {grid!r:.60}."
        )
    if is_drawn:
        require_room(n or 0, given)
        return _drawn(runner, given, how, n or 0, seed)
    return _combined(runner, given, how)


def _is_list_of(grid: Any, kind: type) -> bool:
    return isinstance(grid, list | tuple) and bool(grid) and all(isinstance(one, kind) for one in grid)


def _listed(runner: CompGraphRunner, grid: Sequence[Setting]) -> tuple[Setting, ...]:
    """Return settings that are taken as they are; what one leaves out is the runner's."""
    names = tuple(dict.fromkeys(name for setting in grid for name in setting))
    if not names:
        raise ScaleError("No setting of the grid names a hyperparameter. Give some, as [{'threshold': 50}, ...].")
    _require_settable(runner, grid)
    now = {name: runner.hyperparameters[name] for name in names}
    return tuple({**now, **setting} for setting in grid)


def _combined(runner: CompGraphRunner, given: Mapping[str, Any], how: str) -> tuple[Setting, ...]:
    """Return the settings of each value with each other, or of the first values of all, the second ones, and so on."""
    values: dict[str, Sequence[Any]] = {}
    for name, of_name in given.items():
        if isinstance(of_name, tuple):
            listed = f"[{', '.join(map(repr, of_name[:4]))}{', ...' * (len(of_name) > 4)}]"
            raise ScaleError(
                f"{name}={of_name!r:.60} is a range, as everywhere in EPypes. For these values write {name}={listed}; "
                f"for values between two ends how='random' with n=..."
            )
        param = _param(runner, name, of_name)
        values[name] = param.choices or _number_axis(runner, name, param).values()
    lengths = {name: len(of_name) for name, of_name in values.items()}
    if how == "zip" and len(set(lengths.values())) > 1:
        counts = ", ".join(f"{name} has {length}" for name, length in lengths.items())
        raise ScaleError(
            f"how='zip' takes the first values together, then the second, and so on, but {counts}. "
            "Give as many of each."
        )
    require_room(max(lengths.values()) if how == "zip" else math.prod(lengths.values()), values)
    combine: Callable[..., Iterable[tuple[Any, ...]]] = zip if how == "zip" else product
    return tuple(dict(zip(values, row, strict=True)) for row in combine(*values.values()))


def _drawn(runner: CompGraphRunner, given: Mapping[str, Any], how: str, n: int, seed: int) -> tuple[Setting, ...]:
    """Return settings that are drawn: at random, or by Latin hypercubes, with each n-th part once."""
    import numpy as np

    axes = [axis_of(runner, name, _param(runner, name, of_name)) for name, of_name in given.items()]
    generator = np.random.default_rng(seed)
    if how == "random":
        rows = generator.random((n, len(axes)))
    else:
        with optional_import():
            from scipy.stats import qmc
        rows = qmc.LatinHypercube(len(axes), seed=generator).random(n)
    drawn = ({axis.token: axis.at(share) for axis, share in zip(axes, row, strict=True)} for row in rows.tolist())
    return tuple(bounded(axes, setting, runner.hyperparameters) for setting in drawn)


# -- the order in which settings are run --------------------------------------------------------------------------


def running_order(cg: CompGraph, settings: Sequence[Setting]) -> list[int]:
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


def steps(cg: CompGraph, settings: Sequence[Setting]) -> list[int]:
    """Return where, in running order, the hyperparameter that changes least often has a new value: 0, and others."""
    slowest = _slowest_first(cg, settings)[0]
    of_slowest = [identity(setting[slowest]) for setting in settings]
    return [0, *(place for place, (one, other) in enumerate(pairwise(of_slowest), 1) if one != other)]


def _slowest_first(cg: CompGraph, settings: Sequence[Setting]) -> list[str]:
    return sorted(settings[0], key=lambda name: -len(functions_after(cg, name)))


def functions_after(cg: CompGraph, *tokens: str) -> frozenset[str]:
    """Return the functions that depend on one of these tokens, directly or by what others make of it."""
    made, found = set(tokens), set[str]()
    for function in cg.functions:  # in run order
        if not made.isdisjoint(cg.func_inputs(function)):
            found.add(function)
            made.update(cg.func_outputs(function))
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
