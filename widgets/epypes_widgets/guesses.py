"""The values that a hyperparameter may take for which the user gave no hint."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Final

from epypes.catalog import entry_of, fits, parameter_names, uses, usual
from epypes.catalog.ranges import without_negative
from epypes.graph import CompGraph, annotated_params, as_switch
from epypes.hints import Param, Roi, Text, param_from_value
from epypes_widgets.movable import is_movable, plain
from epypes_widgets.places import Tunable

_RECTANGLES: Final = frozenset(("roi", "rect", "rectangle", "crop", "box", "bbox", "window"))
_THRESHOLDS: Final = frozenset(("thresh", "threshold", "level", "cutoff"))


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
    """Give the functions that take a token, in run order."""
    for name in cg.digraph.consumers.get(token, ()):
        inputs = cg.func_inputs(name)
        parameters = parameter_names(cg.functions[name])
        tokens = dict(zip(parameters, inputs, strict=False))
        position = inputs.index(token)
        parameter = parameters[position] if position < len(parameters) else ""
        yield Taker(name, cg.functions[name], parameter, tokens)


def guess(runner: Tunable, token: str) -> Param | Roi | Text | None:
    """Return what annotations, the table or the value say of a hyperparameter; None if it can only be shown.

    What says something that the value does not fit is passed over. Never raises.
    """
    value = runner.hyperparameters[token]
    for source in (_annotated, _selected, _tabled, _valued):
        try:
            found = source(runner, token, value)
            if found is not None and _holds(found, value):
                return found
        except Exception:  # noqa: S112 - values are any objects; one that can't be compared has no range
            continue
    return None


def _annotated(runner: Tunable, token: str, value: Any) -> Param | Roi | None:
    fitting = (param for param in annotated_params(runner.cg, token) if _holds(param, value))
    found = next(fitting, None)
    return None if found is None else _with_tokens(runner, token, found)


def _holds(param: Param | Roi | Text, value: Any) -> bool:
    try:
        return bool(param.allows(value))
    except Exception:  # a value that can't be compared with numbers
        return False


def _with_tokens(runner: Tunable, token: str, found: Param | Roi) -> Param | Roi:
    """Return a hint in which parameters of the function are named by the tokens they get; others are dropped."""
    cg = runner.cg
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


def _tabled(runner: Tunable, token: str, value: Any) -> Param | None:
    if not is_movable(value) and not isinstance(value, str | bool):
        return None
    found = _by_function(runner, token, value) or _by_name(runner, token, value)
    if found is None or found.choices is not None:
        return found
    return without_negative(found, plain(value))


def _by_function(runner: Tunable, token: str, value: Any) -> Param | None:
    for taker in takers(runner.cg, token):
        entry = entry_of(taker.function, taker.parameter)
        image = "" if entry is None else entry.cuts
        said = [(entry, image), *((use.entry, use.cuts) for use in uses(taker.function, taker.parameter) if use.entry)]
        for known, parameter in said:
            param = None if known is None else known.resolved()
            if param is None or not _fits(param, value):
                continue
            if param.choices is not None:
                return param
            return replace(param, cuts=_payload(runner, taker.tokens.get(parameter, "")))
    return None


def _by_name(runner: Tunable, token: str, value: Any) -> Param | None:
    cuts = ""
    names: dict[str, None] = {}
    for taker in takers(runner.cg, token):
        names[taker.parameter] = None
        cuts = cuts or _cut_by(runner, taker, token)
    # What is compared with an image is a threshold, whatever it is called.
    asked = (*names, token, "threshold") if cuts else (*names, token)
    found = next(filter(None, (usual(name, plain(value)) for name in asked if name)), None)
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
    is_threshold = bool(_THRESHOLDS & {*words(taker.parameter), *words(token)})
    known = any(use.entry is not None for use in found)  # a function whose thresholds are not of values, as Canny
    return inputs[0] if is_threshold and len(inputs) == 1 and not known else ""


def _payload(runner: Tunable, token: str) -> str:
    return "" if token in runner.hyperparameters else token


def _valued(runner: Tunable, token: str, value: Any) -> Param | Roi | Text | None:
    if isinstance(value, str):
        return Text()
    if isinstance(value, tuple | list):
        names = {
            word for name in (token, *(taker.parameter for taker in takers(runner.cg, token))) for word in words(name)
        }
        return Roi() if names & _RECTANGLES and Roi().allows(value) else None
    param = param_from_value(plain(value))
    if param is None or param.choices is not None or param.low is None or param.high is None:
        return param
    return Param(step=param.step, soft=(param.low, param.high))


def _fits(param: Param, value: Any) -> bool:
    return (param.choices is not None or is_movable(value)) and fits(param, value)


def words(name: str) -> tuple[str, ...]:
    """Return the words of a name in lower case, numbers apart: ("block", "size", "1") of ``blockSize_1``."""
    return tuple(word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", name))
