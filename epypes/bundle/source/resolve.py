"""The resolution of an object: the name under which it can be imported, or its definition in the notebook.

Objects are looked up by identity, never by name: a name may mean another function by now. A decorator stays where it
stands. Whether the text makes what the notebook has by now is found out by the comparison with the module's objects.

The cells that were executed are the text of a notebook; of a script, it is the script. A file may have been changed
since it was started. So what is found is compiled and compared with the function.
"""

from __future__ import annotations
import __future__

import ast
import copy
import functools
import io
import itertools
import linecache
import re
import sys
import types
import warnings
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache
from inspect import CO_ASYNC_GENERATOR, CO_COROUTINE
from typing import Any, Final, TypeGuard

from epypes.bundle.private_import import loaded_module
from epypes.bundle.source.references import (
    captured_by,
    global_names,
    imports_of,
    may_remember,
    namespace_of,
    nested_codes,
)
from epypes.graph import outputs
from epypes.run.guard import unguarded
from epypes.wording import keep_as_state

_CELL_MAGIC: Final = "get_ipython().run_cell_magic("
_EXECUTING: Final = ("capture", "time", "prun")
LATE_ANNOTATIONS: Final = __future__.annotations.compiler_flag
# Above a function these say something about their whole file.
_ABOUT_THE_FILE: Final = re.compile(r"\s*#(!|.*coding[:=])")

# The number of the cell, the line.
Position = tuple[int, ...]
Assignment = ast.Assign | ast.AnnAssign | ast.AugAssign
_Functions = dict[tuple[str, int], tuple[list[ast.FunctionDef | ast.Lambda], list[types.CodeType]]]


class Refused(Exception):
    """One reason why something can't be promoted; collected, then raised together as PromotionRefused."""


@contextmanager
def noted_refusals(reasons: list[str]) -> Iterator[None]:
    """Note what is refused inside, and go on after it."""
    try:
        yield
    except Refused as refusal:
        reasons.append(str(refusal))


# -- what can be imported --------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Importable:
    """An object that ``module`` has as ``qualname``."""

    module: str
    qualname: str


def importable(value: Any, *names: str) -> Importable | None:
    """Return a public name under which an object can be imported, if it has one.

    The object's own package is preferred to others that show it too, and there the shortest name.

    Parameters
    ----------
    value
        A function, class or other object.
    names
        Names that it may have in its module besides its own.
    """
    own = str(getattr(value, "__module__", None))
    if own == "__main__":
        return None
    # C functions and the special forms of typing often know their name, but not their module.
    known = [getattr(value, attribute, None) for attribute in ("__qualname__", "__name__", "_name")]
    for name in dict.fromkeys(name for name in (*known, *names) if isinstance(name, str)):
        for module in _modules_with(name.partition(".")[0], own):
            is_public = not module.startswith("_") and "._" not in module
            if is_public and _reached(module, name) is value:
                return Importable(module, name)
    qualname = str(known[0])
    return Importable(own, qualname) if _reached(own, qualname) is value else None


def _modules_with(name: str, own: str) -> Iterator[str]:
    """Give the modules that may have a name: a module and the packages around it, then others that have it already."""
    package = own.partition(".")[0].lstrip("_")  # _functools is what functools is made of
    yield from (package, *itertools.accumulate(own.split("."), "{}.{}".format))

    def distance(module: str) -> tuple[bool, int, int, str]:
        return module.partition(".")[0] != package, module.count("."), len(module), module

    # These are not asked for what they would load only now.
    found = [module for module, loaded in [*sys.modules.items()] if name in getattr(loaded, "__dict__", {})]
    yield from sorted(found, key=distance)


def _reached(module: str, qualname: str) -> Any:
    found: Any = loaded_module(module)
    for part in qualname.split("."):
        found = getattr(found, part, None)
    return found


def evaluated(expression: ast.expr, names: Mapping[str, Any]) -> Any:
    """Look up a dotted name; None for any other expression."""
    if isinstance(expression, ast.Name):
        return names.get(expression.id)
    if isinstance(expression, ast.Attribute):
        return getattr(evaluated(expression.value, names), expression.attr, None)
    return None


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


