"""Array files: the arrays of a bundle that are too large for text, each a ``.npy`` file, to the last bit.

Constants of the module are ``arrays/NAME.npy``, which a small function in the module itself reads. Hyperparameters are
``hyperparameters/TOKEN.npy``, whose name stands in pipeline.toml. No file holds pickled objects, and what is read can't
be written to.
"""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from epypes.errors import BundleError, InvalidType
from epypes.run.guard import is_plain_array

CONSTANTS: Final = "arrays"
HYPERPARAMETERS: Final = "hyperparameters"
READER: Final = "stored_array"
_READER_TEXT: Final = '''def {reader}(name):
    """Return an array that this bundle keeps as a file; it can't be written to."""
    array = {numpy}.load(
        {pathlib}.Path(__file__).with_name("{folder}") / f"{{name}}.npy", allow_pickle=False
    )
    array.flags.writeable = False
    return array'''
_LONGEST_NAME: Final = 80


@dataclass(frozen=True, slots=True)
class StoredArray:
    """A hyperparameter that is a file of the bundle, known by its name alone where the files are not read."""

    file: str

    def __post_init__(self) -> None:
        if not isinstance(self.file, str) or not re.fullmatch(rf"{HYPERPARAMETERS}/\w+\.npy", self.file):
            raise InvalidType(f"{self.file!r} is no file of {HYPERPARAMETERS}/")


class ArrayFiles:
    """The arrays that become files in one folder of a bundle.

    Parameters
    ----------
    folder
        The name of the folder.
    """

    def __init__(self, folder: str) -> None:
        self.folder = folder
        self._arrays: dict[str, Any] = {}

    def add(self, array: Any, name: str) -> str:
        """Add an array, unless it is there already; return its name, which is like the one that is given."""
        known = next((each for each, other in self._arrays.items() if other is array), "")
        if known:
            return known
        stem = re.sub(r"\W", "_", name, flags=re.ASCII)[:_LONGEST_NAME]
        candidates = itertools.chain([stem, f"{stem}_"], (f"{stem}_{number}" for number in itertools.count(2)))
        free = next(each for each in candidates if each not in self._arrays)
        self._arrays[free] = array
        return free

    def file(self, name: str) -> str:
        """Return the path of an array within the bundle."""
        return f"{self.folder}/{name}.npy"

    def write(self, bundle: Path) -> None:
        """Write the files into a bundle, in the order of the arrays' elements."""
        for name, array in self._arrays.items():
            import numpy as np

            (bundle / self.folder).mkdir(exist_ok=True)
            np.save(bundle / self.file(name), array, allow_pickle=False)


def is_storable(value: Any) -> bool:
    """Whether a value is an array without objects, which a file holds to the last bit."""
    return is_plain_array(value) and not value.dtype.hasobject


def store_hyperparameters(values: Mapping[str, Any], most_numbers: int) -> tuple[dict[str, Any], ArrayFiles]:
    """Return values by token with a StoredArray for each array of more numbers, and the files of these."""
    files, after = ArrayFiles(HYPERPARAMETERS), dict(values)
    for token, value in values.items():
        if is_storable(value) and value.size > most_numbers:
            after[token] = StoredArray(files.file(files.add(value, token)))
    return after, files


def reader_text(numpy: str, pathlib: str) -> str:
    """Return the function by which a module reads its arrays; ``numpy`` and ``pathlib`` are their names there."""
    return _READER_TEXT.format(reader=READER, folder=CONSTANTS, numpy=numpy, pathlib=pathlib)


def read_array(path: Path, mmap_mode: Literal["r"] | None = None) -> Any:
    """Return an array of a bundle, which can't be written to.

    Raises
    ------
    BundleError
        The file holds no array, or a part of one.
    """
    import numpy as np

    try:
        array = np.load(path, mmap_mode, allow_pickle=False)
        array.flags.writeable = False
    except Exception as error:  # a broken header raises errors of many kinds
        text = f"{path} is no array that NumPy can read: {error}. Promote the graph again."
        raise BundleError(path, text) from error
    return array
