"""What is in a file that stands for a value?"""

from __future__ import annotations

import os
import zipfile
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, Final

from epypes.acquisition.files import read_image
from epypes.acquisition.pictures import IMAGE_ENDINGS
from epypes.errors import ScaleError
from epypes.graph import colour_order

if TYPE_CHECKING:
    from epypes.graph import CompGraph

ARRAYS: Final = frozenset({".npy", ".npz"})


def is_file(value: Any) -> bool:
    """Whether something stands for what is in a file: a path, or a text that ends like the name of one."""
    if isinstance(value, os.PathLike):
        return True
    return isinstance(value, str) and PurePath(value).suffix.lower() in IMAGE_ENDINGS | ARRAYS


def read_value(value: Any, cg: CompGraph, token: str) -> Any:
    """Return a value, of a path what is in its file.

    Parameters
    ----------
    value
        A value, or the path of an image, of ``.npy`` or of ``.npz``: an archive of one array is that array, of several
        a dict.
    cg, token
        Whose value it is: this says the order of an image's colours.

    Raises
    ------
    ScaleError
        The file can't be read as an array.
    ImageFileError
        It can't be read as an image.
    """
    if not is_file(value):
        return value
    path = Path(value)
    if path.suffix.lower() in ARRAYS:
        return _arrays(path)
    return read_image(path, colour_order(cg, token))


def _arrays(path: Path) -> Any:
    import numpy as np

    try:
        found = np.load(path, allow_pickle=False)
        if not hasattr(found, "files"):
            return found
        with found:
            arrays = {name: found[name] for name in found.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        said = error.strerror if isinstance(error, OSError) and error.strerror else str(error).partition("\n")[0]
        raise ScaleError(f"{str(path)!r} can't be read as an array: {said}. Check the path.") from error
    return next(iter(arrays.values())) if len(arrays) == 1 else arrays
