"""The text of the notebook: its cells, and the text that some code was compiled from.

The cells that were executed are the text; of a script, it is the script. A file may have been changed since it was
started, and text that is moved to another place may mean something else. So what is found, and what is written, is
compiled and compared with the function.
"""

from __future__ import annotations
import __future__

import ast
import dis
import io
import itertools
import linecache
import os
import re
import sys
import tokenize
import types
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import takewhile
from typing import Any, Final

from epypes.bundle.expressions import laid_out

_CELL_MAGIC: Final = "get_ipython().run_cell_magic("
_EXECUTING: Final = ("capture", "time", "prun")


# The number of the cell, the line.
Position = tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Statement:
    """A statement that gives names their values.

    Attributes
    ----------
    node
        Its syntax tree.
    lines
        The lines of its cell.
    cell
        The number of its cell, 0 in a script.
    """

    node: ast.stmt
    lines: tuple[str, ...]
    cell: int


def executed_cells(names: Mapping[str, Any]) -> list[tuple[int, str]]:
    """Return the cells that a notebook has executed, each with its number; none outside of notebooks."""
    cells = names.get("In")
    if not isinstance(cells, list):
        return []
    texts = ((number, _without_magic(cell)) for number, cell in enumerate(cells) if isinstance(cell, str))
    return [(number, text) for number, text in texts if text.strip()]


@lru_cache(maxsize=512)
def _without_magic(cell: str) -> str:
    """Return what a cell magic such as %%capture or %%time has executed of its cell, on the same lines."""
    tree = parsed(cell) if cell.lstrip().startswith(_CELL_MAGIC) else None
    call = getattr(tree.body[0], "value", None) if tree and len(tree.body) == 1 else None
    constants = (part.value for part in getattr(call, "args", ()) if isinstance(part, ast.Constant))
    texts = [value for value in constants if isinstance(value, str)]
    return f"\n{texts[2]}" if len(texts) == 3 and texts[0] in _EXECUTING else cell


def cell_of(file: str, names: Mapping[str, Any]) -> int:
    """Return the number of the cell that Python knows as a file, the last one of that text; 0 outside of notebooks."""
    source = "".join(linecache.getlines(file)).strip()
    numbers = (number for number, cell in executed_cells(names) if source and cell.strip() == source)
    return max(numbers, default=0)


def place_of(code: types.CodeType) -> str:
    """Return where code stands: the cell's number, if it is from a notebook, and the line."""
    return place_in(code.co_filename, code.co_firstlineno)


def place_in(file: str, number: int) -> str:
    """Return a place in a file or cell: the cell's number, if it is from a notebook, and the line."""
    names = vars(sys.modules["__main__"])
    cell = cell_of(file, names)
    # What a cell magic has executed begins on the second line.
    below = any(known == cell and text.startswith("\n") for known, text in executed_cells(names))
    return f"cell [{cell}], line {number + below}" if cell else f"{file}, line {number}"


def statements_of(name: str, names: Mapping[str, Any], file: str = "") -> Iterator[Statement]:
    """Return the statements that have given a name its value, the last one first.

    Parameters
    ----------
    name
        A global name.
    names
        The notebook's names.
    file
        Without a notebook, the text is that of this file.
    """
    texts = executed_cells(names)
    if not texts and file:
        texts = [(0, "".join(linecache.getlines(file)))]
    for cell, text in reversed(texts):
        for node in reversed(_givers(text).get(name, ())):
            yield Statement(node, tuple(text.split("\n")), cell)


@lru_cache(maxsize=512)  # every constant of a graph asks for every cell
def _givers(text: str) -> dict[str, tuple[ast.stmt, ...]]:
    """Return the statements of a cell by the global names that they give a value."""
    found: dict[str, tuple[ast.stmt, ...]] = {}
    tree = parsed(text)
    for node in _statements(tree.body) if tree else ():
        for name in dict.fromkeys(given_names(node)):
            found[name] = (*found.get(name, ()), node)
    return found


def _statements(body: list[ast.stmt]) -> Iterator[ast.stmt]:
    """Return statements and those inside of them, but not inside of functions and classes."""
    for node in body:
        yield node
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            for field in ("body", "orelse", "finalbody"):
                yield from _statements(getattr(node, field, []))


