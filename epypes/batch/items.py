"""The inputs of a map, a sweep or a check: image files and values, one after another."""

from __future__ import annotations

import glob
import os
import zipfile
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any, Final

from epypes.acquisition.files import IMAGE_ENDINGS, image_files, natural_order, read_image
from epypes.bundle.clone import clone_runner
from epypes.errors import ScaleError
from epypes.graph import CompGraph, colour_order
from epypes.run import CompGraphRunner
from epypes.run.guard import is_array, is_plain_array

_KINDS: Final = "a folder, a glob such as 'images/*.png', a list or a generator of images, paths or dicts by token"
_SHOWN: Final = "*?["


@dataclass(frozen=True, slots=True)
class Item:
    """One input.

    Attributes
    ----------
    number
        Its place, from 0.
    name
        Of a file its name, relative to the folder that was given; otherwise its place, as ``"#3"``.
    payload
        Values by free source token; a Path stands for an image file, which is read where the item is run.
    """

    number: int
    name: str
    payload: Mapping[str, Any]


def items_of(images: Any, runner: CompGraphRunner) -> Iterator[Item]:
    """Yield the inputs of an image set, each when the caller wants the next one.

    Parameters
    ----------
    images
        A folder, a glob, one file, or an iterable of images (arrays), paths of image files, or dicts by free source
        token, in which a Path stands for an image file, and so does a text with the ending of an image, of ``.npy`` or
        of ``.npz`` if there is such a file; any other text stands for itself. What a generator gives is copied, since
        it may be one array that is filled again each time.
    runner
        Its free source tokens are what an item has to give.

    Raises
    ------
    ScaleError
        The set is empty, which of a generator is known at its end; or an item does not give these tokens.
    """
    free = runner.free_source_tokens
    if isinstance(images, str | Path):
        files, root = _files(images)
        token = _only(free, f"{str(images)!r} gives one image")
        return iter([Item(number, _name(file, root), {token: file.absolute()}) for number, file in enumerate(files)])
    _check_set(images)
    return _of_values(images, free)


def payload_of(item: Item, cg: CompGraph) -> dict[str, Any]:
    """Return the payload with its files read: BGR, or RGB where the graph has the token marked so.

    Raises
    ------
    ImageFileError
        A file is missing, or no image.
    ScaleError
        A ``.npy`` or ``.npz`` can't be read.
    """
    return {
        token: read_value(value, cg, token) if isinstance(value, Path) else value
        for token, value in item.payload.items()
    }


def count_of(images: Any) -> int | None:
    """Return how many items there will be, as far as that is known without going through them."""
    if isinstance(images, str | Path):
        return len(_files(images)[0])
    try:
        return len(images)
    except TypeError:
        return None


# -- files ------------------------------------------------------------------------------------------------------


def _files(images: str | Path) -> tuple[list[Path], Path]:
    """Return the files that a folder or a glob names, and the folder that their names are relative to."""
    path = Path(images).expanduser()
    if path.is_dir():
        files, root = image_files(path), path
        looked_for = (
            f"There are no images in folder {str(images)!r}: no file ends in {', '.join(sorted(IMAGE_ENDINGS))}."
        )
    elif path.exists() or not any(mark in str(images) for mark in _SHOWN):
        files, root = ([path] if path.is_file() else []), path.parent
        looked_for = f"There is no folder or file {str(images)!r}. Check the path."
    else:
        found = (Path(name) for name in glob.glob(str(path), recursive=True))
        files = sorted(filter(Path.is_file, found), key=lambda file: (str(file.parent), natural_order(file)))
        root = _fixed_part(path)
        looked_for = (
            f"No file matches {str(images)!r}. Check the path; in a glob * stands for any text, ** for folders."
        )
    if not files:
        raise ScaleError(looked_for)
    return files, root


def _fixed_part(pattern: Path) -> Path:
    """Return the folder before the first part that has a mark in it."""
    fixed = pattern
    while any(mark in str(fixed) for mark in _SHOWN):
        fixed = fixed.parent
    return fixed


def _name(file: Path, root: Path) -> str:
    return str(file.relative_to(root)) if file.is_relative_to(root) else str(file)


# -- values -----------------------------------------------------------------------------------------------------


