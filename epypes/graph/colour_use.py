"""Colour use of a function: the order of colours in which it surely takes, passes on or makes images, read from source.

Names say it: the conversions of OpenCV and of scikit-image, and Matplotlib's imshow, which shows RGB. ``COLOR_BGR2RGB``
and ``COLOR_RGB2BGR`` are one operation, and programs exchange the names: what they say is a hint, not sure. No library
is imported.

The body is followed statement by statement, with what each local name surely is. What is done in one branch only, in a
loop or in a nested function says nothing, unless the branch depends on the shape or dtype of an array alone.
"""

from __future__ import annotations

import ast
import re
import sys
from collections import defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache, partial
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Final
from weakref import WeakKeyDictionary

from epypes.graph.identity import unwrapped
from epypes.graph.source import Definition, argument_names, definition_of
from epypes.images import Order

# A user's function may call another, and that another.
_DEEPEST: Final = 3
_CACHE: Final = type(lru_cache(len))


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


_SPACES: Final = _words("hed hsv lab luv rgbcie xyz ycbcr ydbdr yiq ypbpr yuv")
_TO_RGB: Final = {f"{space}2rgb" for space in _SPACES} | {"label2rgb", "combine_stains"}
_OF_RGB: Final = {f"rgb2{space}" for space in _SPACES} | {"rgb2gray", "separate_stains"}
# A function whose code has none of these names tells nothing, unless one that it calls does.
_TELLING: Final = _TO_RGB | _OF_RGB | {"cvtColor", "imread", "imshow"}
_CONVERSION: Final = re.compile(r"cv2\.COLOR_([A-Za-z]+?)2([A-Za-z]\w*)")
_CHANNELS: Final[Mapping[str, Order]] = {"BGR": "bgr", "BGRA": "bgr", "RGB": "rgb", "RGBA": "rgb"}
# Of their first argument they return an image with the same channels.
_PASSED_ON: Final[Mapping[str, frozenset[str]]] = {
    "cv2": _words(
        """GaussianBlur addWeighted bilateralFilter bitwise_and blur boxFilter convertScaleAbs copyMakeBorder dilate
        edgePreservingFilter erode fastNlMeansDenoisingColored filter2D flip getRectSubPix medianBlur morphologyEx
        pyrDown pyrUp remap resize rotate undistort warpAffine warpPerspective"""
    ),
    "numpy": _words("array asarray ascontiguousarray clip copy flipud fliplr float32 float64 rot90 uint8"),
    "skimage": _words(
        """img_as_float img_as_float32 img_as_float64 img_as_ubyte img_as_uint rescale resize rgba2rgb
        rotate"""
    ),
    "matplotlib": frozenset(),
}
_PASSING_METHODS: Final = _words("astype clip copy")
_ABOUT_SHAPE: Final = re.compile(r"dtype|ndim|shape|size|u?int\d*|float\d*|bool_?")
_PASSED_CHANNELS: Final = (":", "0:", ":3", "0:3")


@dataclass(frozen=True, slots=True)
class TracedImage:
    """The image of an input, or one that is made in a known order.

    Attributes
    ----------
    place
        The place of the input that brings it; None if it is made, as BGR.
    is_swapped
        Whether red and blue are exchanged.
    """

    place: int | None
    is_swapped: bool = False


# What an expression is: a TracedImage; a tuple of values; the dotted name of a library's module, function or constant,
# "matplotlib" for any of its objects; a function of the user; None if nothing is known.
Value = object


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
        What the value is: a TracedImage, or a tuple of values; of anything else nothing is known.
    """

    taken: Mapping[int, Order] = field(default_factory=dict)
    hinted: Mapping[int, Order] = field(default_factory=dict)
    returned: Value = None


_NOTHING: Final = ColourUse()
# Weak, so that a function of a notebook that was defined again can go.
_READ: Final[WeakKeyDictionary[FunctionType, ColourUse]] = WeakKeyDictionary()


def opposite(order: Order) -> Order:
    """Return the other order."""
    return "rgb" if order == "bgr" else "bgr"


def may_tell(function: object, depth: int = _DEEPEST) -> bool:
    """Whether the names in a function's code may say an order; cheap, and without its source."""
    try:
        plain = function if type(function) is FunctionType else unwrapped(function)
        if not isinstance(plain, FunctionType):
            return isinstance(function, partial)
        names = plain.__code__.co_names
        if plain.__name__ in _TELLING or not _TELLING.isdisjoint(names):
            return True
        called = (found for name in names if type(found := plain.__globals__.get(name)) is FunctionType)
        return depth > 1 and any(each is not plain and may_tell(each, depth - 1) for each in called)
    except Exception:  # whatever an object's __getattr__ raises
        return False


