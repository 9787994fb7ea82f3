"""Hyperparameters in TOML: how a value is written and read back.

What TOML has stands there as it is. Anything else is a table with its ``kind``: beside the value where the whole value
is meant, as an inline table where it is inside a list or a table. Every entry is ready for JSON too.

An array of more than MOST_NUMBERS numbers, as a calibrated map, is a file of the bundle, whose name stands in TOML.
"""

from __future__ import annotations

import enum
import re
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

from epypes.catalog import plain
from epypes.errors import BundleError
from epypes.run.guard import is_plain_array

# What a person still reads, and a line of a diff still shows.
MOST_NUMBERS: Final = 400
ARRAYS_OF_HYPERPARAMETERS: Final = "hyperparameters"
_KIND: Final = "kind"
_SMALL: Final = range(-(2**63), 2**63)


class Unwritable(ValueError):
    """A value that no entry holds to the last bit; its text says of which kind it is."""


class LargeArray(Unwritable):
    """An array of numbers that is too large for text."""


@dataclass(frozen=True, slots=True)
class Member:
    """A member of an enumeration that is known by its names alone, where the bundle's module is not executed."""

    enum: str
    name: str


@dataclass(frozen=True, slots=True)
class StoredArray:
    """An array that is a file of the bundle, known by its name alone where the files are not read."""

    file: str


