"""What does an expression mean that calls nothing?"""

from __future__ import annotations

import ast
import builtins
from collections.abc import Mapping
from typing import Any, Final

from epypes.bundle.literal import is_same_data

UNKNOWN: Final = object()
_PLAIN: Final = (
    ast.Constant, ast.Tuple, ast.List, ast.Dict, ast.Set, ast.UnaryOp, ast.BinOp, ast.Name, ast.Attribute, ast.operator,
    ast.unaryop, ast.expr_context,
)  # fmt: skip
_MOST_DIGITS: Final = 3


def value_of(expression: ast.expr, names: Mapping[str, Any]) -> Any:
    """Return what an expression means that calls nothing, UNKNOWN for any other.

    Parameters
    ----------
    expression
        Literals, names, attributes and sums of them.
    names
        What its names mean.
    """
    parts = list(ast.walk(expression))
    if not all(isinstance(part, _PLAIN) for part in parts) or any(map(_may_be_huge, parts)):
        return UNKNOWN
    return evaluated(expression, names)


def evaluated(expression: ast.expr, names: Mapping[str, Any]) -> Any:
    """Return the value of an expression that was found to do nothing else; UNKNOWN if it raises."""
    try:
        code = compile(ast.Expression(expression), "notebook", "eval", dont_inherit=True)
        return eval(code, {"__builtins__": vars(builtins), **names})  # noqa: S307 - the notebook's own text, as checked
    except Exception:
        return UNKNOWN


def _may_be_huge(node: ast.AST) -> bool:
    """Whether this may take all memory: a power, a shift, a repetition."""
    if not isinstance(node, ast.BinOp) or not isinstance(node.op, ast.Pow | ast.LShift | ast.Mult):
        return False
    sides = (node.left, node.right)
    if isinstance(node.op, ast.Mult):
        return not all(_is_number(side) or isinstance(side, ast.Name | ast.Attribute) for side in sides)
    return not all(_is_number(side) and len(ast.unparse(side)) <= _MOST_DIGITS for side in sides)


def _is_number(node: ast.expr) -> bool:
    numbers = ast.Constant | ast.UnaryOp | ast.BinOp
    parts = [part for part in ast.walk(node) if isinstance(part, ast.expr)]
    return all(isinstance(part, numbers) for part in parts) and not any(
        isinstance(part, ast.Constant) and not isinstance(part.value, int | float | complex) for part in parts
    )


def is_same(expression: ast.expr, value: object, names: Mapping[str, Any]) -> bool:
    """Whether an expression means a value, to the last bit."""
    written = value_of(expression, names)
    return written is value or is_same_data(written, value)