def given_names(node: ast.stmt) -> Iterator[str]:
    """Give the names to which a statement gives a value or a module."""
    if isinstance(node, ast.Assign | ast.AnnAssign | ast.AugAssign):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        for target in targets:
            parts = (part for part in ast.walk(target) if isinstance(part, ast.Name))
            yield from (part.id for part in parts if isinstance(part.ctx, ast.Store))
    elif isinstance(node, ast.Import | ast.ImportFrom):
        yield from (alias.asname or alias.name for alias in node.names)


def names_of(value: object, names: Mapping[str, Any]) -> list[str]:
    """Return the names that a notebook has given to an object, but those that hold what cells have shown."""
    return [name for name, known in names.items() if known is value and not name.startswith("_")]


LATE_ANNOTATIONS: Final = __future__.annotations.compiler_flag
# Above a function these say something about their whole file.
_ABOUT_THE_FILE: Final = re.compile(r"\s*#(!|.*coding[:=])")


def lines_in(file: str) -> list[str]:
    """Return the lines of a file or cell; none if there is no text."""
    # From Python 3.13 on "<string>" has the text of `python -c`; what exec and libraries make has that name too.
    text = "" if file == "<string>" else "".join(linecache.getlines(file))
    # As Python counts lines: others end them at form feeds too.
    return io.StringIO(text, newline=None).readlines()


def definition_of(code: types.CodeType) -> tuple[list[str], ast.FunctionDef | None]:
    """Return the lines that code is from, and the definition among them that compiles to this very code."""
    lines = lines_in(code.co_filename)
    found = _defined_as(lines, code)
    if found is None and os.path.isfile(code.co_filename):
        # Lines that were remembered may be older than the file that was run last.
        linecache.checkcache(code.co_filename)
        lines = lines_in(code.co_filename)
        found = _defined_as(lines, code)
    return lines, found


def _defined_as(lines: list[str], code: types.CodeType) -> ast.FunctionDef | None:
    for by_statement in (False, True):
        known = _definitions("".join(lines), code.co_flags & LATE_ANNOTATIONS, by_statement)
        found = known.get((code.co_name, code.co_firstlineno))
        if found is not None and computes_the_same(found[1], code):
            return found[0]
    return None


@lru_cache(maxsize=16)  # one cell often defines many functions
def _definitions(
    source: str, flags: int, by_statement: bool
) -> dict[tuple[str, int], tuple[ast.FunctionDef, types.CodeType]]:
    """Return the definitions in a cell, with their code, by name and first line, decorators included."""
    tree = parsed(source)
    if tree is None:
        return {}
    codes = {(code.co_name, code.co_firstlineno): code for code in codes_in(tree, flags, by_statement)}
    nodes = ((node.name, first_line(node), node) for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))
    return {(name, line): (node, codes[name, line]) for name, line, node in nodes if (name, line) in codes}


def codes_in(tree: ast.Module, flags: int, by_statement: bool) -> Iterator[types.CodeType]:
    """Return all code in a script, or in a cell.

    A script is compiled as a whole, a cell ``by_statement``. That is not the same: Python calls ``cv2.blur`` in
    another way where it sees that cv2 is imported.
    """
    units = [ast.Module([statement], []) for statement in tree.body] if by_statement else [tree]
    for unit in units:
        module = compiled(unit, flags)
        yield from nested_codes(module) if module else ()


def parsed(source: str) -> ast.Module | None:
    """Return the syntax tree of text; None if it is no Python."""
    try:
        with warnings.catch_warnings(action="ignore"):  # the notebook has shown them
            return ast.parse(source)
    except (SyntaxError, ValueError):
        return None


def compiled(tree: ast.Module, flags: int) -> types.CodeType | None:
    """Compile as a cell is compiled, which may await; None if that can't be done."""
    try:
        with warnings.catch_warnings(action="ignore"):  # the notebook has shown them
            flags |= ast.PyCF_ALLOW_TOP_LEVEL_AWAIT
            code: types.CodeType = compile(tree, "text", "exec", flags, dont_inherit=True)
            return code
    except (SyntaxError, ValueError):
        return None


