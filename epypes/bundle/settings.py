"""The settings of a bundle: pipeline.toml, written and read back, and the values in it.

What TOML has stands there as it is. Anything else is a table with its ``kind``: beside the value where the whole value
is meant, as an inline table where it is inside a list or a table. Every entry is ready for JSON too.

An array of more than MOST_NUMBERS numbers, as a calibrated map, is a file of the bundle, whose name stands in TOML.
"""

from __future__ import annotations

import enum
import math
import sys
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from epypes.bundle.arrays import StoredArray
from epypes.bundle.compare import Tolerance, read_tolerances
from epypes.catalog import plain, range_of
from epypes.errors import BundleError
from epypes.graph import CompGraph
from epypes.hints import Param
from epypes.images import Order
from epypes.optional import optional_import
from epypes.pipeline import Pipeline
from epypes.run.guard import is_plain_array

# What a person still reads, and a line of a diff still shows.
MOST_NUMBERS: Final = 400
FORMAT: Final = 1
_KIND: Final = "kind"
_SMALL: Final = range(-(2**63), 2**63)
_LINE: Final = 100
_COMMENT: Final = (
    "What the graph in pipeline.py is run with. The manifest covers it: change a value in the notebook and promote."
)
_STATES: Final = "What an event finds as the one before has left it, with the token that leaves it. No event brings it."
_UNWRITABLE: Final = (
    "is {}, which pipeline.toml can't hold. Use numbers, strings, a small array or tuples, lists and dicts of them; "
    "make it in a function"
)
_TOO_LARGE: Final = (
    f"is or holds {{}}; {MOST_NUMBERS} are the most that pipeline.toml holds, where people read them. Make each array "
    "a hyperparameter of its own, or let the function read it from a variable of the notebook, outside of it: the "
    "bundle has either as a file. Or make it in a function"
)
# What stands before the lines that need a word.
_COMMENTS: Final = {
    "types": "The annotations of the functions are not compared.",
    "inputs": "The tokens that an event brings, and those that its answer carries.",
    "rgb": "Their three or four channels are RGB; those of all others are BGR.",
    "own": "What pipeline.py has of its own, in place of what a bundle usually does.",
}


class Unwritable(ValueError):
    """A value that no entry holds to the last bit; its text says of which kind it is, ``reason`` what to do instead."""

    def __init__(self, kind: str, reason: str = _UNWRITABLE) -> None:
        super().__init__(kind)
        self.reason = reason.format(kind)


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
    states
        The state between runs: by key of ``runner.state``, the delayed token; of a nested pipeline, both after the
        function's name and a dot. It begins with the initial values in the module.
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
    states: Mapping[str, str] = field(default_factory=dict)
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
            encode_value(value)
        except Unwritable as error:
            reasons.append(f"{what} {token!r} {error.reason}; or {last}.")
    return reasons


def writable_defaults(cg: CompGraph, hyperparameters: Mapping[str, Any]) -> dict[str, Any]:
    """Return the graph's defaults of hyperparameters, but for those that TOML can't hold.

    They may be missing: in the bundle every hyperparameter has a value. What an event brings has no default there.
    """
    return {token: value for token, value in cg.defaults.items() if token in hyperparameters and fits(value)}


def states_of(cg: CompGraph) -> dict[str, str]:
    """Return the state between runs of a graph and its nested pipelines, as ``Settings.states`` has it."""
    found = {previous: delay.token for previous, delay in cg.delays.items()}
    for name, function in cg.functions.items():
        if isinstance(function, Pipeline):
            found |= {f"{name}.{key}": f"{name}.{token}" for key, token in states_of(function.cg).items()}
    return found


def write_settings(path: Path, settings: Settings, cg: CompGraph) -> None:
    """Write pipeline.toml, with a comment per section and the ranges that annotations and usual names give."""
    with optional_import():
        import tomlkit
    bundle: dict[str, Any] = {"format": FORMAT, "name": settings.name}
    bundle |= {} if settings.types else {"types": False}
    bundle |= {"groups": True} if settings.has_groups else {}
    ports = {"inputs": list(settings.inputs), "outputs": list(settings.outputs)}
    ports |= {key: list(getattr(settings, key)) for key in ("rgb", "own") if getattr(settings, key)}
    document = tomlkit.document()
    document.add(tomlkit.comment(_COMMENT))
    document.add("bundle", _table(bundle))
    document.add("ports", _table(ports))
    if settings.states:
        document.add("states", _table(settings.states, _STATES))
    for section in ("hyperparameters", "defaults", "attributes"):
        tables = tomlkit.table(is_super_table=True)
        for name, value in getattr(settings, section).items():
            if section == "hyperparameters":
                takers = ", ".join(cg.digraph.consumers.get(name, ()))
                tables.add(name, _table(_entry_of(cg, name, value), f"Taken by {takers}."))
            else:
                tables.add(name, _table(encode_value(value)))
        if tables:
            document.add(section, tables)
    path.write_text(tomlkit.dumps(document), encoding="utf-8")


