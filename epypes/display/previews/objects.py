"""What is shown of a value that is no array and no table?"""

from __future__ import annotations

import enum
import itertools
import math
import os
from collections.abc import Sequence
from typing import Any, Final

from epypes.display.markup import cut
from epypes.display.previews.arrays import histogram_sketch, is_histogram
from epypes.display.previews.features import list_sketch
from epypes.display.previews.fields import fields_of
from epypes.display.previews.kinds import items_in, kind_name, length_of, pairs_in, stored
from epypes.display.previews.registry import ours
from epypes.display.previews.short import float_text, item_texts, reason, row_texts, short_repr, shown_items
from epypes.display.previews.shown import Look, Preview, Sketch
from epypes.display.previews.tables import dict_list_sketch, is_dict_list

_MOST_ROWS: Final = 4
_LOOKED_AT: Final = 200
# A tuple that is so short is written out on the vertex: the sides of a kernel, a size.
_PLAIN_TUPLE: Final = 4
_NUMBERS: Final = (int, float, bool)


@ours(int, str, bytes, bytearray, complex, type(None))
def _plain(value: Any, look: Look) -> Preview:
    if issubclass(type(type(value)), enum.EnumType):
        return _enum(value, look)
    short = short_repr(value)
    count = length_of(value)
    size = f" of {count}" if count > len(short) else ""
    return Preview(short, f"{_name(value)}{size} {short}")


@ours(float)
def _float(value: float, look: Look) -> Preview:
    if issubclass(type(type(value)), enum.EnumType) or not math.isfinite(value):
        return _plain(value, look)
    return Preview(float_text(value), f"{_name(value)} {float.__repr__(value)}")


@ours(enum.Enum)
def _enum(value: Any, look: Look) -> Preview:
    (name,), (content,) = stored(value, "_name_"), stored(value, "_value_")
    text = f"{_name(value)}.{name}"
    return Preview(text, f"{text} = {short_repr(content)}")


@ours(BaseException)
def _exception(value: BaseException, look: Look) -> Preview:
    return Preview(reason(value), reason(value, 200))


@ours("pathlib.PurePath", "pathlib._local.PurePath")
def _path(value: Any, look: Look) -> Preview:
    text = os.fspath(value)
    return Preview(value.name or text, f"{_name(value)} {cut(text, 200)}")


@ours(list)
def _list(value: Sequence[Any], look: Look) -> Sketch | Preview:
    # A subclass may have ways of its own to reach its items, which are nobody else's.
    plain = value if type(value) is list else list(items_in(value))
    if is_dict_list(plain):
        return dict_list_sketch(plain)
    return list_sketch(plain, _name(value), look, lambda: _items(value)) or _items(value)


@ours(tuple)
def _tuple(value: tuple[Any, ...], look: Look) -> Sketch | Preview:
    plain = value if type(value) is tuple else tuple(items_in(value))
    if is_histogram(plain):
        return histogram_sketch((plain[0], plain[1]))
    fields = fields_of(value)
    if fields is not None:
        return _fields(value, fields)
    if 0 < len(plain) <= _PLAIN_TUPLE and all(type(item) in _NUMBERS for item in plain):
        return Preview(short_repr(plain), f"tuple {short_repr(plain)}")
    return list_sketch(plain, _name(value), look, lambda: _items(value)) or _items(value)


@ours(set, frozenset)
def _set(value: Any, look: Look) -> Preview:
    return _items(value)


@ours(dict, "types.MappingProxyType", "builtins.mappingproxy")
def _dict(value: Any, look: Look) -> Preview:
    count = length_of(value) or len(value)
    rows = item_texts(value, count, _MOST_ROWS) or ("(empty)",)
    keys = ", ".join(short_repr(key) for key, _ in itertools.islice(pairs_in(value), 8))
    return Preview(f"{_name(value)} of {count}", cut(f"{_name(value)} of {count}: {keys}", 200), rows=rows)


@ours(object)
def _object(value: Any, look: Look) -> Preview:
    fields = fields_of(value)
    if fields is not None:
        return _fields(value, fields)
    text, kind = short_repr(value), _name(value)
    return Preview(text, text if text.startswith(kind) else f"{kind} {text}")


def _fields(value: Any, fields: dict[str, Any]) -> Preview:
    text = _name(value)
    said = ", ".join(f"{name}: {short_repr(item)}" for name, item in itertools.islice(fields.items(), 8))
    return Preview(text, cut(f"{text}: {said}", 280), rows=item_texts(fields, len(fields), _MOST_ROWS))


def _items(value: Any) -> Preview:
    count = length_of(value)
    text, rows = f"{_name(value)} of {count}", row_texts(shown_items(value), count, _MOST_ROWS)
    return Preview(text, f"{text}: {short_repr(value)}", rows=rows or ("(empty)",))


def _name(value: Any) -> str:
    return cut(kind_name(type(value)), 20)