def nested_codes(code: types.CodeType) -> Iterator[types.CodeType]:
    """Return code, and that of all that is defined in it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, types.CodeType):
            yield from nested_codes(constant)


def names_from_outside(code: types.CodeType) -> Iterator[str]:
    """Return the names that code reads, but for those that the body of a class has given a meaning before."""
    own = {"__name__"}  # a class reads the module's, whichever that is
    for instruction in dis.get_instructions(code):
        if instruction.opname == "STORE_NAME":
            own.add(instruction.argval)
        elif instruction.opname == "LOAD_GLOBAL" or (
            instruction.opname == "LOAD_NAME" and instruction.argval not in own
        ):
            yield instruction.argval


def computes_the_same(one: types.CodeType, other: types.CodeType) -> bool:
    """Whether two pieces of code are the same, but for the place where they stand."""
    return _bare(one) == _bare(other)


def _bare(code: types.CodeType) -> types.CodeType:
    """Return code without its file and lines."""
    constants = tuple(_bare(value) if isinstance(value, types.CodeType) else value for value in code.co_consts)
    return code.replace(co_consts=constants, co_filename="", co_firstlineno=1, co_linetable=b"")


def code_on_its_own(text: str) -> types.CodeType | None:
    """Compile a definition that was taken out, for a module where annotations are read at once; None if that fails.

    Whether it means there what it means in the notebook is found out by the comparison with the module's objects.
    """
    tree = parsed(text)
    return compiled(tree, 0) if tree is not None else None


def first_line(node: ast.FunctionDef | ast.ClassDef) -> int:
    """Return the line where a definition begins, decorators included."""
    return min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])


def own_text(lines: list[str], node: ast.FunctionDef | ast.ClassDef, dropped: Collection[ast.expr]) -> str:
    """Return a definition with the comment above it, not indented, without the decorators that are dropped."""
    above = comment_above(lines, first_line(node))
    first = first_line(node) - 1
    margin = lines[first][: len(lines[first]) - len(lines[first].lstrip())]
    gone = {number for decorator in dropped for number in range(decorator.lineno, (decorator.end_lineno or 0) + 1)}
    lines_left = [line for number, line in enumerate(lines[first : node.end_lineno], first + 1) if number not in gone]
    return "".join(f"{line}\n" for line in above) + _dedented(lines_left, margin).rstrip() + "\n"


def renamed(text: str, old: str, new: str) -> str:
    """Return a definition under another name."""
    if old == new:
        return text
    number = ast.parse(text).body[0].lineno - 1
    lines = text.splitlines(keepends=True)
    lines[number] = re.sub(rf"\bdef(\s+){old}\b", rf"def\g<1>{new}", lines[number], count=1)
    return "".join(lines)


def with_defaults(text: str, sources: Mapping[str, str]) -> str:
    """Return a definition with other defaults, by parameter."""
    node = ast.parse(text).body[0] if sources else None
    if not isinstance(node, ast.FunctionDef):
        return text
    whole, starts = text.encode(), [0, *itertools.accumulate(map(len, text.encode().splitlines(keepends=True)))]
    changes = [(default, sources[parameter]) for parameter, default in written_defaults(node) if parameter in sources]
    for default, source in reversed(changes):
        start = starts[default.lineno - 1] + default.col_offset
        end = starts[(default.end_lineno or 0) - 1] + (default.end_col_offset or 0)
        whole = whole[:start] + source.encode() + whole[end:]
    return whole.decode()


def written_defaults(node: ast.FunctionDef) -> list[tuple[str, ast.expr]]:
    """Return the parameters that have a default, each with its expression, in the order of the text."""
    by_position = [*node.args.posonlyargs, *node.args.args][::-1]
    pairs = [(one.arg, default) for one, default in zip(by_position, node.args.defaults[::-1], strict=False)][::-1]
    by_name = zip(node.args.kwonlyargs, node.args.kw_defaults, strict=True)
    return pairs + [(one.arg, default) for one, default in by_name if default is not None]


def inside_function(head: str, text: str, returned: str) -> str:
    """Return a function of this head in which a definition stands, and which returns what that defines."""
    inside = set(_lines_in_strings(text))
    lines = enumerate(io.StringIO(text).readlines(), 1)
    body = "".join(line if number in inside or not line.strip() else f"    {line}" for number, line in lines)
    return f"{head}\n{body}\n    return {returned}\n"


def comment_above(lines: Sequence[str], number: int) -> list[str]:
    """Return the lines of comment above a line, without one on the encoding, which would change all that is written."""
    first = number - 1
    while first and lines[first - 1].lstrip().startswith("#"):
        if first <= 2 and _ABOUT_THE_FILE.match(lines[first - 1]):
            break
        first -= 1
    return [line.strip() for line in lines[first : number - 1]]


def _dedented(lines: list[str], margin: str) -> str:
    """Take the margin away, but not inside of string literals, where it is part of the value."""
    if not margin:
        return "".join(lines)
    inside = set(_lines_in_strings("".join(lines)))
    return "".join(line if number in inside else _without(margin, line) for number, line in enumerate(lines, 1))


def _without(margin: str, line: str) -> str:
    """Take the margin from a line, or as much of it as is there: comments and what is in brackets may stand before."""
    shared = sum(1 for _ in takewhile(lambda pair: pair[0] == pair[1], zip(margin, line, strict=False)))
    return line[shared:] if line.strip() else "\n"


def _lines_in_strings(text: str) -> Iterator[int]:
    """Return the numbers of the lines that begin inside of a string literal."""
    begun: list[int] = []
    try:
        for token in tokenize.generate_tokens(io.StringIO(text).readline):
            kind = tokenize.tok_name[token.type]
            if kind == "STRING":
                yield from range(token.start[0] + 1, token.end[0] + 1)
            elif kind.endswith("STRING_START"):  # of an f-string, from Python 3.12 on
                begun.append(token.start[0])
            elif kind.endswith("STRING_END"):
                yield from range(begun.pop() + 1, token.end[0] + 1)
    except (tokenize.TokenError, SyntaxError):
        return  # the text is compiled later, and then refused


def spelled_tree(tree: ast.AST) -> list[object]:
    """Return all that a syntax tree says, without its lines; not by ast.dump, which a long sum is too deep for."""
    return [(type(node), [_spelled(value) for _, value in ast.iter_fields(node)]) for node in ast.walk(tree)]


def _spelled(value: object) -> object:
    if isinstance(value, list):
        return [_spelled(item) for item in value]
    return ast.AST if isinstance(value, ast.AST) else (type(value), value)


# Until its name is known.
UNNAMED: Final = "function"


def lambdas_of(code: types.CodeType) -> tuple[list[str], list[ast.Lambda]]:
    """Return the lines that code is from, and the lambdas among them that may be it: one, if Python has its columns."""
    lines = lines_in(code.co_filename)
    tree = parsed("".join(lines))
    if tree is None:
        return lines, []
    nodes = [node for node in ast.walk(tree) if isinstance(node, ast.Lambda) and node.lineno == code.co_firstlineno]
    flags = code.co_flags & LATE_ANNOTATIONS
    others = [other for by_statement in (False, True) for other in codes_in(tree, flags, by_statement)]
    # The table of lines holds the columns too, unless Python runs with -X no_debug_ranges.
    if not any(other.co_linetable == code.co_linetable and _is_same_place(other, code) for other in others):
        return lines, []
    # Some versions of Python put the return at the line's beginning, without a text.
    places = [place for place in code.co_positions() if None not in place and place[::2] != place[1::2]]
    around = [node for node in nodes if places and all(_holds(node.body, place) for place in places)]
    # Of lambdas in one another, the innermost.
    return lines, [max(around, key=lambda node: (node.body.lineno, node.body.col_offset))] if around else nodes


def _is_same_place(one: types.CodeType, other: types.CodeType) -> bool:
    return one.co_firstlineno == other.co_firstlineno and one.co_name == other.co_name and computes_the_same(one, other)


def _holds(body: ast.expr, place: Sequence[Any]) -> bool:
    """Whether a body holds a place: its first and last line, and the columns there."""
    line, end_line, column, end_column = place
    ends_inside = (end_line, end_column) <= (body.end_lineno, body.end_col_offset)
    return (body.lineno, body.col_offset) <= (line, column) and ends_inside


def as_function(lines: list[str], node: ast.Lambda) -> tuple[str, ast.FunctionDef]:
    """Return a lambda as the text of a function, with the comment above or beside it, and as a syntax tree.

    Parameters
    ----------
    lines
        The lines of its cell.
    node
        The lambda.
    """
    # Of the only lambda on its line.
    above = comment_above(lines, node.lineno) if lines[node.lineno - 1].count("lambda") == 1 else []
    head = f"def {UNNAMED}({ast.unparse(node.args)}):"
    text = "\n".join([head, *laid_out(ast.unparse(node.body), 1, "return ")]) + "\n"
    found = ast.parse(text).body[0]
    if not isinstance(found, ast.FunctionDef):
        raise TypeError(type(found).__name__)
    return "".join(f"{line}\n" for line in above) + text, ast.increment_lineno(found, node.lineno - 1)
