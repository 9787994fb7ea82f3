"""Expressions: the source text that makes a value again, with the imports that it needs, and its layout."""

from __future__ import annotations

import ast
import dataclasses
import enum
import inspect
import itertools
import json
import keyword
import logging
import pathlib
import re
import sys
import types
import unicodedata
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from datetime import date, datetime, time, timedelta, timezone
from decimal import Decimal
from fractions import Fraction
from operator import attrgetter, itemgetter, methodcaller
from typing import TYPE_CHECKING, Annotated, Any, Final, get_origin

from epypes.bundle.source.resolve import Importable, Refused, assignment_of, evaluated, importable, names_of
from epypes.bundle.source.side_effects import changes_itself
from epypes.nothing import Nothing
from epypes.pipeline import Node
from epypes.run.guard import is_plain_array

if TYPE_CHECKING:
    from epypes.bundle.source.slice import Slice


# -- identifiers -------------------------------------------------------------------------------------------------------

# Style checkers refuse these as variables, since they look like numbers; nothing can be assigned to __debug__.
_NOT_NAMES: Final = frozenset({"l", "O", "I", "__debug__"})
_LONGEST: Final = 30


def is_identifier(text: str) -> bool:
    """Whether text can be a variable as it is: Python itself normalizes some characters."""
    is_usable = text.isidentifier() and not keyword.iskeyword(text) and text not in _NOT_NAMES
    return is_usable and unicodedata.normalize("NFKC", text) == text


def identifier_of(name: str, is_taken: Callable[[str], bool]) -> str:
    """Return a variable that is not taken, as like a name as can be."""
    stem = str.__str__(name)
    if not is_identifier(stem):
        stem = re.sub(r"\W+", "_", stem.encode("ascii", "ignore").decode())[:_LONGEST].strip("_") or "token"
        stem = f"token_{stem}" if stem[0].isdecimal() else stem
    candidates = itertools.chain([stem, f"{stem}_"], (f"{stem}_{number}" for number in itertools.count(2)))
    return next(text for text in candidates if is_identifier(text) and not is_taken(text))


# -- literals ----------------------------------------------------------------------------------------------------------

UNKNOWN: Final = object()


def is_data(value: object) -> bool:
    """Whether a value is of a type that literals are made of."""
    kinds = (bool, int, float, complex, str, bytes, type(None), tuple, list, dict, set, frozenset)
    return type(value) in kinds


def escaped(text: str, most: int = 200) -> str:
    """Return text as it may stand in a comment or docstring, whatever it holds: names are data."""
    return json.dumps(text if len(text) <= most else f"{text[: most - 3]}...")[1:-1]


def quoted(text: str | bytes) -> str:
    """Return the literal of a text, in double quotes unless it holds some; of a member of a StrEnum, of its text."""
    source = repr(text if isinstance(text, bytes) else str.__str__(text))
    return source if '"' in source else source.replace("'", '"')


def has_steady_order(values: Iterable[Any]) -> bool:
    """Whether a set of these has the same order in every process: hashes of text, for one, are seeded."""
    return all(
        has_steady_order(value) if type(value) is tuple else type(value) in (bool, int, float, complex)
        for value in values
    )


def bracketed(value: Any, write: Callable[[Any], str]) -> str:
    """Return the source of a tuple, list, dict or set, whose elements ``write`` writes."""
    if type(value) is dict:
        return f"{{{', '.join(f'{write(key)}: {write(item)}' for key, item in value.items())}}}"
    elements = [*map(write, value)]
    if type(value) is set:
        return f"{{{', '.join(elements if has_steady_order(value) else sorted(elements))}}}"
    inner = ", ".join(elements)
    return f"[{inner}]" if type(value) is list else f"({inner}{',' if len(elements) == 1 else ''})"


def literal(value: Any) -> str:
    """Return the source of a constant: as repr, but with sets sorted whose order changes from process to process.

    Raises
    ------
    ValueError
        Something in it is of a type that literals are not made of, or is an int that is too long for Python.
    """
    if type(value) in (str, bytes):
        return quoted(value)
    if type(value) in (tuple, list, dict) or (type(value) is set and value):
        return bracketed(value, literal)
    if not is_data(value):  # a kind of str or int inside a tuple would become a plain one
        raise ValueError(f"an object of class {type(value).__name__!r} has no literal")
    return repr(value)