def colour_use(function: object, inputs: int) -> ColourUse:
    """Return what a function with so many inputs surely does with orders of colours; never raises."""
    try:
        calls = _Calls(_DEEPEST + 1)
        return calls.use(calls.call(_value_of(function), [TracedImage(place) for place in range(inputs)], {}))
    except Exception:  # names of a user's function may mean any odd objects
        return _NOTHING


def _called(function: object) -> object:
    """Return the function that a node or a cache calls as it is."""
    for _ in range(_DEEPEST):
        kind = type(function)
        is_node = isinstance(getattr(kind, "__epypes_is_its_func__", None), property)
        if kind is not _CACHE and not (is_node and function.__epypes_is_its_func__):  # type: ignore[attr-defined]
            break
        function = vars(function)["__wrapped__"]
    return function


def _value_of(found: object, written: str = "") -> Value:
    """Return what an object is, which stands under a name in the source: its dotted name, if it is of a library."""
    found = _called(found)
    if isinstance(found, ModuleType):
        return found.__name__
    name = getattr(found, "__name__", written)
    if isinstance(found, BuiltinFunctionType | int) and getattr(sys.modules.get("cv2"), name, None) == found:
        return f"cv2.{name}"
    if isinstance(found, FunctionType | BuiltinFunctionType | type):
        library = str(found.__module__).partition(".")[0]
        return f"{library}.{name}" if library in _PASSED_ON else found
    return found if isinstance(found, MethodType | partial) else None


def _use_of(function: FunctionType, depth: int) -> ColourUse:
    known = _READ.get(function)
    if known is None and depth:
        known = _READ[function] = _NOTHING  # for a function that calls itself
        node = definition_of(function)
        if node is not None and not isinstance(node, ast.AsyncFunctionDef):
            known = _READ[function] = _FunctionBody(function, node, depth).read(node)
    return known or _NOTHING


def _swapped(value: Value) -> Value:
    return replace(value, is_swapped=not value.is_swapped) if isinstance(value, TracedImage) else None


def _with_inputs(value: Value, given: Mapping[int, Value]) -> Value:
    """Return what a function returns, which was given these values."""
    if isinstance(value, tuple):
        return tuple(_with_inputs(part, given) for part in value)
    if not isinstance(value, TracedImage) or value.place is None:
        return value
    image = given.get(value.place)
    return _swapped(image) if value.is_swapped else image


