"""Arrays that are too large for text are files of a bundle.

They stand in ``arrays/NAME.npy`` beside the module, named as the notebook names them; one small function reads them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from epypes.bundle.identifiers import identifier_of
from epypes.bundle.resolve import Refused

if TYPE_CHECKING:
    from epypes.bundle.slice import Slice

ARRAYS: Final = "arrays"
READER: Final = "stored_array"
MOST_BYTES: Final = 16_000_000
_MOST_CHARACTERS: Final = 400
_REFERENCE: Final = re.compile(rf'\b{READER}\("\w+"\)')
_TEXT: Final = '''def {reader}(name):
    """Return an array that this bundle keeps as a file; it can't be written to."""
    array = {numpy}.load({pathlib}.Path(__file__).with_name("{folder}") / f"{{name}}.npy", allow_pickle=False)
    array.flags.writeable = False
    return array'''


class Arrays:
    """The arrays that a module has from files, by name.

    Parameters
    ----------
    are_kept
        Whether there is a folder for them. Without, there is only text.
    """

    def __init__(self, are_kept: bool) -> None:
        self.by_name: dict[str, Any] = {}
        self._are_kept = are_kept
        self._even_small = False

    def short(self, write: Callable[[], str]) -> str:
        """Return the expression that ``write`` writes; "" if there is none that people still read.

        Small arrays stand in it as text, unless they make it too long.
        """
        source = write()
        if self._are_kept and len(source) > _MOST_CHARACTERS:
            self._even_small = True
            try:
                source = write()
            finally:
                self._even_small = False
        return source if len(_REFERENCE.sub("", source)) <= _MOST_CHARACTERS else ""

    def written(self, gathered: Slice, array: Any, what: str, text: str) -> str:
        """Return the expression of an array of numbers: its text, or the call that reads it from a file."""
        is_readable = bool(text) and len(text) <= _MOST_CHARACTERS and not self._even_small
        if not self._are_kept or is_readable or array.dtype.kind not in "biufc":
            return text
        return f'{READER}("{self._add(gathered, array, what)}")'

    def reader(self, gathered: Slice) -> str:
        """Return the function that reads the arrays; "" if there are none."""
        if not self.by_name:
            return ""
        numpy, pathlib = (gathered.module_name(module, READER) for module in ("numpy", "pathlib"))
        return _TEXT.format(reader=READER, numpy=numpy, pathlib=pathlib, folder=ARRAYS)

    def _add(self, gathered: Slice, array: Any, what: str) -> str:
        known = next((name for name, other in self.by_name.items() if other is array), "")
        if known:
            return known
        size = sum(other.nbytes for other in self.by_name.values()) + array.nbytes
        if size > MOST_BYTES:
            raise Refused(
                f"{what} uses an array, with which the bundle's arrays have {size / 1e6:.1f} MB; {MOST_BYTES / 1e6:g} "
                "MB are the most. Pass it in as a token, or put it into the data of a package that is installed and "
                "read it with importlib.resources."
            )
        if not self.by_name:
            gathered.keep_name(READER)
        name = identifier_of(_name_in(gathered.names.read, array), self.by_name.__contains__)
        self.by_name[name] = array
        # What the function that reads them needs is known before the imports are written.
        for module in ("numpy", "pathlib"):
            gathered.module_name(module, what)
        return name


def write_arrays(folder: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays into a bundle, each in the order of its elements, to the last bit."""
    if not arrays:
        return
    import numpy as np

    for name, array in arrays.items():
        (folder / ARRAYS).mkdir(exist_ok=True)
        np.save(folder / ARRAYS / f"{name}.npy", array, allow_pickle=False)


def _name_in(names: Mapping[str, Any], array: Any) -> str:
    """Return what the notebook calls an array: a variable, or one with the key or number under which it is in it."""
    paths = (path for name, value in sorted(names.items()) for path in _paths(value, array, name, 5))
    return min(paths, key=len, default="array")


def _paths(value: Any, array: Any, path: str, depth: int) -> Iterator[str]:
    if value is array:
        yield path
    elif depth and type(value) in (dict, list, tuple):
        parts = value.items() if isinstance(value, dict) else enumerate(value)
        for key, part in parts:
            yield from _paths(part, array, f"{path}_{key}", depth - 1)
