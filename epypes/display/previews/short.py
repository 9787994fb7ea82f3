"""Any value in a few characters.

Values are written in a bounded time: few levels, few items, arrays by dtype and shape. Subclasses of lists and dicts
are bounded too, and an object whose ``__repr__`` raises is written with the reason.
"""

from __future__ import annotations

import itertools
import re
from collections import deque
from collections.abc import Callable, Iterable, Iterator
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
    users_code,
)
from epypes.display.text import cut

_MOST_BITS: Final = 400
_LEVELS: Final = 3
_ITEMS: Final = 4
_TEXT_CHARACTERS: Final = 60
_OBJECT_CHARACTERS: Final = 80
_CHARACTERS: Final = 120
_LONGEST: Final = 200
_BRACKETS: Final = (
    (list, "[", "]"),
    (tuple, "(", ")"),
    (set, "{", "}"),
    (frozenset, "{", "}"),
    (deque, "deque([", "])"),
)
_PLAIN: Final = (bool, int, float, type(None))
_TEXTS: Final = (str, bytes, bytearray)
_arguments_of: Final = BaseException.__dict__["args"].__get__
# Floats from here on have an exponent.
_LARGEST_WRITTEN: Final = 1e12
# Where an object is in memory is another place in each process.
_ADDRESS: Final = re.compile(" at 0x[0-9A-Fa-f]{6,}")


def short_repr(value: Any) -> str:
    """Return a value in about a hundred characters, on one line; never raises."""
    return cut(_repr(value, _LEVELS), _CHARACTERS)


def _repr(value: Any, level: int) -> str:
    """Write a value with so many levels below it."""
    try:
        return _text(value) or _container(value, level) or cut(_object(value), _OBJECT_CHARACTERS)
    except Exception as error:
        return f"<{kind_name(type(value))}: no repr: {reason(error, 40)}>"


def _text(value: Any) -> str:
    """Write numbers, texts and arrays; nothing for any other value."""
    kind = type(value)
    if kind in _PLAIN:
        return f"int of {value.bit_length()} bits" if kind is int and value.bit_length() > _MOST_BITS else repr(value)
    for known in _TEXTS:
        if issubclass(kind, known):
            # Cut before it is written, which takes as long as a text is.
            beginning = repr(known.__getitem__(value, slice(_LONGEST)))
            return cut(beginning if length_of(value) <= _LONGEST else beginning[:-1], _TEXT_CHARACTERS)
    return array_text(value) if is_array(value) else ""


def _container(value: Any, level: int) -> str:
    kind, fields = type(value), fields_of(value)
    if fields is not None:
        return f"{kind_name(kind)}({_pairs(fields, level, '{}={}', str)})"
    if issubclass(kind, dict | MappingProxyType):
        return f"{{{_pairs(value, level, '{}: {}', lambda key: _repr(key, level - 1))}}}"
    if declared(kind, "__repr__") is BaseException.__repr__:
        arguments = [_repr(item, level - 1) for item in _arguments_of(value)[:_ITEMS]]
        return f"{kind_name(kind)}({', '.join(arguments)})"
    brackets = next(((left, right) for known, left, right in _BRACKETS if issubclass(kind, known)), None)
    return _items(value, *brackets, level) if brackets else ""


def _items(value: Any, left: str, right: str, level: int) -> str:
    count = length_of(value)
    if level <= 0 and count:
        return f"{left}...{right}"
    parts = [_repr(item, level - 1) for item in itertools.islice(shown_items(value), _ITEMS)]
    more = ["..."] if count > len(parts) else []
    return f"{left}{', '.join(parts + more)}{',)' if right == ')' and count == 1 else right}"


def _pairs(value: Any, level: int, form: str, key_text: Callable[[Any], str]) -> str:
    pairs = list(itertools.islice(pairs_in(value), _ITEMS + 1))
    if level <= 0 and pairs:
        return "..."
    parts = [form.format(key_text(key), _repr(item, level - 1)) for key, item in pairs[:_ITEMS]]
    return ", ".join(parts + ["..."] * (len(pairs) > _ITEMS))


def _object(value: Any) -> str:
    kind = type(value)
    if issubclass(kind, type):
        return qualified_name(value)
    if issubclass(kind, FunctionType | BuiltinFunctionType):
        return plain_text(value.__qualname__)
    if declared(kind, "__repr__") is object.__repr__:
        return kind_name(kind)
    length = length_of(value)
    # What is so long would take its own repr as long.
    return f"{kind_name(kind)} of {length}" if length > _LONGEST else _text_by(repr, value)


def shown_items(value: Any) -> Iterator[Any]:
    """Return the items of a list, tuple, set or deque, those of a set in order."""
    return iter(sorted_items(value, short_repr)) if issubclass(type(value), set | frozenset) else items_in(value)


def _text_by(write: Callable[[Any], str], value: Any) -> str:
    """Return an author's ``repr`` or ``str`` of a value, without addresses in memory."""
    with users_code():
        return without_addresses(plain_text(write(value))[: 2 * _LONGEST])


def without_addresses(text: str) -> str:
    """Return text without addresses in memory, which differ from process to process."""
    return _ADDRESS.sub("", text)


def reason(error: BaseException, characters: int = 60) -> str:
    """Return what was raised, ``"ValueError: no image"``, cut."""
    kind = kind_name(type(error))
    try:
        message = _message(error)
    except Exception:  # an exception's __str__ is its author's
        message = ""
    return cut(f"{kind}: {message}" if message else kind, characters)


def _message(error: BaseException) -> str:
    """Return the message of an exception; one whose message is a value, as that value is written."""
    arguments = _arguments_of(error)
    is_value = len(arguments) == 1 and not issubclass(type(arguments[0]), str)
    if is_value and declared(type(error), "__str__") is BaseException.__str__:
        return short_repr(arguments[0])
    return _text_by(str, error)


def float_text(value: float, digits: int = 6) -> str:
    """Return a float to so many digits; one without fraction with ``.0``, unlike an int.

    One with more digits before the point has all of those, since 1234567 is read sooner than 1.23457e+06.
    """
    number = float(value)
    if 10**digits <= abs(number) < _LARGEST_WRITTEN:
        return f"{number:.0f}"
    text = f"{number:.{digits}g}"
    return text + ".0" * text.lstrip("-").isdigit()


def array_text(array: Any) -> str:
    """Return dtype and shape of an array, ``"uint8 480 x 640"``; of one without axes its value."""
    if not array.shape:
        return cut(item if type(item := array.item()) is str else short_repr(item), _TEXT_CHARACTERS)
    # Those with fields are called records, since their names are long.
    dtype = "records" if array.dtype.names else cut(str(array.dtype), 16)
    return f"{dtype} {' x '.join(map(str, array.shape))}"


def row_texts(rows: Iterable[str], count: int, most: int) -> tuple[str, ...]:
    """Return the first of so many lines, the last of which is how many more there are."""
    kept = list(itertools.islice(rows, count if count <= most else most - 1))
    return (*kept, f"... {count - len(kept)} more") if count > len(kept) else tuple(kept)
