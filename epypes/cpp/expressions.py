"""Expressions: numbers, tuples, lists and calls, with the meaning that they have in Python.

Integers of Python have no end and those of C++ have 64 bits: where a result may have more, it is checked.
"""

from __future__ import annotations

import ast
import functools
import math
import sys
import types
from collections.abc import Callable, Mapping
from dataclasses import replace
from itertools import pairwise
from typing import Any, Final

from epypes.cpp import arrays, opencv
from epypes.cpp import types as t
from epypes.cpp.scope import UNKNOWN, ByHand, Expr, Scope, is_number, no_counterpart, refuse, tuple_of

# An array that is written out.
_MOST_ELEMENTS: Final = 64


def written(value: Any, name: str, node: Any) -> Expr:
    """Return a value that is known before the function runs: a constant, or what only a call can use."""
    if value is None:
        return Expr("{}", t.NONE, None)
    if type(value) in (bool, int, float, str):
        kind = t.type_of(value)
        if isinstance(kind, t.Int):
            kind = t.Int(value, value, is_int=-(2**31) <= value < 2**31)
        return Expr(t.literal(value, kind), kind, value, is_atom=type(value) is str or value >= 0)
    if type(value) is tuple and value:
        return tuple_of([written(item, name, node) for item in value])
    if isinstance(value, types.ModuleType | types.FunctionType | types.BuiltinFunctionType | type) or callable(value):
        return Expr("", t.NONE, value)
    import numpy as np

    if isinstance(value, np.dtype):
        return Expr("", t.NONE, value)
    if isinstance(value, np.ndarray) and value.dtype.name in t.ELEMENTS and 0 < value.size <= _MOST_ELEMENTS:
        element, shape = t.ELEMENTS[value.dtype.name], ", ".join(map(str, value.shape))
        numbers = ", ".join(t.literal(each, t.number(value.dtype.name)) for each in value.reshape(-1))
        own: Any = t.type_of(value)
        kind = t.readonly(replace(own, is_mat=False, channels=0))
        return Expr(f"numpy::array<{element}, {value.ndim}>({{{shape}}}, {{{numbers}}})", kind)
    raise ByHand(f"the global {name!r} is a {type(value).__name__}", node)


def translate(scope: Scope, node: ast.expr, hint: tuple[str, ...] = ()) -> Expr:
    """Return an expression in C++; ``hint`` has the names of the variables that its results become."""
    if isinstance(node, ast.Call):
        return _call(scope, node, hint)
    refuse(type(node) not in _TRANSLATORS, f"the expression {ast.unparse(node):.60} has no translation", node)
    return _TRANSLATORS[type(node)](scope, node)


def value_of(scope: Scope, node: ast.expr) -> Expr:
    """Return an expression that is a value: no module, function or type."""
    found = translate(scope, node)
    refuse(not found.text, f"{ast.unparse(node):.60} is used as a value", node)
    return found


def _constant(scope: Scope, node: Any) -> Expr:
    return written(node.value, ast.unparse(node), node)


def _name(scope: Scope, node: Any) -> Expr:
    import builtins

    if node.id not in scope.locals and node.id not in scope.names and hasattr(builtins, node.id):
        return Expr("", t.NONE, getattr(builtins, node.id))
    return scope.load(node)


def _attribute(scope: Scope, node: Any) -> Expr:
    owner = translate(scope, node.value)
    if isinstance(owner.value, types.ModuleType):
        module, name = owner.value, node.attr
        if module.__name__ == "cv2" and (text := opencv.constant(name)):
            value = getattr(module, name)
            return Expr(text, t.Int(value, value, is_int=True), value)
        value = getattr(module, name, UNKNOWN)
        refuse(value is UNKNOWN, f"{ast.unparse(node)} does not exist here", node)
        if value == math.pi:
            return Expr("CV_PI", t.FLOAT, value)
        return written(value, ast.unparse(node), node)
    if isinstance(owner.value, type) and owner.value.__module__.startswith("cv2"):
        return Expr("", t.NONE, getattr(owner.value, node.attr, UNKNOWN))
    if isinstance(owner.type, t.RecordType) and not owner.type.is_pointer:
        kind = t.data("structures")["objects"].get(owner.type.name, {}).get(node.attr, "")
        refuse(not kind, f"the attribute {node.attr!r} of a {owner.type.name}", node)
        return opencv.member(f"{owner.atom}.{node.attr}", kind)
    if isinstance(owner.type, t.ArrayType):
        return arrays.attribute(owner, node.attr, node)
    raise ByHand(f"the attribute {node.attr!r} of {t.describe(owner.type)}", node)


