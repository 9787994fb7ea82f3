"""How does a view become JSON, and JSON a view?

Any painter can work from JSON: a record is an object by the names of its fields, a picture a data URI.
"""

from __future__ import annotations

import base64
import functools
import types
import typing
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

from epypes.display.previews.raster import Picture
from epypes.display.views.graphview import GraphView


def to_json(graph: GraphView) -> dict[str, Any]:
    """Return a view as what ``json.dumps`` takes."""
    written: dict[str, Any] = _written(graph)
    return written


def from_json(written: Mapping[str, Any]) -> GraphView:
    """Return the view that ``to_json`` has written; fields that are missing have their defaults.

    Raises
    ------
    TypeError, ValueError
        This is not a view.
    """
    if not isinstance(written, Mapping):
        raise TypeError(f"A view in JSON is an object, not {type(written).__name__!r}.")
    graph: GraphView = _read(GraphView, written)
    return graph


def _written(value: Any) -> Any:
    if isinstance(value, Picture):
        data = base64.b64encode(value.data).decode()
        return {"uri": f"data:{value.media_type};base64,{data}", "width": value.width, "height": value.height}
    if is_dataclass(value):
        return {field.name: _written(getattr(value, field.name)) for field in fields(value)}
    if hasattr(value, "_asdict"):
        return {name: _written(item) for name, item in value._asdict().items()}
    return [_written(item) for item in value] if isinstance(value, tuple) else value


def _read(kind: Any, written: Any) -> Any:
    """Return a value of a kind, as an annotation of a record says it."""
    if Picture in _parts(kind) and isinstance(written, Mapping):
        media_type, _, data = written["uri"].removeprefix("data:").partition(";base64,")
        return Picture(base64.b64decode(data), media_type, written["width"], written["height"])
    if isinstance(written, Mapping):
        (record,) = (part for part in _parts(kind) if hasattr(part, "__annotations__"))
        kinds = _kinds(record)
        return record(**{name: _read(kinds[name], item) for name, item in written.items() if name in kinds})
    if isinstance(written, list):
        return tuple(
            _read(item_kind, item) for item_kind, item in zip(_item_kinds(kind, len(written)), written, strict=True)
        )
    return written


@functools.cache
def _kinds(record: type) -> dict[str, Any]:
    return typing.get_type_hints(record)


def _parts(kind: Any) -> tuple[Any, ...]:
    """Return the kinds of which a value may be one."""
    return typing.get_args(kind) if typing.get_origin(kind) in (typing.Union, types.UnionType) else (kind,)


def _item_kinds(kind: Any, count: int) -> tuple[Any, ...]:
    """Return the kind of each item of a tuple."""
    (of,) = (part for part in _parts(kind) if typing.get_origin(part) is tuple)
    items = typing.get_args(of)
    return items[:1] * count if items[-1] is Ellipsis else items
