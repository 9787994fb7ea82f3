"""Which graph do functions make by the names of their parameters?"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

from epypes.errors import Finding
from epypes.graph.outputs import declared_outputs
from epypes.graph.parts import Default, Parts
from epypes.graph.signature import NO_DEFAULT, parameters_of

_BY_HAND = "name it in CompGraph(func_dict, func_io)"


def read_functions(functions: Iterable[Any]) -> Parts:
    """Read names, io and defaults of functions; what can't be read becomes a finding and is left out."""
    parts = Parts()
    for function in functions:
        name = _name(function, parts.findings)
        if name is None:
            continue
        if name in parts.functions:
            text = f"Two functions are called {name!r}. Rename one of them, or {_BY_HAND}."
            parts.findings.append(Finding("two functions", text, (name,)))
            continue
        _add(parts, name, function)
    return parts


def _name(function: Any, findings: list[Finding]) -> str | None:
    if not callable(function):
        text = f"{function!r:.60} is {type(function).__name__}, which can't be called. Give functions, one by one."
        findings.append(Finding("not callable", text, ()))
        return None
    name = getattr(function, "__name__", None)
    if isinstance(name, str) and name.isidentifier():
        return name
    what = "A lambda" if name == "<lambda>" else f"{function!r:.60}"
    text = f"{what} has no name that could be its token's. Write it as a function (def), or {_BY_HAND}."
    findings.append(Finding("no name", text, ()))
    return None


def _add(parts: Parts, name: str, function: Callable[..., Any]) -> None:
    parameters = parameters_of(function)
    if parameters is None:
        text = (
            f"The parameters of {name!r} are not known, since it has no signature. "
            f"Write a function (def) that calls it, or {_BY_HAND}."
        )
        parts.findings.append(Finding("no signature", text, (name,)))
        return
    made = declared_outputs(function)
    outputs: Any = name if made is None else made[0] if len(made) == 1 else made or None
    parts.functions[name] = function
    parts.func_io[name] = (tuple(token for token, _ in parameters.positional), outputs)
    given = [(token, value) for token, value in parameters.positional if value is not NO_DEFAULT]
    parts.defaults.extend(Default(token, value, name) for token, value in given)
