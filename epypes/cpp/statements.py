"""Statements and whole functions."""

from __future__ import annotations

import ast
import builtins
import copy
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

from epypes.cpp import arrays, opencv
from epypes.cpp import types as t
from epypes.cpp.expressions import (
    arguments,
    binary,
    condition,
    joined,
    narrow_names,
    translate,
    value_of,
    widened,
    written,
)
from epypes.cpp.loops import for_statement, leave, while_statement
from epypes.cpp.scope import UNKNOWN, Binding, ByHand, Expr, Scope, names_in, refuse
from epypes.optional import optional_import

_ROUNDS: Final = 6
# The nodes that read a list without giving it a second name.
_READERS: Final = (
    ast.Attribute, ast.Subscript, ast.For, ast.comprehension, ast.Compare, ast.BoolOp, ast.UnaryOp, ast.If, ast.While,
    ast.Return
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Translated:
    """A function in C++: its lines between the braces, what it returns, and the names of its parameters."""

    lines: tuple[str, ...]
    returns: t.Type
    parameters: Mapping[str, str]


def function(
    node: ast.FunctionDef,
    names: Mapping[str, Any],
    given: Mapping[str, t.Type],
    functions: Callable[[Any, Sequence[t.Type], ast.AST], tuple[str, t.Type]],
    wanted: t.Type | None = None,
) -> Translated:
    """Translate a function for the types of its arguments.

    Parameters
    ----------
    node, names
        The function and its global names.
    given
        The types of its arguments by name; those of type None are no parameters in C++.
    functions
        Returns the C++ name and the return type of another function of the user.
    wanted
        The type that it has to return; without, what it returns decides.

    Raises
    ------
    ByHand
        It can't be translated.
    """
    node, imported = _without_imports(node, names)
    _check(node)
    refined: dict[tuple[int, int] | str, t.Type] = {}
    returned = wanted
    for _ in range(_ROUNDS):
        before = dict(refined), returned
        scope = Scope(node, {**names, **imported}, functions, refined)
        parameters = _begin(scope, given)
        try:
            body(scope, node.body, returned)
        except ByHand:
            if refined != before[0]:
                continue  # the next round knows what is in a list
            raise
        refuse(not scope.is_dead, "it may end without a return", node)
        for dtype, place in scope.unsure.items():
            # The caller of a function of the user may write to what that returns.
            is_written = wanted is None or scope.written & {dtype, ""}
            refuse(is_written, f"it may be a view in NumPy and a copy in C++, and {dtype} is written to", place)
        if wanted is None:
            kind = scope.returns[0] if scope.returns else t.NONE
            for other in scope.returns[1:]:
                kind = joined(kind, other, node)
            # While more becomes known of what is in lists, what it returns is not known yet.
            returned = t.kept(kind) if refined == before[0] else None
        if (refined, returned) == before and returned is not None:
            return Translated(tuple(scope.declare()), returned, parameters)
    raise ByHand("its types are not clear", node)


def _without_imports(node: ast.FunctionDef, names: Mapping[str, Any]) -> tuple[ast.FunctionDef, Mapping[str, Any]]:
    """Return a function without its import statements, and what these import."""
    found: dict[str, Any] = {}
    statements: list[ast.stmt] = []
    for each in node.body:
        inner = each.body if isinstance(each, ast.With) and _is_optional_import(each, names) else [each]
        for part in inner:
            if isinstance(part, ast.Import) and all(name.name in sys.modules for name in part.names):
                for name in part.names:
                    whole = name.name if name.asname else name.name.partition(".")[0]
                    found[name.asname or whole] = sys.modules[whole]
            elif isinstance(part, ast.ImportFrom) and not part.level and part.module in sys.modules:
                found |= {name.asname or name.name: getattr(sys.modules[part.module], name.name) for name in part.names}
            else:
                statements.append(part if inner == [each] else each)
    refuse(not statements, "it has no statements", node)
    plain = ast.FunctionDef(node.name, node.args, statements, [], node.returns)
    return _with_options(ast.copy_location(plain, node)), found


def _with_options(node: ast.FunctionDef) -> ast.FunctionDef:
    """Return a function in which a dict that only ``**`` reads stands as named arguments where it is read."""
    node = copy.deepcopy(node)
    stored = [each.id for each in names_in(node, ast.Store)]
    statement: Any
    for statement in [*node.body]:
        value, name = getattr(statement, "value", None), getattr(getattr(statement, "targets", [None])[0], "id", "")
        if not isinstance(value, ast.Dict) or not name or stored.count(name) != 1:
            continue
        calls = [each for each in ast.walk(node) if isinstance(each, ast.Call)]
        reads = [each for each in calls if any(_reads(part, name) for part in each.keywords)]
        loads = sum(each.id == name for each in names_in(node)) - 1
        changed = {each.id for each in names_in(value)} & {*stored}
        if loads == len(reads) and not changed and all(isinstance(key, ast.Constant) for key in value.keys):
            keys = [str(getattr(key, "value", "")) for key in value.keys]
            given = [ast.keyword(key, each) for key, each in zip(keys, value.values, strict=True)]
            for call in reads:
                call.keywords = [each for each in call.keywords if not _reads(each, name)] + given
            node.body.remove(statement)
    return node


def _reads(keyword: ast.keyword, name: str) -> bool:
    return keyword.arg is None and isinstance(keyword.value, ast.Name) and keyword.value.id == name


def _is_optional_import(node: ast.With, names: Mapping[str, Any]) -> bool:
    """Whether a block only imports, and says by EPypes' optional_import what is missing."""
    name = getattr(node.items[0].context_expr, "func", None)
    is_own = isinstance(name, ast.Name) and names.get(name.id) is optional_import
    return is_own and all(isinstance(each, ast.Import | ast.ImportFrom) for each in node.body)


def _check(node: ast.FunctionDef) -> None:
    arguments = node.args
    if arguments.vararg or arguments.kwarg or arguments.kwonlyargs or arguments.posonlyargs:
        raise ByHand("its parameters have *, ** or /", node)
    for each in ast.walk(node):
        kind = type(each).__name__
        refuse(kind.startswith("Yield"), "it is a generator", each)
        refused = t.data("python")["refused"].get(kind)
        refuse(refused, f"it has {refused}", each)
        if isinstance(each, ast.FunctionDef | ast.AsyncFunctionDef) and each is not node:
            raise ByHand("it has a function of its own", each)
        if isinstance(each, ast.Name) and isinstance(each.ctx, ast.Store) and hasattr(builtins, each.id):
            raise ByHand(f"it assigns {each.id!r}, which Python has itself", each)


def _begin(scope: Scope, given: Mapping[str, t.Type]) -> Mapping[str, str]:
    """Bind the arguments; return their names in C++."""
    cpp_names = {}
    for name, kind in given.items():
        if kind == t.NONE:
            scope.env[name] = Binding("{}", t.NONE, None, None)
            continue
        cpp_names[name] = scope.fresh(name)
        scope.env[name] = Binding(cpp_names[name], t.readonly(kind))
    for name, kind in given.items():
        if name in scope.stored and kind != t.NONE and not scope.is_simple(name):
            bound = scope.env[name]
            scope.assign(name, widened(Expr(bound.cpp, bound.type, name=name)), scope.node)
    return cpp_names


def body(scope: Scope, statements: Sequence[ast.stmt], returned: t.Type | None) -> None:
    """Translate statements up to the one after which no other runs."""
    for statement in statements:
        if scope.is_dead:
            return
        scope.statement = statement
        translator = _STATEMENTS.get(type(statement))
        if translator is None:
            raise ByHand("the statement has no translation", statement)
        translator(scope, statement, returned)


def _expression(scope: Scope, node: Any, returned: t.Type | None) -> None:
    if isinstance(node.value, ast.Constant):
        return  # a docstring
    refuse(not isinstance(node.value, ast.Call), "a statement that is an expression", node)
    if isinstance(node.value.func, ast.Attribute) and isinstance(node.value.func.value, ast.Name):
        owner = scope.env.get(node.value.func.value.id)
        if owner is not None and isinstance(owner.type, t.ListType):
            _list_method(scope, node.value, owner)
            return
    found = translate(scope, node.value)
    if found.text.endswith(")") and found.parts is None:
        scope.emit(f"static_cast<void>({found.text});")


def _list_method(scope: Scope, node: Any, owner: Binding) -> None:
    name, kind = node.func.value.id, owner.type
    refuse(kind.is_tuple or kind.origin == (0, 0), f"{name!r} is changed, which this function has not made", node)
    given, named = arguments(scope, node)
    refuse(named or len(given) != 1 or node.func.attr != "append", f"the method {node.func.attr!r} of a list", node)
    refuse(not given[0].text, f"{ast.unparse(node.args[0]):.40} in a list", node)
    _check_alias(scope, name, node)
    known, item = scope.refined.get(kind.origin, kind.item), t.kept(given[0].type)
    scope.refined[kind.origin] = item if known == t.NONE else joined(known, item, node)
    bound = scope.load(ast.Name(name, ast.Load(), lineno=node.lineno))
    if kind.item != t.NONE:  # else the next round knows the type
        scope.emit(f"{bound.text}.push_back({fitted(scope, given[0], kind.item, node)});")


def _check_alias(scope: Scope, name: str, node: Any) -> None:
    """Raise ByHand if a list that grows may have a second name: C++ copies it, and Python does not."""
    returned = {id(each.value) for each in ast.walk(scope.node) if isinstance(each, ast.Return)}
    new = stored = 0
    parent: Any
    child: Any
    for parent in ast.walk(scope.node):
        if isinstance(parent, ast.Assign | ast.AnnAssign):
            target: Any = parent.target if isinstance(parent, ast.AnnAssign) else parent.targets[0]
            made: Any = parent.value
            is_row = isinstance(target, ast.Tuple) and isinstance(made, ast.Tuple)
            pairs = zip(target.elts, made.elts, strict=False) if is_row else [(target, made)]
            new += sum(getattr(part, "id", "") == name and _is_new_list(scope, value) for part, value in pairs)
        for child in ast.iter_child_nodes(parent):
            if getattr(child, "id", "") != name:
                continue
            stored += isinstance(child.ctx, ast.Store)
            is_read = isinstance(parent, _READERS) or (isinstance(parent, ast.IfExp) and child is parent.test)
            is_read |= isinstance(parent, ast.List | ast.Tuple) and id(parent) in returned
            is_read |= isinstance(parent, ast.Call) and _is_library(scope, parent.func)
            is_alias = isinstance(child.ctx, ast.Load) and not is_read
            refuse(is_alias, f"the list {name!r} may have a second name", node)
    refuse(new != stored, f"the list {name!r} may have a second name", node)


def _is_new_list(scope: Scope, node: Any) -> bool:
    is_call = isinstance(node, ast.Call) and _is_library(scope, node.func)
    return isinstance(node, ast.List | ast.ListComp) or (is_call and getattr(node.func, "id", "") in ("list", "sorted"))


def _is_library(scope: Scope, function: Any) -> bool:
    """Whether a function is Python's own, or one of NumPy or OpenCV: none of these keeps a list."""
    root = function
    while isinstance(root, ast.Attribute):
        root = root.value
    name = getattr(root, "id", "")
    found = scope.names.get(name, getattr(builtins, name, None))
    return getattr(found, "__module__", getattr(found, "__name__", "")) in ("builtins", "numpy", "cv2")


def _assign(scope: Scope, node: Any, returned: t.Type | None) -> None:
    if node.value is None:
        return  # an annotation
    targets = getattr(node, "targets", None) or [node.target]
    target = targets[0]
    hint: tuple[str, ...] = ()
    if isinstance(target, ast.Name):
        hint = (target.id,)
    elif isinstance(target, ast.Tuple) and all(isinstance(each, ast.Name) for each in target.elts):
        hint = tuple(ast.unparse(each) for each in target.elts)
    is_row = isinstance(target, ast.Tuple) and isinstance(node.value, ast.Tuple) and len(targets) == 1
    if is_row and len(target.elts) == len(node.value.elts):
        _assign_each(scope, target, node.value, node)
        return
    value = translate(scope, node.value, hint)
    if len(targets) > 1:
        refuse(isinstance(value.type, t.ListType | t.TupleType), "several names for a list or a tuple", node)
        value = value if value.value is not UNKNOWN else scope.hold("value", value)
    for each in targets:
        _store(scope, each, value, node)


def _assign_each(scope: Scope, target: Any, value: Any, node: Any) -> None:
    """Assign side by side: all values are computed before the first is assigned."""
    found = [value_of(scope, each) for each in value.elts]
    names = {each.id for each in names_in(target)}
    read = {each.id for each in names_in(value)}
    if names & read or any(isinstance(each, ast.Subscript) for each in target.elts):
        for index, each in enumerate(found):
            if each.value is UNKNOWN:
                found[index] = scope.hold("next", each)
    for name, part in zip(target.elts, found, strict=True):
        _store(scope, name, part, node)


def _store(scope: Scope, target: ast.expr, value: Expr, node: Any) -> None:
    if isinstance(target, ast.Name):
        refuse(not value.text, f"{target.id!r} becomes a function or a module", node)
        if isinstance(value.type, t.ListType) and value.name and not value.type.is_tuple:
            raise ByHand(f"the list {value.name!r} has a second name", node)
        scope.assign(target.id, value, node)
    elif isinstance(target, ast.Tuple):
        parts = unpacked(scope, value, len(target.elts), node)
        for each, part in zip(target.elts, parts, strict=True):
            _store(scope, each, part, node)
    elif isinstance(target, ast.Subscript):
        _store_item(scope, target, value, node)
    else:
        raise ByHand(f"an assignment to {ast.unparse(target):.40}", node)


def unpacked(scope: Scope, value: Expr, count: int, node: Any) -> Sequence[Expr]:
    """Return the items of a value that is unpacked."""
    parts = opencv.items(value)
    if not parts and isinstance(value.type, t.ArrayType):
        return arrays.unpacked(scope, value, count, node)
    if not parts and isinstance(value.type, t.ListType) and value.type.item != t.NONE:
        name = value.text
        if not value.name:
            name = scope.hold("items", value).text
        scope.emit(f"python::check_size({name}, {count});")
        return [Expr(f"{name}[{index}]", value.type.item) for index in range(count)]
    refuse(len(parts) != count, f"{count} names for {t.describe(value.type)}", node)
    if value.parts is None and not value.name and isinstance(value.type, t.TupleType):
        return opencv.items(scope.hold("items", value))
    return parts


def _store_item(scope: Scope, target: ast.Subscript, value: Expr, node: Any) -> None:
    owner = value_of(scope, target.value)
    if isinstance(owner.type, t.ArrayType):
        arrays.store(scope, owner, target, value, node)
        return
    raise ByHand(f"an item of {t.describe(owner.type)} is assigned", node)


def _augmented(scope: Scope, node: Any, returned: t.Type | None) -> None:
    if isinstance(node.target, ast.Name):
        name = node.target.id
        left = scope.load(ast.Name(name, ast.Load(), lineno=node.lineno))
        right = value_of(scope, node.value)
        if isinstance(left.type, t.ArrayType):
            arrays.augmented(scope, left, node.op, right, node)
            return
        refuse(isinstance(left.type, t.ListType), "a list is extended by an operator", node)
        scope.assign(name, binary(node.op, left, right, node), node)
        return
    if isinstance(node.target, ast.Subscript):
        owner = value_of(scope, node.target.value)
        if isinstance(owner.type, t.ArrayType):
            arrays.augmented_item(scope, owner, node, value_of(scope, node.value))
            return
    raise ByHand(f"an assignment to {ast.unparse(node.target):.40}", node)


def _return(scope: Scope, node: Any, returned: t.Type | None) -> None:
    value = value_of(scope, node.value) if node.value is not None else written(None, "", node)
    if returned is not None:
        scope.emit(f"return {fitted(scope, value, returned, node)};")
    scope.returns.append(value.type)
    scope.is_dead = True


def fitted(scope: Scope, value: Expr, wanted: t.Type, node: Any) -> str:
    """Return a value as the type that a function has to return."""
    own = value.type
    if isinstance(wanted, t.ArrayType) and isinstance(own, t.ArrayType):
        return arrays.fitted(value, wanted, node)
    if value.value is None and (wanted == t.NONE or isinstance(wanted, t.OptionalType)):
        return "std::nullopt"
    if value.value is None and isinstance(wanted, t.ArrayType) and wanted.is_mat:
        return "cv::Mat()"
    if isinstance(wanted, t.OptionalType):
        return value.text if own == wanted else fitted(scope, value, wanted.item, node)
    if isinstance(wanted, t.TupleType) and isinstance(own, t.TupleType) and value.parts is None and not value.name:
        value = scope.hold("items", value)
    if isinstance(wanted, t.TupleType) and len(parts := opencv.items(value)) == len(wanted.items):
        texts = [fitted(scope, part, kind, node) for part, kind in zip(parts, wanted.items, strict=True)]
        return f"{wanted.cpp}{{{', '.join(texts)}}}"
    if isinstance(wanted, t.ListType) and value.parts is not None:
        texts = [fitted(scope, part, wanted.item, node) for part in value.parts]
        return f"{wanted.cpp}{{{', '.join(texts)}}}"
    if isinstance(wanted, t.Int) and isinstance(own, t.Int):
        return opencv.narrow(value) if wanted.is_int else value.text
    if wanted == t.MIXED and (own == t.FLOAT or own.dtype == "float64"):
        return value.text
    if wanted == t.MIXED and isinstance(own, t.Int) and own.is_within(53):
        return f"static_cast<double>({value.text})"
    inner = tuple(getattr(kind, "item", kind) for kind in (own, wanted))
    is_same = own.cpp == wanted.cpp and isinstance(inner[0], t.Int | t.ArrayType) and type(inner[0]) is type(inner[1])
    is_int64 = isinstance(own, t.Int) and wanted.dtype == "int64"
    refuse(
        own != wanted and not is_same and not is_int64,
        f"{t.describe(own)}, where {t.describe(wanted)} was recorded",
        node,
    )
    return value.text


def _if(scope: Scope, node: Any, returned: t.Type | None) -> None:
    test = condition(scope, node.test)
    if test.value is not UNKNOWN:
        body(scope, node.body if test.value else node.orelse, returned)
        return
    before = dict(scope.env)
    ends = []
    for head, statements, is_true in ((f"if ({test.text}) {{", node.body, True), ("} else {", node.orelse, False)):
        scope.env = dict(before)
        scope.is_dead = False
        narrow_names(scope, node.test, is_true=is_true)
        if statements:
            with scope.inside(head):
                body(scope, statements, returned)
        if not scope.is_dead:
            ends.append(scope.env)
    scope.merge(ends)


def _raise(scope: Scope, node: Any, returned: t.Type | None) -> None:
    error = node.exc
    call = error if isinstance(error, ast.Call) else ast.Call(error, [], [])
    name = getattr(call.func, "id", "")
    refuse(len(call.args) > 1 or call.keywords or node.cause or name in scope.locals, "an error of several parts", node)
    given = call.args[0] if call.args else ast.Constant("")
    message = ast.unparse(given)[2:-1] if isinstance(given, ast.JoinedStr) else getattr(given, "value", None)
    thrown = t.data("python")["errors"].get(name)
    refuse(not thrown or not isinstance(message, str), "an error that is no plain one of Python", node)
    scope.emit(f"throw {thrown}({t.quoted(str(message))});")
    scope.is_dead = True


def _assert(scope: Scope, node: Any, returned: t.Type | None) -> None:
    test = condition(scope, node.test)
    message = getattr(node.msg, "value", "") if node.msg is not None else ast.unparse(node.test)
    with scope.inside(f"if (!{test.atom}) {{"):
        scope.emit(f"throw std::logic_error({t.quoted(str(message))});")
    narrow_names(scope, node.test, is_true=True)


def _pass(scope: Scope, node: Any, returned: t.Type | None) -> None:
    return


_STATEMENTS: Final[dict[type, Callable[[Scope, Any, t.Type | None], None]]] = {
    ast.Expr: _expression,
    ast.Assign: _assign,
    ast.AnnAssign: _assign,
    ast.AugAssign: _augmented,
    ast.Return: _return,
    ast.If: _if,
    ast.Raise: _raise,
    ast.Assert: _assert,
    ast.Pass: _pass,
    ast.For: for_statement,
    ast.While: while_statement,
    ast.Break: leave,
    ast.Continue: leave,
}