def _joined_text(scope: Scope, node: Any) -> Expr:
    """Return an f-string of integers and texts."""
    parts = []
    for each in node.values:
        found = value_of(scope, each if isinstance(each, ast.Constant) else each.value)
        is_plain = isinstance(each, ast.Constant) or (each.format_spec is None and each.conversion == -1)
        if not is_plain or not (isinstance(found.type, t.Int) or found.type == t.TEXT):
            raise ByHand("a format of a value that is neither an integer nor a text", node)
        parts.append(f"std::to_string({found.text})" if isinstance(found.type, t.Int) else f"std::string({found.text})")
    return Expr(" + ".join(parts) or "std::string()", t.TEXT, is_atom=False)


def _tuple(scope: Scope, node: Any) -> Expr:
    if any(isinstance(item, ast.Starred) for item in node.elts):
        parts: list[Expr] = []
        for item in node.elts:
            found = value_of(scope, item.value if isinstance(item, ast.Starred) else item)
            parts += opencv.items(found) if isinstance(item, ast.Starred) else [found]
            if isinstance(item, ast.Starred) and not opencv.items(found):
                raise ByHand("a sequence of unknown length is unpacked", node)
        return tuple_of(parts)
    return tuple_of([value_of(scope, item) for item in node.elts])


def _comprehension(scope: Scope, node: Any) -> Expr:
    from epypes.cpp import loops

    return loops.comprehension(scope, node)


def _list(scope: Scope, node: Any) -> Expr:
    parts = [value_of(scope, item) for item in node.elts]
    return list_of(scope, parts, node)


def list_of(scope: Scope, parts: list[Expr], node: ast.expr) -> Expr:
    """Return a list that is written out."""
    origin = (node.lineno, node.col_offset)
    kind = scope.refined.get(origin, t.NONE)
    try:
        for part in parts:
            kind = joined(part.type, kind, node) if kind != t.NONE else t.kept(part.type)
    except ByHand:
        # Only what makes an array of its items takes it.
        return Expr("", t.ListType(t.NONE, origin=origin), parts=tuple(parts))
    whole = t.ListType(kind, origin=origin)
    if kind == t.NONE:
        return Expr("{}", whole, parts=())
    if isinstance(kind, t.ArrayType) and not kind.is_mat:
        parts = [arrays.as_array(part, node) for part in parts]
    return Expr(f"{whole.cpp}{{{', '.join(part.text for part in parts)}}}", whole, parts=tuple(parts))


def joined(left: t.Type, right: t.Type, node: Any) -> t.Type:
    """Return the type of what is one or the other; numbers of different types have none, since Python keeps both."""
    try:
        found = t.join(left, right)
    except TypeError as error:
        raise ByHand(f"a value is one of {error}", node) from None
    if found.cpp in (left.cpp, right.cpp):
        return found
    raise ByHand(f"a value is {t.describe(left)} or {t.describe(right)}", node)


# -- operators ---------------------------------------------------------------------------------------------------------


def widened(given: Expr) -> Expr:
    """Return a number as C++ calculates with it: an int, a truth value or a literal becomes an integer of 64 bits."""
    if given.type == t.BOOL:
        return Expr(f"std::int64_t{{{given.text}}}", t.Int(0, 1))
    if isinstance(given.type, t.Int) and given.type.is_int and given.value is UNKNOWN:
        return replace(
            given, text=f"std::int64_t{{{given.text}}}", is_atom=True, type=replace(given.type, is_int=False)
        )
    return given


