"""Do the attributes and defaults in a class's text still make the values that the class has?

The text is executed again in the bundle, with what its names mean by now. So its expressions are evaluated here, as far
as they can do no harm, and compared; a value that can't be evaluated is to be written in another way.
"""

from __future__ import annotations

import ast
import collections
import dataclasses
import enum
import fractions
import math
import pathlib
import re
import sys
import types
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Final

from epypes.bundle.evaluate import UNKNOWN, evaluated, value_of
from epypes.bundle.literal import is_data, is_same_data
from epypes.bundle.text import first_line
from epypes.run.guard import is_plain_array

# fmt: off
_HARMLESS: Final = (
    ast.Constant, ast.Tuple, ast.List, ast.Dict, ast.Set, ast.UnaryOp, ast.BinOp, ast.Name, ast.Attribute, ast.operator,
    ast.unaryop, ast.expr_context, ast.Call, ast.keyword, ast.Starred, ast.Subscript, ast.Slice, ast.JoinedStr,
    ast.FormattedValue, ast.IfExp, ast.Compare, ast.cmpop, ast.BoolOp, ast.boolop, ast.ListComp, ast.SetComp,
    ast.DictComp, ast.GeneratorExp, ast.comprehension,
)
_CALLED: Final = {
    "builtins": (
        "abs bool bytes complex dict enumerate float frozenset int len list max min range reversed round set slice "
        "sorted str sum tuple zip"
    ),
    "numpy": (
        "arange array asarray ascontiguousarray asfortranarray concatenate diag dtype eye full hstack identity "
        "linspace logspace ones outer prod stack sum tri vstack zeros"
    ),
    "cv2": "getGaussianKernel getStructuringElement",
}
# fmt: on
_CLASSES: Final = (fractions.Fraction, pathlib.Path, pathlib.PurePath, collections.OrderedDict, re.compile)
_METHODS: Final = (
    "astype", "copy", "join", "lower", "ravel", "reshape", "split", "strip", "transpose", "upper",
)  # fmt: skip
_MOST_TIMES: Final = 4096
# Stands for what a class's body makes in steps, or in a way that is not followed.
IN_STEPS: Final = ast.Yield()