class _Calls:
    """The orders that calls show.

    Parameters
    ----------
    depth
        How deep calls are followed into functions of the user.
    """

    def __init__(self, depth: int) -> None:
        self._depth = depth
        self._taken: defaultdict[int, set[Order]] = defaultdict(set)
        self._hinted: defaultdict[int, set[Order]] = defaultdict(set)

    def use(self, returned: Value) -> ColourUse:
        """Return the orders of the inputs of which one is known: a function that takes both knows what it does."""
        taken, hinted = (
            {place: next(iter(orders)) for place, orders in found.items() if len(orders) == 1}
            for found in (self._taken, self._hinted)
        )
        return ColourUse(taken, hinted, returned)

    def call(self, function: Value, arguments: Sequence[Value], keywords: Mapping[str, Value]) -> Value:
        """Note what a call takes, and return what it makes."""
        match function:
            case str():
                return self._call_library(function, arguments, keywords)
            case MethodType():
                return self.call(_value_of(function.__func__), [None, *arguments], keywords)
            case partial(args=()):
                bound = {name: value if type(value) is int else None for name, value in function.keywords.items()}
                return self.call(_value_of(function.func), arguments, {**bound, **keywords})
            case FunctionType():
                use, code = _use_of(function, self._depth - 1), function.__code__
                places = {name: place for place, name in enumerate(code.co_varnames[: code.co_argcount])}
                given = dict(enumerate(arguments)) | {places[key]: keywords[key] for key in keywords if key in places}
                for orders, is_hint in ((use.taken, False), (use.hinted, True)):
                    for place, order in orders.items():
                        self._take(given.get(place), order, is_hint=is_hint)
                return _with_inputs(use.returned, given)
        return None

    def _call_library(self, full_name: str, arguments: Sequence[Value], keywords: Mapping[str, Value]) -> Value:
        library, name = full_name.partition(".")[0], full_name.rpartition(".")[2]
        named = (keywords[key] for key in ("src", "image", "X") if key in keywords)
        image = arguments[0] if arguments else next(named, None)
        if full_name == "cv2.cvtColor":
            return self._convert(image, arguments[1] if len(arguments) > 1 else keywords.get("code"))
        if full_name == "cv2.imread" and len(arguments) == 1 and not keywords:
            return TracedImage(None)
        if name in _PASSED_ON.get(library, ()):
            return image if isinstance(image, TracedImage) else None
        if library == "skimage" and "channel_axis" not in keywords:
            if name in _OF_RGB:
                self._take(image, "rgb")
            return TracedImage(None, is_swapped=True) if name in _TO_RGB else None
        if library == "matplotlib":
            if name == "imshow" and len(arguments) < 2 and "cmap" not in keywords:
                self._take(image, "rgb")
            return library
        return None

    def _convert(self, image: Value, code: Value) -> Value:
        """Note what a conversion of OpenCV takes, and return what it makes."""
        codes: Iterable[str] = [code] if isinstance(code, str) else []
        if type(code) is int:  # one number may have several names
            codes = [f"cv2.{name}" for name, number in vars(sys.modules["cv2"]).items() if number is code]
        made = {self._convert_by_name(image, *parts.groups()) for parts in map(_CONVERSION.fullmatch, codes) if parts}
        return made.pop() if len(made) == 1 else None

    def _convert_by_name(self, image: Value, of: str, to: str) -> Value:
        before, after = _CHANNELS.get(of), _CHANNELS.get(to.partition("_")[0])
        if before is not None:
            self._take(image, before, is_hint=after is not None)
            return None if after is None else _swapped(image) if before != after else image
        # OpenCV calls the patterns of sensors otherwise than their makers.
        return None if after is None or of == "GRAY" or of.startswith("Bayer") else TracedImage(None, after == "rgb")

    def _take(self, image: Value, order: Order, *, is_hint: bool = False) -> None:
        if isinstance(image, TracedImage) and image.place is not None:
            orders = self._hinted if is_hint else self._taken
            orders[image.place].add(opposite(order) if image.is_swapped else order)


# -- bodies -----------------------------------------------------------------------------------------------------------


