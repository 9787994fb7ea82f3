"""What does the table say of a parameter of this very function?"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from functools import partial
from typing import Any, Final

from epypes.catalog.entry import Entry
from epypes.catalog.opencv_features import FEATURES
from epypes.catalog.opencv_filters import FILTERS
from epypes.catalog.skimage import SKIMAGE

TABLE: Final[tuple[Entry, ...]] = (*FILTERS, *FEATURES, *SKIMAGE)

_MAKER: Final = "_create"


def _by_name() -> dict[str, dict[str, dict[str, Entry]]]:
    """Return the entries by the function's last name, its full name, and the parameter."""
    found: dict[str, dict[str, dict[str, Entry]]] = {}
    for entry in TABLE:
        last = entry.function.rpartition(".")[2]
        found.setdefault(last, {}).setdefault(entry.function, {})[entry.parameter] = entry
    return found


_BY_NAME: Final = _by_name()


def entry_of(function: Any, parameter: str) -> Entry | None:
    """Return the entry of a parameter of a library's function, found by object; None if there is none.

    A library that nobody has imported is not imported.
    """
    while isinstance(function, partial):
        function = function.func
    return _entries_of(function).get(parameter)


def _entries_of(function: Any) -> Mapping[str, Entry]:
    name = getattr(function, "__qualname__", None) or getattr(function, "__name__", None)
    if not isinstance(name, str):
        return {}
    # OpenCV makes an object in three ways: cv2.ORB_create(), cv2.ORB.create(), cv2.BFMatcher().
    maker = name.removesuffix(".create") + _MAKER
    for last in (name, maker):
        for full, parameters in _BY_NAME.get(last, {}).items():
            entry = next(iter(parameters.values()))
            if _is_called(function, entry.library, full):
                return parameters
    return {}


def _is_called(function: Any, library: str, full: str) -> bool:
    """Whether a library has this very function under a name."""
    path, _, last = full.rpartition(".")
    home = sys.modules.get(f"{library}.{path}" if path else library)
    if home is None or (path and not str(getattr(function, "__module__", "")).startswith(library)):
        return False  # not asked: scikit-image imports what it is asked for
    spellings: list[tuple[object, str]] = [(home, last)]
    if last.endswith(_MAKER):
        made = getattr(home, last.removesuffix(_MAKER), None)
        spellings += [(made, "create"), (home, last.removesuffix(_MAKER))]
    return any(getattr(place, name, None) is function for place, name in spellings)