def _table(entries: Mapping[str, Any], comment: str = "") -> Any:
    """Return a table for TOML: rows of a matrix, and what is long, on lines of their own."""
    with optional_import():
        import tomlkit
    table = tomlkit.table()
    if comment and comment.isprintable():
        table.add(tomlkit.comment(comment))
    for key, part in entries.items():
        item = part
        if key in _COMMENTS:
            table.add(tomlkit.comment(_COMMENTS[key]))
        if isinstance(part, dict):
            item = tomlkit.inline_table()
            item.update(part)
        elif isinstance(part, list):
            item = tomlkit.array()
            item.extend(part)
            has_rows = any(isinstance(entry, list) for entry in part) and len(part) > 1
            item.multiline(has_rows or len(item.as_string()) > _LINE)
        table.add(key, item)
    return table


def _entry_of(cg: CompGraph, token: str, value: Any) -> dict[str, Any]:
    """Return what stands in pipeline.toml of a hyperparameter: its value, and the range that it may take."""
    entry = encode_value(value)
    hint = range_of(cg, token, value)
    if not isinstance(hint, Param):
        return entry
    entry.update({key: plain(getattr(hint, key)) for key in ("low", "high", "step") if _is_limit(getattr(hint, key))})
    entry.update({key: True for key in ("odd", "log") if getattr(hint, key)})
    if hint.soft is not None and all(map(_is_limit, hint.soft)):
        entry["soft"] = [plain(end) for end in hint.soft]
    if hint.choices and all(map(fits, hint.choices)):
        entry["choices"] = [_choice(choice, entry) for choice in hint.choices]
        entry.update({"labels": list(hint.labels)} if hint.labels else {})
    entry.update({key: getattr(hint, key) for key in ("unit", "about") if getattr(hint, key)})
    return entry


def _is_limit(limit: Any) -> bool:
    """Whether TOML has a limit as a number; it may have no infinite one."""
    number = plain(limit)
    return type(number) in (int, float) and math.isfinite(number) and _KIND not in encode_value(number)


def _choice(choice: Any, entry: Mapping[str, Any]) -> Any:
    """Return a choice as it stands in the place of an entry's value; whole if it is of another kind."""
    own = encode_value(choice)
    same = all(own.get(key) == entry.get(key) for key in (_KIND, "dtype", "shape", "enum"))
    return own["value"] if (same or _KIND not in own) and "value" in own else own


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
            text = f"{path} has format {bundle['format']}; this EPypes reads format {FORMAT}. Promote the graph again"
            raise BundleError(path, f"{text}, or use the EPypes that wrote it.")
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
            _texts(document.get("states", {})),
            entries,
        )
    except KeyError as error:
        raise BundleError(path, f"{path} lacks {error.args[0]!r}. Promote the graph again.") from error
    except (OSError, ValueError, TypeError, AttributeError) as error:
        raise BundleError(path, f"{path} can't be read: {error}. Promote the graph again.") from error


def _strings(values: Sequence[Any]) -> tuple[str, ...]:
    if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
        raise TypeError(f"{values!r} is not a list of token names")
    if len(set(values)) < len(values):
        raise TypeError(f"{values!r} names a token twice")
    return tuple(values)


def _texts(entries: Mapping[str, Any]) -> dict[str, str]:
    if not isinstance(entries, dict) or not all(isinstance(value, str) for value in entries.values()):
        raise TypeError(f"{entries!r} is no table of token names")
    return entries


def _values(entries: Mapping[str, Any], enums: Mapping[str, Any] | None) -> dict[str, Any]:
    return {token: decode_value(entry, enums) for token, entry in entries.items()}


# -- values ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Member:
    """A member of an enumeration that is known by its names alone, where the bundle's module is not executed."""

    enum: str
    name: str


def cast_like(entry: Mapping[str, Any], value: Any) -> Any:
    """Return a number as one of the kind that an entry has: NumPy's of its dtype, else Python's own."""
    number = plain(value)
    if entry.get(_KIND) != "numpy" or not isinstance(number, bool | int | float):
        return number
    import numpy as np

    return np.dtype(entry["dtype"]).type(number)


def fits(value: Any) -> bool:
    """Whether an entry holds a value to the last bit."""
    return not unwritable({"": value})


def encode_value(value: Any) -> dict[str, Any]:
    """Return the entry of a value: ``value``, with its ``kind`` and what else that needs where TOML has none like it.

    Raises
    ------
    Unwritable
        There is no entry for a value of this kind, or of this size.
    """
    try:
        return _encode(value)
    except RecursionError:
        raise Unwritable("nested too deep") from None


def _encode(value: Any) -> dict[str, Any]:
    kind = type(value)
    if value is None:
        return {_KIND: "none"}
    if kind in (bool, float) or (kind is int and value in _SMALL):
        return {"value": value}
    if kind is str:
        if any("\ud800" <= character <= "\udfff" for character in value):
            raise Unwritable("a text with half a character in it")
        return {"value": value}
    if kind is list:
        return {"value": _items(value)}
    if kind is dict and _KIND not in value and all(type(key) is str and fits(key) for key in value):
        return {"value": {key: _part(item) for key, item in value.items()}}
    for name, (python_type, write, _) in _KINDS.items():
        if kind is python_type:
            return {"value": write(value), _KIND: name}
    return _encode_by_name(value)


