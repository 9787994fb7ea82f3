"""The settings of a bundle: pipeline.toml, written and read back, and the values in it.

What TOML has stands there as it is. Anything else is a table with its ``kind``: beside the value where the whole value
is meant, as an inline table where it is inside a list or a table. Every entry is ready for JSON too.

An array of more than MOST_NUMBERS numbers, as a calibrated map, is a file of the bundle, whose name stands in TOML.
"""

from __future__ import annotations

import enum
import math
import re
import sys
import tomllib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final, Literal

from epypes.bundle.compare import Tolerance, read_tolerances
from epypes.catalog import plain, range_of
from epypes.errors import BundleError
from epypes.graph import CompGraph
from epypes.hints import Param
from epypes.images import Order
from epypes.optional import optional_import
from epypes.run.guard import is_plain_array

# What a person still reads, and a line of a diff still shows.
MOST_NUMBERS: Final = 400
ARRAYS_OF_HYPERPARAMETERS: Final = "hyperparameters"
_KIND: Final = "kind"
_SMALL: Final = range(-(2**63), 2**63)
FORMAT: Final = 1
_LINE: Final = 100
_COMMENT: Final = (
    "What the graph in pipeline.py is run with. The manifest covers it: change a value in the notebook and promote."
)


class Unwritable(ValueError):
    """A value that no entry holds to the last bit; its text says of which kind it is."""

    reason = (
        "is {}, which pipeline.toml can't hold. Use numbers, strings, a small array or tuples, lists and dicts of "
        "them; make it in a function"
    )


class LargeArray(Unwritable):
    """An array of numbers that is too large for text."""

    reason = (
        f"is or holds {{}}; {MOST_NUMBERS} are the most that pipeline.toml holds, where people read them. Make each "
        "array a hyperparameter of its own, or let the function read it from a variable of the notebook, outside of "
        "it: the bundle has either as a file. Or make it in a function"
    )


@dataclass(frozen=True, slots=True)
class Settings:
    """The settings of a bundle.

    Attributes
    ----------
    name
        The bundle's name.
    inputs
        The free source tokens that an event brings.
    outputs
        The tokens that an answer carries.
    hyperparameters
        Values by token.
    rgb
        Of the inputs and outputs, those whose three or four channels are RGB.
    defaults
        The graph's defaults of hyperparameters by token: what they are where the graph is used without these settings.
    types
        Whether the graph compares annotations, as CompGraph does by default.
    tolerances
        How far outputs may be from what was recorded, by token; those of all others not at all.
    own
        What of the pipeline the module defines itself: ``"f_in"``, ``"f_out"``, ``"make_pipeline"``.
    attributes
        The pipeline's attributes.
    has_groups
        Whether the module says which functions are drawn as one box.
    entries
        The hyperparameters as they stand in the file: value and kind, range, unit; ready for JSON. Empty before that.
    """

    name: str
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]
    hyperparameters: Mapping[str, Any]
    rgb: tuple[str, ...] = ()
    defaults: Mapping[str, Any] = field(default_factory=dict)
    types: bool = True
    tolerances: Mapping[str, Tolerance] = field(default_factory=dict)
    own: tuple[str, ...] = ()
    attributes: Mapping[str, Any] = field(default_factory=dict)
    has_groups: bool = False
    entries: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    def order(self, token: str) -> Order:
        """Return the order of a token's colours."""
        return "rgb" if token in self.rgb else "bgr"


def unwritable(values: Mapping[str, Any], what: str = "Hyperparameter") -> list[str]:
    """Return a reason for each value that pipeline.toml can't hold."""
    reasons = []
    last = "unfreeze it and pass it to run()" if what == "Hyperparameter" else "leave it out"
    for token, value in values.items():
        try:
            written(value)
        except Unwritable as found:
            reasons.append(f"{what} {token!r} {found.reason.format(found)}; or {last}.")
    return reasons


