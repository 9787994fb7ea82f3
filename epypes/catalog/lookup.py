"""The parameters of library functions, looked up by the very function that takes them, or by name alone.

The table is in TOML files of this package, which are read once, when they are first needed. ``opencv.toml`` explains
the fields.
"""

from __future__ import annotations

import re
import sys
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cache, partial, reduce
from importlib.resources import files
from numbers import Integral, Real
from operator import or_
from typing import Any, Final

from epypes.hints import Param

_FILES: Final = {"cv2": "opencv.toml", "skimage": "skimage.toml"}
_CREATE: Final = "_create"
# A shorter name of a parameter, as "n" or "dp", means too many things.
_SHORTEST: Final = 3


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
        library = sys.modules.get(self.library)
        values = {name: [getattr(library, part, None) for part in name.split("|")] for name in self.constants}
        existing = {name: reduce(or_, parts) for name, parts in values.items() if None not in parts}
        if not existing:
            return None
        return replace(self.param, choices=tuple(existing.values()), labels=tuple(existing))


@cache
def table() -> tuple[CatalogEntry, ...]:
    """Return all entries, OpenCV's first, in the files' order."""
    found = []
    for library, file in _FILES.items():
        content = _read_toml(file)
        shared = content.pop("shared")
        for function, parameters in content.items():
            for parameter, value in parameters.items():
                fields = dict(shared[value] if isinstance(value, str) else value)
                constants, cuts = tuple(fields.pop("constants", ())), fields.pop("cuts", "")
                found.append(CatalogEntry(library, function, parameter, _param_of(fields), constants, cuts))
    return tuple(found)


def _read_toml(file: str) -> dict[str, Any]:
    return tomllib.loads(files("epypes.catalog").joinpath(file).read_text("utf-8"))


def _param_of(fields: Mapping[str, Any]) -> Param:
    values: Any = {name: tuple(value) if isinstance(value, list) else value for name, value in fields.items()}
    return Param(**values)


# -- by function ------------------------------------------------------------------------------------------------------


def entry_of(function: Any, parameter: str) -> CatalogEntry | None:
    """Return the entry of a parameter of a library's function, found by object; None if there is none.

    A library that is not imported yet is not imported.
    """
    while isinstance(function, partial):
        function = function.func
    entries = (entry for entry in table() if entry.parameter == parameter and callable(function))
    return next((entry for entry in entries if _is_of(entry, function)), None)


def _is_of(entry: CatalogEntry, function: Any) -> bool:
    """Whether an entry's library has this very function under the entry's name."""
    path, _, name = entry.function.rpartition(".")
    module = sys.modules.get(f"{entry.library}.{path}" if path else entry.library)
    if module is None or (path and not str(getattr(function, "__module__", "")).startswith(entry.library)):
        return False  # without getattr on the module: scikit-image imports what its attributes name
    names: list[tuple[object, str]] = [(module, name)]
    if name.endswith(_CREATE):
        # OpenCV makes an object in three ways: cv2.ORB_create(), cv2.ORB.create(), cv2.BFMatcher().
        class_name = name.removesuffix(_CREATE)
        names += [(getattr(module, class_name, None), "create"), (module, class_name)]
    return any(getattr(owner, name, None) is function for owner, name in names)


# -- by name ----------------------------------------------------------------------------------------------------------


def usual(name: str, value: float | str) -> Param | None:
    """Return the usual values of a parameter of this name; None if nothing fits.

    Parameters
    ----------
    name
        A parameter, or a token: of ``blur_sigma_1`` its last words count too.
    value
        Its present value. A range that does not hold it is not returned.
    """
    common, by_parameter = _by_name()
    for bare_name in _bare_names(name):
        found = _first_fitting(common.get(bare_name, ()), value)
        found = found or _first_fitting(_agreed(by_parameter.get(bare_name, ())), value)
        if found is not None:
            return found
    return None


@cache
def _by_name() -> tuple[Mapping[str, tuple[Param, ...]], Mapping[str, tuple[CatalogEntry, ...]]]:
    """Return the ranges of common names, and the entries by the parameter's name."""
    content = _read_toml("names.toml")
    common: dict[str, tuple[Param, ...]] = {}
    for group in content["usual"]:
        common |= dict.fromkeys(group["names"], tuple(map(_param_of, group["ranges"])))
    by_parameter: dict[str, tuple[CatalogEntry, ...]] = {}
    for entry in table():
        name = entry.parameter.replace("_", "").lower()
        if len(name) >= _SHORTEST and name not in content["vague"]:
            by_parameter[name] = (*by_parameter.get(name, ()), entry)
    return common, by_parameter


def _bare_names(name: str) -> list[str]:
    """Return a name in lower case without underscores, then its last two words and its last one."""
    words = [word.lower() for word in re.findall(r"[A-Z]*[a-z]+\d*|[A-Z]+\d*|\d+", name)]
    while len(words) > 1 and words[-1].isdigit():
        words.pop()  # the suffix of one of several graphs
    return list(dict.fromkeys(("".join(words), "".join(words[-2:]), "".join(words[-1:]))))


def _agreed(entries: Iterable[CatalogEntry]) -> tuple[Param, ...]:
    """Return the range that all entries of a name have; none if they differ."""
    params = [entry.resolved() for entry in entries]
    plain = {repr(param and replace(param, about="", unit="")) for param in params}
    return (params[0],) if len(plain) == 1 and params[0] is not None else ()


def _first_fitting(params: Iterable[Param], value: Any) -> Param | None:
    """Return the first range whose usual values hold a value, or the last that allows it."""
    fitting = [param for param in (_for_type_of(value, param) for param in params) if fits(param, value)]
    return next((param for param in fitting if _is_usual(param, value)), fitting[-1] if fitting else None)


def _for_type_of(value: Any, param: Param) -> Param:
    """Return a range with whole ends for a whole number: known by its name alone, it may be used as an index."""
    if not isinstance(value, int) or param.choices is not None or param.soft is None or param.soft[1] <= 1:
        return param
    low, high = (None if end is None else int(end) for end in (param.low, param.high))
    soft = (int(param.soft[0]), int(param.soft[1]))
    return replace(param, low=low, high=high, soft=soft, step=None if (param.step or 1) < 1 else param.step)


def _is_usual(param: Param, value: Any) -> bool:
    if param.choices is not None or param.soft is None:
        return True
    if isinstance(value, int) and param.soft[1] <= 1:
        return False  # a whole number is no share
    return bool(param.soft[0] <= value <= param.soft[1])


def fits(param: Param, value: Any) -> bool:
    """Whether a range holds a value, which is of its type: 1 is not True, and only integers are odd."""
    if param.choices is not None:
        return isinstance(value, bool) == isinstance(param.choices[0], bool) and param.allows(value)
    is_number = isinstance(value, Real) and not isinstance(value, bool)
    return is_number and param.allows(value) and (isinstance(value, Integral) or not param.odd)