class _FunctionBody(_Calls):
    """The body of a Python function, with what local names are."""

    def __init__(self, function: FunctionType, node: Definition, depth: int) -> None:
        super().__init__(depth)
        code = self._code = function.__code__
        self._globals = function.__globals__
        self._closure = dict(zip(code.co_freevars, function.__closure__ or (), strict=True))
        inputs = argument_names(node)[: code.co_argcount]
        self._names: dict[str, Value] = {name: TracedImage(place) for place, name in enumerate(inputs)}
        # Nothing is written into the arrays of inputs, which are read-only.
        self._untouched = set(inputs) - _stored(node)
        self._returned: set[Value] = set()

    def read(self, node: Definition) -> ColourUse:
        if isinstance(node, ast.Lambda):
            self._returned.add(self._value(node.body))
        else:
            self._follow(node.body)
        return self.use(self._returned.pop() if len(self._returned) == 1 else None)

    # -- expressions ----------------------------------------------------------------------------------------------

    def _value(self, expression: ast.expr) -> Value:
        """Return what an expression is, and note what the calls in it take."""
        match expression:
            case ast.Name(id=name):
                return self._value_of_name(name)
            case ast.Attribute(value=value, attr=name):
                owner = self._value(value)
                # A name that the code does not have is of a file that was changed since.
                return f"{owner}.{name}" if isinstance(owner, str) and name in self._code.co_names else None
            case ast.Call():
                return self._call(expression)
            case ast.Tuple(elts=elements):
                return tuple(map(self._value, elements))
            case ast.Subscript(value=value, slice=index):
                return _item(self._value(value), index)
            case ast.BinOp(left=left, right=right):
                images = [self._value(side) for side in (left, right) if not isinstance(side, ast.Constant)]
                return images[0] if len(images) == 1 and isinstance(images[0], TracedImage) else None
            case ast.NamedExpr(target=ast.Name(id=name), value=value):
                self._names[name] = self._value(value)
                return self._names[name]
            case ast.IfExp() | ast.BoolOp() | ast.Lambda():
                return None
            case ast.ListComp() | ast.SetComp() | ast.DictComp() | ast.GeneratorExp():
                return None
        for part in ast.iter_child_nodes(expression):
            if isinstance(part, ast.expr):
                self._value(part)
        return None

    def _value_of_name(self, name: str) -> Value:
        if name in self._code.co_cellvars:  # a nested function may change it
            return found if isinstance(found := self._names.get(name), str) else None
        if name in self._code.co_varnames:
            return self._names.get(name)
        return _value_of(self._closure[name].cell_contents if name in self._closure else self._globals.get(name), name)

    def _call(self, call: ast.Call) -> Value:
        function = self._value(call.func)
        arguments = [self._value(argument) for argument in call.args]
        keywords = {keyword.arg: self._value(keyword.value) for keyword in call.keywords}
        named = {key: value for key, value in keywords.items() if key is not None}
        if any(isinstance(argument, ast.Starred) for argument in call.args) or len(named) < len(keywords):
            return None
        if isinstance(call.func, ast.Attribute) and call.func.attr in _PASSING_METHODS:
            owner = self._value(call.func.value)
            if isinstance(owner, TracedImage):
                return owner
        made = self.call(function, arguments, named)
        if not named.keys().isdisjoint(("dst", "out")) or (function == "cv2.cvtColor" and len(arguments) > 2):
            self._forget_written()
            return None
        return made

    # -- statements -----------------------------------------------------------------------------------------------

    def _follow(self, statements: Iterable[ast.stmt]) -> bool:
        """Follow statements; return whether they end the call."""
        return any(map(self._ends, statements))

    def _ends(self, statement: ast.stmt) -> bool:
        match statement:
            case ast.Return(value=value):
                self._returned.add(self._value(value) if value is not None else None)
                return True
            case ast.Raise():
                return True
            case ast.Expr(value=value):
                self._value(value)
            case ast.Assign(targets=targets, value=value):
                made = self._value(value)
                for target in targets:
                    self._assign(target, made, value)
            case ast.AnnAssign(target=target, value=ast.expr() as value):
                self._assign(target, self._value(value), value)
            case ast.Import(names=names) | ast.ImportFrom(names=names):
                for alias in names:
                    self._import(alias, statement)
            case ast.With(items=items, body=body):
                for item in items:
                    self._names.update(dict.fromkeys(_stored(item)))
                return self._follow(body)
            case ast.If(test=test) if _is_about_shape(test):
                return self._branch(statement)
            case _:
                return self._skip(statement)
        return False

    def _assign(self, target: ast.expr, made: Value, value: ast.expr) -> None:
        match target:
            case ast.Name(id=name):
                self._names[name] = made
            case ast.Tuple(elts=elements) | ast.List(elts=elements):
                parts: Sequence[Value] = [made if made == "matplotlib" else None] * len(elements)
                if isinstance(made, tuple) and len(made) == len(elements):
                    parts = made
                for element, part in zip(elements, parts, strict=True):
                    self._assign(element, part, value)
            case ast.Attribute():
                pass
            case ast.Subscript() if _is_colour(value):
                pass  # it is drawn into
            case _:
                self._names.update(dict.fromkeys(_stored(target)))
                self._forget_written()

    def _import(self, alias: ast.alias, statement: ast.Import | ast.ImportFrom) -> None:
        name = alias.asname or alias.name.partition(".")[0]
        if isinstance(statement, ast.Import):
            self._names[name] = alias.name if alias.asname else name
        else:
            self._names[name] = None if statement.level else f"{statement.module}.{alias.name}"

    def _branch(self, statement: ast.If) -> bool:
        """Follow both branches; afterwards a name is what it is at the end of both."""
        before, ends = self._names, []
        for body in (statement.body, statement.orelse):
            self._names = dict(before)
            if not self._follow(body):
                ends.append(self._names)
        if ends:
            self._names = {name: value for name, value in ends[0].items() if ends[-1].get(name) == value}
        return not ends

    def _skip(self, statement: ast.stmt) -> bool:
        """Pass over a statement that is not done in every call, or repeatedly; with a return in it, nothing is sure."""
        parts = [*ast.walk(statement)]
        self._names.update(dict.fromkeys(_stored(statement)))
        if any(isinstance(part, ast.Subscript) and isinstance(part.ctx, ast.Store) for part in parts):
            self._forget_written()
        may_end = any(isinstance(part, ast.Return) for part in parts)
        if may_end:
            self._returned.add(None)
        return may_end

    def _forget_written(self) -> None:
        """Forget the images that can be written into: any of them may be what was written into just now."""
        for name, value in self._names.items():
            if name not in self._untouched and not isinstance(value, str):
                self._names[name] = None


