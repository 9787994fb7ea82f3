"""The values that each hyperparameter of a runner may take, and which two of them are the ends of one range.

The hint that the user gave comes first, then the branches of a switch, the annotation of a function that takes the
token, the catalog of OpenCV's and scikit-image's parameters, and the value. No widgets here.
"""

from __future__ import annotations

import math
import re
from collections.abc import Collection, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Final, NamedTuple

from epypes.catalog import entry_of, fits, parameter_names, range_of, uses, usual, with_odd
from epypes.errors import InvalidType, InvalidValue, UnknownName
from epypes.graph import CompGraph, annotated_params, as_switch, inner_graph, inside_of
from epypes.hints import Param, Roi, Text, as_param, param_from_value
from epypes_widgets.values import as_python, is_integer, is_movable

if TYPE_CHECKING:
    from epypes_widgets.session import Tunable

Range = Param | Roi | Text | None

_RECTANGLES: Final = frozenset(("roi", "rect", "rectangle", "crop", "box", "bbox", "window"))
_UPPER: Final = {"lo": "hi", "low": "high", "min": "max", "lower": "upper", "minimum": "maximum"}
_NUMBERED: Final = frozenset(("threshold", "thresh"))


def ranges(runner: Tunable, hints: Mapping[str, Any], settings: Collection[str] = ()) -> dict[str, Range]:
    """Return the range of every hyperparameter, in graph order; None for one that can only be shown.

    Parameters
    ----------
    runner
        Its hyperparameters and their values are read.
    hints
        By token: a Param or Roi, a tuple as a range, a list as choices.
    settings
        The names of a camera's settings, for the error about a name that is unknown.

    Returns
    -------
    dict
        By token. A Param has choices, or two finite ends: hard ones, or ``soft``. Of two tokens that bound a range, the
        lower one names the other by ``below``.

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
            kind, of = ("setting or hyperparameter", "camera or ") if settings else ("hyperparameter", "")
            raise UnknownName(kind, name, [*values, *settings], f"of this {of}runner")
    return _ranges(runner, {name: _read(runner, name, hint) for name, hint in hints.items()})


class _Part(NamedTuple):
    """The graph of a pipeline, with the hyperparameters that the graph around it gives it."""

    cg: CompGraph
    hyperparameters: Mapping[str, Any]


def _ranges(runner: Tunable | _Part, given: Mapping[str, Param | Roi]) -> dict[str, Range]:
    values, left = runner.hyperparameters, set(runner.hyperparameters)
    tokens = [token for token in runner.cg.source_tokens if token in values]
    found = {
        token: _closed(given[token] if token in given else _guess(runner, token), values[token]) for token in tokens
    }
    found = _paired(runner, found, given)
    left.difference_update(tokens)
    for name, function in runner.cg.functions.items():
        prefix, inner = f"{name}__", inner_graph(function)
        own = {known.removeprefix(prefix): known for known in values if known in left and known.startswith(prefix)}
        if inner is None or not own:
            continue
        left.difference_update(own.values())
        part = _Part(inner, {token: values[known] for token, known in own.items()})
        hints = {token: _seen_inside(given[known], prefix) for token, known in own.items() if known in given}
        taken = dict(zip(_free(part), runner.cg.func_inputs(name), strict=False))
        for token, param in _ranges(part, hints).items():
            hinted = given.get(own[token])
            found[own[token]] = hinted if isinstance(hinted, Roi) else _seen_outside(param, prefix, taken, hinted)
    return found | {token: _closed(given.get(token) or _guess(runner, token), values[token]) for token in sorted(left)}


def _free(part: _Part) -> list[str]:
    return [t for t in part.cg.source_tokens if t not in part.hyperparameters and t not in part.cg.delays]


def _seen_inside(hint: Param | Roi, prefix: str) -> Param | Roi:
    return replace(hint, below=hint.below.removeprefix(prefix)) if isinstance(hint, Param) else hint


def _seen_outside(param: Range, prefix: str, taken: Mapping[str, str], hinted: Param | Roi | None) -> Range:
    """Return the range of a hyperparameter inside a pipeline with the names that other tokens have around it."""
    if isinstance(param, Roi):
        return replace(param, on=taken.get(param.on, ""))
    if not isinstance(param, Param):
        return param
    cuts = param.cuts if hinted is not None else taken.get(param.cuts, "")
    return replace(param, below=param.below and f"{prefix}{param.below}", cuts=cuts)


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
    number = as_python(value)
    low, high = (min(param.soft[0], number), max(param.soft[1], number)) if param.soft else (number, number)
    if low < high and math.isfinite(low) and math.isfinite(high):
        return replace(param, soft=(low, high))
    low, high = (None if end is None or math.isinf(end) else end for end in (param.low, param.high))
    if low is not None and high is not None:
        return replace(param, soft=None)
    around = param_from_value(number)
    if around is None or around.low is None or around.high is None:
        return None
    if low is None:
        low = around.low if high is None else min(around.low, high)
    if high is None:
        high = max(around.high, 10 * low if param.log else low + 1)
    return replace(param, soft=(low, high))


def _read(runner: Tunable, name: str, hint: Any) -> Param | Roi:
    value = runner.hyperparameters[name]
    try:
        param = as_param(hint)
    except (TypeError, ValueError) as error:
        raise InvalidValue(f"Hint of {name!r}: {error}") from error
    if param is None:
        raise InvalidType(
            f"Hint of {name!r} is {hint!r:.60}. Give an ep.Param, a tuple as a range (low, high), a list or dict of "
            "choices, or an ep.Roi."
        )
    if not allows(param, value):
        raise InvalidValue(
            f"{name!r} is {value!r:.60}, outside of its hint ({range_text(param)}). "
            f"Set runner[{name!r}] to a value inside, or widen the hint."
        )
    if isinstance(param, Param) and allows(odd := with_odd(hint, param, runner.cg, name), value):
        param = odd
    image = param.on if isinstance(param, Roi) else param.cuts
    if image:
        runner.cg.require_token(image)
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


def takers(cg: CompGraph, token: str) -> list[Taker]:
    """Return the functions that take a token, in run order."""
    cg, token = inside_of(cg, token)
    found = []
    for name in cg.digraph.consumers.get(token, ()):
        tokens = dict(zip(parameter_names(cg.functions[name]), cg.func_inputs(name), strict=False))
        parameter = next((parameter for parameter, taken in tokens.items() if taken == token), "")
        found.append(Taker(name, cg.functions[name], parameter, tokens))
    return found


# -- without a hint -------------------------------------------------------------------------------------------------


def _guess(runner: Tunable | _Part, token: str) -> Range:
    """Return the range that the graph, the catalog or the value give; what the value does not fit is passed over."""
    value, known = runner.hyperparameters[token], takers(runner.cg, token)
    for source in (_branches, _annotated, _cataloged, _valued):
        with suppress(Exception):  # values are any objects; one that can't be compared has no range
            found = source(runner, token, value, known)
            if found is not None and allows(found, value):
                return found
    return None


def _branches(runner: Tunable | _Part, token: str, value: Any, known: list[Taker]) -> Param | None:
    """Return the branches that a hyperparameter chooses among, in each of its switches."""
    inputs = runner.cg.func_inputs
    switches = [as_switch(taker.function) for taker in known if inputs(taker.name)[0] == token]
    branches = [switch.branches for switch in switches if switch is not None]
    return Param(choices=tuple(k for k in branches[0] if all(k in each for each in branches))) if branches else None


def _annotated(runner: Tunable | _Part, token: str, value: Any, known: list[Taker]) -> Param | Roi | None:
    """Return a fitting annotation in which parameters of the function are named by the tokens they get."""
    found = next((param for param in annotated_params(runner.cg, token) if allows(param, value)), None)
    tokens = {name: taken for taker in reversed(known) for name, taken in taker.tokens.items()}

    def named(name: str) -> str:
        return name if name in runner.cg.tokens else tokens.get(name, "")

    if isinstance(found, Roi):
        return replace(found, on=named(found.on))
    if found is None or not (found.below or found.cuts):
        return found
    below = named(found.below)
    return replace(found, below=below if below in runner.hyperparameters else "", cuts=named(found.cuts))


def _cataloged(runner: Tunable | _Part, token: str, value: Any, known: list[Taker]) -> Param | None:
    found = range_of(runner.cg, token, value)
    cuts = next(filter(None, (_cut_by(runner, taker, token) for taker in known)), "")
    if found is None and cuts:  # what is compared with an image is a threshold, whatever it is called
        found = usual("threshold", as_python(value))
    if not isinstance(found, Param) or not fits(found, value) or (found.choices is None and not is_movable(value)):
        return None
    return replace(found, cuts=cuts) if cuts and found.choices is None else found


def _cut_by(runner: Tunable | _Part, taker: Taker, token: str) -> str:
    """Return the token whose values a function compares with this one; empty if that is not known."""
    entry, used = entry_of(taker.function, taker.parameter), uses(taker.function, taker.parameter)
    compared = [*([entry.cuts] if entry else []), *(use.cuts for use in used)]
    payload = [name for name in runner.cg.func_inputs(taker.name) if name not in runner.hyperparameters]
    return next((taker.tokens[name] for name in compared if taker.tokens.get(name) in payload), "")


def _valued(runner: Tunable | _Part, token: str, value: Any, known: list[Taker]) -> Range:
    if isinstance(value, str):
        return Text()
    if isinstance(value, tuple | list):
        names = (token, *(taker.parameter for taker in known))
        return Roi() if any(_RECTANGLES.intersection(_words(name)) for name in names) else None
    param = param_from_value(as_python(value))
    if param is None or param.choices is not None or param.low is None or param.high is None:
        return param
    return Param(step=param.step, soft=(param.low, param.high))


def _words(name: str) -> tuple[str, ...]:
    """Return the words of a name in lower case, numbers apart: ("block", "size", "1") of ``blockSize_1``."""
    return tuple(word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+", name))


# -- pairs ----------------------------------------------------------------------------------------------------------


def _paired(runner: Tunable | _Part, found: Mapping[str, Range], given: Mapping[str, Range]) -> dict[str, Range]:
    """Return ranges in which the lower one of two tokens names the other by ``below``.

    A hint's ``below`` is kept, or refused with ValueError. Else two tokens are a pair if they go into one function,
    neither has a hint, their names or those of their parameters differ by low and high, and their values are of one
    type and in order.
    """
    values = runner.hyperparameters
    ranges = {token: replace(param, below="") if isinstance(param, Param) else param for token, param in found.items()}
    declared = [(token, param.below) for token, param in found.items() if isinstance(param, Param) and param.below]
    taken: set[str] = set()
    for low, high in (*declared, *_named_pairs(runner, [token for token in ranges if token not in given])):
        param = ranges[low]
        is_free = low != high and not {low, high} & taken
        if isinstance(param, Param) and is_free and _is_pair(values, low, high, ranges):
            taken |= {low, high}
            ranges[low] = replace(param, below=high)
        elif low in given:
            raise InvalidValue(
                f"{low!r} ({values[low]!r:.60}) is hinted to stay below {high!r} ({values[high]!r:.60}). Both must be "
                "numbers of one type, in order, and in no other pair. Set them so, or leave below out."
            )
    return ranges


def _is_pair(values: Mapping[str, Any], low: str, high: str, ranges: Mapping[str, Range]) -> bool:
    if any(not isinstance(param := ranges.get(name), Param) or param.choices is not None for name in (low, high)):
        return False
    one, other = values[low], values[high]
    return is_movable(one) and is_movable(other) and is_integer(one) == is_integer(other) and bool(one <= other)


def _named_pairs(runner: Tunable | _Part, tokens: list[str]) -> Iterator[tuple[str, str]]:
    """Yield the tokens whose names differ by low and high, and those whose parameters do."""
    for token in tokens:
        for taker in takers(runner.cg, token):
            uppers, inputs = _uppers(token), runner.cg.func_inputs(taker.name)
            by_name = [other for other in inputs if _words(other) in uppers]
            uppers = _uppers(taker.parameter)
            by_parameter = [other for name, other in taker.tokens.items() if _words(name) in uppers]
            yield from ((token, other) for other in (*by_name, *by_parameter) if other in tokens)


def _uppers(name: str) -> list[tuple[str, ...]]:
    """Return the words that the name of the upper end would have."""
    own = _words(name)
    found = [(*own[:place], _UPPER[word], *own[place + 1 :]) for place, word in enumerate(own) if word in _UPPER]
    if len(own) > 1 and own[-1] == "1" and own[-2] in _NUMBERED:
        found.append((*own[:-1], "2"))
    return found