def binary(operator: ast.operator, left: Expr, right: Expr, node: Any) -> Expr:
    """Return the result of an operator."""
    if left.value is not UNKNOWN and right.value is not UNKNOWN and left.parts is None and right.parts is None:
        return _folded(operator, left, right, node)
    if is_of_numpy(left) or is_of_numpy(right):
        return arrays.binary(operator, left, right, node)
    if not all(isinstance(side.type, t.Int) or side.type in (t.FLOAT, t.BOOL) for side in (left, right)):
        raise ByHand(f"{t.describe(left.type)} {type(operator).__name__} {t.describe(right.type)}", node)
    if left.type == right.type == t.BOOL and isinstance(operator, ast.BitAnd | ast.BitOr | ast.BitXor):
        return Expr(f"static_cast<bool>({left.atom} {t.operator(operator)['sign']} {right.atom})", t.BOOL)
    return _of_numbers(operator, left, right, node)


def is_of_numpy(given: Expr) -> bool:
    """Whether NumPy calculates with a value: an array, or a number of a dtype."""
    return isinstance(given.type, t.ArrayType) or bool(given.type.dtype)


def _folded(operator: ast.operator, left: Expr, right: Expr, node: Any) -> Expr:
    """Return the result of an operator on constants; names of OpenCV's remain where C++ calculates the same."""
    text = ast.unparse(ast.BinOp(ast.Constant(0), operator, ast.Constant(0))).strip("0 ")
    try:
        value = eval(f"left {text} right", {"left": left.value, "right": right.value})  # noqa: S307
    except Exception as error:
        raise ByHand(f"{type(error).__name__}: {error}", node) from None
    kind = t.type_of(value)
    if kind == t.FLOAT and "CV_PI" in left.text + right.text and text in ("*", "/"):
        return Expr(f"{left.atom} {text} {right.atom}", kind, value, is_atom=False)
    if "cv::" in left.text + right.text and text in ("+", "|") and isinstance(kind, t.Int):
        return Expr(f"{left.atom} {text} {right.atom}", t.Int(value, value, is_int=True), value, is_atom=False)
    return written(value, "", node)


def _of_numbers(operator: ast.operator, left: Expr, right: Expr, node: Any) -> Expr:
    """Return the result of an operator on Python's numbers: by C++'s own where that gives the same for all values."""
    left, right, table = widened(left), widened(right), t.operator(operator)
    name, sign, is_float = table.get("python"), table.get("sign"), t.FLOAT in (left.type, right.type)
    kind: t.Type = t.FLOAT
    if is_float:
        refuse(name is None or name.startswith("shift"), f"{type(operator).__name__} of floats", node)
        is_plain = sign in ("+", "-", "*") or (isinstance(operator, ast.Div) and right.value not in (UNKNOWN, 0))
    else:
        low, high = _range(operator, left.type, right.type)
        refuse(isinstance(operator, ast.Pow) and right.type.low < 0, "a power whose exponent may be negative", node)
        is_plain = sign is not None and low >= t.LOW and high <= t.HIGH
        kind = t.FLOAT if isinstance(operator, ast.Div) else t.Int(max(low, t.LOW), min(high, t.HIGH))
    if is_plain:
        return Expr(f"{left.atom} {sign or '/'} {right.atom}", kind, is_atom=False)
    return Expr(f"python::{name}({left.text}, {right.text})", kind)


def _range(operator: ast.operator, one: t.Int, other: t.Int) -> tuple[int, int]:
    """Return the least and the largest result of an operator on integers."""
    calculate = {ast.Add: int.__add__, ast.Sub: int.__sub__, ast.Mult: int.__mul__}.get(type(operator))
    if calculate is not None:
        ends = [calculate(a, b) for a in (one.low, one.high) for b in (other.low, other.high)]
        return min(ends), max(ends)
    if other.low > 0 and isinstance(operator, ast.FloorDiv):
        return min(one.low, 0), max(one.high, 0)
    if other.low >= (0 if isinstance(operator, ast.BitAnd) else 1) and isinstance(operator, ast.Mod | ast.BitAnd):
        return 0, other.high
    return t.LOW, t.HIGH


def _binary(scope: Scope, node: Any) -> Expr:
    left = value_of(scope, node.left)
    return binary(node.op, left, value_of(scope, node.right), node)