def _item(value: Value, index: ast.expr) -> Value:
    """Return what a part of an image is: rows and columns keep the channels, ``[..., ::-1]`` exchanges them."""
    if not isinstance(value, TracedImage):
        return value if value == "matplotlib" else None
    axes = index.elts if isinstance(index, ast.Tuple) else [index]
    if axes and isinstance(axes[0], ast.Constant) and axes[0].value is Ellipsis:
        axes = [*[ast.Slice()] * (4 - len(axes)), *axes[1:]]
    if not 0 < len(axes) <= 3 or not all(isinstance(axis, ast.Slice) for axis in axes):
        return None
    channels = ast.unparse(axes[2]) if len(axes) == 3 else ":"
    if channels == "::-1":
        return _swapped(value)
    return value if channels in _PASSED_CHANNELS else None


def _is_about_shape(test: ast.expr) -> bool:
    """Whether a condition asks for the shape or dtype of arrays alone, or whether something is None."""
    match test:
        case ast.Compare(left=ast.Name(), ops=[ast.Is() | ast.IsNot()], comparators=[ast.Constant(value=None)]):
            return True
        case ast.Attribute(value=ast.Name(), attr=name):
            return _ABOUT_SHAPE.fullmatch(name) is not None
        case ast.Name(id=name):
            return name == "len"
        case ast.BoolOp() | ast.UnaryOp() | ast.Compare() | ast.Tuple() | ast.Subscript() | ast.Slice() | ast.Call():
            return all(_is_about_shape(part) for part in ast.iter_child_nodes(test) if isinstance(part, ast.expr))
    return isinstance(test, ast.Constant)


def _is_colour(value: ast.expr) -> bool:
    """Whether a value is a number or a tuple of numbers."""
    numbers = value.elts if isinstance(value, ast.Tuple | ast.List) else [value]
    return all(isinstance(number, ast.Constant) for number in numbers)


def _stored(node: ast.AST) -> set[str]:
    """Return the names that a part of a function assigns to, defines, imports or catches."""
    found: set[str] = set()
    for part in ast.walk(node):
        if isinstance(part, ast.Name) and not isinstance(part.ctx, ast.Load):
            found.add(part.id)
        found.update(name.partition(".")[0] for key in ("name", "asname", "rest") if (name := getattr(part, key, None)))
    return found
