"""Which values may each hyperparameter of a runner take?

The hint that the user gave comes first, then the annotation of a function that takes the token, then the value.
No widgets here.
"""

from __future__ import annotations

import math
import numbers
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from epypes.errors import UnknownName
from epypes.graph import CompGraph, annotated_params
from epypes.hints import Param, Roi, Text, as_param, param_from_value
from epypes.run import CompGraphRunner


def ranges(runner: CompGraphRunner, hints: Mapping[str, Any]) -> dict[str, Param | Roi | Text | None]:
    """Return the range of every hyperparameter, in graph order; None for one that can only be shown.

    Parameters
    ----------
    runner
        Its hyperparameters and their values are read.
    hints
        By token: a Param, a tuple as a range, a list as choices.

    Raises
    ------
    UnknownName
        A hint is for a name that is not a hyperparameter of the runner.
    TypeError
        A hint is neither a Param, nor a tuple, nor a list.
    ValueError
        A hint contradicts itself, or the value that the hyperparameter has lies outside of it.
    """
    values = runner.hyperparameters
    for name in hints:
        if name not in values:
            raise UnknownName("hyperparameter", name, values, "of this runner")
    given = {name: _read(name, hint, values[name]) for name, hint in hints.items()}
    return {
        token: _settled(given.get(token) or _guess(runner.cg, token, values[token]), values[token])
        for token in runner.cg.source_tokens
        if token in values
    }


def allows(param: Param | Roi | Text, value: Any) -> bool:
    """Whether a value is within a range; one that can't be compared is not."""
    try:
        return bool(param.allows(value))
    except (TypeError, ValueError):
        return False


def described(param: Param | Roi | Text) -> str:
    """Return a range in words, as "odd 1 to 31" or "one of 'canny', 'sobel'"."""
    if not isinstance(param, Param):
        return "any text" if isinstance(param, Text) else "(x, y, width, height), whole and not negative"
    if param.choices is not None:
        return f"one of {', '.join(map(repr, param.choices))}"
    low = "below" if param.low is None else f"{param.low:g}"
    high = "above" if param.high is None else f"{param.high:g}"
    return f"{'odd ' * param.odd}{low} to {high}"


def _settled(param: Param | Roi | None, value: Any) -> Param | Roi | Text | None:
    if isinstance(value, str) and param is None:
        return Text()
    return closed(param, value) if isinstance(param, Param) else param


def closed(param: Param | None, value: Any) -> Param | None:
    """Return a range whose open ends are taken from the value; None if it can't be moved along.

    Notes
    -----
    Booleans, enumerations and choices have no ends. A value that is not a finite number has no range.
    """
    if param is None or param.choices is not None:
        return param
    if not _is_number(value):
        return None
    guess = param_from_value(_plain(value))
    if guess is None or guess.low is None or guess.high is None:
        return None
    low, high = param.low, param.high
    if low is None:
        low = min(guess.low, guess.high if high is None else high)
    if high is None:
        high = max(guess.high, 10 * low if param.log else low + 1)
    return replace(param, low=low, high=high)


def _read(name: str, hint: Any, value: Any) -> Param | Roi:
    try:
        param = as_param(hint)
    except ValueError as error:
        raise ValueError(f"Hint of {name!r}: {error}") from error
    if param is None:
        raise TypeError(
            f"Hint of {name!r} is {hint!r:.60}. Give an ep.Param, a tuple as a range (low, high), or a list of choices."
        )
    if not allows(param, value):
        raise ValueError(
            f"{name!r} is {value!r:.60}, outside of its hint ({described(param)}). "
            f"Set runner[{name!r}] to a value inside, or widen the hint."
        )
    return param


def _guess(cg: CompGraph, token: str, value: Any) -> Param | None:
    """Return what the annotations say, if it fits the value, else what the value says."""
    fitting = (param for param in annotated_params(cg, token) if allows(param, value))
    return next(fitting, None) or param_from_value(_plain(value))


def _plain(value: Any) -> Any:
    """Return a number of NumPy as Python's: ranges are guessed from Python's types."""
    if not _is_number(value):
        return value
    return int(value) if isinstance(value, numbers.Integral) else float(value)


def _is_number(value: Any) -> bool:
    real = isinstance(value, numbers.Real) and not isinstance(value, bool)
    try:
        return real and math.isfinite(float(value))
    except (OverflowError, TypeError):  # 10**400, or a duration of NumPy
        return False
