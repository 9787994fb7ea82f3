"""The service around an exported graph: a program that stands behind ZeroMQ, as `epypes serve` does.

Its C++ is in ``templates/service``; what depends on the graph is how events and answers carry its tokens (tokens.cpp).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Final

from epypes.cpp.types import (
    BOOL,
    DEPTHS,
    ELEMENTS,
    FLOAT,
    NONE,
    TEXT,
    ArrayType,
    Int,
    ListType,
    OptionalType,
    Plain,
    RecordType,
    TokenType,
    TupleType,
    Type,
    describe,
    quoted,
)
from epypes.errors import BundleError

if TYPE_CHECKING:
    from epypes.bundle.settings import Settings
    from epypes.cpp.recorded import Recording

# The methods of Reader and Writer for the records of OpenCV, in a list or a tuple.
_RECORDS: Final = {"KeyPoint": "keypoints", "DMatch": "matches"}
_READERS: Final = {FLOAT: "number", BOOL: "boolean", TEXT: "text", NONE: "none"}
_SETTERS: Final = {FLOAT: "number", BOOL: "boolean", TEXT: "text"}


def entries(recording: Recording) -> dict[str, dict[str, object]]:
    """Return by name in C++ the hyperparameters as pipeline.toml has them, without numbers that JSON lacks."""

    def is_json(part: object) -> bool:
        numbers = part if isinstance(part, list) else [part]
        return all(math.isfinite(number) for number in numbers if isinstance(number, float))

    return {
        recording.tokens[token].name: {key: part for key, part in entry.items() if is_json(part)}
        for token, entry in recording.bundle.settings.entries.items()
    }


def _order(token: TokenType, settings: Settings) -> str:
    return f"Order::{settings.order(token.token)}"


# -- reading ----------------------------------------------------------------------------------------------------------


def reading(settings: Settings, token: TokenType, value: str) -> str:
    """Return the expression that reads an input."""
    name, order, where = settings.name, _order(token, settings), quoted(token.token)

    def read(kind: Type, value: str) -> str:
        if isinstance(kind, Int):
            return f"reader.integer({value}, {where})"
        if kind in _READERS:
            return f"reader.{_READERS[kind]}({value}, {where})"
        if isinstance(kind, Plain):
            return f"reader.scalar<{kind.cpp}>({value}, {where})"
        if isinstance(kind, ArrayType) and kind.is_mat:
            depth = DEPTHS.get(kind.dtype, "-1")
            array = f"reader.array({value}, {where}, {depth}, {max(kind.ndim, 0)}, {kind.channels}, {order})"
            return f"({value}).has_none() ? cv::Mat() : {array}" if kind.is_nullable else array
        if isinstance(kind, ArrayType):
            return f"read_array<{ELEMENTS[kind.dtype]}, {kind.ndim}>(reader, {value}, {where})"
        if isinstance(kind, ListType) and isinstance(kind.item, RecordType) and kind.item.name in _RECORDS:
            return f"reader.{_RECORDS[kind.item.name]}({value}, {where})"
        if isinstance(kind, ListType):
            return f"reader.list({value}, {where}, [&](const Value& item) {{ return {read(kind.item, 'item')}; }})"
        if isinstance(kind, TupleType):
            items = ", ".join(read(each, f"items[{place}]") for place, each in enumerate(kind.items))
            found = f"const auto& items = reader.items(of, {where}, {len(kind.items)});"
            return f"[&](const Value& of) {{ {found} return {kind.cpp}({items}); }}({value})"
        if isinstance(kind, OptionalType):
            return f"({value}).has_none() ? {kind.cpp}() : {kind.cpp}({read(kind.item, value)})"
        raise BundleError(name, f"An event can't bring {token.token!r} to a service in C++: {describe(kind)}.")

    return read(token.type, value)


# -- writing ----------------------------------------------------------------------------------------------------------


def writing(settings: Settings, token: TokenType) -> str:
    """Return the statement that writes an output."""
    name, order = settings.name, _order(token, settings)

    def write(kind: Type, target: str, value: str) -> str:
        if isinstance(kind, Int):
            return f"{target}.set_integer({value});"
        if kind == NONE:
            return f"{target}.set_none(true);"
        if kind in _SETTERS:
            return f"{target}.set_{_SETTERS[kind]}({value});"
        if isinstance(kind, Plain):
            return f"writer.scalar({target}, {value});"
        if isinstance(kind, ArrayType) and kind.is_mat:
            axes = kind.ndim if kind.ndim > 0 else f"{value}.channels() > 1 ? 3 : 2"
            array = f"writer.array({target}, {value}, {axes}, {order});"
            is_none = f"if ({value}.empty()) {{ {target}.set_none(true); }} else {{ {array} }}"
            return is_none if kind.is_nullable else array
        if isinstance(kind, ArrayType):
            return f"write_array(writer, {target}, {value});"
        if isinstance(kind, ListType):
            holder = f"Holder::{'tuple' if kind.is_tuple else 'list'}"
            if isinstance(kind.item, RecordType) and kind.item.name in _RECORDS:
                return f"writer.{_RECORDS[kind.item.name]}({target}, {value}, {holder});"
            item = write(kind.item, "item", "each")
            return f"writer.list({target}, {value}, {holder}, [&](Value& item, const auto& each) {{ {item} }});"
        if isinstance(kind, TupleType):
            items = " ".join(
                write(each, "(*items.add_items())", f"std::get<{place}>(of)") for place, each in enumerate(kind.items)
            )
            of = f"const auto& of = {value};"
            return f"{{ {of} auto& items = *{target}.mutable_tuple(); {items} }}"
        if isinstance(kind, OptionalType):
            return f"if ({value}) {{ {write(kind.item, target, f'(*{value})')} }} else {{ {target}.set_none(true); }}"
        raise BundleError(name, f"No answer of a service in C++ can carry {token.token!r}: {describe(kind)}.")

    return write(token.type, f"part({quoted(token.token)})", f"outputs.{token.name}")
