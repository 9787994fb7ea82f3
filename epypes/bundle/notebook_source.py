"""The text of the notebook: its cells, and the text that some code was compiled from.

The cells that were executed are the text; of a script, it is the script. A file may have been changed since it was
started. So what is found is compiled and compared with the function.
"""

from __future__ import annotations
import __future__

import ast
import dis
import io
import linecache
import re
import sys
import types
import warnings
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, Final

_CELL_MAGIC: Final = "get_ipython().run_cell_magic("
_EXECUTING: Final = ("capture", "time", "prun")
LATE_ANNOTATIONS: Final = __future__.annotations.compiler_flag
# Above a function these say something about their whole file.
_ABOUT_THE_FILE: Final = re.compile(r"\s*#(!|.*coding[:=])")

# The number of the cell, the line.
Position = tuple[int, ...]
Assignment = ast.Assign | ast.AnnAssign | ast.AugAssign
_Functions = dict[tuple[str, int], tuple[list[ast.FunctionDef | ast.Lambda], list[types.CodeType]]]

# -- cells and places ------------------------------------------------------------------------------------------------


def executed_cells(names: Mapping[str, Any], file: str = "") -> list[tuple[int, str]]:
    """Return the cells that a notebook has executed, each with its number; outside of notebooks the text of a file."""
    cells = names.get("In")
    known = enumerate(cells if isinstance(cells, list) else [])
    texts = [(number, _without_magic(cell)) for number, cell in known if isinstance(cell, str) and cell]
    return texts or ([(0, "".join(linecache.getlines(file)))] if file else [])


@lru_cache(maxsize=512)
def _without_magic(cell: str) -> str:
    """Return what a cell magic such as %%capture or %%time has executed of its cell, on the same lines."""
    tree = parsed(cell) if cell.lstrip().startswith(_CELL_MAGIC) else None
    call = getattr(tree.body[0], "value", None) if tree and len(tree.body) == 1 else None
    values = [getattr(part, "value", None) for part in getattr(call, "args", ())]
    return f"\n{values[2]}" if len(values) == 3 and values[0] in _EXECUTING else cell


def cell_of(file: str, names: Mapping[str, Any]) -> int:
    """Return the number of the cell that Python knows as a file, the last one of that text; 0 outside of notebooks."""
    source = "".join(linecache.getlines(file)).strip()
    return max((number for number, cell in executed_cells(names) if source and cell.strip() == source), default=0)


def place_of(code: types.CodeType) -> str:
    """Return where code stands: the cell's number, if it is from a notebook, and the line."""
    return place_in(code.co_filename, code.co_firstlineno)


def place_in(file: str, number: int) -> str:
    """Return a place in a file or cell: the cell's number, if it is from a notebook, and the line."""
    names = vars(sys.modules["__main__"])
    cell = cell_of(file, names)
    if not cell:
        return f"{file}, line {number}"
    below = dict(executed_cells(names))[cell].startswith("\n")  # as what a cell magic has executed
    return f"cell [{cell}], line {number + below}"


def names_of(value: object, names: Mapping[str, Any]) -> list[str]:
    """Return the names that a notebook has given to an object, but those that hold what cells have shown."""
    return [name for name, known in names.items() if known is value and not name.startswith("_")]


# -- assignments -----------------------------------------------------------------------------------------------------


def assignment_of(name: str, names: Mapping[str, Any], file: str = "") -> tuple[Assignment, list[str], int] | None:
    """Return the statement that has given a global name its value last; None if there is none.

    It comes with the lines of its cell, and the cell's number, 0 in a script. ``names`` are the notebook's names;
    outside of notebooks the text is that of ``file``.
    """
    texts = reversed(executed_cells(names, file))
    found = ((_assignments(text).get(name), text.split("\n"), cell) for cell, text in texts)
    return next(((node, lines, cell) for node, lines, cell in found if node is not None), None)


@lru_cache(maxsize=512)  # every constant of a graph asks for every cell
def _assignments(text: str) -> dict[str, Assignment]:
    """Return the last statement of a cell, but for those in functions and classes, that gives each name its value."""
    found: dict[str, Assignment] = {}
    tree = parsed(text)
    waiting: list[ast.AST] = [*reversed(tree.body)] if tree else []
    while waiting:
        node = waiting.pop()
        if isinstance(node, Assignment):
            for target in node.targets if isinstance(node, ast.Assign) else [node.target]:
                parts = (part for part in ast.walk(target) if isinstance(part, ast.Name))
                found |= {part.id: node for part in parts if isinstance(part.ctx, ast.Store)}
        elif not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            waiting += reversed([*ast.iter_child_nodes(node)])
    return found


# -- the text of functions -------------------------------------------------------------------------------------------


def lines_in(file: str) -> list[str]:
    """Return the lines of a file or cell; none if there is no text."""
    # From Python 3.13 on "<string>" has the text of `python -c`; what exec and libraries make has that name too.
    text = "" if file == "<string>" else "".join(linecache.getlines(file))
    # As Python counts lines: others end them at form feeds too.
    return io.StringIO(text, newline=None).readlines()