def _unary(scope: Scope, node: Any) -> Expr:
    if isinstance(node.op, ast.Not):
        found = condition(scope, node.operand)
        value = UNKNOWN if found.value is UNKNOWN else not found.value
        return Expr(f"!{found.atom}", t.BOOL, value)
    given = value_of(scope, node.operand)
    if is_of_numpy(given):
        return arrays.calculate(t.operator(node.op)["numpy"], [given], node)
    if given.value is not UNKNOWN and isinstance(node.op, ast.USub) and is_number(given.type):
        return written(-given.value, "", node)
    refuse(given.type != t.FLOAT and not isinstance(widened(given).type, t.Int), f"{ast.unparse(node):.60}", node)
    whole = widened(given)
    if isinstance(node.op, ast.UAdd):
        return whole
    if given.type == t.FLOAT:
        refuse(isinstance(node.op, ast.Invert), "~ of a float", node)
        return Expr(f"-{given.atom}", t.FLOAT, is_atom=False)
    if isinstance(node.op, ast.Invert):
        return Expr(f"~{whole.atom}", t.Int(-whole.type.high - 1, -whole.type.low - 1), is_atom=False)
    return binary(ast.Sub(), written(0, "", node), whole, node)


def _compare(scope: Scope, node: Any) -> Expr:
    sides = [translate(scope, node.left)]
    for index, each in enumerate(node.comparators):
        # What follows a comparison that is false is not evaluated.
        sides.append(
            translate(scope, each) if index == 0 else scope.captured(functools.partial(translate, scope, each))
        )
    if len(node.ops) > 1 and not sides[1].name and sides[1].value is UNKNOWN:
        refuse(len(node.ops) > 2, "a chain of more than two comparisons", node)
        sides[1] = scope.hold("middle", sides[1])
    found = [_compared(scope, operator, *pair, node) for operator, pair in zip(node.ops, pairwise(sides), strict=True)]
    if len(found) == 1:
        return found[0]
    refuse(any(each.type != t.BOOL for each in found), "a chain of comparisons of arrays", node)
    return Expr(" && ".join(each.text for each in found), t.BOOL, is_atom=False)


def _compared(scope: Scope, operator: ast.cmpop, left: Expr, right: Expr, node: Any) -> Expr:
    if isinstance(operator, ast.Is | ast.IsNot):
        return _is_none(left, right, node, is_not=isinstance(operator, ast.IsNot))
    if isinstance(operator, ast.In | ast.NotIn):
        return _contained(scope, left, right, node, is_not=isinstance(operator, ast.NotIn))
    sign = t.operator(operator)["sign"]
    if is_of_numpy(left) or is_of_numpy(right):
        return arrays.calculate(t.operator(operator)["numpy"], [left, right], node)
    if left.parts is not None or right.parts is not None or isinstance(left.type, t.TupleType):
        one, other = opencv.items(left), opencv.items(right)
        if isinstance(operator, ast.Eq) and len(one) == len(other) > 0:
            each = [_compared(scope, operator, *pair, node) for pair in zip(one, other, strict=True)]
            return Expr(" && ".join(part.text for part in each), t.BOOL, is_atom=False)
        raise ByHand("tuples are compared", node)
    if left.type == right.type == t.TEXT:
        sides = [f"std::string({side.text})" if side.value is not UNKNOWN else side.text for side in (left, right)]
        return Expr(f"{sides[0]} {sign} {sides[1]}", t.BOOL, is_atom=False)
    if not is_number(left.type) or not is_number(right.type):
        raise ByHand(f"{t.describe(left.type)} {sign} {t.describe(right.type)}", node)
    is_large = any(isinstance(side.type, t.Int) and not side.type.is_within(53) for side in (left, right))
    refuse(is_large and t.FLOAT in (left.type, right.type), "a float beside an integer of more than 53 bits", node)
    return Expr(f"{left.atom} {sign} {right.atom}", t.BOOL, is_atom=False)


def _is_none(left: Expr, right: Expr, node: Any, *, is_not: bool) -> Expr:
    refuse(right.value is not None, "objects are compared by `is`", node)
    if left.value is None:
        return written(not is_not, "", node)
    refuse(isinstance(left.type, t.OptionalType), f"a value that is {t.describe(left.type)}", node)
    kind = left.type
    if isinstance(kind, t.ArrayType) and kind.is_mat and not kind.is_readonly:
        # What OpenCV makes may be empty, of which Python has None, also where no table says so.
        return Expr(f"{'!' if is_not else ''}{left.atom}.empty()", t.BOOL)
    if isinstance(kind, t.ArrayType) and kind.is_mat and (kind.is_nullable or not kind.dtype):
        return Expr(f"{'!' if is_not else ''}python::is_none({left.text})", t.BOOL)
    return written(is_not, "", node)


