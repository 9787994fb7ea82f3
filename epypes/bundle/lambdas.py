"""Which lambda is this, and how is it written as a function with a name?"""

from __future__ import annotations

import ast
import types
from collections.abc import Iterator
from typing import Final

from epypes.bundle.formatting import LINE, laid_out
from epypes.bundle.text import (
    LATE_ANNOTATIONS,
    codes_in,
    computes_the_same,
    is_comment,
    lines_in,
    parsed,
    spelled_tree,
)

# Until its name is known.
UNNAMED: Final = "function"


def lambdas_of(code: types.CodeType) -> tuple[list[str], list[ast.Lambda]]:
    """Return the lines that code is from, and the lambdas among them that may be it: one, if it can be told."""
    lines = lines_in(code.co_filename)
    tree = parsed("".join(lines))
    if tree is None:
        return lines, []
    nodes = [node for node in ast.walk(tree) if isinstance(node, ast.Lambda) and node.lineno == code.co_firstlineno]
    known = [other for apart in (False, True) for other in _same_lambdas(tree, code, apart)]
    if not known:
        return lines, []
    # The table of lines holds the columns too, unless Python was told to forget them.
    exact = [other for other in known if other.co_linetable == code.co_linetable]
    if not exact:
        return lines, []
    around = [node for node in nodes if _holds(node.body, exact[0])]
    # Of lambdas in one another, the innermost.
    return lines, [max(around, key=lambda node: _start(node.body))] if around else nodes


def _same_lambdas(tree: ast.Module, code: types.CodeType, apart: bool) -> Iterator[types.CodeType]:
    for other in codes_in(tree, code.co_flags & LATE_ANNOTATIONS, apart):
        place = (other.co_name, other.co_firstlineno)
        if place == (code.co_name, code.co_firstlineno) and computes_the_same(other, code):
            yield other


def _holds(body: ast.expr, code: types.CodeType) -> bool:
    """Whether code, which has something to show, stands inside of a body."""
    places = [((line, column), (end_line, end_column)) for line, end_line, column, end_column in _shown(code)]
    return bool(places) and _start(body) <= min(places)[0] and max(end for _, end in places) <= _end(body)


def _shown(code: types.CodeType) -> Iterator[tuple[int, int, int, int]]:
    """Return the positions of code that have a text: some versions of Python put the return at the line's beginning."""
    for line, end_line, column, end_column in code.co_positions():
        is_known = line is not None and end_line is not None and column is not None and end_column is not None
        if is_known and (line, column) != (end_line, end_column):
            yield line or 0, end_line or 0, column or 0, end_column or 0


def _start(node: ast.expr) -> tuple[int, int]:
    return node.lineno, node.col_offset


def _end(node: ast.expr) -> tuple[int, int]:
    return node.end_lineno or node.lineno, node.end_col_offset or 0


def as_function(lines: list[str], node: ast.Lambda) -> tuple[str, ast.FunctionDef]:
    """Return a lambda as the text of a function, with the comment above or beside it, and as a syntax tree.

    Parameters
    ----------
    lines
        The lines of its cell.
    node
        The lambda.
    """
    shape = ast.parse(f"def {UNNAMED}(): pass").body[0]
    if not isinstance(shape, ast.FunctionDef):
        raise TypeError(type(shape).__name__)
    vars(shape).update(args=node.args, body=[ast.copy_location(ast.Return(node.body), node.body)])
    head = f"def {UNNAMED}({', '.join(_parameters(node.args))}):"
    text = f"{_comment(lines, node)}{head}\n{_returned(''.join(lines), node.body)}\n"
    return text, ast.copy_location(shape, node)


def _returned(source: str, body: ast.expr) -> str:
    """Return a body as a statement: as it stands, if that is one line which fits."""
    text = f"    return {ast.get_source_segment(source, body)}"
    tree = parsed(f"def f():\n{text}\n")
    returned = getattr(tree.body[0], "body", [])[0] if tree else None
    value = returned.value if isinstance(returned, ast.Return) else None
    if value is not None and "\n" not in text and len(text) <= LINE and spelled_tree(value) == spelled_tree(body):
        return text
    return "\n".join(laid_out(ast.unparse(body), 1, "return "))


def _parameters(arguments: ast.arguments) -> Iterator[str]:
    """Return the parameters as they stand in a definition."""
    by_position = [*arguments.posonlyargs, *arguments.args]
    lone = [None] * (len(by_position) - len(arguments.defaults))
    for number, (argument, default) in enumerate(zip(by_position, [*lone, *arguments.defaults], strict=True), 1):
        yield _parameter(argument, default)
        if number == len(arguments.posonlyargs):
            yield "/"
    if arguments.vararg:
        yield f"*{arguments.vararg.arg}"
    elif arguments.kwonlyargs:
        yield "*"
    for argument, given in zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True):
        yield _parameter(argument, given)
    if arguments.kwarg:
        yield f"**{arguments.kwarg.arg}"


def _parameter(argument: ast.arg, default: ast.expr | None) -> str:
    return f"{argument.arg}={ast.unparse(default)}" if default else argument.arg


def _comment(lines: list[str], node: ast.Lambda) -> str:
    """Return the comment that stands above the line of a lambda, or beside it, and is on it alone."""
    if lines[node.lineno - 1].count("lambda") > 1:
        return ""
    first = number = node.lineno - 1
    while first and is_comment(lines[first - 1], first):
        first -= 1
    above = "".join(f"{line.strip()}\n" for line in lines[first:number])
    rest = lines[(node.end_lineno or 1) - 1].encode()[node.end_col_offset :].decode().lstrip(" ,)]}")
    return above or (f"{rest.strip()}\n" if rest.startswith("#") else "")
