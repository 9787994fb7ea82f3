"""Expressions: the source text that makes a value again, with the imports that it needs, and its layout.

Arrays that are too large for text stand in ``arrays/NAME.npy`` beside the module, named as the notebook names them; one
small function reads them.
"""

from __future__ import annotations

import ast
import dataclasses
import enum
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
from datetime import timedelta
from decimal import Decimal
from fractions import Fraction
from operator import attrgetter, itemgetter, methodcaller
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, get_origin

from epypes.bundle.resolve import Importable, Refused, importable
from epypes.run.guard import is_plain_array

if TYPE_CHECKING:
    from epypes.bundle.slice import Slice


# -- identifiers -------------------------------------------------------------------------------------------------------

# Style checkers refuse these as variables, since they look like numbers; nothing can be assigned to __debug__.
_NOT_NAMES: Final = frozenset({"l", "O", "I", "__debug__"})
_LONGEST: Final = 30


def is_identifier(text: str) -> bool:
    """Whether text can be a variable as it is: Python itself normalizes some characters."""
    is_usable = text.isidentifier() and not keyword.iskeyword(text) and text not in _NOT_NAMES
    return is_usable and unicodedata.normalize("NFKC", text) == text


def identifiers_of(names: Iterable[str], is_taken: Callable[[str], bool]) -> dict[str, str]:
    """Return a variable for each name, each its own; names that can stay as they are come first."""
    names = list(names)
    found = {name: str.__str__(name) for name in names if is_identifier(name) and not is_taken(name)}
    used = set(found.values())
    for name in names:
        if name not in found:
            found[name] = identifier_of(name, lambda text: text in used or is_taken(text))
            used.add(found[name])
    return found


def identifier_of(name: str, is_taken: Callable[[str], bool]) -> str:
    """Return a variable that is not taken, as like a name as can be."""
    stem = str.__str__(name)
    if not is_identifier(name):
        stem = re.sub(r"\W+", "_", name.encode("ascii", "ignore").decode())[:_LONGEST].strip("_") or "token"
        stem = f"token_{stem}" if stem[0].isdecimal() else stem
    if is_identifier(stem) and not is_taken(stem):
        return stem
    numbered = (f"{stem}_{number}" for number in itertools.count(2))
    return next(text for text in itertools.chain([f"{stem}_"], numbered) if not is_taken(text))


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
        read = ast.literal_eval(source)
    except (ValueError, SyntaxError, RecursionError, MemoryError):  # Python writes no int of 5000 digits, for one
        return ""
    # By source: 0j == -0j, but they are not the same.
    return source if type(read) is type(value) and literal(read) == source else ""


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
_KNOW_THEIR_CALL: Final = (itemgetter, attrgetter, methodcaller, timedelta, Fraction, Decimal, logging.Logger)
# More numbers are too many to read.
_MOST_NUMBERS: Final = 200
_MOST_CHARACTERS: Final = 400


