"""Literals: the source text that makes plain data again, to the last bit."""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Mapping
from typing import Any, Final

UNKNOWN: Final = object()
_OPERATORS: Final[Mapping[type, Callable[[Any, Any], Any]]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
}  # fmt: skip


def is_data(value: object) -> bool:
    """Whether a value is of a type that literals are made of."""
    kinds = (bool, int, float, complex, str, bytes, type(None), tuple, list, dict, set, frozenset)
    return type(value) in kinds


def quoted(text: str | bytes) -> str:
    """Return the literal of a text, in double quotes unless it holds some; of a member of a StrEnum, of its text."""
    source = repr(text if isinstance(text, bytes) else str.__str__(text))
    return source if '"' in source else source.replace("'", '"')


def literal(value: Any) -> str:
    """Return the source of a constant: as repr, but with sets sorted, whose order changes from process to process.

    Raises
    ------
    ValueError
        Something in it is of a type that literals are not made of, or is an int that is too long for Python.
    """
    if type(value) in (str, bytes):
        return quoted(value)
    if type(value) is set and value:
        return "{" + ", ".join(sorted(map(literal, value))) + "}"
    if type(value) is dict:
        return "{" + ", ".join(f"{literal(key)}: {literal(item)}" for key, item in value.items()) + "}"
    if type(value) is list:
        return "[" + ", ".join(map(literal, value)) + "]"
    if type(value) is tuple:
        return "(" + ", ".join(map(literal, value)) + (",)" if len(value) == 1 else ")")
    if not is_data(value):  # a kind of str or int inside a tuple would become a plain one
        raise ValueError(f"an object of class {type(value).__name__!r} has no literal")
    return repr(value)


def literal_source(value: Any) -> str:
    """Return the literal of this very value; "" if there is none."""
    try:
        source = literal(value)
        read = ast.literal_eval(source)
    except (ValueError, SyntaxError, RecursionError, MemoryError):  # Python writes no int of 5000 digits, for one
        return ""
    # By source: 0j == -0j, but they are not the same.
    return source if type(read) is type(value) and literal(read) == source else ""


def is_same_data(written: Any, value: Any) -> bool:
    """Whether a value is what a literal says, to the last bit."""
    try:
        return type(written) is type(value) and literal(written) == literal(value)
    except (ValueError, RecursionError):
        return False


def literal_value(expression: ast.expr) -> Any:
    """Return the value of a literal or of a sum or product of numbers, UNKNOWN for any other expression."""
    try:
        if isinstance(expression, ast.BinOp) and type(expression.op) in _OPERATORS:
            left, right = literal_value(expression.left), literal_value(expression.right)
            are_numbers = type(left) in (int, float, complex) and type(right) in (int, float, complex)
            return _OPERATORS[type(expression.op)](left, right) if are_numbers else UNKNOWN
        return ast.literal_eval(expression)
    except (ValueError, TypeError, SyntaxError, ArithmeticError, MemoryError, RecursionError):
        return UNKNOWN
