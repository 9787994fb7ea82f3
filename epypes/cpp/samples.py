"""Recorded values as files of cv::FileStorage: numbers as texts, arrays in base64, both to the last bit."""

from __future__ import annotations

import base64
import gzip
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

from epypes.cpp.types import DEPTHS, ArrayType, ListType, OptionalType, RecordType, TokenType, TupleType, Type, quoted
from epypes.wire.opencv import record_fields

# The letters by which cv::FileStorage names the depths.
_LETTERS: Final = dict(zip(DEPTHS, "ucwsifd", strict=True))
# Every base64 text of cv::FileStorage begins with the layout, in this many bytes.
_HEADER: Final = 24
_WIDTH: Final = 64
# An empty cv::Mat.
_NONE: Final = ("rows: 0", "cols: 0", "dt: u", "data: []")


def write_sample(path: Path, tokens: Mapping[str, TokenType], values: Mapping[str, Any]) -> None:
    """Write values by token to a compressed YAML file, under the names that tokens have in C++."""
    lines = ["%YAML 1.2", "---"]
    for token, value in values.items():
        lines += _entry(f"{tokens[token].name}:", value, tokens[token].type, "")
    with path.open("wb") as file, gzip.GzipFile("", "wb", 6, file, mtime=0) as packed:
        packed.write(("\n".join(lines) + "\n").encode())


def _entry(head: str, value: Any, kind: Type, indent: str) -> list[str]:
    """Return the lines of a value after a key or a dash."""
    inner = f"{indent}   "
    if isinstance(kind, OptionalType):
        return [f"{indent}{head} []"] if value is None else [f"{indent}{head}", *_entry("-", value, kind.item, inner)]
    if value is None and not isinstance(kind, ArrayType):
        return [f"{indent}{head} []"]
    if isinstance(kind, ArrayType):
        if value is None:
            return [f"{indent}{head} !!opencv-matrix", *(f"{inner}{line}" for line in _NONE)]
        if kind.is_mat:
            return _matrix(f"{indent}{head}", value, inner)
        shape = [f"{inner}shape: [ {', '.join(map(str, value.shape))} ]"]
        import numpy as np

        whole = np.ascontiguousarray(value).reshape(-1).view(np.uint8).reshape(1, -1)
        return [f"{indent}{head}", *shape, *_matrix(f"{inner}bytes:", whole, f"{inner}   ")]
    if isinstance(kind, RecordType):
        return [f"{indent}{head} [ {', '.join(_scalar(part) for part in record_fields(value))} ]"]
    if isinstance(kind, ListType | TupleType):
        if not value:
            return [f"{indent}{head} []"]
        kinds = kind.items if isinstance(kind, TupleType) else (kind.item,) * len(value)
        lines = [f"{indent}{head}"]
        for item, each in zip(value, kinds, strict=True):
            lines += _entry("-", item, each, inner)
        return lines
    return [f"{indent}{head} {_scalar(value)}"]


def _scalar(value: Any) -> str:
    plain = value.item() if hasattr(value, "item") else value
    if isinstance(plain, bool):
        return f'"{str(plain).lower()}"'
    return quoted(plain if isinstance(plain, str) else repr(plain))


def _matrix(head: str, array: Any, indent: str) -> list[str]:
    import numpy as np

    rows, columns, *channels = array.shape
    layout = f"{channels[0] if channels and channels[0] > 1 else ''}{_LETTERS[array.dtype.name]}"
    lines = [f"{head} !!opencv-matrix", f"{indent}rows: {rows}", f"{indent}cols: {columns}"]
    quotes = '"' if layout[:-1] else ""
    lines.append(f"{indent}dt: {quotes}{layout}{quotes}")
    if not array.size:
        return [*lines, f"{indent}data: []"]
    data = layout.encode().ljust(_HEADER) + np.ascontiguousarray(array).tobytes()
    # The layout is packed for itself.
    text = base64.b64encode(data).decode()
    inner = f"{indent}   "
    chunks = [f"{inner}{text[start : start + _WIDTH]}" for start in range(0, len(text), _WIDTH)]
    return [*lines, f"{indent}data: !!binary |", *chunks]