def definition_of(code: types.CodeType) -> tuple[list[str], ast.FunctionDef | ast.Lambda | None]:
    """Return the lines that code is from, and the definition among them that compiles to this very code."""
    linecache.checkcache(code.co_filename)  # a script may have been changed and run again
    lines = lines_in(code.co_filename)
    functions = _functions_in("".join(lines), code.co_flags & LATE_ANNOTATIONS)
    nodes, codes = functions.get((code.co_name, code.co_firstlineno), ([], []))
    same = [other for other in codes if computes_the_same(other, code)]
    if code.co_name != "<lambda>":
        return lines, next((node for node in nodes if same and isinstance(node, ast.FunctionDef)), None)
    # The table of lines holds the columns too, unless Python runs with -X no_debug_ranges.
    is_same = any(other.co_linetable == code.co_linetable for other in same)
    return lines, _lambda_of(code, [node for node in nodes if isinstance(node, ast.Lambda)]) if is_same else None


def _lambda_of(code: types.CodeType, lambdas: Sequence[ast.Lambda]) -> ast.Lambda | None:
    """Return the innermost lambda around the columns of its code; without columns, one if all have the same text."""
    # Some versions of Python put the return at the line's beginning, without a text.
    places: list[Any] = [place for place in code.co_positions() if None not in place and place[::2] != place[1::2]]
    if places:
        start, end = min(place[::2] for place in places), max(place[1::2] for place in places)
        around = [
            node
            for node in lambdas
            if (node.body.lineno, node.body.col_offset) <= start
            and end <= (node.body.end_lineno or 0, node.body.end_col_offset or 0)
        ]
        lambdas = [max(around, key=lambda node: (node.body.lineno, node.body.col_offset))] if around else lambdas
    return lambdas[0] if len({ast.dump(node) for node in lambdas}) == 1 else None


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


def imports_in(node: ast.AST, names: Mapping[str, Any]) -> list[str]:
    """Return the modules that the import statements of a text may name, as ``imports_of`` does for its code."""
    code = compiled(node if isinstance(node, ast.Module) else ast.Module([node], []))  # type: ignore[list-item]
    return imports_of(code, names) if code is not None else []


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


# -- definitions -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class Definition:
    """The definition of a function or class in the notebook.

    Attributes
    ----------
    what
        How reasons call it, as ``"Function 'blur'"``.
    node
        Its syntax tree; a lambda's is that of a function with one statement.
    dropped
        The decorators that do not stay.
    file, lines
        The file or cell that it is from, as Python knows it, and the lines there.
    names
        What its names mean by now.
    function
        The function that has this text: of a decorated one, the innermost; None for a class.
    captured
        What a function has from the function around it, by name.
    wrappers
        The functions that decorators have wrapped around it, each with its decorator.
    changed
        Expressions of the defaults whose text makes another value than the function has, by the text's.
    """

    what: str
    node: ast.FunctionDef | ast.ClassDef
    file: str
    lines: Sequence[str]
    names: Mapping[str, Any]
    function: types.FunctionType | None
    captured: Mapping[str, Any]
    dropped: Collection[ast.expr]
    wrappers: Sequence[tuple[ast.expr, Any]] = ()
    changed: Mapping[ast.expr, str] = field(default_factory=dict)

    @property
    def is_lambda(self) -> bool:
        """Whether it had no name."""
        return self.function is not None and self.function.__code__.co_name == "<lambda>"

    @property
    def line(self) -> int:
        """Where it begins in its file or cell."""
        return first_line(self.node)

    def reads(self) -> list[str]:
        """Return the global names that its statement reads in a module, but for those of changed defaults."""
        node = copy.copy(self.node)
        node.decorator_list = [one for one in node.decorator_list if one not in self.dropped]
        if isinstance(node, ast.FunctionDef):
            nones: dict[ast.expr, ast.expr] = {one: ast.copy_location(ast.Constant(None), one) for one in self.changed}
            node.args = with_defaults(node.args, nones)
        code = compiled(ast.Module([node], []))
        return global_names(code) if code is not None else []

    def factory(self) -> ast.FunctionDef | None:
        """Return the definition of the function that has returned it; None for one that stands at the margin."""
        qualname = self.function.__code__.co_qualname if self.function is not None else ""
        name = qualname.rpartition(".<locals>")[0].rpartition(".")[2]
        tree = parsed("".join(self.lines)) if name else None
        nodes = [node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)] if tree else []
        around = (node for node in nodes if node.name == name and node.lineno <= self.line <= (node.end_lineno or 0))
        return max(around, key=lambda node: node.lineno, default=None)

    def place_in(self, node: ast.AST) -> str:
        """Return the cell and line of a part of it."""
        return place_in(self.file, getattr(node, "lineno", self.line))

    def place_of(self, name: str) -> str:
        """Return the cell and line where it uses a name."""
        uses = (node for node in ast.walk(self.node) if isinstance(node, ast.Name) and node.id == name)
        return self.place_in(next(uses, self.node))