def _contained(scope: Scope, left: Expr, right: Expr, node: Any, *, is_not: bool) -> Expr:
    refuse(not right.parts, "`in` of a value that is not written out", node)
    each = [_compared(scope, ast.Eq(), left, part, node) for part in right.parts or ()]
    text = " || ".join(part.text for part in each)
    return Expr(f"!({text})" if is_not else text, t.BOOL, is_atom=is_not)


def condition(scope: Scope, node: ast.expr) -> Expr:
    """Return whether Python takes a value as true."""
    if isinstance(node, ast.BoolOp):
        return _joined_sides(scope, node, lambda each: condition(scope, each))
    given = translate(scope, node)
    if given.type == t.BOOL:
        return given
    if given.value is not UNKNOWN and given.text and given.parts is None:
        return written(bool(given.value), "", node)
    if isinstance(given.type, t.ListType) or given.type == t.TEXT:
        return Expr(f"!{given.atom}.empty()", t.BOOL)
    if is_number(given.type):
        return given if given.type.dtype == "bool" else Expr(f"{given.atom} != 0", t.BOOL, is_atom=False)
    raise ByHand(f"whether {t.describe(given.type)} is true", node)


def _bool_op(scope: Scope, node: Any) -> Expr:
    """Return what `and` or `or` gives of truth values: Python returns the last side that it looks at."""

    def side(each: ast.expr) -> Expr:
        found = value_of(scope, each)
        refuse(found.type != t.BOOL, "`and` or `or` of values that are no truth values", each)
        return found

    return _joined_sides(scope, node, side)


def _joined_sides(scope: Scope, node: ast.BoolOp, side: Callable[[ast.expr], Expr]) -> Expr:
    is_and = isinstance(node.op, ast.And)
    saved = dict(scope.env)
    parts = [side(node.values[0])]
    for before, each in pairwise(node.values):
        if parts[-1].value is not UNKNOWN and parts[-1].value is not is_and:
            break
        narrow_names(scope, before, is_true=is_and)
        parts.append(scope.captured(functools.partial(side, each)))
    scope.env = saved
    known = [part for part in parts if part.value is UNKNOWN or part.value is not is_and]
    if not known:
        return written(is_and, "", node)
    if known[0].value is not UNKNOWN:
        return known[0]
    joiner = " && " if is_and else " || "
    return Expr(joiner.join(part.atom for part in known), t.BOOL, is_atom=len(known) == 1 and known[0].is_atom)


def narrow_names(scope: Scope, test: ast.expr, *, is_true: bool) -> None:
    """Take over what a test says of None: where ``x is not None`` holds, x is a value."""
    if isinstance(test, ast.UnaryOp) and isinstance(test.op, ast.Not):
        narrow_names(scope, test.operand, is_true=not is_true)
        return
    if isinstance(test, ast.BoolOp) and isinstance(test.op, ast.And) == is_true:
        for each in test.values:
            narrow_names(scope, each, is_true=is_true)
        return
    if not (isinstance(test, ast.Compare) and len(test.ops) == 1 and isinstance(test.left, ast.Name)):
        return
    is_none = isinstance(test.comparators[0], ast.Constant) and test.comparators[0].value is None
    bound = scope.env.get(test.left.id)
    if not is_none or bound is None or not isinstance(test.ops[0], ast.Is | ast.IsNot):
        return
    if isinstance(test.ops[0], ast.IsNot) == is_true and isinstance(bound.type, t.ArrayType):
        scope.env[test.left.id] = replace(bound, type=replace(bound.type, is_nullable=False))


