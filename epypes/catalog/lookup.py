"""Look-up of a parameter's usual values: by the very function that takes it, or by its name alone."""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import cache, partial
from typing import Any, Final

from epypes.catalog.table import FILES, CatalogEntry, entries_of, param_of, read_toml, table
from epypes.hints import Param

_CREATE: Final = "_create"
# A shorter name of a parameter, as "n" or "dp", means too many things.
_SHORTEST: Final = 3


def entry_of(function: Any, parameter: str) -> CatalogEntry | None:
    """Return the entry of a parameter of a library's function, found by object; None if there is none.

    A library that is not imported yet is not imported.
    """
    while isinstance(function, partial):
        function = function.func
    name = getattr(function, "__qualname__", None) or getattr(function, "__name__", None)
    if not isinstance(name, str):
        return None
    # OpenCV makes an object in three ways: cv2.ORB_create(), cv2.ORB.create(), cv2.BFMatcher().
    last_names = (name, name.removesuffix(".create") + _CREATE)
    for library in filter(sys.modules.__contains__, FILES):
        functions = _by_function(library)
        for last_name in last_names:
            for full_name, parameters in functions.get(last_name, {}).items():
                if _is_called(function, library, full_name):
                    return parameters.get(parameter)
    return None


@cache
def _by_function(library: str) -> Mapping[str, Mapping[str, Mapping[str, CatalogEntry]]]:
    """Return the entries of a library by the function's last name, its full name, and the parameter."""
    found: dict[str, dict[str, dict[str, CatalogEntry]]] = {}
    for entry in entries_of(library):
        functions = found.setdefault(entry.function.rpartition(".")[2], {})
        functions.setdefault(entry.function, {})[entry.parameter] = entry
    return found


def _is_called(function: Any, library: str, full_name: str) -> bool:
    """Whether a library has this very function under a name."""
    path, _, last_name = full_name.rpartition(".")
    module = sys.modules.get(f"{library}.{path}" if path else library)
    if module is None or (path and not str(getattr(function, "__module__", "")).startswith(library)):
        return False  # without getattr on the module: scikit-image imports what its attributes name
    names: list[tuple[object, str]] = [(module, last_name)]
    if last_name.endswith(_CREATE):
        class_name = last_name.removesuffix(_CREATE)
        names += [(getattr(module, class_name, None), "create"), (module, class_name)]
    return any(getattr(owner, name, None) is function for owner, name in names)


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
    content = read_toml("names.toml")
    common: dict[str, tuple[Param, ...]] = {}
    for group in content["usual"]:
        common |= dict.fromkeys(group["names"], tuple(map(param_of, group["ranges"])))
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
    fitting = [param for param in (_for_type_of(value, param) for param in params) if _allows(param, value)]
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


def _allows(param: Param, value: Any) -> bool:
    if param.choices is not None and isinstance(value, bool) != isinstance(param.choices[0], bool):
        return False  # 1 equals True
    if isinstance(value, str | bool) and param.choices is None:
        return False
    return param.allows(value) and (isinstance(value, int) or not param.odd)