def literal_source(value: Any) -> str:
    """Return the literal of this very value; "" if there is none."""
    try:
        source = literal(value)
        # By source: 0j == -0j, but they are not the same.
        return source if is_same_data(ast.literal_eval(source), value) else ""
    except (ValueError, SyntaxError, RecursionError, MemoryError):  # Python writes no int of 5000 digits, for one
        return ""


def is_same_data(written: Any, value: Any) -> bool:
    """Whether a value is what a literal says, to the last bit."""
    try:
        return type(written) is type(value) and literal(written) == literal(value)
    except (ValueError, RecursionError):
        return False


def literal_value(expression: ast.expr) -> Any:
    """Return the value of a literal, UNKNOWN for any other expression."""
    try:
        return ast.literal_eval(expression)
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
        return UNKNOWN


# -- expressions -------------------------------------------------------------------------------------------------------

# Their objects know the call that makes them.
_KNOW_THEIR_CALL: Final = (
    range, slice, itemgetter, attrgetter, methodcaller, timedelta, timezone, Fraction, Decimal, logging.Logger,
)  # fmt: skip
_PARTS_OF_DATES: Final = {
    date: ("year", "month", "day"),
    time: ("hour", "minute", "second", "microsecond", "tzinfo"),
    datetime: ("year", "month", "day", "hour", "minute", "second", "microsecond", "tzinfo"),
}
# More numbers are too many to read.
_MOST_NUMBERS: Final = 200
_MOST_CHARACTERS: Final = 400
# Objects of these are what their classes make of the arguments; nothing else is done to them.
_OF_THEIR_ARGUMENTS: Final = ("numpy.vectorize", "scipy.interpolate.", "scipy.spatial.", "skimage.transform.")
_ARRAY: Final = re.compile(r'array\(.*?"\)')


def expression(gathered: Slice, value: Any, what: str, wanted: str = "") -> str:
    """Return the expression of a value, with what it needs imported and defined; "" if there is none.

    Parameters
    ----------
    gathered
        The module that it is for; is added to.
    value
        A literal, an array, a number of NumPy's, a member of an enumeration, a named tuple, a dataclass's object, a
        function or class, a simple object such as a range or an itemgetter, or a tuple, list or dict of these.
    what
        How to call it in a reason.
    wanted
        The name of a function that has none of its own, or of an array that is stored in a file.

    Raises
    ------
    Refused
        There would be one, but what it needs can't be promoted, or has a name that means something else in the module.
    """
    try:
        return _Writer(gathered, what, wanted).write(value)
    except (ValueError, RecursionError):  # as for what holds itself, or is nested deeper than Python reads
        return ""


def constructed(gathered: Slice, value: Any, what: str) -> str:
    """Return the call of its class by which a cell has made an object; "" if there is none, or more was done."""
    try:
        return _Writer(gathered, what, "").constructed(value)
    except (ValueError, RecursionError):
        return ""


def expression_or_none(gathered: Slice, value: Any, what: str, reason: str, wanted: str = "") -> str:
    """Return the expression of a value; "None", with a reason noted in the slice, if there is none.

    ``reason`` is what stands behind ``what`` then; ``{kind}`` in it is the type of the value.
    """
    with gathered.noted_refusals():
        source = expression(gathered, value, what, wanted)
        if source:
            return source
        gathered.refusals.append(f"{what} {reason.replace('{kind}', type(value).__name__)}")
    return "None"


def names_in(source: str) -> set[str]:
    """Return the names that an expression reads."""
    return {node.id for node in ast.walk(ast.parse(source)) if isinstance(node, ast.Name)}


def is_short(source: str) -> bool:
    """Whether an expression is one that people still read; arrays in it are short enough by themselves."""
    return len(_ARRAY.sub("", source)) <= _MOST_CHARACTERS


