"""The values that each hyperparameter of a runner may take, and which two of them are the ends of one range.

The hint that the user gave comes first, then the annotation of a function that takes the token, then the catalog of
OpenCV's and scikit-image's parameters, then the value. No widgets here.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from epypes.catalog import entry_of, fits, parameter_names, uses, usual
from epypes.catalog.ranges import without_negative
from epypes.errors import UnknownName
from epypes.graph import CompGraph, annotated_params, as_switch
from epypes.hints import Param, Roi, Text, as_param, param_from_value
from epypes_widgets.target import Tunable
from epypes_widgets.values import as_python, is_integer, is_movable

Range = Param | Roi | Text | None

_RECTANGLES: Final = frozenset(("roi", "rect", "rectangle", "crop", "box", "bbox", "window"))
_THRESHOLDS: Final = frozenset(("thresh", "threshold", "level", "cutoff"))
_UPPER: Final = {"lo": "hi", "low": "high", "min": "max", "lower": "upper", "minimum": "maximum"}
_NUMBERED: Final = frozenset(("threshold", "thresh"))


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
        names the other by ``below``.

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
        token: _closed(given[token] if token in given else _guess(runner, token), values[token])
        for token in runner.cg.source_tokens
        if token in values
    }
    return _paired(runner, found, given)


def allows(param: Param | Roi | Text, value: Any) -> bool:
    """Whether a value is within a range; one that can't be compared is not."""
    try:
        return bool(param.allows(value))
    except Exception:  # whatever a user's own class raises
        return False


def range_text(param: Param | Roi | Text) -> str:
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


def _closed(param: Range, value: Any) -> Range:
    """Return a range of which something can be offered: one with an open end gets a soft range, around the value.

    None if the value can't be moved along it: one that is not a finite number has no range.
    """
    if not isinstance(param, Param) or param.choices is not None:
        return param
    if not is_movable(value):
        return None
    if param.soft is not None:
        low, high = param.soft
        return replace(param, soft=(min(low, as_python(value)), max(high, as_python(value))))
    if param.low is not None and param.high is not None:
        return param
    around = param_from_value(as_python(value))
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
            f"{name!r} is {value!r:.60}, outside of its hint ({range_text(param)}). "
            f"Set runner[{name!r}] to a value inside, or widen the hint."
        )
    for token in (param.on,) if isinstance(param, Roi) else (param.cuts,):
        if token:
            runner.cg.require_token(token)
    if isinstance(param, Param) and param.below and param.below not in runner.hyperparameters:
        raise UnknownName("hyperparameter", param.below, runner.hyperparameters, "of this runner")
    return param


@dataclass(frozen=True, slots=True)
class Taker:
    """A function that takes a hyperparameter, and where.

    Attributes
    ----------
    name
        The function's name in the graph.
    function
        The function.
    parameter
        What it calls the hyperparameter; empty if that is not known.
    tokens
        Its inputs by the names of its parameters, as far as they are known.
    """

    name: str
    function: Any
    parameter: str
    tokens: dict[str, str]


def takers(cg: CompGraph, token: str) -> Iterator[Taker]:
    """Yield the functions that take a token, in run order."""
    for name in cg.digraph.consumers.get(token, ()):
        inputs = cg.func_inputs(name)
        parameters = parameter_names(cg.functions[name])
        position = inputs.index(token)
        parameter = parameters[position] if position < len(parameters) else ""
        yield Taker(name, cg.functions[name], parameter, dict(zip(parameters, inputs, strict=False)))


# -- without a hint -------------------------------------------------------------------------------------------------


def _guess(runner: Tunable, token: str) -> Range:
    """Return the range that annotations, the catalog or the value give; what the value does not fit is passed over."""
    value = runner.hyperparameters[token]
    for source in (_annotated, _selected, _cataloged, _valued):
        try:
            found = source(runner, token, value)
            if found is not None and allows(found, value):
                return found
        except Exception:  # noqa: S112 - values are any objects; one that can't be compared has no range
            continue
    return None


def _annotated(runner: Tunable, token: str, value: Any) -> Param | Roi | None:
    """Return a fitting annotation in which parameters of the function are named by the tokens they get."""
    cg = runner.cg
    found = next((param for param in annotated_params(cg, token) if allows(param, value)), None)
    if found is None:
        return None
    tokens = {name: taken for taker in reversed([*takers(cg, token)]) for name, taken in taker.tokens.items()}

    def named(name: str) -> str:
        return name if name in cg.tokens else tokens.get(name, "")

    if isinstance(found, Roi):
        return replace(found, on=named(found.on))
    if not found.below and not found.cuts:
        return found
    below = named(found.below)
    return replace(found, below=below if below in runner.hyperparameters else "", cuts=named(found.cuts))


def _selected(runner: Tunable, token: str, value: Any) -> Param | None:
    """Return the branches that a hyperparameter chooses among."""
    for taker in takers(runner.cg, token):
        switch = as_switch(taker.function)
        if switch is not None and runner.cg.func_inputs(taker.name)[0] == token:
            return Param(choices=switch.branches)
    return None


def _cataloged(runner: Tunable, token: str, value: Any) -> Param | None:
    if not is_movable(value) and not isinstance(value, str | bool):
        return None
    found = _by_function(runner, token, value) or _by_name(runner, token, value)
    if found is None or found.choices is not None:
        return found
    return without_negative(found, as_python(value))


