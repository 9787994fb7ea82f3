"""Colour use of a function: the order of colours in which it surely takes, passes on or makes images, read from source.

The body is followed statement by statement, with what each local name surely is: a parameter's image, perhaps with
red and blue exchanged, an image made in a certain order, or nothing known. What is done in one branch only, in a loop
or in a nested function says nothing, unless the branch depends on the shape or dtype of an array alone.
"""

from __future__ import annotations

import ast
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache, partial
from types import FunctionType, MethodType
from typing import Any, Final
from weakref import WeakKeyDictionary

from epypes.graph.colour_names import (
    PASSING_METHODS,
    PLOT,
    TELLING,
    ColourCalls,
    Passed,
    Seen,
    full_name,
    library_name,
    names_of_codes,
    swapped,
)
from epypes.graph.source import Definition, argument_names, definition_of
from epypes.images import Order

# A user's function may call another, and that another.
_DEEPEST: Final = 3
_CACHE: Final = type(lru_cache(len))
_ABOUT_SHAPE: Final = frozenset(("dtype", "ndim", "shape", "size"))


@dataclass(frozen=True, slots=True)
class ColourUse:
    """The orders of colours that a function surely uses.

    Attributes
    ----------
    taken
        By the place of an input, the order in which it is taken.
    hinted
        Likewise, where only a name says it, as ``COLOR_RGB2BGR`` does.
    returned
        What the value is.
    parts
        What its items are, if it is a tuple.
    """

    taken: Mapping[int, Order] = field(default_factory=dict)
    hinted: Mapping[int, Order] = field(default_factory=dict)
    returned: Seen = None
    parts: tuple[Seen, ...] = ()


_NOTHING: Final = ColourUse()
# Weak, so that a function of a notebook that was defined again can go.
_READ: Final[WeakKeyDictionary[FunctionType, ColourUse]] = WeakKeyDictionary()


def may_tell(function: object) -> bool:
    """Whether the names in a function's code may say an order; cheap, and without its source."""
    try:
        return _may_tell(_called(function), _DEEPEST)
    except Exception:  # whatever an object's __getattr__ raises
        return False


def _may_tell(function: object, depth: int) -> bool:
    if type(function) is not FunctionType:
        return isinstance(function, partial) or (isinstance(function, MethodType) and may_tell(function.__func__))
    names = function.__code__.co_names
    if not names or not depth:
        return False
    if not TELLING.isdisjoint(names) or function.__name__ in TELLING:
        return True
    around = function.__globals__
    called = (around[name] for name in names if type(around.get(name)) is FunctionType)
    return any(each is not function and _may_tell(each, depth - 1) for each in called)


def colour_use(function: object) -> ColourUse:
    """Return what a function surely does with orders of colours; never raises."""
    try:
        return _use_of(function, _DEEPEST)
    except Exception:  # names of a user's function may mean any odd objects
        return _NOTHING


def _use_of(function: object, depth: int) -> ColourUse:
    plain = _called(function)
    if isinstance(plain, MethodType):
        return _shifted(_use_of(plain.__func__, depth))
    if isinstance(plain, partial):
        return _use_of_partial(plain, depth)
    library, name = library_name(full_name(plain))
    if library == "skimage" or not isinstance(plain, FunctionType):
        return _use_of_library(library, name)
    known = _READ.get(plain)
    if known is None and depth:
        _READ[plain] = _NOTHING  # for a function that calls itself
        known = _READ[plain] = _read(plain, depth)
    return known or _NOTHING


def _called(function: object) -> object:
    """Return the function that a node or a cache calls as it is."""
    for _ in range(_DEEPEST):
        kind = type(function)
        is_node = isinstance(getattr(kind, "__epypes_is_its_func__", None), property)
        if kind is not _CACHE and not (is_node and function.__epypes_is_its_func__):  # type: ignore[attr-defined]
            break
        function = vars(function)["__wrapped__"]
    return function


def _shifted(use: ColourUse) -> ColourUse:
    """Return the use of a method, whose first parameter is bound."""

    def shift(seen: Seen) -> Seen:
        if not isinstance(seen, Passed):
            return seen
        return seen._replace(place=seen.place - 1) if seen.place else None

    return ColourUse(
        {place - 1: order for place, order in use.taken.items() if place},
        {place - 1: order for place, order in use.hinted.items() if place},
        shift(use.returned),
        tuple(map(shift, use.parts)),
    )


