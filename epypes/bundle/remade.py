"""Does what a function has captured come out the same if the function around it is called again?

No function of the notebook is called to find out. A local of the function around is made again from its one assignment,
with calls of what gives the same whenever it is called; whatever else is captured, nobody can tell.
"""

from __future__ import annotations

import ast
import copy
import operator
import types
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from typing import Any, Final

from epypes.bundle.evaluate import UNKNOWN, value_of
from epypes.bundle.literal import is_same_data
from epypes.bundle.source import evaluated, importable
from epypes.bundle.text import nested_codes
from epypes.run.guard import is_plain_array

# fmt: off
_PURE: Final[Mapping[str, frozenset[str]]] = {
    "builtins": frozenset((
        "abs", "bool", "bytes", "complex", "dict", "divmod", "float", "frozenset", "int", "len", "list", "max", "min",
        "pow", "range", "round", "set", "sorted", "str", "sum", "tuple",
    )),
    "numpy": frozenset((
        "arange", "array", "asarray", "concatenate", "cumsum", "diag", "eye", "full", "hstack", "identity", "linspace",
        "max", "mean", "meshgrid", "min", "ones", "ones_like", "outer", "sum", "vstack", "zeros", "zeros_like",
    )),
    "cv2": frozenset(("getGaborKernel", "getGaussianKernel", "getRotationMatrix2D", "getStructuringElement")),
}
# fmt: on
_PURE_METHODS: Final = frozenset(
    ("astype", "copy", "get", "lower", "max", "mean", "min", "ravel", "reshape", "split", "strip", "sum", "upper")
)
_SUMS: Final[Mapping[type, Callable[[Any, Any], Any]]] = {
    ast.Add: operator.add, ast.Sub: operator.sub, ast.Mult: operator.mul, ast.Div: operator.truediv,
    ast.FloorDiv: operator.floordiv, ast.Mod: operator.mod, ast.Pow: operator.pow,
}  # fmt: skip
# A power of integers above this is no number that people compute with.
_MOST: Final = 4096


def unlike(
    around: Sequence[ast.FunctionDef], captured: Mapping[str, Any], given: Mapping[str, Any], names: Mapping[str, Any]
) -> str:
    """Return a captured name that may be something else when the functions around are called again; "" if none may.

    Parameters
    ----------
    around
        The functions around what has captured, the outermost first.
    captured
        Its values by name.
    given
        What parameters of these functions are given.
    names
        The names of the notebook.
    """
    for name, value in captured.items():
        if name in given:
            same = is_same_value(given[name], value)
        elif isinstance(value, types.FunctionType) and value.__code__.co_qualname.find("<locals>") > 0:
            same = _is_defined_once(around, name, value)
        else:
            same = is_same_value(_local(name, around, given, names), value)
        if not same:
            return name
    return ""


def with_inner(captured: Mapping[str, Any], code: types.CodeType) -> dict[str, Any]:
    """Return what is captured, and what functions in it that are defined in some code have captured themselves."""
    every, inside = dict(captured), set(nested_codes(code))
    waiting = list(captured.values())
    while waiting:
        function = waiting.pop()
        if not isinstance(function, types.FunctionType) or function.__code__ not in inside:
            continue
        for name, value in _cells(function):
            if name not in every:
                every[name] = value
                waiting.append(value)
            elif every[name] is not value:
                every[name] = UNKNOWN
    return every


def _cells(function: types.FunctionType) -> Iterator[tuple[str, Any]]:
    for name, cell in zip(function.__code__.co_freevars, function.__closure__ or (), strict=True):
        try:
            yield name, cell.cell_contents
        except ValueError:
            yield name, UNKNOWN


def own_parts(node: ast.AST) -> Iterator[ast.AST]:
    """Return the parts of a function, but not those of functions inside of it."""
    for part in ast.iter_child_nodes(node):
        yield part
        if not isinstance(part, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda | ast.ClassDef):
            yield from own_parts(part)


def makers(node: ast.FunctionDef, inner: ast.AST) -> list[ast.FunctionDef] | None:
    """Return the functions around an inner one, the outermost first; None if one of them is not always defined.

    Parameters
    ----------
    node
        The outermost function.
    inner
        A function inside of it.
    """
    found: list[ast.FunctionDef] = []
    while node is not inner:
        found.append(node)
        if inner in own_parts(node) and isinstance(inner, ast.Lambda):
            return found
        inside = [part for part in node.body if isinstance(part, ast.FunctionDef) and inner in ast.walk(part)]
        if len(inside) != 1 or len(_bindings(node, inside[0].name)) != 1:
            return None
        node = inside[0]
    return found


def _is_defined_once(around: Sequence[ast.FunctionDef], name: str, function: types.FunctionType) -> bool:
    """Whether a captured function is what a function around defines under that name, and has nothing of its own."""
    bindings = [(node, part) for node in around for part in _bindings(node, name)]
    if len(bindings) != 1 or function.__defaults__ or function.__kwdefaults__ or function.__dict__:
        return False
    node, part = bindings[0]
    if not isinstance(part, ast.FunctionDef) or part not in node.body or part.decorator_list:
        return False
    return part.lineno == function.__code__.co_firstlineno and part.name == function.__code__.co_name


def _bindings(node: ast.FunctionDef, name: str) -> list[ast.AST]:
    """Return the parts of a function that give a local a value."""
    return [part for part in own_parts(node) if name in _bound(part)]


