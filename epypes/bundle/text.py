"""Which text says what a function computes, and does it still say that?

A file may have been changed since it was started, and text that is moved to another place may mean something else. So
nothing is believed: what is found, and what is written, is compiled and compared with the function.
"""

from __future__ import annotations
import __future__

import ast
import dis
import io
import linecache
import os
import re
import tokenize
import types
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from itertools import takewhile
from typing import Final

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
    for apart in (False, True):
        known = _definitions("".join(lines), code.co_flags & LATE_ANNOTATIONS, apart)
        found = known.get((code.co_name, code.co_firstlineno))
        if found is not None and computes_the_same(found[1], code):
            return found[0]
    return None


@lru_cache(maxsize=16)  # one cell often defines many functions
def _definitions(source: str, flags: int, apart: bool) -> dict[tuple[str, int], tuple[ast.FunctionDef, types.CodeType]]:
    """Return the definitions in a cell, with their code, by name and first line, decorators included."""
    tree = parsed(source)
    if tree is None:
        return {}
    codes = {(code.co_name, code.co_firstlineno): code for code in codes_in(tree, flags, apart)}
    nodes = ((node.name, first_line(node), node) for node in ast.walk(tree) if isinstance(node, ast.FunctionDef))
    return {(name, line): (node, codes[name, line]) for name, line, node in nodes if (name, line) in codes}


def codes_in(tree: ast.Module, flags: int, apart: bool) -> Iterator[types.CodeType]:
    """Return all code in a script, or in a cell.

    A script is compiled as a whole, a cell statement by statement (``apart``). That is not the same: Python calls
    ``cv2.blur`` in another way where it sees that cv2 is imported.
    """
    units = [ast.Module([statement], []) for statement in tree.body] if apart else [tree]
    for unit in units:
        module = compiled(unit, flags)
        yield from nested_codes(module) if module else ()


def parsed(source: str) -> ast.Module | None:
    """Return the syntax tree of text; None if it is no Python."""
    try:
        with _without_warnings():
            return ast.parse(source)
    except (SyntaxError, ValueError):
        return None


def compiled(tree: ast.Module, flags: int) -> types.CodeType | None:
    """Compile as a cell is compiled, which may await; None if that can't be done."""
    try:
        with _without_warnings():
            flags |= ast.PyCF_ALLOW_TOP_LEVEL_AWAIT
            code: types.CodeType = compile(tree, "text", "exec", flags, dont_inherit=True)
            return code
    except (SyntaxError, ValueError):
        return None