def _use_of_partial(function: partial[Any], depth: int) -> ColourUse:
    """Return the use of ``partial(cv2.cvtColor, code=...)`` or of a function with bound keywords."""
    if function.args:
        return _NOTHING
    if full_name(function.func) != "cv2.cvtColor":
        return _use_of(function.func, depth)
    names = names_of_codes().get(function.keywords.get("code", -1), ())
    body = ColourCalls({}, ())
    returned = {body.convert(Passed(0), name) for name in names}
    return ColourUse(body.agreed(body.taken), {}, returned.pop() if len(returned) == 1 else None)


def _use_of_library(library: str, name: str) -> ColourUse:
    body = ColourCalls({}, ())
    returned = body.library_call(library, name, [Passed(0)])
    return ColourUse(body.agreed(body.taken), {}, returned)


def _read(function: FunctionType, depth: int) -> ColourUse:
    node = definition_of(function)
    if node is None or isinstance(node, ast.AsyncFunctionDef):
        return _NOTHING
    body = _FunctionBody(function, node, depth)
    return ColourUse(body.agreed(body.taken), body.agreed(body.hinted), *body.value_returned())


# -- bodies -----------------------------------------------------------------------------------------------------------


class _FunctionBody(ColourCalls):
    """The body of a Python function."""

    def __init__(self, function: FunctionType, node: Definition, depth: int) -> None:
        code = function.__code__
        positional = argument_names(node)[: code.co_argcount]
        names: dict[str, Seen] = {name: Passed(place) for place, name in enumerate(positional)}
        super().__init__(names, range(len(positional)))
        self._code, self._depth, self._globals = code, depth, function.__globals__
        self._closure = dict(zip(code.co_freevars, function.__closure__ or (), strict=True))
        self._imported: dict[str, str] = {}
        # Nothing is written into the arrays of inputs, which are read-only.
        self._untouched = set(positional) - _stored(node)
        self._returned: list[tuple[Seen, tuple[Seen, ...]]] = []
        # Whether every call executes the statement that is looked at.
        self._is_sure = True
        if isinstance(node, ast.Lambda):
            self._returned.append(self._seen_with_parts(node.body))
        else:
            self._follow(node.body)

    def value_returned(self) -> tuple[Seen, tuple[Seen, ...]]:
        """Return what the value and its items are, the same at every return."""
        found = set(self._returned)
        return found.pop() if len(found) == 1 and self._is_sure else (None, ())

    def _object(self, expression: ast.expr) -> Any:
        """Return the object that a name outside of the function has; None for any other expression."""
        code = self._code
        if not isinstance(expression, ast.Name) or expression.id in (*code.co_varnames, *code.co_cellvars):
            return None
        if expression.id in self._closure:
            return self._closure[expression.id].cell_contents
        return self._globals.get(expression.id)

    def _full_name(self, expression: ast.expr) -> str:
        if isinstance(expression, ast.Name):
            found = self._imported.get(expression.id)
            return full_name(self._object(expression), expression.id) if found is None else found
        if isinstance(expression, ast.Attribute) and expression.attr in self._code.co_names:
            owner = self._full_name(expression.value)
            return owner and f"{owner}.{expression.attr}"
        return ""

    def _seen_with_parts(self, expression: ast.expr | None) -> tuple[Seen, tuple[Seen, ...]]:
        if isinstance(expression, ast.Tuple):
            return None, tuple(map(self._seen, expression.elts))
        return (None if expression is None else self._seen(expression)), ()

    def _seen(self, expression: ast.expr) -> Seen:
        """Return what an expression is, and note what the calls in it take."""
        match expression:
            case ast.Name(id=name):
                return None if name in self._code.co_cellvars else self.names.get(name)
            case ast.Call():
                return self._call(expression)
            case ast.Subscript(value=value, slice=index):
                return _of_item(self._seen(value), index)
            case ast.BinOp(left=left, right=right):
                sides = self._seen(left), self._seen(right)
                numbers = [isinstance(side, ast.Constant) for side in (left, right)]
                return sides[numbers.index(False)] if sum(numbers) == 1 else None
            case ast.NamedExpr(target=target, value=value):
                self.names[target.id] = self._seen(value)
                return self.names[target.id]
            case ast.IfExp() | ast.BoolOp() | ast.Lambda() | ast.ListComp() | ast.SetComp() | ast.DictComp():
                return None
            case ast.GeneratorExp():
                return None
        for part in ast.iter_child_nodes(expression):
            if isinstance(part, ast.expr):
                self._seen(part)
        return None

    def _call(self, call: ast.Call) -> Seen:
        images = [self._seen(argument) for argument in call.args]
        keywords = {keyword.arg or "**": self._seen(keyword.value) for keyword in call.keywords}
        library, name = library_name(self._full_name(call.func))
        if any(isinstance(argument, ast.Starred) for argument in call.args) or "**" in keywords:
            return None
        if library == "cv2" and name == "cvtColor":
            return self._conversion(call, images, keywords)
        if "dst" in keywords or "out" in keywords:
            self._forget()
            return None
        if library in {"cv2", "numpy", "skimage", PLOT}:
            first = [keywords[key] for key in ("src", "image", "X") if key in keywords and not images]
            return self.library_call(library, name, images or first, keywords)
        if isinstance(call.func, ast.Attribute):
            owner = self._seen(call.func.value)
            if owner == PLOT:
                return self.library_call(PLOT, name or call.func.attr, images, keywords)
            return owner if call.func.attr in PASSING_METHODS else None
        helper = self._object(call.func)
        return self._helper(helper, images, keywords) if isinstance(helper, FunctionType) else None

    def _conversion(self, call: ast.Call, images: Sequence[Seen], keywords: Mapping[str, Seen]) -> Seen:
        codes = [*call.args[1:2], *(each.value for each in call.keywords if each.arg == "code")]
        image = images[0] if images else keywords.get("src")
        library, name = library_name(self._full_name(codes[0]) if codes else "")
        made = self.convert(image, name) if library == "cv2" else None
        if len(images) > 2 or "dst" in keywords:
            self._forget()
            return None
        return made

    def _helper(self, function: FunctionType, images: Sequence[Seen], keywords: Mapping[str, Seen]) -> Seen:
        """Take what another function of the user takes, and return what it returns."""
        use = _use_of(function, self._depth - 1)
        code = function.__code__
        places = {name: place for place, name in enumerate(code.co_varnames[: code.co_argcount])}
        given = dict(enumerate(images)) | {places[key]: seen for key, seen in keywords.items() if key in places}
        for orders, is_hint in ((use.taken, False), (use.hinted, True)):
            for place, order in orders.items():
                self.take(given.get(place), order, is_hint=is_hint)
        if not isinstance(use.returned, Passed):
            return use.returned
        seen = given.get(use.returned.place)
        return swapped(seen) if use.returned.is_swapped else seen

    # -- statements ------------------------------------------------------------------------------------------------

    def _follow(self, statements: Iterable[ast.stmt]) -> bool:
        """Follow statements; return whether they end the call."""
        return any(not self._is_sure or self._ends(statement) for statement in statements)

    def _ends(self, statement: ast.stmt) -> bool:
        match statement:
            case ast.Return(value=value):
                self._returned.append(self._seen_with_parts(value))
                return True
            case ast.Raise():
                return True
            case ast.Expr(value=value):
                self._seen(value)
            case ast.Assign(targets=targets, value=value):
                self._assign(targets, value)
            case ast.AnnAssign(target=target, value=ast.expr() as value):
                self._assign([target], value)
            case ast.Import() | ast.ImportFrom():
                self._import(statement)
            case ast.With(items=items, body=body):
                self._forget(name for item in items for name in _stored(item))
                return self._follow(body)
            case ast.If(test=test) if _is_about_shape(test):
                return self._branch(statement)
            case ast.Assert() | ast.Pass() | ast.AnnAssign():
                pass
            case _:
                self._skip(statement)
        return False

    def _assign(self, targets: Sequence[ast.expr], value: ast.expr) -> None:
        seen, parts = self._seen_with_parts(value)
        for target in targets:
            match target:
                case ast.Name(id=name):
                    self.names[name] = seen
                    self._imported.pop(name, None)
                case ast.Tuple(elts=elements) | ast.List(elts=elements) if all(
                    isinstance(element, ast.Name) for element in elements
                ):
                    each = parts if len(parts) == len(elements) else (seen if seen == PLOT else None,) * len(elements)
                    self.names.update(zip((name.id for name in elements if isinstance(name, ast.Name)), each))  # noqa: B905
                case ast.Attribute():
                    pass
                case ast.Subscript() if _is_colour(value):
                    pass  # it is drawn into
                case _:
                    self._forget(_stored(target))
                    self._forget()

    def _import(self, statement: ast.Import | ast.ImportFrom) -> None:
        for alias in statement.names:
            if isinstance(statement, ast.Import):
                name = alias.name if alias.asname else alias.name.partition(".")[0]
                self._imported[alias.asname or name] = name
            elif statement.module and not statement.level:
                self._imported[alias.asname or alias.name] = f"{statement.module}.{alias.name}"

    def _branch(self, statement: ast.If) -> bool:
        """Follow both branches; afterwards a name is what it is at the end of both."""
        before = dict(self.names)
        if self._follow(statement.body):
            self.names = before
            return self._follow(statement.orelse)
        after, self.names = self.names, before
        if self._follow(statement.orelse):
            self.names = after
        else:
            self.names = {name: seen for name, seen in after.items() if self.names.get(name) == seen}
        return False

    def _skip(self, statement: ast.stmt) -> None:
        """Pass over a statement that is not done in every call, or done repeatedly."""
        self._forget(_stored(statement))
        parts = [*ast.walk(statement)]
        if any(isinstance(part, ast.Subscript) and isinstance(part.ctx, ast.Store) for part in parts):
            self._forget()
        if any(isinstance(part, ast.Return) for part in parts):
            self._is_sure = False

    def _forget(self, names: Iterable[str] | None = None) -> None:
        """Forget what names are; without names, of all whose arrays can be written into."""
        for name in [*self.names] if names is None else names:
            if names is not None or name not in self._untouched:
                self.names[name] = None
                self._imported.pop(name, None)


