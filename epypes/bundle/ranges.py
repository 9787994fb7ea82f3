"""Which values may a hyperparameter of a service take?

What an annotation says, the branches of a switch, or what is usual for the functions that take it: so that whoever
tunes the service has a range. What is usual is a ``soft`` range and forbids nothing.
"""

from __future__ import annotations

import numbers
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

from epypes.bundle.entries import plain
from epypes.catalog import entry_of, parameter_names, uses, usual
from epypes.graph import CompGraph, annotated_params, as_switch
from epypes.hints import Param, Roi


def range_of(cg: CompGraph, token: str, value: Any) -> Param | Roi | None:
    """Return the values that a hyperparameter may take, of which its present one is one; None if nothing says so.

    Values are any objects, so whatever one raises when it is compared, it has no range then.
    """
    number = plain(value)
    for source in (_annotated, _selected, _by_function, _by_name):
        try:
            found = next((param for param in source(cg, token, number) if _holds(param, number)), None)
        except Exception:  # noqa: S112
            continue
        if found is not None:
            return _without_negative(found, number) if source in (_by_function, _by_name) else found
    return None


def _takers(cg: CompGraph, token: str) -> Iterator[tuple[Any, str]]:
    """Give the functions that take a token, and what each calls it."""
    for name in cg.digraph.consumers.get(token, ()):
        function = cg.functions[name]
        parameters, position = parameter_names(function), cg.func_inputs(name).index(token)
        yield function, parameters[position] if position < len(parameters) else ""


def _annotated(cg: CompGraph, token: str, value: Any) -> Iterator[Param | Roi]:
    return annotated_params(cg, token)


def _selected(cg: CompGraph, token: str, value: Any) -> Iterator[Param]:
    for name in cg.digraph.consumers.get(token, ()):
        found = as_switch(cg.functions[name])
        if found is not None and cg.func_inputs(name)[0] == token:
            yield Param(choices=found.branches)


def _by_function(cg: CompGraph, token: str, value: Any) -> Iterator[Param]:
    for function, parameter in _takers(cg, token):
        known = [entry_of(function, parameter), *(use.entry for use in uses(function, parameter))]
        yield from (param for param in (entry.resolved() for entry in known if entry) if param is not None)


def _by_name(cg: CompGraph, token: str, value: Any) -> Iterator[Param]:
    if isinstance(value, int | float | str):
        names = dict.fromkeys([*(parameter for _, parameter in _takers(cg, token)), token])
        yield from filter(None, (usual(name, value) for name in names if name))


def _holds(param: Param | Roi, value: Any) -> bool:
    """Whether a value is within a range of its own type: 1 is not True, and only integers are odd."""
    if isinstance(param, Param) and param.choices is None:
        if isinstance(value, bool) or not isinstance(value, numbers.Real):
            return False
        return param.allows(value) and (isinstance(value, numbers.Integral) or not param.odd)
    if isinstance(param, Param) and param.choices:
        return isinstance(value, bool) == isinstance(param.choices[0], bool) and param.allows(value)
    return param.allows(value)


def _without_negative(param: Param | Roi, value: Any) -> Param | Roi:
    """Return a range that offers no negative values to one that is not negative."""
    if isinstance(param, Roi) or param.soft is None or value < 0 or param.soft[0] >= 0:
        return param
    return replace(param, soft=(type(param.soft[0])(0), max(param.soft[1], value)))
