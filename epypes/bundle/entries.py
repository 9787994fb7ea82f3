"""How does the value of a hyperparameter stand in TOML, and how is it read back?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any


def plain(value: Any) -> Any:
    """Return a number of NumPy's as Python's own; whether that computes the same, the replay shows."""
    is_number = type(value).__module__ == "numpy" and getattr(value, "shape", None) == ()
    return value.item() if is_number else value


def fits(value: Any) -> bool:
    """Whether TOML, with a word on its kind where need be, holds a plain value to the last bit."""
    if type(value) in (tuple, list):
        # One kind per table entry: what is inside a sequence keeps its type only if TOML has it.
        return all(type(item) in (bool, int, float, str) and fits(item) for item in value)
    if type(value) is int:
        return -(2**63) <= value < 2**63
    return value is None or type(value) in (bool, float, str)


def written(value: Any) -> dict[str, Any]:
    """Return the entry of a value that fits: ``value``, and its ``kind`` where TOML has none like it."""
    if value is None:
        return {"kind": "none"}
    return {"value": list(value), "kind": "tuple"} if isinstance(value, tuple) else {"value": value}


def read(entry: Mapping[str, Any]) -> Any:
    """Return the value of an entry; KeyError if it has none."""
    if entry.get("kind") == "none":
        return None
    return tuple(entry["value"]) if entry.get("kind") == "tuple" else entry["value"]