def store_arrays(values: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return values with a StoredArray for each array that is too large for text, and the arrays by file.

    Parameters
    ----------
    values
        Hyperparameters by token.
    """
    after, arrays = dict(values), {}
    for token, value in values.items():
        if is_plain_array(value) and value.dtype.kind in "biufc" and value.size > MOST_NUMBERS:
            file = f"{ARRAYS_OF_HYPERPARAMETERS}/{re.sub(r'[^0-9A-Za-z_]', '_', token)}.npy"
            while file in arrays:
                file = f"{file.removesuffix('.npy')}_.npy"
            after[token], arrays[file] = StoredArray(file), value
    return after, arrays


def write_stored_arrays(folder: Path, arrays: Mapping[str, Any]) -> None:
    """Write the arrays into a bundle, to the last bit."""
    for file, array in arrays.items():
        import numpy as np

        (folder / file).parent.mkdir(exist_ok=True)
        np.save(folder / file, array, allow_pickle=False)


def load_array(path: Path, mmap_mode: Literal["r"] | None = None) -> Any:
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


def alike(entry: Mapping[str, Any], value: Any) -> Any:
    """Return a number as one of the kind that an entry has: NumPy's of its dtype, else Python's own."""
    number = plain(value)
    if entry.get(_KIND) != "numpy" or not isinstance(number, bool | int | float):
        return number
    import numpy as np

    return np.dtype(entry["dtype"]).type(number)


def fits(value: Any) -> bool:
    """Whether an entry holds a value to the last bit."""
    try:
        written(value)
    except Unwritable:
        return False
    return True


def written(value: Any) -> dict[str, Any]:
    """Return the entry of a value: ``value``, with its ``kind`` and what else that needs where TOML has none like it.

    Raises
    ------
    Unwritable
        There is no entry for a value of this kind, or of this size.
    """
    try:
        return _written(value)
    except RecursionError:
        raise Unwritable("nested too deep") from None


def _written(value: Any) -> dict[str, Any]:
    write = _WRITERS.get(type(value))
    if write is not None:
        return write(value)
    if is_plain_array(value):
        return _array(value)
    if _is_numpy_number(value):
        return {"value": _of_number(value), _KIND: "numpy", "dtype": value.dtype.name}
    if isinstance(value, enum.Enum) and value.name in type(value).__members__:
        return {"value": value.name, _KIND: "enum", "enum": type(value).__qualname__}
    if isinstance(value, StoredArray):
        return {"value": value.file, _KIND: "file"}
    if isinstance(value, Member):
        return {"value": value.name, _KIND: "enum", "enum": value.enum}
    raise Unwritable(f"a {type(value).__name__}")


def _part(value: Any) -> Any:
    """Return a value as it stands inside a list or table."""
    entry = _written(value)
    return entry if _KIND in entry else entry["value"]


def _whole(part: Any, enums: Mapping[str, Any]) -> Any:
    if isinstance(part, dict):
        if _KIND in part:
            return read(part, enums)
        return {key: _whole(item, enums) for key, item in part.items()}
    return [_whole(item, enums) for item in part] if isinstance(part, list) else part


def read(entry: Mapping[str, Any], enums: Mapping[str, Any] | None = None) -> Any:
    """Return the value of an entry.

    Parameters
    ----------
    entry
        What :func:`written` returned; other keys are passed over.
    enums
        The enumerations by name. Members of others are read as :class:`Member`.

    Returns
    -------
    Any
        The value; a :class:`StoredArray` for an array that is a file.

    Raises
    ------
    KeyError
        The entry lacks something.
    TypeError
        It makes no sense.
    """
    known = {} if enums is None else enums
    kind = entry.get(_KIND)
    if kind is None:
        return _whole(entry["value"], known)
    if not isinstance(kind, str) or kind not in _READERS:
        raise TypeError(f"no value has the kind {kind!r}")
    return _READERS[kind](entry, known)


def members_in(value: Any) -> Iterator[enum.Enum | Member]:
    """Give the members of enumerations that are in a value."""
    if isinstance(value, enum.Enum | Member):
        yield value
    elif isinstance(value, dict):
        for pair in value.items():
            yield from members_in(pair)
    elif type(value) in (tuple, list, set, frozenset):
        for item in value:
            yield from members_in(item)


# ----------------------------------------------------------------------------------------------------------------------


def _is_numpy_number(value: Any) -> bool:
    """Whether this is a scalar of NumPy's that Python's own numbers hold to the last bit."""
    numpy = sys.modules.get("numpy")
    if numpy is None or not isinstance(value, numpy.number | numpy.bool_):
        return False
    return value.dtype.kind in "biuf" and value.dtype.itemsize <= 8


def _of_number(number: Any) -> Any:
    """Return a number of NumPy's as the shortest one of Python's that makes it again."""
    whole = number.item()
    if number.dtype.kind != "f":
        return _part(whole)
    short = float(str(number))
    return _part(short if number.dtype.type(short).tobytes() == number.tobytes() else whole)


def _as_it_is(value: Any) -> dict[str, Any]:
    return {"value": value}


def _text(value: str) -> dict[str, Any]:
    if any("\ud800" <= character <= "\udfff" for character in value):
        raise Unwritable("a text with half a character in it")
    return {"value": value}


def _integer(value: int) -> dict[str, Any]:
    return {"value": value} if value in _SMALL else {"value": hex(value), _KIND: "int"}


def _sequence(value: Any) -> dict[str, Any]:
    items = [_part(item) for item in value]
    return {"value": items} if type(value) is list else {"value": items, _KIND: type(value).__name__}


def _set(value: Any) -> dict[str, Any]:
    items = sorted((_part(item) for item in value), key=repr)
    return {"value": items, _KIND: type(value).__name__}


def _mapping(value: dict[Any, Any]) -> dict[str, Any]:
    if _KIND not in value and all(type(key) is str and fits(key) for key in value):
        return {"value": {key: _part(item) for key, item in value.items()}}
    return {"value": [[_part(key), _part(item)] for key, item in value.items()], _KIND: "dict"}


def _array(array: Any) -> dict[str, Any]:
    import numpy as np

    if array.dtype.kind not in "biuf" or array.dtype.itemsize > 8:
        raise Unwritable(f"an array of {array.dtype}")
    if array.size > MOST_NUMBERS:
        raise LargeArray(f"an array of {array.size} numbers")
    dtype = array.dtype.name if array.dtype.isnative else array.dtype.str
    numbers = [_of_number(number) for number in array.astype(array.dtype.newbyteorder("=")).reshape(-1)]
    value = np.array(numbers, object).reshape(array.shape).tolist()
    entry = {"value": value, _KIND: "array", "dtype": dtype}
    if array.size == 0:
        entry["shape"] = list(array.shape)
    if np.asarray(read(entry)).tobytes() != array.tobytes():
        raise Unwritable(f"an array of {array.dtype} with numbers that TOML has not")
    return entry


def _read_array(entry: Mapping[str, Any], enums: Mapping[str, Any]) -> Any:
    import numpy as np

    dtype = np.dtype(entry["dtype"])
    if "shape" in entry:
        return np.zeros(entry["shape"], dtype)
    return np.array(_whole(entry["value"], enums), dtype)


def _read_number(entry: Mapping[str, Any], enums: Mapping[str, Any]) -> Any:
    import numpy as np

    return np.dtype(entry["dtype"]).type(_whole(entry["value"], enums))


def _read_member(entry: Mapping[str, Any], enums: Mapping[str, Any]) -> Any:
    name, member = entry["enum"], entry["value"]
    return enums[name][member] if name in enums else Member(name, member)


def _read_stored(entry: Mapping[str, Any], enums: Mapping[str, Any]) -> StoredArray:
    file = entry["value"]
    if not isinstance(file, str) or not re.fullmatch(rf"{ARRAYS_OF_HYPERPARAMETERS}/\w+\.npy", file):
        raise TypeError(f"{file!r} is no file of {ARRAYS_OF_HYPERPARAMETERS}/")
    return StoredArray(file)


_WRITERS: Final[Mapping[type, Callable[[Any], dict[str, Any]]]] = {
    type(None): lambda value: {_KIND: "none"},
    bool: _as_it_is,
    int: _integer,
    float: _as_it_is,
    str: _text,
    complex: lambda value: {"value": [_part(value.real), _part(value.imag)], _KIND: "complex"},
    bytes: lambda value: {"value": value.hex(), _KIND: "bytes"},
    tuple: _sequence,
    list: _sequence,
    set: _set,
    frozenset: _set,
    dict: _mapping,
}

_READERS: Final[Mapping[str, Callable[[Mapping[str, Any], Mapping[str, Any]], Any]]] = {
    "none": lambda entry, enums: None,
    "int": lambda entry, enums: int(entry["value"], 16),
    "complex": lambda entry, enums: complex(*_whole(entry["value"], enums)),
    "bytes": lambda entry, enums: bytes.fromhex(entry["value"]),
    "tuple": lambda entry, enums: tuple(_whole(entry["value"], enums)),
    "set": lambda entry, enums: set(_whole(entry["value"], enums)),
    "frozenset": lambda entry, enums: frozenset(_whole(entry["value"], enums)),
    "dict": lambda entry, enums: {_whole(key, enums): _whole(item, enums) for key, item in entry["value"]},
    "array": _read_array,
    "file": _read_stored,
    "numpy": _read_number,
    "enum": _read_member,
}