def definition_of(code: types.CodeType) -> tuple[list[str], ast.FunctionDef | None]:
    """Return the lines that code is from, and the definition among them that compiles to this very code."""
    lines, nodes = _nodes_of(code)
    return lines, next((node for node in nodes if isinstance(node, ast.FunctionDef)), None)


def lambdas_of(code: types.CodeType) -> tuple[list[str], list[ast.Lambda]]:
    """Return the lines that code is from, and the lambdas among them that may be it: one, if Python has its columns."""
    lines, found = _nodes_of(code)
    nodes = [node for node in found if isinstance(node, ast.Lambda)]
    # Some versions of Python put the return at the line's beginning, without a text.
    places: list[Any] = [place for place in code.co_positions() if None not in place and place[::2] != place[1::2]]
    starts, ends = [(place[0], place[2]) for place in places], [(place[1], place[3]) for place in places]
    around = [node for node in nodes if starts and _start(node.body) <= min(starts) and max(ends) <= _end(node.body)]
    # Of lambdas in one another, the innermost.
    return lines, [max(around, key=lambda node: _start(node.body))] if around else nodes


def _start(node: ast.expr) -> tuple[int, int]:
    return node.lineno, node.col_offset


def _end(node: ast.expr) -> tuple[int, int]:
    return node.end_lineno or 0, node.end_col_offset or 0


def _nodes_of(code: types.CodeType) -> tuple[list[str], list[ast.FunctionDef | ast.Lambda]]:
    """Return the lines that code is from, and what stands at its place if that compiles to this very code."""
    linecache.checkcache(code.co_filename)  # a script may have been changed and run again
    lines = lines_in(code.co_filename)
    functions = _functions_in("".join(lines), code.co_flags & LATE_ANNOTATIONS)
    nodes, codes = functions.get((code.co_name, code.co_firstlineno), ([], []))
    same = [other for other in codes if computes_the_same(other, code)]
    # The table of lines holds the columns too, unless Python runs with -X no_debug_ranges.
    if code.co_name == "<lambda>":
        same = [other for other in same if other.co_linetable == code.co_linetable]
    return lines, nodes if same else []


@lru_cache(maxsize=16)  # one cell often defines many functions
def _functions_in(source: str, flags: int) -> _Functions:
    """Return the functions in a cell or script, with the code that they compile to, by name and first line.

    A script is compiled as a whole, a cell by statement. That is not the same: Python calls ``cv2.blur`` in another
    way where it sees that cv2 is imported.
    """
    found: _Functions = {}
    tree = parsed(source)
    for node in ast.walk(tree) if tree else ():
        if isinstance(node, ast.FunctionDef | ast.Lambda):
            place = getattr(node, "name", "<lambda>"), first_line(node)
            found.setdefault(place, ([], []))[0].append(node)
    for unit in [tree, *(ast.Module([statement], []) for statement in tree.body)] if tree else ():
        module = compiled(unit, flags)
        for code in nested_codes(module) if module else ():
            found.get((code.co_name, code.co_firstlineno), ([], []))[1].append(code)
    return found


def parsed(source: str) -> ast.Module | None:
    """Return the syntax tree of text; None if it is no Python."""
    try:
        with warnings.catch_warnings(action="ignore"):  # the notebook has shown them
            return ast.parse(source)
    except (SyntaxError, ValueError):
        return None


def compiled(tree: ast.Module, flags: int = 0) -> types.CodeType | None:
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
    own = {"__name__", "__annotations__"}  # a class reads the module's, whichever that is, and has its own annotations
    for instruction in dis.get_instructions(code):
        if instruction.opname == "STORE_NAME":
            own.add(instruction.argval)
        elif instruction.opname in ("LOAD_GLOBAL", "LOAD_FROM_DICT_OR_GLOBALS") or (
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


def first_line(node: ast.FunctionDef | ast.ClassDef | ast.Lambda) -> int:
    """Return the line where a definition begins, decorators included."""
    decorators: list[ast.expr] = getattr(node, "decorator_list", [])
    return min(part.lineno for part in (node, *decorators))


def comment_above(lines: Sequence[str], number: int) -> list[str]:
    """Return the lines of comment above a line, without one on the encoding, which would change all that is written."""
    first = number - 1
    while first and lines[first - 1].lstrip().startswith("#") and not _ABOUT_THE_FILE.match(lines[first - 1]):
        first -= 1
    return [line.strip() for line in lines[first : number - 1]]


def spelled_tree(tree: ast.AST) -> list[object]:
    """Return all that a syntax tree says, without its lines; not by ast.dump, which a long sum is too deep for."""
    return [(type(node), [_spelled(value) for _, value in ast.iter_fields(node)]) for node in ast.walk(tree)]


def _spelled(value: object) -> object:
    if isinstance(value, list):
        return [_spelled(item) for item in value]
    return ast.AST if isinstance(value, ast.AST) else (type(value), value)