# A wrapper may be made to wrap itself; a hundred layers are no accident of a notebook.
_DEEPEST: Final = 100


def layers(function: Any) -> list[Any]:
    """Return a function, what it wraps, and so on down to what wraps nothing."""
    found = [function]
    while len(found) < _DEEPEST and "__wrapped__" in getattr(found[-1], "__dict__", {}):
        found.append(found[-1].__wrapped__)
    return found


def function_definition(function: Any, what: str) -> Definition:
    """Return the definition of a function of the notebook, with its decorators if each of them has wrapped it.

    Parameters
    ----------
    function
        The function, or what decorators have made of it.
    what
        How to call it in a reason, as ``"Function 'blur'"``.

    Raises
    ------
    Refused
        Its source is not to be had or does not say all of it.
    """
    *wrappers, innermost = layers(function)
    node = definition_of(innermost.__code__)[1] if isinstance(innermost, types.FunctionType) else None
    given = getattr(node, "decorator_list", [])
    decorators = [one for one in given if _target(one, innermost) not in _MARKS]
    if decorators and len(decorators) == len(wrappers):
        function = innermost
    elif isinstance(function, types.FunctionType):
        decorators = []
    else:
        raise Refused(_no_definition(function, innermost, what))
    code: types.CodeType = function.__code__
    place = place_of(code)
    if code.co_flags & (CO_COROUTINE | CO_ASYNC_GENERATOR):
        raise Refused(f"{what} is asynchronous ({place}), which no graph waits for. Write a plain function (def).")
    lines, node = definition_of(code)
    node = as_function(node) if isinstance(node, ast.Lambda) else node
    if not lines:
        way_out = "Define it in a cell without %%time, in a file, or in a module that is installed"
        way_out += ": Python keeps no text of what is typed at a prompt."
        raise Refused(f"{what} has no source ({place}). {way_out}")
    if node is None:
        text = f"{what} is not what its source says ({place}): that was changed since it was run, or the function was."
        raise Refused(f"{text} Run it again, so that both are the same.")
    captured = captured_by(function)
    names = namespace_of(function) if captured else function.__globals__
    targets = {one: _target(one, function) for one in node.decorator_list}
    # A decorator that has returned the function itself may have left something on it.
    dropped = [one for one, target in targets.items() if target is outputs or not (decorators or target in _LEAVING)]
    wrapped = [*zip(decorators, wrappers, strict=False)]
    return Definition(what, node, code.co_filename, lines, names, function, captured, dropped, wrapped)


# What returns the function itself, and what leaves something on it.
_MARKS: Final = (unguarded, outputs)
_LEAVING: Final = (unguarded, functools.wraps)


def as_function(node: ast.Lambda) -> ast.FunctionDef:
    """Return a lambda as a function that is called so until its name is known."""
    body: list[ast.stmt] = [ast.copy_location(ast.Return(node.body), node.body)]
    return ast.copy_location(ast.FunctionDef("function", node.args, body, []), node)


def _target(decorator: ast.expr, function: types.FunctionType) -> Any:
    """Return what a decorator calls, if that is a name."""
    called = decorator.func if isinstance(decorator, ast.Call) else decorator
    return evaluated(called, namespace_of(function))


def is_of_notebook(function: Any) -> TypeGuard[types.FunctionType]:
    """Whether this is a function of the notebook, or of a module that can't be imported, as that of a bundle."""
    if not isinstance(function, types.FunctionType):
        return False
    home = function.__globals__.get("__name__")
    return home == "__main__" or home not in sys.modules


def _no_definition(value: Any, innermost: Any, what: str) -> str:
    """Return why something that can be called has no definition that makes it."""
    owner = value.__self__ if isinstance(value, types.MethodType | types.BuiltinMethodType) else value
    kind = type(owner)
    text = f"{'an' if owner is value else 'a method of an'} object of class {kind.__name__!r}"
    names = vars(sys.modules["__main__"])
    given = filter(None, (assignment_of(name, names) for name in names_of(value, names)))
    places = [f"cell [{cell}], line {node.lineno}" for node, _, cell in given]
    methods = functions_of(kind).values() if importable(kind) is None else ()
    places += [place_of(function.__code__) for function in (*methods, innermost) if is_of_notebook(function)]
    where = f" ({places[0]})" if places else ""
    way_out = "Write a plain function (def) that makes the object and calls it."
    way_out += f" {keep_as_state('state', is_object=True)}." if may_remember(owner) else ""
    return f"{what} is {text}{where}. {way_out}"