def _check_set(images: Any) -> None:
    if isinstance(images, Mapping):
        raise ScaleError("images is one dict. Give a list of dicts by token: [{...}, {...}].")
    shape = getattr(images, "shape", None)
    if isinstance(shape, tuple) and (len(shape) < 3 or (len(shape) == 3 and shape[2] in (3, 4))):
        raise ScaleError(f"images is one array of shape {shape}. Give a list of images, if need be of one: [image].")
    if not isinstance(images, Iterable):
        raise ScaleError(f"images can't be {type(images).__name__!r}. Give {_KINDS}.")


def _of_values(images: Iterable[Any], free: tuple[str, ...]) -> Iterator[Item]:
    number, is_copied = -1, not holds_its_arrays(images)
    for number, value in enumerate(images):
        item = _item(number, value, free)
        if is_copied:
            item = replace(item, payload=defensive_copy(item.payload))
        # This generator waits for its caller, and must not keep the value alive meanwhile.
        del value
        yield item
        del item
    if number < 0:
        raise ScaleError(f"The image set is empty: the {type(images).__name__} gave nothing. Give {_KINDS}.")


def _item(number: int, value: Any, free: tuple[str, ...]) -> Item:
    if isinstance(value, Item):
        return value
    if isinstance(value, Mapping):
        if set(value) != set(free):
            named, wanted = (", ".join(map(str, names)) or "nothing" for names in (value, free))
            raise ScaleError(f"Item #{number} gives {named}; the graph's free source tokens are: {wanted}.")
        given = {token: value[token] for token in free}
    else:
        if value is None:
            raise ScaleError(f"Item #{number} is None, which is no image. Leave it out.")
        given = {_only(free, f"item #{number} is one value"): Path(value) if isinstance(value, str) else value}
    given = {token: _file_or_value(value) for token, value in given.items()}
    files = [file for file in given.values() if isinstance(file, Path)]
    # The process that reads it may have another working folder.
    payload = {token: file.absolute() if isinstance(file, Path) else file for token, file in given.items()}
    return Item(number, ", ".join(map(str, files)) or f"#{number}", payload)


def _file_or_value(value: Any) -> Any:
    """Return the path that a text stands for: one with a file's ending, of a file that is there."""
    if isinstance(value, str) and is_file(value) and Path(value).expanduser().is_file():
        return Path(value).expanduser()
    return value


def _only(free: tuple[str, ...], given: str) -> str:
    """Return the one free source token."""
    if len(free) != 1:
        tokens = ", ".join(free) or "none"
        example = ", ".join(f"{token!r}: ..." for token in free)
        raise ScaleError(f"The graph's free source tokens are: {tokens}; {given}. Give dicts: [{{{example}}}, ...].")
    return free[0]


ARRAYS: Final = frozenset({".npy", ".npz"})


def is_file(value: Any) -> bool:
    """Whether a value names a file: a path, or a text with the ending of an image or an array."""
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
        The graph and the token that has the value: they give the order of an image's colours.

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
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error).partition("\n")[0]
        raise ScaleError(f"{str(path)!r} can't be read as an array: {reason}. Check the path.") from error
    return next(iter(arrays.values())) if len(arrays) == 1 else arrays


def defensive_copy(value: Any) -> Any:
    """Return a value whose arrays are copies, also those in tuples, lists and dicts."""
    if is_plain_array(value):
        return value.copy(order="K")
    if is_array(value):
        return value.copy()
    if type(value) in (list, tuple):
        return type(value)(map(defensive_copy, value))
    if isinstance(value, tuple) and hasattr(value, "_make"):
        return value._make(map(defensive_copy, value))
    return {key: defensive_copy(item) for key, item in value.items()} if type(value) is dict else value


def holds_its_arrays(values: Any) -> bool:
    """Whether an iterable is a list, a tuple or an array; any other may give one array, filled again, each time."""
    return type(values) in (list, tuple) or is_array(values)


def detached_runner(runner: CompGraphRunner) -> CompGraphRunner:
    """Return another runner, which keeps its values when the given runner's hyperparameters are set or written into."""
    own = {token: defensive_copy(value) for token, value in runner.hyperparameters.items()}
    return clone_runner(runner, own)
