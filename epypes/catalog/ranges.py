"""The range of a hyperparameter, from the functions of a graph that take it.

It is what an annotation says, the branches of a switch, or what is usual for the library functions that get the value,
or for its name. What is usual is a ``soft`` range and forbids nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import replace
from numbers import Integral
from typing import Any

from epypes.catalog.calls import parameter_names, uses
from epypes.catalog.lookup import CatalogEntry, entry_of, fits, usual
from epypes.graph import CompGraph, annotated_params, as_switch, inside_of
from epypes.hints import Param, Roi


def plain(value: Any) -> Any:
    """Return a scalar of NumPy's as Python's own, to be compared."""
    is_scalar = type(value).__module__ == "numpy" and getattr(value, "shape", None) == ()
    return value.item() if is_scalar else value


def range_of(cg: CompGraph, token: str, value: Any) -> Param | Roi | None:
    """Return the values that a hyperparameter may take, of which its present one is one; None if nothing says so."""
    cg, token = inside_of(cg, token)
    number = plain(value)
    for hint in _hints(cg, token):
        # Values are any objects; one that can't be compared has no range.
        with suppress(Exception):
            if hint.allows(number) if isinstance(hint, Roi) else fits(hint, number):
                return hint
    for hint in _usual(cg, token, number):
        with suppress(Exception):
            if fits(hint, number):
                return without_negative(hint, number)
    return None


def reason_against(cg: CompGraph, function: str, token: str, value: Any) -> str:
    """Return why a function can't take this number for an input token, as a clause; empty if nothing says so.

    Annotations are asked, then the library functions that get the value: what is only usual there forbids nothing.
    """
    number = plain(value)
    for hint in annotated_params(cg, token):
        if isinstance(hint, Roi) or not hint.allows(number):
            return f"its annotation allows {hint.describe()}"
    for entry in _entries(cg, function, token)[1]:
        # Constants are listed as far as they are usual.
        if not entry.constants and not fits(entry.param, number):
            return f"{entry.library}.{entry.function} takes {entry.param.describe()}"
    return ""


def with_odd(hint: Any, param: Param, cg: CompGraph, token: str) -> Param:
    """Return the range of a hint: of odd numbers if it is but two whole ends and a library function takes no others."""
    if type(hint) is not tuple or len(hint) != 2 or not all(isinstance(end, Integral) for end in hint):
        return param
    cg, token = inside_of(cg, token)
    entries = (entry for name in cg.digraph.consumers.get(token, ()) for entry in _entries(cg, name, token)[1])
    with suppress(ValueError):  # there is no odd number in it
        return replace(param, odd=any(entry.param.odd for entry in entries))
    return param


def _hints(cg: CompGraph, token: str) -> Iterator[Param | Roi]:
    """Give what annotations and switches say."""
    yield from annotated_params(cg, token)
    for name in cg.digraph.consumers.get(token, ()):
        found = as_switch(cg.functions[name])
        if found is not None and cg.func_inputs(name)[0] == token:
            yield Param(choices=found.branches)


def _usual(cg: CompGraph, token: str, value: Any) -> Iterator[Param]:
    """Give what is usual for the functions that get a value, then what is usual for its names."""
    names: dict[str, None] = {}
    for name in cg.digraph.consumers.get(token, ()):
        parameter, entries = _entries(cg, name, token)
        names[parameter] = None
        yield from filter(None, (entry.resolved() for entry in entries))
    if isinstance(value, int | float | str):
        yield from filter(None, (usual(name, value) for name in (*names, token) if name))


def _entries(cg: CompGraph, name: str, token: str) -> tuple[str, list[CatalogEntry]]:
    """Return the parameter by which a function of a graph takes a token, and what the table knows of it."""
    function, position = cg.functions[name], cg.func_inputs(name).index(token)
    parameter = dict(enumerate(parameter_names(function))).get(position, "")
    found = [entry_of(function, parameter), *(use.entry for use in uses(function, parameter))]
    return parameter, [entry for entry in found if entry]


def without_negative(hint: Param, value: Any) -> Param:
    """Return a range that offers no negative values to one that is not negative."""
    if hint.soft is None or value < 0 or hint.soft[0] >= 0:
        return hint
    return replace(hint, soft=(type(hint.soft[0])(0), max(hint.soft[1], value)))