def _by_function(runner: Tunable, token: str, value: Any) -> Param | None:
    for taker in takers(runner.cg, token):
        entry = entry_of(taker.function, taker.parameter)
        image = "" if entry is None else entry.cuts
        used = [(use.entry, use.cuts) for use in uses(taker.function, taker.parameter) if use.entry]
        for known, parameter in [(entry, image), *used]:
            param = None if known is None else known.resolved()
            if param is None or not _fits(param, value):
                continue
            if param.choices is not None:
                return param
            return replace(param, cuts=_payload(runner, taker.tokens.get(parameter, "")))
    return None


def _by_name(runner: Tunable, token: str, value: Any) -> Param | None:
    known = list(takers(runner.cg, token))
    cuts = next(filter(None, (_cut_by(runner, taker, token) for taker in known)), "")
    # What is compared with an image is a threshold, whatever it is called.
    asked = dict.fromkeys([*(taker.parameter for taker in known), token, *(["threshold"] if cuts else [])])
    found = next(filter(None, (usual(name, as_python(value)) for name in asked if name)), None)
    if found is None or not _fits(found, value):
        return None
    return replace(found, cuts=cuts) if cuts and found.choices is None else found


def _cut_by(runner: Tunable, taker: Taker, token: str) -> str:
    """Return the token that a function compares with this one; empty if that is not known."""
    found = uses(taker.function, taker.parameter)
    compared = (_payload(runner, taker.tokens.get(use.cuts, "")) for use in found if use.entry is None)
    image = next(filter(None, compared), "")
    if image:
        return image
    inputs = [name for name in runner.cg.func_inputs(taker.name) if _payload(runner, name)]
    is_threshold = bool(_THRESHOLDS & {*_words(taker.parameter), *_words(token)})
    known = any(use.entry is not None for use in found)  # a function whose thresholds are not of values, as Canny
    return inputs[0] if is_threshold and len(inputs) == 1 and not known else ""


def _payload(runner: Tunable, token: str) -> str:
    return "" if token in runner.hyperparameters else token


def _valued(runner: Tunable, token: str, value: Any) -> Range:
    if isinstance(value, str):
        return Text()
    if isinstance(value, tuple | list):
        names = (token, *(taker.parameter for taker in takers(runner.cg, token)))
        return Roi() if any(_RECTANGLES.intersection(_words(name)) for name in names) else None
    param = param_from_value(as_python(value))
    if param is None or param.choices is not None or param.low is None or param.high is None:
        return param
    return Param(step=param.step, soft=(param.low, param.high))


def _fits(param: Param, value: Any) -> bool:
    return (param.choices is not None or is_movable(value)) and fits(param, value)


def _words(name: str) -> tuple[str, ...]:
    """Return the words of a name in lower case, numbers apart: ("block", "size", "1") of ``blockSize_1``."""
    return tuple(word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", name))


# -- pairs ----------------------------------------------------------------------------------------------------------


def _paired(runner: Tunable, found: Mapping[str, Range], given: Mapping[str, Range]) -> dict[str, Range]:
    """Return ranges in which the lower one of two tokens names the other by ``below``.

    A hint's ``below`` is kept, or refused with ValueError. Else two tokens are a pair if they go into one function,
    neither has a hint, their names or those of their parameters differ by low and high, and their values are of one
    type and in order.
    """
    ranges, values = dict(found), runner.hyperparameters
    taken: set[str] = set()

    def take(low: str, high: str) -> bool:
        fits = low != high and not {low, high} & taken and _is_pair(values, low, high, ranges)
        taken.update((low, high) if fits else ())
        return fits

    for token, param in found.items():
        if not isinstance(param, Param) or not param.below or take(token, param.below):
            continue
        if token in given:
            raise ValueError(
                f"{token!r} ({values[token]!r:.60}) is hinted to stay below {param.below!r} "
                f"({values[param.below]!r:.60}). Both must be numbers of one type, in order, and in no other pair. "
                "Set them so, or leave below out."
            )
        ranges[token] = replace(param, below="")
    for low, high in _named_pairs(runner, [token for token in ranges if token not in given]):
        param = ranges[low]
        if isinstance(param, Param) and take(low, high):
            ranges[low] = replace(param, below=high)
    return ranges


def _is_pair(values: Mapping[str, Any], low: str, high: str, ranges: Mapping[str, Range]) -> bool:
    params = (ranges.get(low), ranges.get(high))
    if not all(isinstance(param, Param) and param.choices is None for param in params):
        return False
    one, other = values[low], values[high]
    is_moved = is_movable(one) and is_movable(other)
    return is_moved and is_integer(one) == is_integer(other) and bool(one <= other)


def _named_pairs(runner: Tunable, tokens: list[str]) -> Iterator[tuple[str, str]]:
    """Yield the tokens whose names differ by low and high, and those whose parameters do."""
    for token in tokens:
        for taker in takers(runner.cg, token):
            inputs = runner.cg.func_inputs(taker.name)
            by_name = (other for other in inputs if _words(other) in _uppers(token))
            by_parameter = (other for name, other in taker.tokens.items() if _words(name) in _uppers(taker.parameter))
            yield from ((token, other) for other in (*by_name, *by_parameter) if other in tokens)


def _uppers(name: str) -> list[tuple[str, ...]]:
    """Return the words that the name of the upper end would have."""
    own = _words(name)
    found = [(*own[:place], _UPPER[word], *own[place + 1 :]) for place, word in enumerate(own) if word in _UPPER]
    if len(own) > 1 and own[-1] == "1" and own[-2] in _NUMBERED:
        found.append((*own[:-1], "2"))
    return found