# -- the parts of definitions ----------------------------------------------------------------------------------------


def defaults_in(given: ast.arguments) -> dict[str, ast.expr]:
    """Return the expressions of the defaults of a function, by parameter."""
    parameters = [*given.posonlyargs, *given.args][-len(given.defaults) :] if given.defaults else []
    pairs = zip([*parameters, *given.kwonlyargs], [*given.defaults, *given.kw_defaults], strict=True)
    return {parameter.arg: default for parameter, default in pairs if default is not None}


def with_defaults(given: ast.arguments, new: Mapping[ast.expr, ast.expr]) -> ast.arguments:
    """Return the parameters of a function with other defaults."""
    given = copy.copy(given)
    given.defaults = [new.get(default, default) for default in given.defaults]
    given.kw_defaults = [default and new.get(default, default) for default in given.kw_defaults]
    return given


def annotated_names(node: ast.AST) -> Iterator[str]:
    """Give the names in all annotations of a definition."""
    for part in ast.walk(node):
        for annotation in (getattr(part, "annotation", None), getattr(part, "returns", None)):
            names = ast.walk(annotation) if annotation is not None else ()
            yield from (name.id for name in names if isinstance(name, ast.Name))


# -- classes ---------------------------------------------------------------------------------------------------------


def class_definition(kind: type, around: Mapping[str, Any], what: str) -> Definition:
    """Return the definition of a class of the notebook or the main script.

    Parameters
    ----------
    kind
        The class.
    around
        The names where it was found, which are those of the notebook if it has no method that knows them.
    what
        How to call it in a reason, as ``"Class 'Blur'"``.

    Raises
    ------
    Refused
        Its source is not to be had.
    """
    if kind.__qualname__ != kind.__name__:
        text = f"{what} is defined inside {kind.__qualname__.rpartition('.')[0]!r}"
        raise Refused(f"{text}. Define it at the margin of a cell.")
    file, node = next(statements_of_class(kind), ("", None))
    if node is None:
        way_out = "Write a class statement for it, as class P(typing.NamedTuple), and make again what was made of it."
        raise Refused(f"{what} has no class statement: it was made by a call. {way_out}")
    names = next((function.__globals__ for function in functions_of(kind).values()), around)
    return Definition(what, node, file, lines_in(file), names, None, {}, ())


def statements_of_class(kind: type) -> Iterator[tuple[str, ast.ClassDef]]:
    """Give the class statements of a class's name, each with its file: the last one first.

    They are those in the files and cells of its methods; of a class without methods, in all that Python remembers.
    """
    own = dict.fromkeys(function.__code__.co_filename for function in functions_of(kind).values())
    main = vars(sys.modules["__main__"])
    files = [*own] or [*linecache.cache, str(main.get("__file__", ""))]
    for file in sorted(files, key=lambda file: cell_of(file, main))[::-1]:
        text = "".join(lines_in(file))
        tree = parsed(text) if f"class {kind.__name__}" in text else None
        found = [node for node in ast.walk(tree) if isinstance(node, ast.ClassDef)] if tree else []
        yield from ((file, node) for node in reversed(found) if node.name == kind.__name__)


def is_named_tuple(kind: type) -> bool:
    """Whether a class was made by a call of ``collections.namedtuple``, or of ``typing.NamedTuple``."""
    if kind.__bases__ != (tuple,) or "_field_defaults" not in vars(kind):
        return False
    # A class statement has annotations, and a class without them may have the name of one.
    return not getattr(kind, "__annotations__", None) or next(statements_of_class(kind), None) is None


def functions_of(kind: type) -> dict[str, types.FunctionType]:
    """Return the functions of a class that were written for it, by name; of a property, its first.

    Those that a library has made, as dataclasses does, are left out.
    """
    found: dict[str, types.FunctionType] = {}
    for name, value in vars(kind).items():
        attributes = ("__func__", "fget", "fset", "fdel", "func", "__wrapped__")
        for part in (value, *(getattr(value, attribute, None) for attribute in attributes)):
            if is_of_notebook(part) and lines_in(part.__code__.co_filename):
                found.setdefault(name, part)
    return found