def expression(gathered: Slice, value: Any, what: str, wanted: str = "") -> str:
    """Return the expression of a value, with what it needs imported and defined; "" if there is none.

    Parameters
    ----------
    gathered
        The module that it is for; is added to.
    value
        A literal, a small array, a number of NumPy's, a member of an enumeration, a function or class, a simple object
        such as a range or an itemgetter, or a tuple, list or dict of these.
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


def expression_or_none(gathered: Slice, value: Any, what: str, reason: str = "", wanted: str = "") -> str:
    """Return the expression of a value; "None", with a reason noted in the slice, if there is none.

    ``reason`` is what stands behind ``what`` then; ``{kind}`` in it is the type of the value.
    """
    with gathered.noted_refusals():
        source = expression(gathered, value, what, wanted)
        if not source:
            raise Refused(f"{what} {reason.replace('{kind}', type(value).__name__)}")
        return source
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
        made_by, arguments = _call_of(value)
        if made_by is not None:
            return f"{self.write(made_by)}({self._joined(arguments)})"
        if is_plain_array(value):
            return self._array(value)
        made = self._record(value) or self._object(value)
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
        if get_origin(value) is Annotated:
            annotated = gathered.reference(Importable("typing", "Annotated"), what)
            return f"{annotated}[{self._joined((value.__origin__, *value.__metadata__))}]"
        if isinstance(value, types.GenericAlias):
            return f"{self.write(value.__origin__)}[{self._joined(value.__args__)}]"
        home = importable(value)
        if home is not None:
            return gathered.reference(home, what)
        if isinstance(value, type):
            return gathered.add_class(value, what)
        return gathered.add_function(value, what, self.wanted) if callable(value) else ""

    def _record(self, value: Any) -> str:
        """Return the expression of a member of an enumeration, a dataclass's object or a named tuple; "" for others.

        A class may do more with its arguments than keep them. The comparison with the module's objects finds that out.
        """
        kind, what = type(value), f"Class {type(value).__name__!r} of {self.what[0].lower()}{self.what[1:]}"
        if isinstance(value, enum.Enum):
            if isinstance(value, enum.Flag) and value.name not in kind.__members__:
                return " | ".join(map(self.write, value))
            return f"{self.gathered.add_class(kind, what)}.{value.name}" if value.name in kind.__members__ else ""
        if dataclasses.is_dataclass(kind):
            names = [field.name for field in dataclasses.fields(kind)]
            is_record = all(field.init for field in dataclasses.fields(kind))
            defaults = {field.name: field.default for field in dataclasses.fields(kind)}
        else:
            names, is_record = [*getattr(kind, "_fields", ())], isinstance(value, tuple) and hasattr(kind, "_fields")
            defaults = getattr(kind, "_field_defaults", {})
        if not is_record:
            return ""
        parts = {name: getattr(value, name) for name in names}
        needed = [name for name in names if not is_same_data(parts[name], defaults.get(name, UNKNOWN))]
        given = ", ".join(f"{name}={self.write(parts[name])}" for name in needed)
        return f"{self.gathered.add_class(kind, what)}({given})"

    def _array(self, array: Any) -> str:
        """Return the expression of an array: its numbers if they are few, else the call that reads it from a file."""
        text = self._numbers(array)
        if (text and len(text) <= _MOST_CHARACTERS) or not self.gathered.stores_arrays:
            return text
        return _stored(self.gathered, array, self.what, self.wanted) if array.dtype.kind in "biufc" else ""

    def _numbers(self, array: Any) -> str:
        """Return a small array of numbers as source that makes it again, to the last bit; "" for any other."""
        import numpy as np

        if array.dtype.kind not in "biuf" or array.dtype.itemsize > 8 or array.size > _MOST_NUMBERS:
            return ""
        listed = repr(array.tolist())
        if "nan" in listed or "inf" in listed or np.array(array.tolist(), array.dtype).shape != array.shape:
            return ""
        if not array.flags.c_contiguous and not array.flags.f_contiguous:
            raise Refused(
                f"{self.what} has an array that is a view of another, with gaps or reversed, which would be laid out "
                "otherwise. Make it a whole one in the notebook: np.ascontiguousarray(...)."
            )
        order = "" if array.flags.c_contiguous else ', order="F"'
        return f'{self.gathered.module_name("numpy", self.what)}.array({listed}, dtype="{array.dtype}"{order})'


def _call_of(value: Any) -> tuple[Any, tuple[Any, ...]]:
    """Return what makes a simple object again, and with which arguments; None for any other."""
    kind = type(value)
    if kind is float:  # NaN and the infinities, which have no literal
        return float, (repr(value),)
    if kind is frozenset:
        return (frozenset, (set(value),)) if value else (frozenset, ())
    if kind is range:
        every = (value.start, value.stop, value.step)
        return range, every if value.step != 1 else every[not value.start : 2]
    if kind is slice:
        return slice, (value.start, value.stop) if value.step is None else (value.start, value.stop, value.step)
    if kind is re.Pattern:  # the flag for text is what re.compile adds by itself
        flags = re.RegexFlag(value.flags) & ~(re.UNICODE if isinstance(value.pattern, str) else re.NOFLAG)
        return re.compile, (value.pattern, flags) if flags else (value.pattern,)
    if isinstance(value, pathlib.PurePath):
        return pathlib.Path, (str(value),)
    if kind in _KNOW_THEIR_CALL:
        made_by, arguments = value.__reduce__()[:2]
        return made_by, arguments
    numpy = sys.modules.get("numpy")
    if numpy is None or kind.__module__.partition(".")[0] != "numpy":
        return None, ()
    if isinstance(value, numpy.dtype):
        return numpy.dtype, (value.str if value.names is None else "",)
    # Python's own numbers hold these to the last bit.
    is_number = isinstance(value, numpy.number | numpy.bool_)
    if is_number and value.dtype.kind in "biuf" and value.dtype.itemsize <= 8:
        return kind, (value.item(),)
    return None, ()


# -- arrays in files ---------------------------------------------------------------------------------------------------

ARRAYS: Final = "arrays"
READER: Final = "stored_array"
MOST_BYTES: Final = 16_000_000
_ARRAY: Final = re.compile(rf'\b{READER}\("\w+"\)|array\([^"]*, dtype="\S+?"')
_TEXT: Final = '''def {reader}(name):
    """Return an array that this bundle keeps as a file; it can't be written to."""
    array = {numpy}.load({pathlib}.Path(__file__).with_name("{folder}") / f"{{name}}.npy", allow_pickle=False)
    array.flags.writeable = False
    return array'''


def array_reader(gathered: Slice) -> str:
    """Return the function that reads the arrays that a module has from files; "" if there are none."""
    if not gathered.arrays:
        return ""
    numpy, pathlib = (gathered.module_name(module, READER) for module in ("numpy", "pathlib"))
    return _TEXT.format(reader=READER, numpy=numpy, pathlib=pathlib, folder=ARRAYS)


def _stored(gathered: Slice, array: Any, what: str, wanted: str) -> str:
    """Store an array of numbers as a file; return the call that reads it."""
    known = next((name for name, other in gathered.arrays.items() if other is array), "")
    if known:
        return f'{READER}("{known}")'
    size = sum(other.nbytes for other in gathered.arrays.values()) + array.nbytes
    if size > MOST_BYTES:
        raise Refused(
            f"{what} uses an array, with which the bundle's arrays have {size / 1e6:.1f} MB; {MOST_BYTES / 1e6:g} "
            "MB are the most. Pass it in as a token, or put it into the data of a package that is installed and "
            "read it with importlib.resources."
        )
    if not gathered.arrays:
        gathered.reserve(READER)
    name = identifier_of(wanted or "array", gathered.arrays.__contains__)
    gathered.arrays[name] = array
    # What the function that reads them needs is known before the imports are written.
    for module in ("numpy", "pathlib"):
        gathered.module_name(module, what)
    return f'{READER}("{name}")'


def write_arrays(folder: Path, arrays: Mapping[str, Any]) -> None:
    """Write arrays into a bundle, each in the order of its elements, to the last bit."""
    if not arrays:
        return
    import numpy as np

    for name, array in arrays.items():
        (folder / ARRAYS).mkdir(exist_ok=True)
        np.save(folder / ARRAYS / f"{name}.npy", array, allow_pickle=False)


# -- line breaks -------------------------------------------------------------------------------------------------------

# What is too long for a line gets one item of its outermost brackets per line. Each item is followed by a comma, so
# that formatters leave it on a line of its own. The arguments of a call stand on one line if they fit.
LINE: Final = 88

# What stands before an item, such as "name=", and the expression itself.
Item = tuple[str, str]


def laid_out(source: str, depth: int = 0, before: str = "", after: str = "") -> list[str]:
    """Return the lines of an expression.

    Parameters
    ----------
    source
        The expression, on one line.
    depth
        How many levels it is indented.
    before, after
        What stands before and after it: ``"x = "``, ``","``.
    """
    whole = f"{'    ' * depth}{before}{source}{after}"
    opening, items, closing = ("", [], "") if len(whole) <= LINE else _brackets(source)
    if not items:
        return [whole]
    together = f"{'    ' * (depth + 1)}{', '.join(name + value for name, value in items)}"
    if len(together) <= LINE and len(opening) > 1:  # the arguments of a call or subscript
        pad = "    " * depth
        return [pad + before + opening, together, pad + closing + after]
    return one_per_line(before + opening, items, closing + after, depth)


def one_per_line(opening: str, items: Iterable[Item], closing: str, depth: int = 0) -> list[str]:
    """Return the lines of something in brackets, with a line for each item."""
    pad = "    " * depth
    lines = [line for before, source in items for line in laid_out(source, depth + 1, before, ",")]
    return [pad + opening, *lines, pad + closing] if lines else [pad + opening + closing]


def _brackets(source: str) -> tuple[str, list[Item], str]:
    """Return the outermost brackets of an expression with what is in them; no items if it has none."""
    text = source.encode()  # the columns of syntax trees count bytes

    def segment(node: ast.expr) -> str:
        return text[node.col_offset : node.end_col_offset].decode()

    match ast.parse(source, mode="eval").body:
        case ast.Tuple(elts=items) if source.startswith("("):
            return "(", [("", segment(item)) for item in items], ")"
        case ast.List(elts=items):
            return "[", [("", segment(item)) for item in items], "]"
        case ast.Set(elts=items):
            return "{", [("", segment(item)) for item in items], "}"
        case ast.Dict(keys=keys, values=values) if None not in keys:
            pairs = zip(keys, values, strict=True)
            return "{", [(f"{segment(key)}: ", segment(value)) for key, value in pairs if key], "}"
        case ast.Subscript(value=kind, slice=ast.Tuple(elts=items)):
            return f"{segment(kind)}[", [("", segment(item)) for item in items], "]"
        case ast.Call(func=function, args=arguments, keywords=named):
            given = [("", segment(value)) for value in arguments]
            given += [(f"{word.arg}=" if word.arg else "**", segment(word.value)) for word in named]
            return f"{segment(function)}(", given, ")"
    return "", [], ""
