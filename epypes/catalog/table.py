"""The table of library functions' parameters, as TOML files in this package.

Each file is read once, when it is first needed: 6 ms for OpenCV's. ``opencv.toml`` explains the fields.
"""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cache, reduce
from importlib.resources import files
from operator import or_
from typing import Any, Final

from epypes.hints import Param

FILES: Final = {"cv2": "opencv.toml", "skimage": "skimage.toml"}


@dataclass(frozen=True, slots=True)
class CatalogEntry:
    """The values of one parameter of a library's function.

    Attributes
    ----------
    library
        The package that has the function, as ``"cv2"``.
    function
        Its name in the package, as ``"filters.gaussian"``.
    parameter
        The parameter's name.
    param
        The range that the function takes, and as ``soft`` the usual one. Ends are floats where a whole number would be
        no more usual than another.
    constants
        Names of the constants whose values are the choices. Which of them exist depends on the library's version.
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
        values = {name: _constant(self.library, name) for name in self.constants}
        existing = {name: value for name, value in values.items() if value is not None}
        if not existing:
            return None
        return replace(self.param, choices=tuple(existing.values()), labels=tuple(existing))


def table() -> tuple[CatalogEntry, ...]:
    """Return all entries, OpenCV's first, in the files' order."""
    return tuple(entry for library in FILES for entry in entries_of(library))


@cache
def entries_of(library: str) -> tuple[CatalogEntry, ...]:
    """Return the entries of one library's functions, in the file's order."""
    content = read_toml(FILES[library])
    shared = content.pop("shared")
    found = []
    for function, parameters in content.items():
        for parameter, value in parameters.items():
            fields = dict(shared[value] if isinstance(value, str) else value)
            constants, cuts = tuple(fields.pop("constants", ())), fields.pop("cuts", "")
            found.append(CatalogEntry(library, function, parameter, param_of(fields), constants, cuts))
    return tuple(found)


def read_toml(file: str) -> dict[str, Any]:
    """Return the content of a TOML file of this package."""
    return tomllib.loads(files("epypes.catalog").joinpath(file).read_text("utf-8"))


def param_of(fields: Mapping[str, Any]) -> Param:
    """Return the hint that a table of TOML describes."""
    values: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value for name, value in fields.items()
    }
    return Param(**values)


def _constant(library: str, name: str) -> Any:
    """Return the value of a constant, or of several joined by ``|``; None if the loaded library has it not."""
    parts = [getattr(sys.modules.get(library), part, None) for part in name.split("|")]
    return None if None in parts else reduce(or_, parts)