def bound_names(body: Sequence[ast.stmt]) -> dict[str, ast.expr | None]:
    """Return the names that the body of a class binds, with their expressions; None for functions and classes."""
    found: dict[str, ast.expr | None] = {}
    for statement in body:
        if isinstance(statement, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            found[statement.name] = None
            continue
        if isinstance(statement, ast.Assign):
            found.update(_given(statement.targets, statement.value))
        elif isinstance(statement, ast.AnnAssign):
            found.update(_given([statement.target], statement.value) if statement.value else {})
        else:
            found.update(dict.fromkeys(_stored(statement), IN_STEPS))
    return found


def _given(targets: Sequence[ast.expr], value: ast.expr) -> dict[str, ast.expr]:
    found: dict[str, ast.expr] = {}
    for target in targets:
        found.update(dict.fromkeys(_stored(target), value if isinstance(target, ast.Name) else IN_STEPS))
        found.update(_unpacked(target, value))
    return found


def _stored(node: ast.AST) -> list[str]:
    return [part.id for part in ast.walk(node) if isinstance(part, ast.Name) and isinstance(part.ctx, ast.Store)]


def _unpacked(target: ast.expr, value: ast.expr) -> dict[str, ast.expr]:
    """Return what each of several names is given by a tuple that is written out."""
    if not isinstance(target, ast.Tuple) or not isinstance(value, ast.Tuple) or len(target.elts) != len(value.elts):
        return {}
    pairs = zip(target.elts, value.elts, strict=True)
    return {name.id: part for name, part in pairs if isinstance(name, ast.Name) and not isinstance(part, ast.Starred)}


def values_of_fields(kind: type) -> dict[str, Any]:
    """Return the defaults of a dataclass's or NamedTuple's fields, which may not be attributes of the class."""
    known = vars(kind).get("__dataclass_fields__", {})
    return {
        **{name: field.default for name, field in known.items()},
        **dict.fromkeys(vars(kind).get("_fields", ()), dataclasses.MISSING),
        **vars(kind).get("_field_defaults", {}),
    }


def value_in(kind: type, name: str) -> Any:
    """Return what a name of a class's body has been given; MISSING if the class does not keep it."""
    if issubclass(kind, enum.Enum) and name in kind.__members__:
        return kind.__members__[name].value
    fields = values_of_fields(kind)
    return fields[name] if name in fields else vars(kind).get(name, dataclasses.MISSING)


def names_in(kind: type, bound: Mapping[str, object], names: Mapping[str, Any]) -> dict[str, Any]:
    """Return what names mean in the body of a class: its own come first."""
    own = {name: value_in(kind, name) for name in bound}
    return {**names, **{name: value for name, value in own.items() if value is not dataclasses.MISSING}}


def is_other(kind: type, name: str, expression: ast.expr, names: Mapping[str, Any]) -> bool:
    """Whether an attribute is known to be something else than its text makes by now."""
    return any(
        written is not UNKNOWN and not is_same_value(written, value)
        for _, written, value in _pairs(kind, name, expression, names)
    )


def unknown_in(kind: type, name: str, expression: ast.expr, names: Mapping[str, Any]) -> Iterator[ast.expr]:
    """Give the expressions of an attribute that is a value, but whose text can't be evaluated."""
    for part, written, value in _pairs(kind, name, expression, names):
        if written is UNKNOWN and is_value(value):
            yield part


def is_value(value: Any) -> bool:
    """Whether this is data, an array or a number of NumPy's."""
    numpy = sys.modules.get("numpy")
    return is_data(value) or is_plain_array(value) or (numpy is not None and isinstance(value, numpy.generic))


def defaults_in(
    node: ast.ClassDef, written: Mapping[str, Sequence[types.FunctionType]], names: Mapping[str, Any]
) -> Iterator[tuple[str, ast.expr, bool]]:
    """Give the defaults of methods that have another value by now (True), or can't be evaluated (False)."""
    for method in node.body:
        if not isinstance(method, ast.FunctionDef):
            continue
        for function in _functions_of(method, node, written[method.name]):
            for default, value in _defaults(method.args, function):
                made = evaluated_safely(default, names)
                if made is UNKNOWN or not is_same_value(made, value):
                    yield method.name, default, made is not UNKNOWN


def evaluated_safely(expression: ast.expr, names: Mapping[str, Any]) -> Any:
    """Return the value of an expression that calls only what has no effect; UNKNOWN for any other."""
    known = value_of(expression, names)
    if known is not UNKNOWN:
        return known
    parts = list(ast.walk(expression))
    if not all(isinstance(part, _HARMLESS) and not _is_large(part) for part in parts):
        return UNKNOWN
    if not all(_is_harmless(part.func, names) for part in parts if isinstance(part, ast.Call)):
        return UNKNOWN
    return evaluated(expression, names)


def _is_harmless(called: ast.expr, names: Mapping[str, Any]) -> bool:
    if isinstance(called, ast.Attribute) and called.attr in _METHODS:
        return True
    function = value_of(called, names)
    numpy = sys.modules.get("numpy")
    if numpy is not None and (
        isinstance(function, numpy.ufunc) or (isinstance(function, type) and issubclass(function, numpy.generic))
    ):
        return True
    is_known = any(
        getattr(sys.modules.get(module), name, UNKNOWN) is function
        for module, listed in _CALLED.items()
        for name in listed.split()
    )
    is_of_math = isinstance(function, types.BuiltinFunctionType) and getattr(math, function.__name__, None) is function
    return function is not UNKNOWN and (is_known or is_of_math or any(function is one for one in _CLASSES))


def _is_large(node: ast.AST) -> bool:
    """Whether this may take all memory: a power, a shift, a long repetition."""
    if not isinstance(node, ast.BinOp):
        return False
    numbers = [side.value for side in (node.left, node.right) if isinstance(side, ast.Constant)]
    sizes = [abs(number) for number in numbers if isinstance(number, int | float)]
    if isinstance(node.op, ast.Pow | ast.LShift):
        return not sizes or max(sizes) > 64
    is_repeated = any(isinstance(side, ast.List | ast.Tuple) for side in (node.left, node.right))
    return isinstance(node.op, ast.Mult) and is_repeated and (not sizes or max(sizes) > _MOST_TIMES)


def _pairs(
    kind: type, name: str, expression: ast.expr, names: Mapping[str, Any]
) -> Iterator[tuple[ast.expr, Any, Any]]:
    """Give the expressions that make an attribute, with what they mean by now, and what the class has."""
    called = value_of(expression.func, names) if isinstance(expression, ast.Call) else None
    if called is enum.auto:
        return  # counted from what stands before it
    if called is dataclasses.field:
        field = vars(kind).get("__dataclass_fields__", {}).get(name)
        for word in expression.keywords if isinstance(expression, ast.Call) else ():
            if word.arg in ("default", "default_factory") and field is not None:
                yield word.value, evaluated_safely(word.value, names), getattr(field, word.arg)
        return
    value = value_in(kind, name)
    if value is not dataclasses.MISSING:
        yield expression, evaluated_safely(expression, names), value


def is_same_value(written: Any, value: Any) -> bool:
    """Whether two values are the same to the last bit; objects, whether they are one."""
    if written is value or is_same_data(written, value):
        return True
    if type(written) is not type(value):
        return False
    if is_plain_array(value):
        return _bits(written) == _bits(value)
    if type(value) in (list, tuple):
        return len(written) == len(value) and all(map(is_same_value, written, value))
    if type(value) in (dict, collections.OrderedDict):
        return is_same_value([*written.items()], [*value.items()])
    numpy = sys.modules.get("numpy")
    if numpy is not None and isinstance(value, numpy.generic):
        return bool(written.dtype == value.dtype and written.tobytes() == value.tobytes())
    return isinstance(value, (*_KEPT_BY_VALUE, range, slice)) and bool(written == value)


_KEPT_BY_VALUE: Final = (fractions.Fraction, pathlib.PurePath, re.Pattern)


def _bits(array: Any) -> tuple[object, ...]:
    strides = array.strides if array.size else ()
    return array.dtype, array.shape, strides, array.tobytes()


def _functions_of(
    method: ast.FunctionDef, node: ast.ClassDef, functions: Sequence[types.FunctionType]
) -> list[types.FunctionType]:
    """Return the functions that a definition has made; of a property there are several of one name."""
    alike = [other for other in node.body if isinstance(other, ast.FunctionDef) and other.name == method.name]
    named = [function for function in functions if function.__code__.co_name == method.name]
    at = [function for function in named if function.__code__.co_firstlineno == first_line(method)]
    return at if len(alike) > 1 else named


def _defaults(arguments: ast.arguments, function: types.FunctionType) -> Iterator[tuple[ast.expr, Any]]:
    by_position, by_name = function.__defaults__ or (), function.__kwdefaults__ or {}
    missing = object()
    padded = [*by_position, *[missing] * len(arguments.defaults)][: len(arguments.defaults)]
    yield from zip(arguments.defaults, padded, strict=True)
    named = zip(arguments.kwonlyargs, arguments.kw_defaults, strict=True)
    yield from ((default, by_name.get(argument.arg, missing)) for argument, default in named if default is not None)
