"""Grids of hyperparameter values: the settings that they stand for, and the order in which they run.

Settings are counted before any is written out, so that a grid which is too large costs nothing.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence, Sized
from dataclasses import dataclass
from itertools import islice, pairwise, product
from typing import Any, Final, Literal, get_args

from epypes.batch.ranges import axis_of, bounded, shares
from epypes.catalog import range_of
from epypes.errors import ScaleError, UnknownName
from epypes.graph import CompGraph, as_switch
from epypes.hints import Param, as_param
from epypes.run import CompGraphRunner

How = Literal["product", "zip", "random", "latin"]
Setting = Mapping[str, Any]

# More outcomes are too many to hold, and to look at.
MOST_OUTCOMES: Final = 100_000


@dataclass(frozen=True, slots=True)
class Grid:
    """Settings that are not written out yet.

    Attributes
    ----------
    names
        The hyperparameters that vary, in the order in which they were given.
    size
        How many settings there are.
    settings
        Returns them, each with a value for every name.
    """

    names: tuple[str, ...]
    size: int
    settings: Callable[[], tuple[Setting, ...]]

    def require_room(self, images: int) -> None:
        """Raise ScaleError if the settings, each on so many images, are too many to hold."""
        outcomes = self.size * images
        if outcomes <= MOST_OUTCOMES:
            return
        each = f" on {images:,} images" if images != 1 else ""
        raise ScaleError(
            f"The grid has {self.size:,} settings of {', '.join(self.names)}{each}: {outcomes:,} outcomes, "
            f"and at most {MOST_OUTCOMES:,} can be held. Take fewer values, or how='random' with n=..."
        )


def grid_of(runner: CompGraphRunner, grid: Any, *, how: str = "product", n: int | None = None, seed: int = 0) -> Grid:
    """Read a grid; see ``sweep``.

    Raises
    ------
    ScaleError
        It does not tell which settings are meant, or is empty.
    UnknownName, HyperparameterError
        A name is not a hyperparameter of the runner.
    """
    _require_how(how, n)
    if _is_list_of(grid, Mapping):
        return _listed(runner, grid)
    axes = dict.fromkeys(grid) if _is_list_of(grid, str) else grid
    if not isinstance(axes, Mapping) or not axes:
        raise ScaleError(
            f"grid is a mapping of hyperparameters to values, as {{'threshold': [50, 70]}}, not {grid!r:.60}."
        )
    for name in axes:
        require_hyperparameter(runner, name)
    if how in ("random", "latin"):
        return _drawn(runner, axes, how, n or 0, seed)
    values = {name: _values(runner, name, given) for name, given in axes.items()}
    return _combined(runner, values, how)


def require_hyperparameter(runner: CompGraphRunner, name: Any) -> None:
    """Raise, with the nearest name, unless a runner has this hyperparameter."""
    known = tuple(runner.hyperparameters)
    if name in known:
        return
    if name in runner.free_source_tokens:
        raise ScaleError(f"{name!r} is a free source token, which images are given to. Freeze it, or give images=...")
    raise UnknownName("hyperparameter", name, known)


def _require_how(how: str, n: int | None) -> None:
    if how not in get_args(How):
        raise UnknownName("way to read a grid", how, get_args(How), "for how=")
    is_drawn = how in ("random", "latin")
    if is_drawn and (type(n) is not int or n < 1):
        raise ScaleError(f"how={how!r} draws n settings. Say how many, as n=50, not {n!r}.")
    if n is not None and not is_drawn:
        raise ScaleError(
            f"n={n!r} goes with how='random' or how='latin'. A {how} has as many settings as its values make."
        )


# -- a list of settings ---------------------------------------------------------------------------------------------


def _is_list_of(grid: Any, kind: type) -> bool:
    return isinstance(grid, list | tuple) and bool(grid) and all(isinstance(one, kind) for one in grid)


def _listed(runner: CompGraphRunner, grid: Sequence[Setting]) -> Grid:
    names = tuple(dict.fromkeys(name for setting in grid for name in setting))
    if not names:
        raise ScaleError("No setting of the grid names a hyperparameter. Give some, as [{'threshold': 50}, ...].")
    for name in names:
        require_hyperparameter(runner, name)
        _require_branches(runner, name, [setting[name] for setting in grid if name in setting])
    now = {name: runner.hyperparameters[name] for name in names}
    return Grid(names, len(grid), lambda: tuple({**now, **setting} for setting in grid))


# -- values by hyperparameter ---------------------------------------------------------------------------------------


def _values(runner: CompGraphRunner, name: str, given: Any) -> Sequence[Any]:
    """Return the values of one hyperparameter, sized, and not copied if they are."""
    if given is None or isinstance(given, Param):
        param = _hint(runner, name) if given is None else given
        return axis_of(runner, name, param).values(MOST_OUTCOMES)
    if isinstance(given, tuple):
        listed = f"[{', '.join(map(repr, given[:4]))}{', ...' * (len(given) > 4)}]"
        raise ScaleError(
            f"{name}={given!r:.60} is a range, as everywhere in EPypes. For these values write {name}={listed}; "
            f"for values between two ends how='random' with n=..."
        )
    if hasattr(given, "tolist"):
        given = given.tolist()  # of numpy, as numbers of Python; of an array without axes the one that it holds
    if isinstance(given, str | bytes | Mapping) or not isinstance(given, Iterable):
        raise ScaleError(f"{name}={given!r:.60} is no list of values. Write {name}=[{given!r:.60}, ...].")
    values = _counted(given)
    if not len(values):
        raise ScaleError(f"{name} has no values. Give at least one, or leave it out of the grid.")
    return values


def _counted(given: Iterable[Any]) -> Sequence[Any]:
    if isinstance(given, Sequence):
        return given
    if isinstance(given, Sized) and len(given) > MOST_OUTCOMES:
        return range(len(given))  # to be counted, and refused
    return tuple(islice(given, MOST_OUTCOMES + 1))


def _hint(runner: CompGraphRunner, name: str) -> Param:
    found = range_of(runner.cg, name, runner.hyperparameters[name])
    if isinstance(found, Param):
        return found
    raise ScaleError(
        f"No hint gives the values that {name!r} may take. Give a list of values, or a range, as (low, high)."
    )


def _combined(runner: CompGraphRunner, values: Mapping[str, Sequence[Any]], how: str) -> Grid:
    """Return the grid of each value with each other, or of the first values of all, the second ones, and so on."""
    lengths = {name: len(given) for name, given in values.items()}
    if how == "zip" and len(set(lengths.values())) > 1:
        counts = ", ".join(f"{name} has {length}" for name, length in lengths.items())
        raise ScaleError(
            f"how='zip' takes the first values together, then the second, and so on, but {counts}. "
            "Give as many of each."
        )
    size = max(lengths.values()) if how == "zip" else math.prod(lengths.values())
    if size <= MOST_OUTCOMES:
        for name, given in values.items():
            _require_branches(runner, name, given)
    combine: Callable[..., Iterable[tuple[Any, ...]]] = zip if how == "zip" else product
    return Grid(
        tuple(values), size, lambda: tuple(dict(zip(values, row, strict=True)) for row in combine(*values.values()))
    )


def _require_branches(runner: CompGraphRunner, name: str, values: Iterable[Any]) -> None:
    """Raise UnknownName, with the nearest name, unless the switches that a token selects have these branches."""
    cg = runner.cg
    for function in cg.digraph.consumers.get(name, ()):
        switch = as_switch(cg.functions[function])
        if switch is not None and cg.func_inputs(function)[0] == name:
            for value in values:
                switch.branch_index(value)


# -- drawn by chance ------------------------------------------------------------------------------------------------


def _drawn(runner: CompGraphRunner, grid: Mapping[str, Any], how: str, n: int, seed: int) -> Grid:
    params = {name: _hint(runner, name) if given is None else _as_range(name, given) for name, given in grid.items()}
    for name, param in params.items():
        _require_branches(runner, name, param.choices or ())
    axes = [axis_of(runner, name, param) for name, param in params.items()]
    present = runner.hyperparameters

    def settings() -> tuple[Setting, ...]:
        rows = shares(how, n, len(axes), seed)
        drawn = ({axis.token: axis.at(share) for axis, share in zip(axes, row, strict=True)} for row in rows)
        return tuple(bounded(axes, setting, present) for setting in drawn)

    return Grid(tuple(params), n, settings)


def _as_range(name: str, given: Any) -> Param:
    if isinstance(given, range) or hasattr(given, "tolist"):
        given = list(given) if isinstance(given, range) else given.tolist()
    try:
        param = as_param(given)
    except ValueError as error:
        raise ScaleError(f"{name}={given!r:.60}: {error}") from error
    if not isinstance(param, Param):
        raise ScaleError(f"{name}={given!r:.60} is neither a range, as (low, high), nor a list of values.")
    return param


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
