"""Of what is a graph put together, before it is checked?"""

from __future__ import annotations

import reprlib
from collections.abc import Callable, Container, Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

from epypes.errors import Finding
from epypes.graph.redefined import is_same_default

if TYPE_CHECKING:
    from epypes.graph.compgraph import CompGraph


class Default(NamedTuple):
    """A token's default value, and a function that gives it."""

    token: str
    value: Any
    function: str


@dataclass(frozen=True, slots=True)
class Parts:
    """Functions, their io and defaults, with what is already known to be wrong; not a graph yet.

    Attributes
    ----------
    functions, func_io
        As a CompGraph takes them, in order of definition.
    defaults
        Every default, several for one token included.
    findings
        What is wrong.
    groups
        By function, the group that it is in.
    """

    functions: dict[str, Callable[..., Any]] = field(default_factory=dict)
    func_io: dict[str, Any] = field(default_factory=dict)
    defaults: list[Default] = field(default_factory=list)
    findings: list[Finding] = field(default_factory=list)
    groups: dict[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, cg: CompGraph) -> Parts:
        """Return the parts of a graph."""
        return cls(dict(cg.functions), dict(cg.func_io), defaults_of(cg), groups=groups_of(cg))


def defaults_of(cg: CompGraph) -> list[Default]:
    """Return the defaults of a graph, each with the first function that takes its token."""
    return [Default(token, value, cg.digraph.consumers[token][0]) for token, value in cg.defaults.items()]


def groups_of(cg: CompGraph) -> dict[str, str]:
    """Return by function, in run order, the group that it is in."""
    found = {function: name for name, functions in cg.groups.items() for function in functions}
    return {function: found[function] for function in cg.functions if function in found}


def check_groups(functions: Container[str], groups: Mapping[str, str]) -> Iterable[Finding]:
    """Find groups that are called like a function outside them: both would be one vertex of the picture."""
    for name in dict.fromkeys(groups.values()):
        if name in functions and groups.get(name) != name:
            text = (
                f"A group and a function outside it are both called {name!r}. "
                "Give the group another name, or rename the function with ep.rename()."
            )
            yield Finding("groups", text, (name,))


def check_defaults(defaults: Iterable[Default]) -> Iterable[Finding]:
    """Find tokens with two different defaults."""
    first: dict[str, Default] = {}
    for default in defaults:
        other = first.setdefault(default.token, default)
        if not is_same_default(other.value, default.value):
            text = (
                f"Token {default.token!r} has the default {reprlib.repr(other.value)} in {other.function!r} "
                f"and {reprlib.repr(default.value)} in {default.function!r}. "
                "Make them equal, or rename one of the tokens."
            )
            yield Finding("defaults", text, (default.token, other.function, default.function))