def _of_item(seen: Seen, index: ast.expr) -> Seen:
    """Return what a part of an image is: rows and columns keep the channels, ``[..., ::-1]`` exchanges them."""
    if seen == PLOT or not isinstance(seen, Passed | str):
        return seen
    axes = index.elts if isinstance(index, ast.Tuple) else [index]
    if not axes or len(axes) > 3:
        return None
    starts_with_rest = isinstance(axes[0], ast.Constant) and axes[0].value is Ellipsis
    if not all(isinstance(axis, ast.Slice) for axis in axes[starts_with_rest:]):
        return None
    last = axes[-1] if len(axes) == 3 or (starts_with_rest and len(axes) == 2) else None
    if not isinstance(last, ast.Slice):
        return seen if not starts_with_rest else None
    lower, upper, step = (ast.unparse(end) if end is not None else "" for end in (last.lower, last.upper, last.step))
    if (lower, upper, step) == ("", "", "-1"):
        return swapped(seen)
    return seen if lower in ("", "0") and upper in ("", "3") and not step else None


def _is_about_shape(test: ast.expr) -> bool:
    """Whether a condition asks for the shape or dtype of arrays alone, or whether something is None."""
    match test:
        case ast.BoolOp(values=values):
            return all(map(_is_about_shape, values))
        case ast.UnaryOp(op=ast.Not(), operand=operand):
            return _is_about_shape(operand)
        case ast.Compare(left=ast.Name(), ops=[ast.Is() | ast.IsNot()], comparators=[ast.Constant(value=None)]):
            return True
        case ast.Compare(left=left, comparators=others):
            return all(map(_is_shape_or_constant, [left, *others]))
    return False


