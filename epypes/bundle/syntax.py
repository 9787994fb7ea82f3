"""Python syntax of generated text: identifiers, literals and line breaks.

What is too long for a line gets one item of its outermost brackets per line. Each item is followed by a comma, so that
formatters leave it on a line of its own. The arguments of a call stand on one line if they fit.
"""

from __future__ import annotations

import ast
import itertools
import keyword
import re
import unicodedata
from collections.abc import Callable, Iterable
from typing import Any, Final

# Style checkers refuse these as variables, since they look like numbers; nothing can be assigned to __debug__.
_NOT_NAMES: Final = frozenset({"l", "O", "I", "__debug__"})
_LONGEST: Final = 30


def is_identifier(text: str) -> bool:
    """Whether text can be a variable as it is: Python itself normalizes some characters."""
    is_usable = text.isidentifier() and not keyword.iskeyword(text) and text not in _NOT_NAMES
    return is_usable and unicodedata.normalize("NFKC", text) == text


def identifiers_of(names: Iterable[str], is_taken: Callable[[str], bool]) -> dict[str, str]:
    """Return a variable for each name, each its own; names that can be kept come first."""
    names = list(names)
    found = {name: str.__str__(name) for name in names if is_identifier(name) and not is_taken(name)}
    used = set(found.values())
    for name in names:
        if name not in found:
            found[name] = identifier_of(name, lambda text: text in used or is_taken(text))
            used.add(found[name])
    return found


def identifier_of(name: str, is_taken: Callable[[str], bool]) -> str:
    """Return a variable that is not taken, as like a name as can be."""
    stem = str.__str__(name)
    if not is_identifier(name):
        stem = re.sub(r"\W+", "_", name.encode("ascii", "ignore").decode())[:_LONGEST].strip("_") or "token"
        stem = f"token_{stem}" if stem[0].isdecimal() else stem
    if is_identifier(stem) and not is_taken(stem):
        return stem
    numbered = (f"{stem}_{number}" for number in itertools.count(2))
    return next(text for text in itertools.chain([f"{stem}_"], numbered) if not is_taken(text))


UNKNOWN: Final = object()


def is_data(value: object) -> bool:
    """Whether a value is of a type that literals are made of."""
    kinds = (bool, int, float, complex, str, bytes, type(None), tuple, list, dict, set, frozenset)
    return type(value) in kinds


def quoted(text: str | bytes) -> str:
    """Return the literal of a text, in double quotes unless it holds some; of a member of a StrEnum, of its text."""
    source = repr(text if isinstance(text, bytes) else str.__str__(text))
    return source if '"' in source else source.replace("'", '"')


def has_steady_order(values: Iterable[Any]) -> bool:
    """Whether a set of these has the same order in every process: hashes of text, for one, are seeded."""
    return all(
        has_steady_order(value) if type(value) is tuple else type(value) in (bool, int, float, complex)
        for value in values
    )


def bracketed(value: Any, write: Callable[[Any], str]) -> str:
    """Return the source of a tuple, list, dict or set, whose elements ``write`` writes."""
    if type(value) is dict:
        return f"{{{', '.join(f'{write(key)}: {write(item)}' for key, item in value.items())}}}"
    elements = [*map(write, value)]
    if type(value) is set:
        return f"{{{', '.join(elements if has_steady_order(value) else sorted(elements))}}}"
    inner = ", ".join(elements)
    return f"[{inner}]" if type(value) is list else f"({inner}{',' if len(elements) == 1 else ''})"


def literal(value: Any) -> str:
    """Return the source of a constant: as repr, but with sets sorted whose order changes from process to process.

    Raises
    ------
    ValueError
        Something in it is of a type that literals are not made of, or is an int that is too long for Python.
    """
    if type(value) in (str, bytes):
        return quoted(value)
    if type(value) in (tuple, list, dict) or (type(value) is set and value):
        return bracketed(value, literal)
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
    """Return the value of a literal, UNKNOWN for any other expression."""
    try:
        return ast.literal_eval(expression)
    except (ValueError, TypeError, SyntaxError, MemoryError, RecursionError):
        return UNKNOWN


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
