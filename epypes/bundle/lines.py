"""How does Python fit into lines of 88 characters?

Written as formatters would write it, so that nobody's editor changes it: what fits stands on one line; the arguments of
a call then go between its brackets on a line of their own; then everything gets its own line, with a comma behind.
"""

from __future__ import annotations

import ast
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

LINE: Final = 88


@dataclass(frozen=True, slots=True)
class Group:
    """Something in brackets, which may be broken.

    Attributes
    ----------
    opening, closing
        The brackets, with what stands before the first: ``"cv2.Canny("``.
    items
        What is between them.
    is_display
        Whether it is a tuple, list, dict or set: its items never share a line of their own.
    """

    opening: str
    items: tuple[str | Group, ...]
    closing: str
    is_display: bool = False


Piece = str | Group


def call(reference: str, arguments: Sequence[Piece]) -> Group:
    """Return a call."""
    return Group(f"{reference}(", tuple(arguments), ")")


def prefixed(before: str, piece: Piece) -> Piece:
    """Return a piece with text before it."""
    return before + piece if isinstance(piece, str) else replace(piece, opening=before + piece.opening)


def flat(piece: Piece) -> str:
    """Return a piece on one line."""
    if isinstance(piece, str):
        return piece
    lone = piece.is_display and piece.opening.endswith("(") and len(piece.items) == 1
    return f"{piece.opening}{', '.join(map(flat, piece.items))}{',' * lone}{piece.closing}"


def width(text: str) -> int:
    """Return how many columns text takes: two for a character of East Asia, none for a mark on the one before."""
    return len(text) if text.isascii() else sum(map(_columns, text))


def _columns(character: str) -> int:
    if unicodedata.category(character) in ("Mn", "Me", "Cf"):
        return 0
    return 2 if unicodedata.east_asian_width(character) in "WF" else 1


def fits(depth: int, text: str) -> bool:
    """Whether text fits on a line at a depth of indentation."""
    return 4 * depth + width(text) <= LINE


def laid_out(piece: Piece, depth: int, after: str = "") -> list[str]:
    """Return the lines of a piece, the first one indented as well."""
    pad = "    " * depth
    whole = flat(piece) + after
    if isinstance(piece, str) or not piece.items or fits(depth, whole):
        return [pad + whole]
    inner = ", ".join(map(flat, piece.items))
    lines = [pad + piece.opening]
    if not piece.is_display and fits(depth + 1, inner):
        lines.append(f"{pad}    {inner}")
    else:
        for item in piece.items:
            lines += laid_out(item, depth + 1, ",")
    return [*lines, pad + piece.closing + after]


def assignment(targets: Sequence[str], is_single: bool, value: Piece, depth: int) -> list[str]:
    """Return the lines of an assignment to a name, or to a tuple of names; without names, of the value alone."""
    if not targets:
        return laid_out(value, depth)
    names = ", ".join(targets)
    if not is_single and len(targets) == 1:
        names = f"({names},)"
    pad = "    " * depth
    whole = prefixed(f"{names} = ", value)
    if fits(depth, _first(whole)):
        return laid_out(whole, depth)
    if len(targets) > 1:
        exploded = [f"{pad}(", *(f"{pad}    {name}," for name in targets)]
        return [*exploded, *laid_out(prefixed(") = ", value), depth)]
    if fits(depth + 1, _first(value)):
        return [f"{pad}{names} = (", *laid_out(value, depth + 1), f"{pad})"]
    return laid_out(whole, depth)


def _first(piece: Piece) -> str:
    """Return what of a piece can't be moved to the next line."""
    return piece.opening if isinstance(piece, Group) and piece.items else flat(piece)


def condition(keyword: str, left: str, operator: str, right: Piece, depth: int) -> list[str]:
    """Return the lines of ``if left operator right:``."""
    whole = prefixed(f"{keyword} {left} {operator} ", right)
    if fits(depth, f"{flat(whole)}:"):
        return laid_out(whole, depth, ":")
    if isinstance(whole, Group) and fits(depth, whole.opening):
        return laid_out(whole, depth, ":")
    pad, inner = "    " * depth, f"{left} {operator} {flat(right)}"
    parts = [f"{pad}    {inner}"]
    if not fits(depth + 1, inner):
        parts = [f"{pad}    {left}", *laid_out(prefixed(f"{operator} ", right), depth + 1)]
    return [f"{pad}{keyword} (", *parts, f"{pad}):"]


def piece_of(source: str) -> Piece:
    """Return an expression's source as a piece that may be broken, its strings in double quotes."""
    return _piece(ast.parse(source, mode="eval").body)


_BRACKETS: Final = {ast.Tuple: ("(", ")"), ast.List: ("[", "]"), ast.Set: ("{", "}")}


def _piece(node: ast.expr) -> Piece:
    match node:
        case ast.Constant():
            return constant(node.value)
        case ast.Tuple() | ast.List() | ast.Set():
            opening, closing = _BRACKETS[type(node)]
            return Group(opening, tuple(map(_piece, node.elts)), closing, is_display=True)
        case ast.Dict():
            entries = zip(node.keys, node.values, strict=True)
            items = tuple(prefixed(f"{flat(_piece(key))}: ", _piece(value)) for key, value in entries if key)
            return Group("{", items, "}", is_display=True)
        case ast.Call():
            named = (prefixed(f"{keyword.arg}=", _piece(keyword.value)) for keyword in node.keywords)
            return call(ast.unparse(node.func), (*map(_piece, node.args), *named))
        case ast.Subscript(slice=ast.Tuple() as index):
            return Group(f"{ast.unparse(node.value)}[", tuple(map(_piece, index.elts)), "]")
        case ast.UnaryOp(operand=ast.Constant() as operand):
            return f"-{constant(operand.value)}"
    return ast.unparse(node).replace("e+", "e")


def constant(value: object) -> str:
    """Return a string, number or other constant as formatters write it."""
    if isinstance(value, str):
        return quoted(value)
    if isinstance(value, bytes):
        plain = quoted(value.decode("latin-1")).encode("latin-1", "backslashreplace").decode("latin-1")
        return "b" + "".join(char if char.isascii() else f"\\x{ord(char):02x}" for char in plain)
    return repr(value).replace("e+", "e") if isinstance(value, float | complex) else repr(value)


def quoted(text: str) -> str:
    """Return a string literal, in double quotes where that needs no more escapes."""
    quote = "'" if text.count('"') > text.count("'") else '"'
    return quote + "".join(map(_escaped if quote == '"' else _escaped_single, text)) + quote


def _escaped(character: str) -> str:
    if character in '"\\':
        return f"\\{character}"
    return character if character.isprintable() else character.encode("unicode_escape").decode("ascii")


def _escaped_single(character: str) -> str:
    return {"'": "\\'", '"': '"'}.get(character) or _escaped(character)
