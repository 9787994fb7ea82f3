"""Do the defaults in a function's text have the values that the function has?"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from typing import Any

from epypes.bundle.evaluate import UNKNOWN, is_same, value_of
from epypes.bundle.source import Definition, Refused


def check_defaults(found: Definition, what: str) -> None:
    """Refuse defaults whose text makes something else than the function has."""
    for default, value in defaults_of(found, what):
        place = found.place_in(default)
        text = f"{what} has the default {ast.unparse(default)!r} ({place})"
        if value_of(default, found.names) is UNKNOWN:
            raise Refused(f"{text}, which is no literal and no constant. Write the value itself.")
        if not is_same(default, value, found.names):
            raise Refused(f"{text}, which has another value by now. Define the function again, with that value.")
        if isinstance(default, ast.Attribute) and not _is_constant(value):
            raise Refused(f"{text}, which is no literal and no constant of a module. Write the value itself.")


def _is_constant(value: object) -> bool:
    return callable(value) or type(value) in (bool, int, float, complex, str, bytes, type(None))


def defaults_of(found: Definition, what: str) -> Iterator[tuple[ast.expr, Any]]:
    """Return every default as it is written, with its value."""
    arguments, function = found.node.args, found.function
    by_position, by_name = function.__defaults__ or (), function.__kwdefaults__ or {}
    named = zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True)
    written = {argument.arg: default for argument, default in named if default}
    if len(by_position) != len(arguments.defaults) or by_name.keys() != written.keys():
        text = f"{what} has other parameters with defaults by now than its text says ({found.place})."
        raise Refused(f"{text} Define the function again, with these defaults.")
    yield from zip(arguments.defaults, by_position, strict=True)
    yield from ((default, by_name[name]) for name, default in written.items())
