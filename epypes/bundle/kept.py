"""What do functions of the notebook keep from run to run? Told by comparing what they have from outside."""

from __future__ import annotations

import hashlib
import types
from collections import deque
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final

from epypes.bundle.text import nested_codes
from epypes.run.guard import is_plain_array

_DEEPEST: Final = 6
_MOST: Final = 2000


def kept_by(functions: Mapping[str, Any]) -> dict[tuple[str, str], str]:
    """Return a digest of each list, dict, set and array that functions have from outside.

    Parameters
    ----------
    functions
        The functions of a graph, by name.

    Returns
    -------
    dict
        By the function of the graph, and the name by which it or what it calls knows the value.
    """
    found: dict[tuple[str, str], str] = {}
    for name, function in functions.items():
        for known, value in _outside(function):
            if isinstance(value, list | dict | set | bytearray | deque) or is_plain_array(value):
                found[name, known] = _digest(value)
    return found


def what_changed(before: Mapping[tuple[str, str], str], after: Mapping[tuple[str, str], str]) -> list[str]:
    """Return as reasons what functions have changed between two times."""
    return [
        f"Function {name!r} changes {known!r} from run to run, which outlives the call: the next event would find it "
        "different. Copy it first, or make it a token."
        for (name, known), digest in before.items()
        if after.get((name, known), digest) != digest
    ]


def _outside(function: Any) -> Iterator[tuple[str, Any]]:
    """Give what a function of the notebook, and what it calls, have from outside."""
    waiting: list[tuple[str, Any]] = [("", function)]
    seen: set[int] = set()
    while waiting and len(seen) < _MOST:
        name, value = waiting.pop()
        if id(value) in seen:
            continue
        seen.add(id(value))
        if name:
            yield name, value
        waiting.extend(_parts(value))


def _parts(value: Any) -> Iterable[tuple[str, Any]]:
    if isinstance(value, types.FunctionType) and value.__module__ == "__main__":
        return [*_of_function(value)]
    if isinstance(value, type) and value.__module__ == "__main__":
        return [(f"{value.__name__}.{name}", part) for name, part in vars(value).items() if not name.startswith("__")]
    inner = [getattr(value, name, None) for name in ("func", "__func__")]
    own = [part for part in inner if isinstance(part, types.FunctionType)]
    attributes = getattr(value, "__dict__", None)
    wrapped = attributes.get("__wrapped__") if type(attributes) is dict else None
    return [("", part) for part in (*own, wrapped) if part is not None]


def _of_function(function: types.FunctionType) -> Iterator[tuple[str, Any]]:
    for code in nested_codes(function.__code__):
        yield from ((name, function.__globals__[name]) for name in code.co_names if name in function.__globals__)
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        if cell != types.CellType():
            yield name, cell.cell_contents
    yield from ((f"a default of {function.__name__}", value) for value in function.__defaults__ or ())
    yield from (function.__kwdefaults__ or {}).items()


def _digest(value: Any) -> str:
    found = hashlib.sha256()
    for part in _bytes(value, _DEEPEST):
        found.update(part + b"\0")
    return found.hexdigest()


def _bytes(value: Any, depth: int) -> Iterator[bytes]:
    """Give what tells a value from another one; nothing of objects that are no data."""
    yield type(value).__name__.encode()
    if is_plain_array(value):
        yield str((value.dtype, value.shape)).encode() + (b"" if value.dtype.hasobject else value.tobytes())
    elif isinstance(value, dict) and depth:
        for key, item in value.items():
            yield from (*_bytes(key, depth - 1), *_bytes(item, depth - 1))
    elif isinstance(value, list | tuple | deque | set | frozenset) and depth:
        yield str(len(value)).encode()
        parts = [b"".join(_bytes(part, depth - 1)) for part in value]
        yield from sorted(parts) if isinstance(value, set | frozenset) else parts
    elif type(value) in (bool, int, float, complex, str, bytes, type(None)):
        yield repr(value).encode(errors="surrogatepass")
