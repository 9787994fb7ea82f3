"""What is shown of a value that is no array and no table?"""

from __future__ import annotations

import enum
import itertools
import math
import os
from collections.abc import Iterable, Sequence
from typing import Any, Final

from epypes.display.markup import cut
from epypes.display.previews.arrays import histogram_sketch, is_histogram
from epypes.display.previews.features import list_sketch
from epypes.display.previews.registry import ours
from epypes.display.previews.short import fields_of, float_text, item_texts, reason, row_texts, short_repr
from epypes.display.previews.shown import Look, Preview, Sketch
from epypes.display.previews.tables import dict_list_sketch, is_dict_list

_MOST_ROWS: Final = 4
_LOOKED_AT: Final = 200
# A tuple that is so short is written out on the vertex: the sides of a kernel, a size.
_PLAIN_TUPLE: Final = 4
_NUMBERS: Final = (int, float, bool)


@ours(int, str, bytes, bytearray, complex, type(None))
def _plain(value: Any, look: Look) -> Preview:
    if isinstance(type(value), enum.EnumType):
        return _enum(value, look)
    short = short_repr(value)
    size = f" of {len(value)}" if isinstance(value, str | bytes | bytearray) and len(value) > len(short) else ""
    return Preview(short, f"{_name(value)}{size} {short}")


@ours(float)
def _float(value: float, look: Look) -> Preview:
    if isinstance(type(value), enum.EnumType) or not math.isfinite(value):
        return _plain(value, look)
    return Preview(float_text(value), f"{_name(value)} {float(value)!r}")


@ours(enum.Enum)
def _enum(value: Any, look: Look) -> Preview:
    text = f"{_name(value)}.{value.name}"
    return Preview(text, f"{text} = {short_repr(value.value)}")


@ours(BaseException)
def _exception(value: BaseException, look: Look) -> Preview:
    return Preview(reason(value), reason(value, 200))


@ours("pathlib.PurePath")
def _path(value: Any, look: Look) -> Preview:
    text = os.fspath(value)
    return Preview(value.name or text, f"{_name(value)} {cut(text, 200)}")


@ours(list)
def _list(value: Sequence[Any], look: Look) -> Sketch | Preview:
    if is_dict_list(value):
        return dict_list_sketch(value)
    return list_sketch(value, look) or _items(value, len(value))


@ours(tuple)
def _tuple(value: tuple[Any, ...], look: Look) -> Sketch | Preview:
    if is_histogram(value):
        return histogram_sketch((value[0], value[1]))
    fields = fields_of(value)
    if fields is not None:
        return _fields(value, fields)
    if 0 < len(value) <= _PLAIN_TUPLE and all(type(item) in _NUMBERS for item in value):
        return Preview(short_repr(value), f"tuple {short_repr(value)}")
    return list_sketch(value, look) or _items(value, len(value))


@ours(set, frozenset)
def _set(value: Any, look: Look) -> Preview:
    return _items(value, len(value))


@ours(dict, "types.MappingProxyType", "builtins.mappingproxy")
def _dict(value: Any, look: Look) -> Preview:
    count = len(value)
    rows = item_texts(value, count, _MOST_ROWS) or ("(empty)",)
    keys = ", ".join(short_repr(key) for key in itertools.islice(iter(value), 8))
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


def _items(value: Iterable[Any], count: int) -> Preview:
    text = f"{_name(value)} of {count}"
    return Preview(text, f"{text}: {short_repr(value)}", rows=row_texts(value, count, _MOST_ROWS) or ("(empty)",))


def _name(value: Any) -> str:
    return cut(type(value).__name__, 20)