def _encode_by_name(value: Any) -> dict[str, Any]:
    """Return the entry of a value that names its dtype, its enumeration or its file."""
    numpy = sys.modules.get("numpy")
    if is_plain_array(value):
        return _array(value)
    if numpy and isinstance(value, numpy.number | numpy.bool_) and _is_exact(value.dtype):
        return {"value": _of_number(value), _KIND: "numpy", "dtype": value.dtype.name}
    if isinstance(value, enum.Enum) and value.name in type(value).__members__:
        return {"value": value.name, _KIND: "enum", "enum": type(value).__qualname__}
    if isinstance(value, Member):
        return {"value": value.name, _KIND: "enum", "enum": value.enum}
    if isinstance(value, StoredArray):
        return {"value": value.file, _KIND: "file"}
    raise Unwritable(f"a {type(value).__name__}")


def _is_exact(dtype: Any) -> bool:
    """Whether Python's own numbers hold those of a dtype to the last bit."""
    return dtype.kind in "biuf" and dtype.itemsize <= 8


def _array(array: Any) -> dict[str, Any]:
    if not _is_exact(array.dtype):
        raise Unwritable(f"an array of {array.dtype}")
    if array.size > MOST_NUMBERS:
        raise Unwritable(f"an array of {array.size} numbers", _TOO_LARGE)
    import numpy as np

    numbers = np.array([_of_number(number) for number in array.flat], object)
    dtype = array.dtype.name if array.dtype.isnative else array.dtype.str
    entry = {"value": numbers.reshape(array.shape).tolist(), _KIND: "array", "dtype": dtype}
    entry |= {} if array.size else {"shape": list(array.shape)}
    if decode_value(entry).tobytes() != array.tobytes():
        raise Unwritable(f"an array of {array.dtype} with numbers that TOML has not")
    return entry


def _of_number(number: Any) -> Any:
    """Return a number of NumPy's as the shortest one of Python's that makes it again."""
    whole = number.item()
    if number.dtype.kind != "f":
        return _part(whole)
    short = float(str(number))
    return _part(short if number.dtype.type(short).tobytes() == number.tobytes() else whole)


def _part(value: Any) -> Any:
    """Return a value as it stands inside a list or table."""
    entry = _encode(value)
    return entry if _KIND in entry else entry["value"]


def _items(values: Iterable[Any]) -> list[Any]:
    return [_part(item) for item in values]


def _sorted_items(values: Iterable[Any]) -> list[Any]:
    return sorted(_items(values), key=repr)


# The type of each kind, what stands in an entry for a value of it, and how that makes the value again.
_KINDS: Final[Mapping[str, tuple[type, Callable[[Any], Any], Callable[[Any], Any]]]] = {
    "int": (int, hex, lambda text: int(text, 16)),
    "complex": (complex, lambda value: _items((value.real, value.imag)), lambda parts: complex(*parts)),
    "bytes": (bytes, bytes.hex, bytes.fromhex),
    "tuple": (tuple, _items, tuple),
    "set": (set, _sorted_items, set),
    "frozenset": (frozenset, _sorted_items, frozenset),
    "dict": (dict, lambda value: [_items(pair) for pair in value.items()], dict),
}


def decode_value(entry: Mapping[str, Any], enums: Mapping[str, Any] | None = None) -> Any:
    """Return the value of an entry.

    Parameters
    ----------
    entry
        What :func:`encode_value` returned; other keys are passed over.
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
    kind = entry.get(_KIND)
    if kind == "none":
        return None
    value = _whole(entry["value"], enums)
    if kind is None:
        return value
    if isinstance(kind, str) and kind in _KINDS:
        return _KINDS[kind][2](value)
    if kind in ("array", "numpy"):
        return _of_numpy(kind, value, entry)
    if kind == "enum":
        name = entry["enum"]
        return enums[name][value] if enums and name in enums else Member(name, value)
    if kind == "file":
        return StoredArray(value)
    raise TypeError(f"no value has the kind {kind!r}")


def _of_numpy(kind: str, value: Any, entry: Mapping[str, Any]) -> Any:
    import numpy as np

    dtype = np.dtype(entry["dtype"])
    if kind == "numpy":
        return dtype.type(value)
    array = np.array(value, dtype)
    return array.reshape(entry["shape"]) if "shape" in entry else array


def _whole(part: Any, enums: Mapping[str, Any] | None) -> Any:
    """Return a value that stands inside a list or table."""
    if isinstance(part, dict):
        if _KIND in part:
            return decode_value(part, enums)
        return {key: _whole(item, enums) for key, item in part.items()}
    return [_whole(item, enums) for item in part] if isinstance(part, list) else part


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