def writable_defaults(cg: CompGraph, hyperparameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return the graph's defaults of hyperparameters, but for those that TOML can't hold.

    They may be missing: in the bundle every hyperparameter has a value. What an event brings has no default there.
    """
    return {token: value for token, value in cg.defaults.items() if token in hyperparameters and fits(value)}


def write_settings(path: Path, settings: Settings, cg: CompGraph) -> None:
    """Write pipeline.toml, with a comment per section and the ranges that annotations and usual names give."""
    tomlkit = _tomlkit()
    document = tomlkit.document()
    document.add(tomlkit.comment(_COMMENT))
    bundle = tomlkit.table()
    bundle.add("format", FORMAT)
    bundle.add("name", settings.name)
    if not settings.types:
        bundle.add(tomlkit.comment("The annotations of the functions are not compared."))
        bundle.add("types", False)
    if settings.has_groups:
        bundle.add("groups", True)
    document.add("bundle", bundle)
    document.add("ports", _ports(settings))
    hyperparameters = tomlkit.table(is_super_table=True)
    for token, value in settings.hyperparameters.items():
        hyperparameters.add(token, _table(entry_of(cg, token, value), _takers(cg, token)))
    document.add("hyperparameters", hyperparameters)
    for section, values in (("defaults", settings.defaults), ("attributes", settings.attributes)):
        if values:
            table = tomlkit.table(is_super_table=True)
            for name, value in values.items():
                table.add(name, _table(written(value)))
            document.add(section, table)
    path.write_text(tomlkit.dumps(document), encoding="utf-8")


def _tomlkit() -> Any:
    with optional_import():
        import tomlkit

    return tomlkit


def _ports(settings: Settings) -> Any:
    tomlkit = _tomlkit()
    ports = tomlkit.table()
    ports.add(tomlkit.comment("The tokens that an event brings, and those that its answer carries."))
    ports.add("inputs", list(settings.inputs))
    ports.add("outputs", list(settings.outputs))
    if settings.rgb:
        ports.add(tomlkit.comment("Their three or four channels are RGB; those of all others are BGR."))
        ports.add("rgb", list(settings.rgb))
    if settings.own:
        ports.add(tomlkit.comment("What pipeline.py has of its own, in place of what a bundle usually does."))
        ports.add("own", list(settings.own))
    return ports


def entry_of(cg: CompGraph, token: str, value: Any) -> dict[str, Any]:
    """Return what stands in pipeline.toml of a hyperparameter: its value, and the range that it may take."""
    entry = written(value)
    hint = range_of(cg, token, value)
    if not isinstance(hint, Param):
        return entry
    limits = {key: getattr(hint, key) for key in ("low", "high", "step")}
    entry.update({key: plain(limit) for key, limit in limits.items() if limit is not None and _is_finite(limit)})
    entry.update({key: True for key in ("odd", "log") if getattr(hint, key)})
    if hint.soft is not None and all(map(_is_finite, hint.soft)):
        entry["soft"] = [plain(end) for end in hint.soft]
    if hint.choices and all(map(fits, hint.choices)):
        entry["choices"] = [_choice(choice, value) for choice in hint.choices]
        entry.update({"labels": list(hint.labels)} if hint.labels else {})
    entry.update({key: getattr(hint, key) for key in ("unit", "about") if getattr(hint, key)})
    return entry


def _is_finite(limit: Any) -> bool:
    return math.isfinite(limit) and fits(plain(limit)) and "kind" not in written(plain(limit))


def _choice(choice: Any, value: Any) -> Any:
    """Return a choice as the value would be written in its place."""
    entry = written(choice)
    same = "kind" not in entry or ("value" in entry and {**entry, "value": 0} == {**written(value), "value": 0})
    return entry["value"] if same else entry


def _takers(cg: CompGraph, token: str) -> str:
    takers = cg.digraph.consumers.get(token, ())
    return f"Taken by {', '.join(takers)}."


def _table(entry: Mapping[str, Any], comment: str = "") -> Any:
    table = _tomlkit().table()
    if comment and comment.isprintable():
        table.add(_tomlkit().comment(comment))
    for key, part in entry.items():
        table.add(key, _item(part))
    return table


def _item(part: Any) -> Any:
    """Return a value for TOML: rows of a matrix, and what is long, on lines of their own."""
    if isinstance(part, dict):
        table = _tomlkit().inline_table()
        table.update(part)
        return table
    if not isinstance(part, list):
        return part
    item = _tomlkit().array()
    item.extend(part)
    has_rows = any(isinstance(entry, list) for entry in part) and len(part) > 1
    return item.multiline(True) if has_rows or len(item.as_string()) > _LINE else item


def read_settings(path: Path, enums: Mapping[str, Any] | None = None) -> Settings:
    """Read pipeline.toml.

    Parameters
    ----------
    path
        The file.
    enums
        The enumerations of the bundle's module by name. Without, members of them are read as :class:`Member`.

    Raises
    ------
    BundleError
        It is not TOML, has another format, or lacks an entry; the entry is named.
    """
    try:
        document = tomllib.loads(path.read_text(encoding="utf-8"))
        bundle, ports = document["bundle"], document["ports"]
        if bundle["format"] != FORMAT:
            raise BundleError(path, f"{path} has format {bundle['format']}; this EPypes reads format {FORMAT}.")
        entries = document.get("hyperparameters", {})
        return Settings(
            str(bundle["name"]),
            _strings(ports["inputs"]),
            _strings(ports["outputs"]),
            _values(entries, enums),
            _strings(ports.get("rgb", [])),
            _values(document.get("defaults", {}), enums),
            bundle.get("types", True) is not False,
            read_tolerances(document),
            _strings(ports.get("own", [])),
            _values(document.get("attributes", {}), enums),
            bundle.get("groups", False) is True,
            entries,
        )
    except KeyError as error:
        raise BundleError(path, f"{path} lacks {error.args[0]!r}. Promote the graph again.") from error
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise BundleError(path, f"{path} can't be read: {error}.") from error


def _strings(values: Sequence[Any]) -> tuple[str, ...]:
    if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
        raise TypeError(f"{values!r} is not a list of token names")
    if len(set(values)) < len(values):
        raise TypeError(f"{values!r} names a token twice")
    return tuple(values)


def _values(entries: Mapping[str, Any], enums: Mapping[str, Any] | None) -> dict[str, Any]:
    return {token: read(entry, enums) for token, entry in entries.items()}


# -- values ----------------------------------------------------------------------------------------------------------


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