@contextmanager
def _without_warnings() -> Iterator[None]:
    """Whoever wrote the text was warned when it was run."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


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


def own_parts(node: ast.AST) -> Iterator[ast.AST]:
    """Return the parts of a function or class, but not those of functions and classes inside of it."""
    for part in ast.iter_child_nodes(node):
        yield part
        if not isinstance(part, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda | ast.ClassDef):
            yield from own_parts(part)


def computes_the_same(one: types.CodeType, other: types.CodeType) -> bool:
    """Whether two pieces of code are the same, but for the place where they stand."""
    return _bare(one) == _bare(other)


def _bare(code: types.CodeType) -> types.CodeType:
    """Return code without what tells where it stands."""
    constants = tuple(_bare(value) if isinstance(value, types.CodeType) else value for value in code.co_consts)
    return code.replace(co_consts=constants, co_filename="", co_firstlineno=1, co_linetable=b"")


def same_methods(text: str, node: ast.ClassDef, written: Mapping[str, Sequence[types.FunctionType]]) -> str:
    """Return the name of a method in the text of a class that is not what the class has; "" if there is none."""
    for method in node.body:
        if not isinstance(method, ast.FunctionDef):
            continue
        codes = [function.__code__ for function in written[method.name]]
        late = LATE_ANNOTATIONS if any(code.co_flags & LATE_ANNOTATIONS for code in codes) else 0
        known = [_definitions(text, late, apart).get((method.name, first_line(method))) for apart in (False, True)]
        if not any(found and any(computes_the_same(found[1], code) for code in codes) for found in known):
            return method.name
    return ""


def class_code(text: str, node: ast.ClassDef) -> types.CodeType | None:
    """Compile a class that was taken out, as a module; None if it means something else there."""
    tree = parsed(text)
    if tree is None or len(tree.body) != 1 or spelled_tree(tree.body[0]) != spelled_tree(node):
        return None
    return compiled(tree, 0)


def first_line(node: ast.FunctionDef | ast.ClassDef) -> int:
    """Return the line where a definition begins, decorators included."""
    return min([node.lineno, *(decorator.lineno for decorator in node.decorator_list)])


def own_text(lines: list[str], node: ast.FunctionDef | ast.ClassDef, dropped: Collection[ast.expr]) -> str:
    """Return a definition with the comment above it, not indented, without the decorators that are dropped."""
    first = first_line(node) - 1
    margin = lines[first][: len(lines[first]) - len(lines[first].lstrip())]
    while first and is_comment(lines[first - 1], first):
        first -= 1
    gone = {number for decorator in dropped for number in range(decorator.lineno, (decorator.end_lineno or 0) + 1)}
    kept = [line for number, line in enumerate(lines[first : node.end_lineno], first + 1) if number not in gone]
    return _dedented(kept, margin).rstrip() + "\n"


def renamed(text: str, old: str, new: str) -> str:
    """Return a definition under another name."""
    if old == new:
        return text
    number = ast.parse(text).body[0].lineno - 1
    lines = text.splitlines(keepends=True)
    lines[number] = re.sub(rf"\bdef(\s+){old}\b", rf"def\g<1>{new}", lines[number], count=1)
    return "".join(lines)


def with_defaults(text: str, sources: Sequence[str]) -> str:
    """Return a definition with other defaults: those of parameters by position, then by name; "" for one that stays."""
    if not any(sources):
        return text
    node, lines = ast.parse(text).body[0], text.encode().splitlines(keepends=True)
    if not isinstance(node, ast.FunctionDef):
        raise TypeError(type(node).__name__)
    starts = [sum(map(len, lines[:number])) for number in range(len(lines))]
    defaults = [*node.args.defaults, *(default for default in node.args.kw_defaults if default is not None)]
    whole = text.encode()
    places = [
        (
            starts[one.lineno - 1] + one.col_offset,
            starts[(one.end_lineno or one.lineno) - 1] + (one.end_col_offset or 0),
        )
        for one in defaults
    ]
    for (start, end), source in sorted(zip(places, sources, strict=True), reverse=True):
        if source:
            whole = whole[:start] + source.encode() + whole[end:]
    return whole.decode()


def is_comment(line: str, number: int) -> bool:
    """Whether a line is a comment on what stands below; one on the encoding would change all that is written."""
    return line.lstrip().startswith("#") and not (number <= 2 and _ABOUT_THE_FILE.match(line))


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


def code_on_its_own(text: str, node: ast.FunctionDef, code: types.CodeType) -> types.CodeType | None:
    """Compile a definition that was taken out, for a module where annotations are read at once.

    Parameters
    ----------
    text
        What :func:`own_text` returned.
    node
        The definition, without the decorators that were dropped.
    code
        The function's code. What it captured is global in the module.

    Returns
    -------
    types.CodeType or None
        The code; None if it means something else than the function's.
    """
    tree = parsed(text)
    if tree is None or len(tree.body) != 1 or spelled_tree(tree.body[0]) != spelled_tree(node):
        return None
    as_before = _code_of(node.name, _captured(tree, code.co_freevars), code.co_flags & LATE_ANNOTATIONS)
    # Inside of a class Python renames what begins with two underscores.
    return _code_of(node.name, tree, 0) if as_before and _names_in(as_before) == _names_in(code) else None


def _captured(tree: ast.Module, names: Collection[str]) -> ast.Module:
    """Return a definition inside of a function that has some names."""
    if not names:
        return tree
    around = ast.parse(f"def around({', '.join(names)}):\n    pass")
    vars(around.body[0]).update(name="<around>", body=tree.body)
    return around


def _code_of(name: str, tree: ast.Module, flags: int) -> types.CodeType | None:
    module = compiled(tree, flags)
    return next((code for code in nested_codes(module) if code.co_name == name), None) if module else None


def spelled_tree(tree: ast.AST) -> list[object]:
    """Return all that a syntax tree says, without its lines; not by ast.dump, which a long sum is too deep for."""
    return [(type(node), [_spelled(value) for _, value in ast.iter_fields(node)]) for node in ast.walk(tree)]


def _spelled(value: object) -> object:
    if isinstance(value, list):
        return [_spelled(item) for item in value]
    return ast.AST if isinstance(value, ast.AST) else (type(value), value)


def _names_in(code: types.CodeType) -> list[tuple[tuple[str, ...], ...]]:
    return [(part.co_names, part.co_varnames, part.co_freevars, part.co_cellvars) for part in nested_codes(code)]
