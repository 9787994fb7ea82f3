"""Line breaks of generated Python: what is too long for a line gets one item of its outermost brackets per line.

Each item is followed by a comma, so that formatters leave it on a line of its own. The arguments of a call stand on one
line if they fit.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable
from typing import Final

LINE: Final = 88

# What stands before an item, such as "name=", and the expression itself.
Item = tuple[str, str]


def laid_out(source: str, depth: int = 0, before: str = "", after: str = "") -> list[str]:
    """Return the lines of an expression.

    Parameters
    ----------
    source
        The expression, on one line.
    depth
        How many levels it is indented.
    before, after
        What stands before and after it: ``"x = "``, ``","``.
    """
    whole = f"{'    ' * depth}{before}{source}{after}"
    opening, items, closing = ("", [], "") if len(whole) <= LINE else _brackets(source)
    if not items:
        return [whole]
    together = f"{'    ' * (depth + 1)}{', '.join(name + value for name, value in items)}"
    if len(together) <= LINE and len(opening) > 1:  # the arguments of a call or subscript
        pad = "    " * depth
        return [pad + before + opening, together, pad + closing + after]
    return one_per_line(before + opening, items, closing + after, depth)


def one_per_line(opening: str, items: Iterable[Item], closing: str, depth: int = 0) -> list[str]:
    """Return the lines of something in brackets, with a line for each item."""
    pad = "    " * depth
    lines = [line for before, source in items for line in laid_out(source, depth + 1, before, ",")]
    return [pad + opening, *lines, pad + closing] if lines else [pad + opening + closing]


def _brackets(source: str) -> tuple[str, list[Item], str]:
    """Return the outermost brackets of an expression with what is in them; no items if it has none."""
    text = source.encode()  # the columns of syntax trees count bytes

    def segment(node: ast.expr) -> str:
        return text[node.col_offset : node.end_col_offset].decode()

    match ast.parse(source, mode="eval").body:
        case ast.Tuple(elts=items) if source.startswith("("):
            return "(", [("", segment(item)) for item in items], ")"
        case ast.List(elts=items):
            return "[", [("", segment(item)) for item in items], "]"
        case ast.Set(elts=items):
            return "{", [("", segment(item)) for item in items], "}"
        case ast.Dict(keys=keys, values=values) if None not in keys:
            pairs = zip(keys, values, strict=True)
            return "{", [(f"{segment(key)}: ", segment(value)) for key, value in pairs if key], "}"
        case ast.Subscript(value=kind, slice=ast.Tuple(elts=items)):
            return f"{segment(kind)}[", [("", segment(item)) for item in items], "]"
        case ast.Call(func=function, args=arguments, keywords=named):
            given = [("", segment(value)) for value in arguments]
            given += [(f"{word.arg}=" if word.arg else "**", segment(word.value)) for word in named]
            return f"{segment(function)}(", given, ")"
    return "", [], ""