def _bound(part: ast.AST) -> Collection[str]:
    if isinstance(part, ast.Name):
        return () if isinstance(part.ctx, ast.Load) else (part.id,)
    if isinstance(part, ast.alias):
        return ((part.asname or part.name).partition(".")[0],)
    if isinstance(part, ast.arg):
        return (part.arg,)
    own = getattr(part, "name", None)
    return (own,) if isinstance(own, str) else ()


def _local(
    name: str, around: Sequence[ast.FunctionDef], given: Mapping[str, Any], names: Mapping[str, Any], depth: int = 9
) -> Any:
    """Return what a local of the functions around is, made again from its one assignment; UNKNOWN if that can't be."""
    node = next((node for node in reversed(around) if _bindings(node, name)), None)
    assigned = [value for part in node.body for value in _assigned(part, name)] if node else []
    if node is None or len(assigned) != 1 or len(_bindings(node, name)) != 1 or not depth:
        return UNKNOWN
    read = {part.id for part in ast.walk(assigned[0]) if isinstance(part, ast.Name)} - given.keys()
    own = [word for word in read if any(_bindings(scope, word) for scope in around)]
    locals_ = {word: _local(word, around, given, names, depth - 1) for word in own}
    if any(value is UNKNOWN for value in locals_.values()):
        return UNKNOWN
    return pure_value(assigned[0], {**names, **given, **locals_})


def _assigned(part: ast.stmt, name: str) -> Iterator[ast.expr]:
    """Give the expression of a statement that gives its value to one name."""
    if not isinstance(part, ast.Assign | ast.AnnAssign) or part.value is None:
        return
    targets = part.targets if isinstance(part, ast.Assign) else [part.target]
    if len(targets) == 1 and isinstance(targets[0], ast.Name) and targets[0].id == name:
        yield part.value


def is_same_value(made: Any, value: Any) -> bool:
    """Whether two values are one, or the same data or array, to the last bit."""
    if made is UNKNOWN or value is UNKNOWN:
        return False
    if is_plain_array(made) and is_plain_array(value):
        same = made.dtype == value.dtype and made.shape == value.shape and made.strides == value.strides
        return bool(same and not made.dtype.hasobject and made.tobytes() == value.tobytes())
    if type(made) is type(value) and hasattr(value, "dtype") and hasattr(value, "tobytes"):
        return made is value or bool(value.shape == () and made.tobytes() == value.tobytes())
    return made is value or is_same_data(made, value)


def pure_value(expression: ast.expr, names: Mapping[str, Any]) -> Any:
    """Return what an expression means that calls only what gives the same whenever it is called; UNKNOWN for others."""
    made = _Made(names)
    return value_of(made.visit(copy.deepcopy(expression)), made.names)


class _Made(ast.NodeTransformer):
    """Puts names in the place of calls, sums and subscripts, from the inside out."""

    def __init__(self, names: Mapping[str, Any]) -> None:
        self.names = dict(names)

    def _named(self, node: ast.expr, made: Any) -> ast.expr:
        if made is UNKNOWN:
            return node
        name = f"<{len(self.names)}>"
        self.names[name] = made
        return ast.copy_location(ast.Name(name, ast.Load()), node)

    def visit_Call(self, node: ast.Call) -> ast.expr:
        self.generic_visit(node)
        return self._named(node, _called(node, self.names))

    def visit_BinOp(self, node: ast.BinOp) -> ast.expr:
        self.generic_visit(node)
        left, right = (value_of(side, self.names) for side in (node.left, node.right))
        if not all(map(_is_modest, (left, right))) or type(node.op) not in _SUMS:
            return node
        return self._named(node, _tried(lambda: _SUMS[type(node.op)](left, right)))

    def visit_Subscript(self, node: ast.Subscript) -> ast.expr:
        self.generic_visit(node)
        of, key = value_of(node.value, self.names), value_of(node.slice, self.names)
        if key is UNKNOWN or not (type(of) in (tuple, list, dict, str) or is_plain_array(of)):
            return node
        return self._named(node, _tried(lambda: of[key]))


def _is_modest(value: Any) -> bool:
    """Whether a number, or an array, is one that no sum makes huge."""
    if type(value) is int:
        return abs(value) <= _MOST
    return type(value) in (float, complex) or hasattr(value, "dtype")


def _called(node: ast.Call, names: Mapping[str, Any]) -> Any:
    positional = [value_of(part, names) for part in node.args]
    named = {part.arg or "": value_of(part.value, names) for part in node.keywords}
    if any(value is UNKNOWN for value in (*positional, *named.values())) or not {"", "out"}.isdisjoint(named):
        return UNKNOWN
    function = value_of(node.func, names)
    if function is UNKNOWN or not _is_pure(node.func, function, names):
        return UNKNOWN
    return _tried(lambda: function(*positional, **named))


def _is_pure(written: ast.expr, function: Any, names: Mapping[str, Any]) -> bool:
    """Whether a function gives the same whenever it is called."""
    owner = evaluated(written.value, names) if isinstance(written, ast.Attribute) else None
    if isinstance(written, ast.Attribute) and not isinstance(owner, types.ModuleType):
        owner = value_of(written.value, names)
        return written.attr in _PURE_METHODS and (type(owner) in (str, dict, list, tuple) or is_plain_array(owner))
    home = importable(function)
    if home is None:
        return False
    top = home.module.partition(".")[0]
    is_number = top == "numpy" and (type(function).__name__ == "ufunc" or hasattr(function, "dtype"))
    return is_number or top == "math" or home.qualname in _PURE.get(top, ())


def _tried(make: Callable[[], Any]) -> Any:
    try:
        return make()
    except Exception:
        return UNKNOWN
