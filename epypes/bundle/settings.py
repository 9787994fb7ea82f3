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
from operator import attrgetter
from pathlib import Path
from typing import Any, Final, NamedTuple

from epypes.bundle.arrays import StoredArray
from epypes.bundle.proof.compare import Tolerance, read_tolerances
from epypes.catalog import plain, range_of
from epypes.errors import BundleError, InvalidType, InvalidValue
from epypes.graph import ASSUMED, ColourOrder, CompGraph, inside_of
from epypes.hints import Param
from epypes.images import ORDERS, Order
from epypes.nothing import Nothing
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
_ASSUMED: Final = "No function says the order of the colours of {}: bgr is assumed."
_MARK_RGB: Final = 'If it is rgb, annotate a parameter: Annotated[np.ndarray, ep.Image(order="rgb")].'
# What stands before the lines that need a word.
_COMMENTS: Final = {
    "types": "The annotations of the functions are not compared.",
    "inputs": "The tokens that an event brings, and those that its answer carries.",
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
    colours
        The order of colours of inputs and outputs that have one, by token.
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
    colours: Mapping[str, ColourOrder] = field(default_factory=dict)
    defaults: Mapping[str, Any] = field(default_factory=dict)
    types: bool = True
    tolerances: Mapping[str, Tolerance] = field(default_factory=dict)
    own: tuple[str, ...] = ()
    attributes: Mapping[str, Any] = field(default_factory=dict)
    has_groups: bool = False
    states: Mapping[str, str] = field(default_factory=dict)
    entries: Mapping[str, Mapping[str, Any]] = field(default_factory=dict)

    @property
    def rgb(self) -> tuple[str, ...]:
        """Of the inputs and outputs, those whose three or four channels are RGB."""
        return tuple(token for token, found in self.colours.items() if found.order == "rgb")

    def colour(self, token: str) -> ColourOrder:
        """Return the order of a token's colours, and what says it."""
        return self.colours.get(token, ASSUMED)

    def order(self, token: str) -> Order:
        """Return the order of a token's colours."""
        return self.colour(token).order

    def assumptions(self) -> str:
        """Return one line on the colours whose order is assumed; empty if there are none."""
        tokens = ", ".join(repr(token) for token, found in self.colours.items() if found.is_assumed)
        return tokens and f"{_ASSUMED.format(tokens)} {_MARK_RGB}"


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
    toml = _toml()
    bundle: dict[str, Any] = {"format": FORMAT, "name": settings.name}
    bundle |= {} if settings.types else {"types": False}
    bundle |= {"groups": True} if settings.has_groups else {}
    ports = {"inputs": list(settings.inputs), "outputs": list(settings.outputs)}
    ports |= {"own": list(settings.own)} if settings.own else {}
    hyperparameters = {
        token: _table(_entry_of(cg, token, value), f"Taken by {', '.join(_takers(cg, token))}.")
        for token, value in settings.hyperparameters.items()
    }
    sections: dict[str, Any] = {
        "bundle": _table(bundle),
        "ports": _table(ports),
        "colours": {token: _colour_table(found) for token, found in settings.colours.items()},
        "states": _table(settings.states, _STATES) if settings.states else {},
        "hyperparameters": hyperparameters,
        "defaults": {name: _table(encode_value(value)) for name, value in settings.defaults.items()},
        "attributes": {name: _table(encode_value(value)) for name, value in settings.attributes.items()},
    }
    document = toml.document()
    document.add(toml.comment(_COMMENT))
    for name, section in sections.items():
        if type(section) is dict and section:
            tables = toml.table(is_super_table=True)
            for key, table in section.items():
                tables.add(key, table)
            document.add(name, tables)
        elif section:
            document.add(name, section)
    path.write_text(toml.dumps(document), encoding="utf-8")


def _takers(cg: CompGraph, token: str) -> tuple[str, ...]:
    """Return the functions that take a hyperparameter; of a pipeline, after its name."""
    inner, inside = inside_of(cg, token)
    around = token.removesuffix(inside) if inner is not cg else ""
    return tuple(f"{around}{name}" for name in inner.digraph.consumers.get(inside, ()))


def _toml() -> Any:
    with optional_import():
        import tomlkit
    return tomlkit


def _table(entries: Mapping[str, Any], comment: str = "") -> Any:
    """Return a table for TOML: rows of a matrix, and what is long, on lines of their own."""
    toml, table = _toml(), _toml().table()
    if comment and comment.isprintable():
        table.add(toml.comment(comment))
    for key, part in entries.items():
        item = part
        if key in _COMMENTS:
            table.add(toml.comment(_COMMENTS[key]))
        if isinstance(part, dict):
            item = toml.inline_table()
            item.update(part)
        elif isinstance(part, list):
            item = toml.array()
            item.extend(part)
            has_rows = any(isinstance(entry, list) for entry in part) and len(part) > 1
            item.multiline(has_rows or len(item.as_string()) > _LINE)
        table.add(key, item)
    return table


def _colour_table(found: ColourOrder) -> Any:
    """Return the table of a token's colours; where no function is named, the order is assumed."""
    if not found.is_assumed:
        return _table({"order": found.order, "function": found.function})
    table, order = _table({}, _MARK_RGB), _toml().string(found.order)
    order.comment("assumed").trivia.comment_ws = "  "
    table.add("order", order)
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
        if "rgb" in ports:
            raise InvalidValue("its orders of colours stand under [ports], where an older EPypes wrote them")
        entries = document.get("hyperparameters", {})
        return Settings(
            str(bundle["name"]),
            _strings(ports["inputs"]),
            _strings(ports["outputs"]),
            _values(entries, enums),
            _read_colours(document.get("colours", {})),
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


def _read_colours(entries: Mapping[str, Mapping[str, Any]]) -> dict[str, ColourOrder]:
    for token, entry in entries.items():
        if entry["order"] not in ORDERS:
            raise InvalidValue(f"the order of the colours of {token!r} is {entry['order']!r}, not bgr or rgb")
    return {token: ColourOrder(entry["order"], entry.get("function", "")) for token, entry in entries.items()}


def _strings(values: Sequence[Any]) -> tuple[str, ...]:
    if not isinstance(values, list) or not all(isinstance(value, str) for value in values):
        raise InvalidType(f"{values!r} is not a list of token names")
    if len(set(values)) < len(values):
        raise InvalidType(f"{values!r} names a token twice")
    return tuple(values)


def _texts(entries: Mapping[str, Any]) -> dict[str, str]:
    if not isinstance(entries, dict) or not all(isinstance(value, str) for value in entries.values()):
        raise InvalidType(f"{entries!r} is no table of token names")
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
    for name, single in _SINGLE.items():
        if value is single:
            return {_KIND: name}
    if kind is str and any("\ud800" <= character <= "\udfff" for character in value):
        raise Unwritable("a text with half a character in it")
    if kind in (bool, float, str) or (kind is int and value in _SMALL):
        return {"value": value}
    if kind is list:
        return {"value": _items(value)}
    if kind is dict and _KIND not in value and all(type(key) is str and fits(key) for key in value):
        return {"value": {key: _part(item) for key, item in value.items()}}
    for name, one in _KINDS.items():
        if one.has(value):
            return {"value": one.write(value), _KIND: name, **one.more(value)}
    raise Unwritable(f"a {kind.__name__}")


def _part(value: Any) -> Any:
    """Return a value as it stands inside a list or table."""
    entry = _encode(value)
    return entry if _KIND in entry else entry["value"]


def _items(values: Iterable[Any]) -> list[Any]:
    parts = [_part(item) for item in values]
    return sorted(parts, key=repr) if isinstance(values, set | frozenset) else parts


def _is_exact(dtype: Any) -> bool:
    """Whether Python's own numbers hold those of a dtype to the last bit."""
    return dtype.kind in "biuf" and dtype.itemsize <= 8


def _is_number_of_numpy(value: Any) -> bool:
    numpy = sys.modules.get("numpy")
    return bool(numpy) and isinstance(value, numpy.number | numpy.bool_) and _is_exact(value.dtype)  # type: ignore[union-attr]


def _number(number: Any) -> Any:
    """Return a number of NumPy's as the shortest one of Python's that makes it again."""
    whole = number.item()
    if number.dtype.kind != "f":
        return _part(whole)
    short = float(str(number))
    return _part(short if number.dtype.type(short).tobytes() == number.tobytes() else whole)


def _numbers(array: Any) -> Any:
    """Return the numbers of an array, in lists."""
    if not _is_exact(array.dtype):
        raise Unwritable(f"an array of {array.dtype}")
    if array.size > MOST_NUMBERS:
        raise Unwritable(f"an array of {array.size} numbers", _TOO_LARGE)
    import numpy as np

    numbers = np.array([_number(number) for number in array.flat], object).reshape(array.shape).tolist()
    if np.array(_whole(numbers, None), array.dtype).tobytes() != array.tobytes():
        raise Unwritable(f"an array of {array.dtype} with numbers that TOML has not")
    return numbers


def _described(value: Any) -> dict[str, Any]:
    """Return what the entry of an array or number of NumPy's has besides the numbers."""
    dtype = value.dtype.name if value.dtype.isnative else value.dtype.str
    return {"dtype": dtype} if value.size else {"dtype": dtype, "shape": list(value.shape)}


def _read_numpy(value: Any, entry: Mapping[str, Any], enums: Mapping[str, Any] | None) -> Any:
    import numpy as np

    dtype = np.dtype(entry["dtype"])
    if entry[_KIND] == "numpy":
        return dtype.type(value)
    array = np.array(value, dtype)
    return array.reshape(entry.get("shape", array.shape))


def _is_member(value: Any) -> bool:
    return isinstance(value, Member) or (isinstance(value, enum.Enum) and value.name in type(value).__members__)


def _enum_of(member: Any) -> dict[str, Any]:
    return {"enum": member.enum if isinstance(member, Member) else type(member).__qualname__}


def _read_member(name: str, entry: Mapping[str, Any], enums: Mapping[str, Any] | None) -> Any:
    kind = entry["enum"]
    return enums[kind][name] if enums and kind in enums else Member(kind, name)


class _Kind(NamedTuple):
    """How values of a kind stand in an entry.

    Attributes
    ----------
    has
        Whether a value is of this kind.
    write
        Returns what stands in the entry for a value.
    read
        Returns the value for what stands there, with the entry and the enumerations by name.
    more
        Returns what else the entry of a value has.
    """

    has: Callable[[Any], bool]
    write: Callable[[Any], Any]
    read: Callable[[Any, Mapping[str, Any], Mapping[str, Any] | None], Any]
    more: Callable[[Any], Mapping[str, Any]] = lambda value: {}


def _of_type(kind: type, write: Callable[[Any], Any], read: Callable[[Any], Any]) -> _Kind:
    return _Kind(lambda value: type(value) is kind, write, lambda value, entry, enums: read(value))


_SINGLE: Final[Mapping[str, Any]] = {"none": None, "nothing": Nothing}
_KINDS: Final[Mapping[str, _Kind]] = {
    "int": _of_type(int, hex, lambda text: int(text, 16)),
    "complex": _of_type(complex, lambda value: _items((value.real, value.imag)), lambda parts: complex(*parts)),
    "bytes": _of_type(bytes, bytes.hex, bytes.fromhex),
    "tuple": _of_type(tuple, _items, tuple),
    "set": _of_type(set, _items, set),
    "frozenset": _of_type(frozenset, _items, frozenset),
    "dict": _of_type(dict, lambda value: [_items(pair) for pair in value.items()], dict),
    "file": _of_type(StoredArray, attrgetter("file"), StoredArray),
    "array": _Kind(is_plain_array, _numbers, _read_numpy, _described),
    "numpy": _Kind(_is_number_of_numpy, _number, _read_numpy, _described),
    "enum": _Kind(_is_member, attrgetter("name"), _read_member, _enum_of),
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
    kind: Any = entry.get(_KIND)
    if kind in _SINGLE:
        return _SINGLE[kind]
    value = _whole(entry["value"], enums)
    if kind is None:
        return value
    if kind not in _KINDS:
        raise InvalidType(f"no value has the kind {kind!r}")
    return _KINDS[kind].read(value, entry, enums)


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
    elif isinstance(value, dict | tuple | list | set | frozenset):
        for part in (*value, *(value.values() if isinstance(value, dict) else ())):
            yield from members_in(part)
