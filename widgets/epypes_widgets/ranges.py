"""Which values may each hyperparameter of a runner take?

The hint that the user gave comes first, then the annotation of a function that takes the token, then the table of
OpenCV's and scikit-image's parameters, then the value. No widgets here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from epypes.errors import UnknownName
from epypes.hints import Param, Roi, Text, as_param, param_from_value
from epypes_widgets.guesses import guess
from epypes_widgets.movable import is_movable, plain
from epypes_widgets.pairs import paired
from epypes_widgets.places import Tunable

Range = Param | Roi | Text | None


def ranges(runner: Tunable, hints: Mapping[str, Any]) -> dict[str, Range]:
    """Return the range of every hyperparameter, in graph order; None for one that can only be shown.

    Parameters
    ----------
    runner
        Its hyperparameters and their values are read.
    hints
        By token: a Param or Roi, a tuple as a range, a list as choices.

    Returns
    -------
    dict
        By token. A Param has choices, or two hard ends, or ``soft``. Of two tokens that bound a range, the lower one
        says so by ``below``.

    Raises
    ------
    UnknownName
        A hint is for a name that is not a hyperparameter of the runner, or speaks of a token that isn't there.
    TypeError
        A hint is neither a Param or Roi, nor a tuple, nor a list.
    ValueError
        A hint contradicts itself, or the value that the hyperparameter has lies outside of it.
    """
    values = runner.hyperparameters
    for name in hints:
        if name not in values:
            raise UnknownName("hyperparameter", name, values, "of this runner")
    given = {name: _read(runner, name, hint) for name, hint in hints.items()}
    found = {
        token: closed(given[token] if token in given else guess(runner, token), values[token])
        for token in runner.cg.source_tokens
        if token in values
    }
    return paired(runner, found, given)


def allows(param: Param | Roi | Text, value: Any) -> bool:
    """Whether a value is within a range; one that can't be compared is not."""
    try:
        return bool(param.allows(value))
    except (TypeError, ValueError):
        return False


def described(param: Param | Roi | Text) -> str:
    """Return a range in words, as "odd 1 to 31", "from 0" or "one of 'canny', 'sobel'"."""
    if isinstance(param, Roi):
        return "x, y, width, height in pixels"
    if isinstance(param, Text):
        return "any text"
    if param.choices is not None:
        return f"one of {', '.join(param.labels or map(repr, param.choices))}"
    odd = "odd " * param.odd
    if param.low is not None and param.high is not None:
        return f"{odd}{param.low:g} to {param.high:g}"
    if param.low is None and param.high is None:
        return f"any {odd}number"
    return f"{odd}from {param.low:g}" if param.high is None else f"{odd}up to {param.high:g}"


def closed(param: Range, value: Any) -> Range:
    """Return a range of which something can be offered: one with an open end gets a soft range, around the value.

    None if the value can't be moved along it: one that is not a finite number has no range.
    """
    if not isinstance(param, Param) or param.choices is not None:
        return param
    if not is_movable(value):
        return None
    if param.soft is not None:
        low, high = param.soft
        return replace(param, soft=(min(low, plain(value)), max(high, plain(value))))
    if param.low is not None and param.high is not None:
        return param
    around = param_from_value(plain(value))
    if around is None or around.low is None or around.high is None:
        return None
    low = around.low if param.low is None else param.low
    if param.low is None and param.high is not None:
        low = min(low, param.high)
    high = param.high if param.high is not None else max(around.high, 10 * low if param.log else low + 1)
    return replace(param, soft=(low, high))


def _read(runner: Tunable, name: str, hint: Any) -> Param | Roi:
    value = runner.hyperparameters[name]
    try:
        param = as_param(hint)
    except (TypeError, ValueError) as error:
        raise ValueError(f"Hint of {name!r}: {error}") from error
    if param is None:
        raise TypeError(
            f"Hint of {name!r} is {hint!r:.60}. Give an ep.Param, a tuple as a range (low, high), a list of choices, "
            "or an ep.Roi."
        )
    if not allows(param, value):
        raise ValueError(
            f"{name!r} is {value!r:.60}, outside of its hint ({described(param)}). "
            f"Set runner[{name!r}] to a value inside, or widen the hint."
        )
    for token in (param.on,) if isinstance(param, Roi) else (param.cuts,):
        if token:
            runner.cg.require_token(token)
    if isinstance(param, Param) and param.below and param.below not in runner.hyperparameters:
        raise UnknownName("hyperparameter", param.below, runner.hyperparameters, "of this runner")
    return param