def _if_exp(scope: Scope, node: Any) -> Expr:
    test = condition(scope, node.test)
    if test.value is not UNKNOWN:
        return value_of(scope, node.body if test.value else node.orelse)
    saved = dict(scope.env)
    narrow_names(scope, node.test, is_true=True)
    one = scope.captured(lambda: value_of(scope, node.body))
    scope.env = dict(saved)
    narrow_names(scope, node.test, is_true=False)
    other = scope.captured(lambda: value_of(scope, node.orelse))
    scope.env = saved
    kind = joined(one.type, other.type, node)
    if isinstance(kind, t.ArrayType) and not kind.is_mat:
        one, other = arrays.as_array(one, node), arrays.as_array(other, node)
    if isinstance(kind, t.Int):
        kind = replace(kind, is_int=False)
        one, other = (side if side.type.cpp == "std::int64_t" else widened(side) for side in (one, other))
    if kind == t.TEXT:
        one, other = (replace(side, text=f"std::string({side.text})", is_atom=True) for side in (one, other))
    return Expr(f"{test.atom} ? {one.atom} : {other.atom}", kind, is_atom=False)


# -- subscripts and calls ----------------------------------------------------------------------------------------------


def _subscript(scope: Scope, node: Any) -> Expr:
    owner = translate(scope, node.value)
    if isinstance(owner.type, t.ArrayType):
        return arrays.subscript(scope, owner, node.slice, node)
    if isinstance(owner.type, t.RecordType) and owner.type.name == "Moments" and isinstance(node.slice, ast.Constant):
        return Expr(f"{owner.atom}.{node.slice.value!s}", t.FLOAT)
    if isinstance(node.slice, ast.Slice):
        return _sliced(scope, owner, node)
    index = value_of(scope, node.slice)
    refuse(not isinstance(index.type, t.Int), f"an index that is {t.describe(index.type)}", node)
    if isinstance(owner.type, t.TupleType):
        parts = opencv.items(owner)
        if owner.name == "shape of unknown length" and index.value not in (0, 1):
            raise ByHand("the dimensions of an array are not known", node)
        if type(index.value) is not int or not -len(parts) <= index.value < len(parts):
            raise ByHand("an index into a tuple that is not written out", node)
        return parts[index.value]
    if isinstance(owner.type, t.ListType) and owner.type.item != t.NONE:
        return Expr(f"python::at({owner.text}, {index.text})", owner.type.item)
    raise ByHand(f"an item of {t.describe(owner.type)}", node)


def _sliced(scope: Scope, owner: Expr, node: ast.Subscript) -> Expr:
    part = node.slice
    if isinstance(owner.type, t.TupleType) and isinstance(part, ast.Slice):
        bounds = [None if each is None else value_of(scope, each).value for each in (part.lower, part.upper, part.step)]
        if any(each is UNKNOWN for each in bounds) or (
            owner.name == "shape of unknown length" and bounds != [None, 2, None]
        ):
            raise ByHand("a slice of a tuple that is not written out", node)
        return tuple_of(opencv.items(owner)[slice(*bounds)])
    if not isinstance(owner.type, t.ListType) or not isinstance(part, ast.Slice) or part.step is not None:
        raise ByHand(f"a slice of {t.describe(owner.type)}", node)
    ends = [value_of(scope, end) if end is not None else None for end in (part.lower, part.upper)]
    if any(end is not None and not isinstance(end.type, t.Int) for end in ends):
        raise ByHand("a slice whose ends are no integers", node)
    low, high = (
        end.text if end is not None else default for end, default in zip(ends, ("0", "python::end"), strict=True)
    )
    return Expr(f"python::slice({owner.text}, {low}, {high})", owner.type)


def arguments(scope: Scope, node: Any) -> tuple[list[Expr], dict[str, Expr]]:
    """Return the arguments of a call, those by position and those by name."""
    if any(isinstance(arg, ast.Starred) for arg in node.args) or any(keyword.arg is None for keyword in node.keywords):
        raise ByHand("a call with * or **", node)
    given = [translate(scope, arg) for arg in node.args]
    return given, {str(keyword.arg): translate(scope, keyword.value) for keyword in node.keywords}


