"""Any value in a few characters."""

from __future__ import annotations

import itertools
import re
import reprlib
from collections import deque
from collections.abc import Iterable, Iterator
from types import BuiltinFunctionType, FunctionType, MappingProxyType
from typing import Any, Final

from epypes.display.previews.introspection import (
    declared,
    fields_of,
    is_array,
    items_in,
    kind_name,
    length_of,
    pairs_in,
    plain_text,
    qualified_name,
    sorted_items,
)
from epypes.display.text import cut

_MOST_BITS: Final = 400
_LONGEST: Final = 200
_BRACKETS: Final = (
    (list, "[", "]"),
    (tuple, "(", ")"),
    (set, "{", "}"),
    (frozenset, "{", "}"),
    (deque, "deque([", "])"),
)
_NAMED: Final = (FunctionType, BuiltinFunctionType)
_TEXTS: Final = (str, bytes, bytearray)
_arguments_of: Final = BaseException.__dict__["args"].__get__
# Where an object is in memory is another place in each process.
_ADDRESS: Final = re.compile(" at 0x[0-9A-Fa-f]{6,}")


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
            return f"<{kind_name(type(x))}: no repr: {reason(error, 40)}>"

    def _written(self, x: Any, level: int) -> str:
        kind = type(x)
        known = next((known for known in _TEXTS if issubclass(kind, known)), None)
        if known is not None:
            # reprlib cuts a text only after it has made all of it.
            beginning = repr(known.__getitem__(x, slice(_LONGEST)))
            return cut(beginning if length_of(x) <= _LONGEST else beginning[:-1], self.maxstring)
        if kind is int and x.bit_length() > _MOST_BITS:
            return f"int of {x.bit_length()} bits"
        if is_array(x):
            return array_text(x)
        return self._container(x, level) or cut(self._object(x), self.maxother)

    def _container(self, x: Any, level: int) -> str:
        kind = type(x)
        fields = fields_of(x)
        if fields is not None:
            return f"{kind_name(kind)}({self._pairs(fields, level, '{}={}', str)})"
        if issubclass(kind, dict | MappingProxyType):
            return f"{{{self._pairs(x, level, '{}: {}', lambda key: self.repr1(key, level - 1))}}}"
        if declared(kind, "__repr__") is BaseException.__repr__:
            arguments = [self.repr1(item, level - 1) for item in _arguments_of(x)[: self.maxlist]]
            return f"{kind_name(kind)}({', '.join(arguments)})"
        brackets = next(((left, right) for known, left, right in _BRACKETS if issubclass(kind, known)), None)
        return self._items(x, *brackets, level) if brackets else ""

    def _object(self, x: Any) -> str:
        kind = type(x)
        if issubclass(kind, type):
            return qualified_name(x)
        if issubclass(kind, _NAMED):
            return plain_text(x.__qualname__)
        if declared(kind, "__repr__") is object.__repr__:
            return kind_name(kind)
        length = length_of(x)
        # What is so long would take its own repr as long.
        return f"{kind_name(kind)} of {length}" if length > _LONGEST else text_by(repr, x)

    def repr_float(self, x: float, level: int) -> str:
        """Write a float that is inside of something: to six digits."""
        return float_text(x) if level < self.maxlevel else repr(x)

    def _items(self, x: Any, left: str, right: str, level: int) -> str:
        count = length_of(x)
        if level <= 0 and count:
            return f"{left}...{right}"
        parts = [self.repr1(item, level - 1) for item in itertools.islice(shown_items(x), self.maxlist)]
        more = ["..."] if count > len(parts) else []
        closing = ",)" if right == ")" and count == 1 else right
        return f"{left}{', '.join(parts + more)}{closing}"

    def _pairs(self, x: Any, level: int, form: str, key_text: Any) -> str:
        pairs = list(itertools.islice(pairs_in(x), self.maxdict + 1))
        if level <= 0 and pairs:
            return "..."
        parts = [form.format(key_text(key), self.repr1(value, level - 1)) for key, value in pairs[: self.maxdict]]
        return ", ".join(parts + ["..."] * (len(pairs) > self.maxdict))


_SHORT: Final = ShortRepr()


def short_repr(value: Any) -> str:
    """Return a value in about a hundred characters, on one line; never raises."""
    return cut(_SHORT.repr(value), 120)


def shown_items(value: Any) -> Iterator[Any]:
    """Return the items of a list, tuple, set or deque, those of a set in order."""
    return iter(sorted_items(value, short_repr)) if issubclass(type(value), set | frozenset) else items_in(value)


def text_by(write: Any, value: Any) -> str:
    """Return an author's ``repr`` or ``str`` of a value, without addresses in memory."""
    return without_addresses(plain_text(write(value))[: 2 * _LONGEST])


def without_addresses(text: str) -> str:
    """Return text without addresses in memory, which differ from process to process."""
    return _ADDRESS.sub("", text)


def _message(error: BaseException) -> str:
    """Return the message of an exception; one whose message is a value, as that value is written."""
    arguments = _arguments_of(error)
    is_value = len(arguments) == 1 and not issubclass(type(arguments[0]), str)
    if is_value and declared(type(error), "__str__") is BaseException.__str__:
        return short_repr(arguments[0])
    return text_by(str, error)


def reason(error: BaseException, characters: int = 60) -> str:
    """Return what was raised, ``"ValueError: no image"``, cut."""
    kind = kind_name(type(error))
    try:
        message = _message(error)
    except Exception:  # an exception's __str__ is its author's
        message = ""
    return cut(f"{kind}: {message}" if message else kind, characters)


def float_text(value: float, digits: int = 6) -> str:
    """Return a float to so many digits; one without fraction with ``.0``, unlike an int."""
    text = f"{float(value):.{digits}g}"
    return text + ".0" * text.lstrip("-").isdigit()


def array_text(array: Any) -> str:
    """Return dtype and shape of an array, ``"uint8 480 x 640"``; of one without axes its value."""
    if not array.shape:
        return cut(item if type(item := array.item()) is str else short_repr(item), 60)
    return f"{dtype_text(array.dtype)} {' x '.join(map(str, array.shape))}"


def dtype_text(dtype: Any) -> str:
    """Return the name of a dtype; those with fields are called records, since their names are long."""
    return "records" if dtype.names else cut(str(dtype), 16)


def row_texts(rows: Iterable[str], count: int, most: int) -> tuple[str, ...]:
    """Return the first of so many lines, the last of which is how many more there are."""
    kept = list(itertools.islice(rows, count if count <= most else most - 1))
    return (*kept, f"... {count - len(kept)} more") if count > len(kept) else tuple(kept)