@dataclass(frozen=True, slots=True)
class _Writer:
    gathered: Slice
    what: str
    wanted: str

    def write(self, value: Any) -> str:
        """Return the expression of a value.

        Raises
        ------
        ValueError
            There is none.
        """
        source = literal_source(value)
        if source:
            return source
        if type(value) in (tuple, list, dict):
            return bracketed(value, self.write)
        call = _call_of(value)
        if call is not None:
            made_by, arguments = call
            return f"{self.write(made_by)}({self._joined(arguments)})"
        made = self._array(value) if is_plain_array(value) else self._record(value) or self._object(value)
        if not made:
            raise ValueError(f"no expression makes an object of class {type(value).__name__!r}")
        return made

    def _joined(self, values: Iterable[Any]) -> str:
        return ", ".join(map(self.write, values))

    def _object(self, value: Any) -> str:
        """Return the expression of what has a name, or a definition in the notebook; "" for any other."""
        gathered, what = self.gathered, self.what
        if isinstance(value, types.ModuleType):
            return gathered.module_name(value.__name__, what)
        if value is ...:
            return "..."
        if value is Nothing:
            return gathered.reference(Importable("epypes", "Nothing"), what)
        if isinstance(value, types.UnionType):
            return " | ".join(map(self.write, value.__args__))
        origin = get_origin(value)
        if origin is Annotated:
            return f"{self.write(Annotated)}[{self._joined((value.__origin__, *value.__metadata__))}]"
        if origin is Callable:
            *given, result = value.__args__
            return f"{self.write(origin)}[{'...' if given == [...] else self.write(given)}, {self.write(result)}]"
        if origin is not None:
            return f"{self.write(origin)}[{self._joined(value.__args__)}]"
        home = importable(value, *names_of(value, vars(types)))
        if home is not None:
            return gathered.reference(home, what)
        if isinstance(value, type):
            return gathered.add_class(value, what)
        made = self.constructed(value)
        return made or (gathered.add_function(value, what, self.wanted) if callable(value) else "")

    def constructed(self, value: Any) -> str:
        """Return the call of its class by which a cell has made an object; "" if that is not all that was done."""
        kind, names = type(value), self.gathered.notebook or vars(sys.modules["__main__"])
        is_own = kind.__module__ == "__main__" and not isinstance(value, Node) and not changes_itself(kind)
        if not is_own and not f"{kind.__module__}.{kind.__qualname__}".startswith(_OF_THEIR_ARGUMENTS):
            return ""
        given = next(filter(None, (assignment_of(name, names) for name in names_of(value, names))), None)
        call = given[0].value if given is not None else None
        if not isinstance(call, ast.Call) or evaluated(call.func, names) is not kind:
            return ""
        if not all(each.arg for each in call.keywords):
            return ""
        arguments = [self.write(_value_of(argument, names)) for argument in call.args]
        arguments += [f"{each.arg}={self.write(_value_of(each.value, names))}" for each in call.keywords]
        return f"{self.write(kind)}({', '.join(arguments)})"

    def _record(self, value: Any) -> str:
        """Return the expression of a member of an enumeration, a dataclass's object or a named tuple; "" for others.

        A class may do more with its arguments than keep them. The comparison with the module's objects finds that out.
        """
        kind, what = type(value), f"Class {type(value).__name__!r} of {self.what[0].lower()}{self.what[1:]}"
        if isinstance(value, enum.Enum):
            if isinstance(value, enum.Flag) and value.name not in kind.__members__:
                return " | ".join(map(self.write, value))
            return f"{self.gathered.add_class(kind, what)}.{value.name}"
        if kind is types.SimpleNamespace:
            given = ", ".join(f"{name}={self.write(part)}" for name, part in vars(value).items())
            return f"{self.write(kind)}({given})"
        if not dataclasses.is_dataclass(kind) and not (isinstance(value, tuple) and hasattr(kind, "_fields")):
            return ""
        defaults = {name: one.default for name, one in inspect.signature(kind).parameters.items()}
        parts = {name: getattr(value, name, UNKNOWN) for name in defaults}
        needed = [name for name, part in parts.items() if not is_same_data(part, defaults[name])]
        given = ", ".join(f"{name}={self.write(parts[name])}" for name in needed)
        return f"{self.gathered.add_class(kind, what)}({given})"

    def _array(self, array: Any) -> str:
        """Return the expression of an array: its numbers if they are few, else the call that reads it from a file."""
        source = ""
        # No list has the shape of a matrix without numbers.
        is_small = array.size <= _MOST_NUMBERS and (array.size > 0 or array.ndim == 1)
        kind = quoted(str(array.dtype)) if array.dtype.names is None else literal_source(array.dtype.descr)
        is_small &= array.dtype.names is None or "('', " not in kind  # what pads its fields
        parts = array.astype(str) if array.dtype.kind == "M" else array
        listed = literal_source(parts.tolist()) if is_small and array.dtype.kind in "biufcMSUV" else ""
        if listed:
            if not array.flags.c_contiguous and not array.flags.f_contiguous:
                raise Refused(
                    f"{self.what} has an array that is a view of another, with gaps or reversed, which would be laid "
                    "out otherwise. Make it a whole one in the notebook: np.ascontiguousarray(...)."
                )
            order = "" if array.flags.c_contiguous else ', order="F"'
            numpy = self.gathered.module_name("numpy", self.what)
            source = f"{numpy}.array({listed}, dtype={kind}{order})"
        is_text = source and len(source) <= _MOST_CHARACTERS
        return source if is_text else self.gathered.store_array(array, self.wanted or "array", self.what) or source