def _call(scope: Scope, node: Any, hint: tuple[str, ...]) -> Expr:
    if isinstance(node.func, ast.Attribute):
        owner = translate(scope, node.func.value)
        if owner.text or owner.type != t.NONE:
            return _method(scope, node, owner, hint)
        if isinstance(owner.value, type) and owner.value.__module__.startswith("cv2"):
            return opencv.call(scope, node, node.func.attr, arguments(scope, node), hint, owner=owner.value.__name__)
    function = translate(scope, node.func).value
    from epypes.cpp import loops
    from epypes.cpp import numpy as functions

    if getattr(function, "__module__", "") == "builtins":
        if function is bool and len(node.args) == 1:
            return condition(scope, node.args[0])
        return loops.call(scope, str(getattr(function, "__name__", "")), node)
    module, name = str(getattr(function, "__module__", "") or ""), str(getattr(function, "__name__", ""))
    if isinstance(function, types.FunctionType) and not module.startswith(("cv2", "numpy", "math")):
        return _own(scope, function, node)
    if module == "math" or getattr(math, name, None) is function:
        return loops.of_math(scope, name, node)
    if module.startswith("cv2") or getattr(sys.modules.get("cv2"), name, None) is function:
        if isinstance(function, type):
            return opencv.call(scope, node, "__init__", arguments(scope, node), hint, owner=name)
        owner_name, _, method = name.rpartition("_")
        if method == "create" and owner_name and not opencv.overloads(name):
            return opencv.call(scope, node, "create", arguments(scope, node), hint, owner=owner_name)
        return opencv.call(scope, node, name, arguments(scope, node), hint)
    if module.startswith("numpy") or type(function).__module__.startswith("numpy"):
        return functions.call(scope, function, name, node)
    raise ByHand(f"{ast.unparse(node.func)} is neither of OpenCV nor of NumPy, nor a function of yours", node)


def _own(scope: Scope, function: types.FunctionType, node: Any) -> Expr:
    given, named = arguments(scope, node)
    code = function.__code__
    names = code.co_varnames[: code.co_argcount]
    defaults = dict(zip(names[::-1], (function.__defaults__ or ())[::-1], strict=False))
    bound = dict(zip(names, given, strict=False)) | named
    if len(given) > len(names) or bound.keys() - {*names} or code.co_flags & 0x0C or code.co_kwonlyargcount:
        own = str(scope.names.get("__name__")).partition(".")[0]
        refuse(function.__module__.partition(".")[0] != own, no_counterpart(function), node)
        raise ByHand(f"{function.__name__} has *, ** or keyword-only parameters, or gets arguments that it lacks", node)
    for name in names:
        if name not in bound:
            refuse(name not in defaults, f"{function.__name__} needs {name!r}", node)
            bound[name] = written(defaults[name], name, node)
    refuse(any(not bound[name].text for name in names), f"{function.__name__} takes a function", node)
    cpp, kind = scope.functions(function, [foreign(bound[name].type) for name in names], node)
    texts = [bound[name].text for name in names if bound[name].type != t.NONE]
    return Expr(f"{cpp}({', '.join(texts)})", kind)


def foreign(kind: t.Type) -> t.Type:
    """Return the type of an argument: a list that another function has made, which nothing may change."""
    if isinstance(kind, t.ListType):
        return t.ListType(foreign(kind.item), kind.is_tuple)
    return t.TupleType(tuple(map(foreign, kind.items))) if isinstance(kind, t.TupleType) else kind


def _method(scope: Scope, node: Any, owner: Expr, hint: tuple[str, ...]) -> Expr:
    name = node.func.attr if isinstance(node.func, ast.Attribute) else ""
    if isinstance(owner.type, t.RecordType) and owner.type.is_pointer:
        return opencv.call(scope, node, name, arguments(scope, node), hint, this=owner, owner=owner.type.name)
    if is_of_numpy(owner):
        from epypes.cpp import numpy as functions

        return functions.method(scope, owner, name, node)
    raise ByHand(f"the method {name!r} of {t.describe(owner.type)}", node)


_TRANSLATORS: Final[Mapping[type, Callable[[Scope, Any], Expr]]] = {
    ast.Constant: _constant,
    ast.Name: _name,
    ast.Attribute: _attribute,
    ast.Tuple: _tuple,
    ast.List: _list,
    ast.ListComp: _comprehension,
    ast.JoinedStr: _joined_text,
    ast.BinOp: _binary,
    ast.UnaryOp: _unary,
    ast.Compare: _compare,
    ast.BoolOp: _bool_op,
    ast.IfExp: _if_exp,
    ast.Subscript: _subscript,
}