def _is_shape_or_constant(expression: ast.expr) -> bool:
    match expression:
        case ast.Constant():
            return True
        case ast.Tuple(elts=elements):
            return all(map(_is_shape_or_constant, elements))
        case ast.Attribute(value=ast.Name(), attr=name):
            return name in _ABOUT_SHAPE or name.startswith(("uint", "int", "float", "bool"))
        case ast.Subscript(value=value):
            return _is_shape_or_constant(value)
        case ast.Call(func=ast.Name(id="len"), args=[argument]):
            return _is_shape_or_constant(argument)
        case ast.UnaryOp(operand=operand):
            return _is_shape_or_constant(operand)
    return False


def _is_colour(value: ast.expr) -> bool:
    """Whether a value is a number or a tuple of numbers."""
    numbers = value.elts if isinstance(value, ast.Tuple | ast.List) else [value]
    return all(isinstance(number, ast.Constant) for number in numbers)


def _stored(node: ast.AST) -> set[str]:
    """Return the names that a part of a function assigns to, or defines."""
    found: set[str] = set()
    for part in ast.walk(node):
        match part:
            case ast.Name(id=name, ctx=ast.Store() | ast.Del()):
                found.add(name)
            case ast.FunctionDef(name=name) | ast.AsyncFunctionDef(name=name) | ast.ClassDef(name=name):
                found.add(name)
            case ast.alias(name=name, asname=written):
                found.add(written or name.partition(".")[0])
    return found