def _value_of(argument: ast.expr, names: Mapping[str, Any]) -> Any:
    """Return the value of an argument that is a literal, a name, or a tuple or list of these; UNKNOWN for others."""
    if isinstance(argument, ast.Tuple | ast.List):
        values = [_value_of(part, names) for part in argument.elts]
        return values if isinstance(argument, ast.List) else tuple(values)
    value = literal_value(argument)
    return evaluated(argument, names) if isinstance(argument, ast.Name | ast.Attribute) else value


def _call_of(value: Any) -> tuple[Any, tuple[Any, ...]] | None:
    """Return what makes a simple object again, and with which arguments; None for any other."""
    kind = type(value)
    if kind is float:  # NaN and the infinities, which have no literal
        return float, (repr(value),)
    if kind is frozenset:
        return frozenset, (set(value),) if value else ()
    if kind is range and value.step == 1:
        return range, (value.start, value.stop)
    if kind is re.Pattern:  # the flag for text is what re.compile adds by itself
        flags = re.RegexFlag(value.flags & ~re.UNICODE)
        return re.compile, (value.pattern, flags) if flags else (value.pattern,)
    if isinstance(value, pathlib.PurePath):
        return pathlib.Path if isinstance(value, pathlib.Path) else kind, (str(value),)
    if kind is types.MappingProxyType:
        return kind, (dict(value),)
    if kind in _PARTS_OF_DATES and not getattr(value, "fold", 0):
        return kind, tuple(getattr(value, name) for name in _PARTS_OF_DATES[kind])
    if kind in _KNOW_THEIR_CALL:
        made_by, arguments = value.__reduce__()[:2]
        return made_by, arguments
    return _call_of_numpy(value) if kind.__module__.partition(".")[0] == "numpy" else None


def _call_of_numpy(value: Any) -> tuple[Any, tuple[Any, ...]] | None:
    import numpy as np

    if isinstance(value, np.dtype):
        return np.dtype, (value.str if value.names is None else value.descr,)
    if isinstance(value, np.datetime64 | np.timedelta64):
        number = "NaT" if np.isnat(value) else int(value.astype(np.int64))
        return type(value), (number, np.datetime_data(value.dtype))
    return (type(value), (value.item(),)) if isinstance(value, np.number | np.bool_ | np.character) else None


# -- line breaks -------------------------------------------------------------------------------------------------------

LINE: Final = 88


def laid_out(source: str, depth: int = 0, before: str = "", after: str = "", *, is_broken: bool = False) -> list[str]:
    """Return the lines of an expression.

    What is too long for a line gets one item of its outermost brackets per line. Each item is followed by a comma, so
    that formatters leave it on a line of its own.

    Parameters
    ----------
    source
        The expression, on one line.
    depth
        How many levels it is indented.
    before, after
        What stands before and after it: ``"x = "``, ``","``.
    is_broken
        Whether each item of its brackets gets a line of its own though the whole would fit.
    """
    pad = "    " * depth
    whole = f"{pad}{before}{source}{after}"
    items = _items(ast.parse(source, mode="eval").body) if is_broken or len(whole) > LINE else []
    if not items:
        return [whole]
    text = source.encode()  # the columns of syntax trees count bytes
    lines = [pad + before + text[: items[0][0]].decode()]
    for start, value in items:
        name, item = text[start : value.col_offset].decode(), text[value.col_offset : value.end_col_offset].decode()
        lines += laid_out(item, depth + 1, name, ",")
    closing = text[items[-1][1].end_col_offset :].decode().lstrip(", ")
    return [*lines, pad + closing + after]


def _items(node: ast.expr) -> list[tuple[int, ast.expr]]:
    """Return what is in the outermost brackets of an expression: where each item begins, its name or key, its value."""
    match node:
        case ast.Tuple(elts=values) | ast.List(elts=values) | ast.Set(elts=values):
            return [(value.col_offset, value) for value in values]
        case ast.Subscript(slice=ast.Tuple(elts=values)):
            return [(value.col_offset, value) for value in values]
        case ast.Dict(keys=keys, values=values):
            pairs = zip(keys, values, strict=True)
            return [(key.col_offset if key else value.col_offset - len("**"), value) for key, value in pairs]
        case ast.Call(args=values, keywords=named):
            return [(each.col_offset, each) for each in values] + [(each.col_offset, each.value) for each in named]
    return []
