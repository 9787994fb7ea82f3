"""How is any value written in a few characters?"""

from __future__ import annotations

import dataclasses
import itertools
import reprlib
from collections import deque
from collections.abc import Iterable, Mapping
from types import BuiltinFunctionType, FunctionType
from typing import Any, Final

from epypes.display.markup import cut

_MOST_BITS: Final = 400
_LONGEST: Final = 200
_BRACKETS: Final = (
    (list, "[", "]"),
    (tuple, "(", ")"),
    (set, "{", "}"),
    (frozenset, "{", "}"),
    (deque, "deque([", "])"),
)
_NAMED: Final = (FunctionType, BuiltinFunctionType, type)
_CALL: Final = "{}={}"


class ShortRepr(reprlib.Repr):
    """Writes values in a bounded time: few levels, few items, arrays by dtype and shape.

    Subclasses of lists and dicts are bounded too, and an object whose ``__repr__`` raises is written with the reason.
    """

    def __init__(self) -> None:
        super().__init__()
        self.maxlevel, self.maxlist, self.maxdict, self.maxother, self.maxstring = 3, 4, 4, 80, 60

    def repr1(self, x: Any, level: int) -> str:
        """Write a value with so many levels below it."""
        try:
            return self._written(x, level)
        except Exception as error:
            return f"<{type(x).__name__}: no repr: {reason(error, 40)}>"

    def _written(self, x: Any, level: int) -> str:
        kind = type(x)
        if issubclass(kind, str | bytes | bytearray):
            # reprlib cuts a text only after it has made all of it.
            return self._cut(repr(x[:_LONGEST]) if len(x) <= _LONGEST else repr(x[:_LONGEST])[:-1], self.maxstring)
        if kind is int and x.bit_length() > _MOST_BITS:
            return f"int of {x.bit_length()} bits"
        if is_array(x):
            return array_text(x)
        return self._container(x, level) or self._cut(self._object(x), self.maxother)

    def _container(self, x: Any, level: int) -> str:
        kind = type(x)
        fields = fields_of(x)
        if fields is not None:
            return f"{kind.__name__}({self._dict(fields, level, _CALL)})"
        if issubclass(kind, dict):
            return f"{{{self._dict(x, level, '{}: {}')}}}"
        brackets = next(((left, right) for known, left, right in _BRACKETS if issubclass(kind, known)), None)
        return self._items(x, *brackets, level) if brackets else ""

    def _object(self, x: Any) -> str:
        kind = type(x)
        if getattr(kind, "__repr__", None) is object.__repr__ or issubclass(kind, _NAMED):
            # Their repr says where they are in memory, which is another place in each process.
            return str(getattr(x, "__qualname__", kind.__name__))
        length = _length(x)
        # What is so long would take its own repr as long.
        return f"{kind.__name__} of {length}" if length > _LONGEST else repr(x)

    def _items(self, x: Any, left: str, right: str, level: int) -> str:
        if level <= 0 and len(x):
            return f"{left}...{right}"
        parts = [self.repr1(item, level - 1) for item in itertools.islice(iter(x), self.maxlist)]
        more = ["..."] if len(x) > self.maxlist else []
        closing = ",)" if right == ")" and len(x) == 1 else right
        return f"{left}{', '.join(parts + more)}{closing}"

    def _dict(self, x: Mapping[Any, Any], level: int, form: str) -> str:
        if level <= 0 and x:
            return "..."
        items = itertools.islice(iter(x.items()), self.maxdict)
        is_call = form == _CALL
        parts = [
            form.format(key if is_call else self.repr1(key, level - 1), self.repr1(value, level - 1))
            for key, value in items
        ]
        return ", ".join(parts + ["..."] * (len(x) > self.maxdict))

    def _cut(self, text: str, characters: int) -> str:
        return cut(text, characters)


def _length(x: Any) -> int:
    try:
        return len(x)
    except Exception:  # whatever an object's __len__ raises
        return 0


_SHORT: Final = ShortRepr()


def short_repr(value: Any) -> str:
    """Return a value in about a hundred characters, on one line; never raises."""
    return cut(_SHORT.repr(value), 120)


def reason(error: BaseException, characters: int = 60) -> str:
    """Return what was raised, ``"ValueError: no image"``, cut."""
    kind = type(error).__name__
    try:
        said = str(error)[:_LONGEST]
    except Exception:  # an exception's __str__ is its author's
        said = ""
    return cut(f"{kind}: {said}" if said else kind, characters)


def is_array(value: Any) -> bool:
    """Whether a value is an array or a number of numpy."""
    kind = type(value)
    return hasattr(kind, "dtype") and any(str(parent.__module__) == "numpy" for parent in kind.__mro__)


def fields_of(value: Any) -> dict[str, Any] | None:
    """Return the fields of a named tuple, or of a dataclass that is written by its fields; None of any other."""
    kind = type(value)
    if issubclass(kind, tuple) and hasattr(kind, "_fields"):
        return dict(zip(kind._fields, value, strict=False))
    if not dataclasses.is_dataclass(kind):
        return None
    return {field.name: getattr(value, field.name, "missing") for field in dataclasses.fields(kind)}


def float_text(value: float, digits: int = 6) -> str:
    """Return a float to so many digits; one without fraction with ``.0``, so that it can be told from an int."""
    text = f"{float(value):.{digits}g}"
    return text + ".0" * text.lstrip("-").isdigit()


def array_text(array: Any) -> str:
    """Return dtype and shape of an array, ``"uint8 480 x 640"``; of one without axes its value."""
    if not array.shape:
        return cut(str(array.item())[:_LONGEST], 60)
    return f"{dtype_text(array.dtype)} {' x '.join(map(str, array.shape))}"


def dtype_text(dtype: Any) -> str:
    """Return the name of a dtype; those with fields are called records, since their names are long."""
    return "records" if dtype.names else cut(str(dtype), 16)


def row_texts(values: Iterable[Any], count: int, most: int) -> tuple[str, ...]:
    """Return the first of so many values as lines, the last of which says how many more there are."""
    kept = count if count <= most else most - 1
    rows = [short_repr(value) for value in itertools.islice(iter(values), kept)]
    return (*rows, f"... {count - kept} more") if count > kept else tuple(rows)


def item_texts(mapping: Mapping[Any, Any], count: int, most: int) -> tuple[str, ...]:
    """Return the first of so many items as lines ``key: value``."""
    kept = count if count <= most else most - 1
    items = itertools.islice(iter(mapping.items()), kept)
    rows = [f"{key if type(key) is str else short_repr(key)}: {short_repr(value)}" for key, value in items]
    return (*rows, f"... {count - kept} more") if count > kept else tuple(rows)
