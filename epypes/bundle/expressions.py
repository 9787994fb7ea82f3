"""Expressions: the source text that makes a value again, with the imports that it needs.

Arrays that are too large for text stand in ``arrays/NAME.npy`` beside the module, named as the notebook names them; one
small function reads them.
"""

from __future__ import annotations

import dataclasses
import enum
import pathlib
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from decimal import Decimal
from fractions import Fraction
from operator import attrgetter, itemgetter, methodcaller
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final, get_origin

from epypes.bundle.resolve import Importable, Refused, importable
from epypes.bundle.syntax import identifier_of, literal_source
from epypes.hints import Param
from epypes.images import Image
from epypes.run.guard import is_plain_array

if TYPE_CHECKING:
    from epypes.bundle.slice import Slice


FunctionWriter = Callable[[Any], str]
# Their objects know the call that makes them.
_KNOW_THEIR_CALL: Final = (itemgetter, attrgetter, methodcaller, timedelta, Fraction, Decimal)
# More numbers are too many to read.
_MOST_NUMBERS: Final = 200


def expression(gathered: Slice, value: Any, what: str, function: FunctionWriter | None = None) -> str:
    """Return the expression of a value, with what it needs imported; "" if there is none.

    Parameters
    ----------
    gathered
        The module that it is for; is added to.
    value
        A literal, a small array, a number of NumPy's, a member of an enumeration, something that can be imported, a
        simple object such as a range or an itemgetter, or a tuple, list or dict of these.
    what
        How to call it in a reason.
    function
        Returns the expression of a function of the notebook; without, there is none.

    Raises
    ------
    Refused
        There would be one, but a name that it needs means something else in the module.
    """
    try:
        return _Writer(gathered, what, function).write(value)
    except RecursionError:  # it holds itself, or is nested deeper than Python reads
        return ""


def expression_or_none(gathered: Slice, value: Any, what: str, reason: str) -> str:
    """Return the expression of a value; "None", with a reason noted in the slice, if there is none.

    ``reason`` is what stands behind ``what`` then; ``{kind}`` in it is the type of the value.
    """
    with noted_refusals(gathered):
        source = expression(gathered, value, what)
        if not source:
            raise Refused(f"{what} {reason.replace('{kind}', type(value).__name__)}")
        return source
    return "None"


@contextmanager
def noted_refusals(gathered: Slice) -> Iterator[None]:
    """Note in a slice what is refused inside, and go on after it."""
    try:
        yield
    except Refused as refusal:
        gathered.refusals.append(str(refusal))


@dataclass(frozen=True, slots=True)
class _Writer:
    gathered: Slice
    what: str
    function: FunctionWriter | None

    def write(self, value: Any) -> str:
        source = literal_source(value)
        if source:
            return source
        if type(value) in (tuple, list):
            inner, brackets = self._joined(value), "[]" if type(value) is list else "()"
            comma = "," if type(value) is tuple and len(value) == 1 else ""
            return f"{brackets[0]}{inner}{comma}{brackets[1]}" if inner else ""
        if type(value) is dict:
            pairs = [[self.write(part) for part in pair] for pair in value.items()]
            return f"{{{', '.join(map(': '.join, pairs))}}}" if all(map(all, pairs)) else ""
        if isinstance(value, re.Pattern):
            return self._pattern(value)
        made_by, arguments = _call_of(value)
        return self._call(made_by, arguments) if made_by is not None else self._object(value)

    def _joined(self, values: Iterable[Any]) -> str:
        """Return the expressions of values; "" unless all have one."""
        parts = [self.write(value) for value in values]
        return ", ".join(parts) if all(parts) else ""

    def _call(self, made_by: Any, arguments: tuple[Any, ...]) -> str:
        home = importable(made_by)
        inner = self._joined(arguments) if home else ""
        return f"{self.gathered.reference(home, self.what)}({inner})" if home and (inner or not arguments) else ""

    def _pattern(self, value: re.Pattern[Any]) -> str:
        """Return the call that compiles a pattern again, its flags by name."""
        # The flag for text is what re.compile adds by itself.
        flags = re.RegexFlag(value.flags) & ~(re.UNICODE if isinstance(value.pattern, str) else re.NOFLAG)
        module = self.gathered.module_name("re", self.what)
        named = " | ".join(f"{module}.{flag.name}" for flag in flags)
        return f"{module}.compile({', '.join(filter(None, (literal_source(value.pattern), named)))})"

    def _object(self, value: Any) -> str:
        gathered, what = self.gathered, self.what
        if is_plain_array(value):
            return gathered.arrays.written(gathered, value, what, self._array(value))
        made = self._mark(value) or self._record(value)
        if made:
            return made
        home = importable(value)
        if home is None and self.function is not None and callable(value) and not isinstance(value, type):
            return self.function(value)
        return gathered.reference(home, what) if home else ""

    def _record(self, value: Any) -> str:
        """Return the expression of a member of an enumeration, a dataclass's object or a named tuple; "" for others.

        A class may do more with its arguments than keep them. The comparison with the module's objects finds that out.
        """
        kind, what = type(value), f"Class {type(value).__name__!r} of {self.what[0].lower()}{self.what[1:]}"
        if isinstance(value, enum.Enum):
            is_member = value.name in kind.__members__
            return f"{self.gathered.add_class(kind, None, what)}.{value.name}" if is_member else ""
        if dataclasses.is_dataclass(kind):
            names = [field.name for field in dataclasses.fields(kind) if field.init]
            is_record = len(names) == len(dataclasses.fields(kind))
        else:
            names, is_record = [*getattr(kind, "_fields", ())], isinstance(value, tuple) and hasattr(kind, "_fields")
        parts = [(name, expression(self.gathered, getattr(value, name), self.what)) for name in names if is_record]
        if not is_record or not all(source for _, source in parts):
            return ""
        given = ", ".join(f"{name}={source}" for name, source in parts)
        return f"{self.gathered.add_class(kind, None, what)}({given})"

    def _array(self, array: Any) -> str:
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

    def _mark(self, value: Any) -> str:
        """Return the source of a mark, or of ``Annotated`` with marks, as annotations use them; "" for any other."""
        gathered, what = self.gathered, self.what
        if isinstance(value, Image | Param):
            given = [(field.name, getattr(value, field.name), field.default) for field in dataclasses.fields(value)]
            sources = [(name, literal_source(setting)) for name, setting, default in given if setting != default]
            if not all(source for _, source in sources):
                return ""
            listed = ", ".join(f"{name}={source}" for name, source in sources)
            return f"{gathered.module_name('epypes', what)}.{type(value).__name__}({listed})"
        home = importable(value.__origin__) if get_origin(value) is Annotated else None
        marks = [self._mark(mark) for mark in value.__metadata__] if home else [""]
        if home is None or not all(marks):
            return ""
        is_builtin = home.module == "builtins"
        kind = home.qualname if is_builtin else f"{gathered.module_name(home.module, what)}.{home.qualname}"
        return f"{gathered.reference(Importable('typing', 'Annotated'), what)}[{', '.join([kind, *marks])}]"


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
