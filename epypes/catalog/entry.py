"""What does the table say of one parameter of a library's function?"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import reduce
from operator import or_
from typing import Any

from epypes.hints import Param


@dataclass(frozen=True, slots=True)
class Named:
    """Constants of a library, as ``INTER_LINEAR``; several in one with ``|``."""

    constants: tuple[str, ...]
    about: str


@dataclass(frozen=True, slots=True)
class Cutting:
    """A threshold, and the argument with whose values the function compares it."""

    param: Param
    argument: str


@dataclass(frozen=True, slots=True)
class Entry:
    """What may be given to one parameter of a function.

    Attributes
    ----------
    library
        The package that has the function, as ``"cv2"``.
    function
        Its name in there, as ``"filters.gaussian"``.
    parameter
        The parameter's name.
    param
        The values: those that the function takes, and as ``soft`` those that are usual. Ends are floats where a whole
        number would be no more usual than another.
    constants
        Names of constants whose values are the choices. Which there are depends on the library's version.
    cuts
        The parameter of the image whose values are compared with this one; empty if none are.
    """

    library: str
    function: str
    parameter: str
    param: Param
    constants: tuple[str, ...] = ()
    cuts: str = ""

    def resolved(self) -> Param | None:
        """Return the values, with the constants that the loaded library has; None if it has none of them."""
        if not self.constants:
            return self.param
        found = {name: _constant(self.library, name) for name in self.constants}
        there = {name: value for name, value in found.items() if value is not None}
        if not there:
            return None
        return replace(self.param, choices=tuple(there.values()), labels=tuple(there))


def entries(library: str, table: Mapping[str, Mapping[str, Param | Named | Cutting]]) -> tuple[Entry, ...]:
    """Return the entries of a table by function and parameter."""
    return tuple(
        _entry(library, function, parameter, said)
        for function, parameters in table.items()
        for parameter, said in parameters.items()
    )


def _entry(library: str, function: str, parameter: str, said: Param | Named | Cutting) -> Entry:
    if isinstance(said, Named):
        return Entry(library, function, parameter, Param(about=said.about), constants=said.constants)
    if isinstance(said, Cutting):
        return Entry(library, function, parameter, said.param, cuts=said.argument)
    return Entry(library, function, parameter, said)


def _constant(library: str, name: str) -> Any:
    """Return the value of a constant, or of several in one; never imports the library."""
    parts = [getattr(sys.modules.get(library), part, None) for part in name.split("|")]
    return None if None in parts else reduce(or_, parts)
