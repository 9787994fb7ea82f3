"""Which literal makes a value again, to the last bit?"""

from __future__ import annotations

import ast
from typing import Any


def is_data(value: object) -> bool:
    """Whether a value is of a type that literals are made of."""
    kinds = (bool, int, float, complex, str, bytes, type(None), tuple, list, dict, set, frozenset)
    return type(value) in kinds


def literal(value: Any) -> str:
    """Return the source of a constant: as repr, but with sets sorted, whose order changes from process to process."""
    if type(value) is set and value:
        return "{" + ", ".join(sorted(map(literal, value))) + "}"
    if type(value) is dict:
        return "{" + ", ".join(f"{literal(key)}: {literal(item)}" for key, item in value.items()) + "}"
    if type(value) is list:
        return "[" + ", ".join(map(literal, value)) + "]"
    if type(value) is tuple and len(value) != 1:
        return "(" + ", ".join(map(literal, value)) + ")"
    return repr(value)


def literal_source(value: Any) -> str:
    """Return the literal of this very value; "" if there is none."""
    source = literal(value) if is_data(value) else ""
    try:
        read = ast.literal_eval(source)
    except (ValueError, SyntaxError):
        return ""
    # By source: 0j == -0j, but they are not the same.
    return source if type(read) is type(value) and literal(read) == source else ""
