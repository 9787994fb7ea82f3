"""Calls of OpenCV: from the signatures of Python to those of C++.

The signatures are those of data/opencv.json; data/results.toml has what is known of the arrays that functions make.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.resources import files
from typing import Any, Final

from epypes.cpp import types as t
from epypes.cpp.scope import UNKNOWN, ByHand, Expr, Scope, refuse, tuple_of, writes

_INPUTS: Final = ("InputArray", "InputArrayOfArrays")
_NUMBERS: Final[Mapping[str, t.Type]] = {
    "int": t.INT, "bool": t.BOOL, "double": t.FLOAT, "float": t.FLOAT, "String": t.TEXT, "size_t": t.Int(0, 2**62)
}  # fmt: skip


@functools.cache
def table() -> Mapping[str, Any]:
    """Return the constants, functions and classes of OpenCV."""
    found: Mapping[str, Any] = json.loads((files("epypes.cpp") / "data" / "opencv.json").read_text("utf-8"))
    return found


def tuples() -> Mapping[str, Mapping[str, str]]:
    """Return the structures that are tuples in Python: the types of their members by name."""
    found: Mapping[str, Mapping[str, str]] = t.data("structures")["tuples"]
    return found


def constant(name: str) -> str | None:
    """Return the C++ name of a constant of cv2, which Python also has in capitals."""
    return _constants().get(name)


@functools.cache
def _constants() -> Mapping[str, str]:
    found: Mapping[str, str] = table()["constants"]
    return {**{name.upper(): text for name, text in found.items()}, **found}


def overloads(name: str, owner: str = "") -> Sequence[Mapping[str, Any]]:
    """Return the signatures of a function, or of a method of a class and its bases."""
    found: Sequence[Mapping[str, Any]] = () if owner else table()["functions"].get(name, ())
    while owner in table()["classes"]:
        entry = table()["classes"][owner]
        if name in entry["methods"]:
            found = entry["methods"][name]
            break
        owner = entry["base"]
    return found


def call(
    scope: Scope, node: Any, name: str, arguments: tuple[list[Expr], dict[str, Expr]], hint: Sequence[str] = (),
    this: Expr | None = None, owner: str = ""
) -> Expr:  # fmt: skip
    """Translate the call of a function, of a constructor or of a method of an object."""
    candidates = overloads(name, owner)
    refuse(not candidates, f"cv2.{owner + '.' if owner else ''}{name} is not in the table of OpenCV's functions", node)
    reason = ByHand(f"cv2.{name} has no form with these arguments in C++", node)
    for signature in candidates:
        bound = _bind(signature, *arguments)
        if bound is None:
            continue
        size = len(scope.block.items)
        try:
            return _Call(scope, node, name, signature, bound, hint, this).translate()
        except ByHand as error:
            del scope.block.items[size:]
            reason = error
    raise reason


def _bind(signature: Mapping[str, Any], given: Sequence[Expr], named: Mapping[str, Expr]) -> dict[str, Expr] | None:
    """Return the arguments by the names of the parameters; None if they don't fit."""
    order = signature["py"]
    bound = dict(zip(order, given, strict=False))
    if len(given) > len(order) or named.keys() & bound.keys() or named.keys() - {*order}:
        return None
    bound |= named
    return bound if bound.keys() >= {*order[: signature["needed"]]} else None


class _Call:
    """One call of one signature."""

    def __init__(
        self, scope: Scope, node: Any, name: str, signature: Mapping[str, Any], bound: Mapping[str, Expr],
        hint: Sequence[str], this: Expr | None
    ) -> None:  # fmt: skip
        self.scope, self.node, self.name, self.signature = scope, node, name, signature
        self.bound, self.this = bound, this
        self.outputs: list[Expr] = []
        # The lines after the call.
        self.after: list[str] = []
        outs = [arg for arg in signature["args"] if arg.get("direction", "in") != "in"]
        number = len(outs) + (signature["returns"] not in ("void", ""))
        self.hints = list(hint) if len(hint) == number else []
        if self.hints and number > len(outs):
            self.hints = self.hints[1:]

    def translate(self) -> Expr:
        texts = [self._argument(arg) for arg in self.signature["args"]]
        while texts and texts[-1] is None:
            texts.pop()
        for index, text in enumerate(texts):
            if text is None:
                texts[index] = self.signature["args"][index]["default"]
        name = self.signature["cpp"]
        if self.this is not None:
            name = f"{self.this.atom}->{name.rpartition('::')[2]}"
        text = f"({', '.join(map(str, texts))})"
        if self.name == "__init__":
            owner = self.signature["cpp"].rpartition("::")[0]
            kind = t.RecordType(owner.removeprefix("cv::"), is_pointer=True)
            return Expr(f"cv::makePtr<{owner}>{text}", kind)
        return self._result(f"{name}{text}")

    def _result(self, text: str) -> Expr:
        returns = self.signature["returns"]
        if returns == "void":
            self._emit(f"{text};")
            if not self.outputs:
                return Expr("", t.NONE, None)
            return self.outputs[0] if len(self.outputs) == 1 else tuple_of(self.outputs)
        kind = _NUMBERS.get(returns)
        if kind is not None and not self.outputs:
            return member(text, returns)
        if returns.startswith("Ptr<"):
            return Expr(text, t.RecordType(returns[4:-1], is_pointer=True))
        is_known = kind is not None or returns in ("Mat", "Moments", *tuples())
        refuse(not is_known, f"cv2.{self.name} returns a {returns}, which has no translation", self.node)
        name = self.scope.fresh(
            self.hints[0] if self.hints and returns == "Mat" else "value" if kind else returns.lower()
        )
        self._emit(f"const {kind.cpp if kind else f'cv::{returns}'} {name} = {text};")
        if returns in tuples():
            found = member(name, returns)
        else:
            found = Expr(name, kind or (self._array_type(0) if returns == "Mat" else t.RecordType("Moments")))
        return tuple_of([found, *self.outputs]) if self.outputs else found

    def _emit(self, line: str) -> None:
        for each in (line, *self.after):
            self.scope.emit(each)

    # -- arguments ----------------------------------------------------------------------------------------------------

    def _argument(self, arg: Mapping[str, Any]) -> str | None:
        direction, name, kind = arg.get("direction", "in"), arg["name"], arg["type"]
        given = self.bound.get(name)
        if direction == "out":
            if given is not None and given.value is not None:
                raise ByHand(f"cv2.{self.name} writes into an array that is given as {name!r}", self.node)
            return self._output(kind, name)
        if given is None:
            refuse("default" not in arg, f"C++ needs {name!r} of cv2.{self.name}", self.node)
            return None
        if given.value is None and kind in tuples():
            # Python's binding leaves the default.
            return None if "default" in arg else f"cv::{kind}()"
        index = len(self.outputs) + (self.signature["returns"] not in ("void", ""))
        if direction == "inout" and given.value is None and self._rule(index):
            return self._output("OutputArray", name)
        if direction == "inout":
            if kind != "InputOutputArray" or given.value is None:
                raise ByHand(f"cv2.{self.name} changes {name!r}, which is not translated", self.node)
            # Its line stands before what else the statement evaluates.
            is_part = getattr(self.scope.statement, "value", None) is not self.node
            refuse(is_part, f"cv2.{self.name} changes {name!r} in a part of an expression", self.node)
            writes(self.scope, given, self.node)
            given = given if given.name else self.scope.hold("image", given)
            self.outputs.append(given)
            return self._in_out(given)
        is_optional = "default" in arg or "mask" in name.lower() or name == "kernel"
        if self.name == "inRange" and given.type.dtype == "int64":
            # Python's binding makes 32 bits of them.
            given = replace(
                given, text=f"numpy::astype<std::int32_t>({given.text})", type=replace(given.type, dtype="int32")
            )
        return converted(self.scope, given, kind, self.node, is_optional=is_optional)

    def _in_out(self, given: Expr) -> str:
        kind = given.type
        if not isinstance(kind, t.ArrayType) or (kind.dtype and kind.dtype not in t.DEPTHS):
            raise ByHand(f"cv2.{self.name} changes {t.describe(kind)}", self.node)
        return given.text if kind.is_mat else f"numpy::in_out({given.text})"

    def _output(self, kind: str, name: str) -> str:
        index = len(self.outputs) + (self.signature["returns"] not in ("void", ""))
        hint = self.hints[len(self.outputs)] if len(self.outputs) < len(self.hints) else name
        temporary, base = self.scope.fresh(name if hint == "_" else hint), kind.removesuffix("*")
        if kind == "OutputArrayOfArrays":
            self.scope.emit(f"std::vector<cv::Mat> {temporary};")
            self.outputs.append(Expr(temporary, t.ListType(self._array_type(index), is_tuple=True)))
        elif kind == "OutputArray":
            self.scope.emit(f"cv::Mat {temporary};")
            self.outputs.append(Expr(temporary, self._array_type(index)))
            if size := self._rule(index).get("vector"):
                # As a row per item with its numbers in columns or in channels, whichever this version of OpenCV makes.
                rows = f"static_cast<int>({temporary}.total()) * {temporary}.channels() / {size}"
                self.after.append(f"{temporary} = {temporary}.reshape({1 if _has_rows() else size}, {rows});")
            if self._rule(index).get("release"):
                self.after.append(f"{temporary} = {temporary}.empty() ? cv::Mat() : {temporary};")
        elif kind in ("vector<KeyPoint>", "vector<DMatch>", "vector<vector<DMatch>>"):
            inner: t.Type = t.RecordType("KeyPoint" if "Key" in kind else "DMatch")
            inner = t.ListType(inner, is_tuple=True) if kind.count("vector") == 2 else inner
            found = t.ListType(inner, is_tuple=True)
            self.scope.emit(f"{found.cpp} {temporary};")
            self.outputs.append(Expr(temporary, found))
        elif base in _NUMBERS or base in tuples():
            self.scope.emit(f"{'cv::' if base in tuples() else ''}{base} {temporary}{{}};")
            self.outputs.append(member(temporary, base))
            return f"&{temporary}" if kind.endswith("*") else temporary
        else:
            raise ByHand(f"cv2.{self.name} returns a {kind}, which has no translation", self.node)
        return temporary

    def _array_type(self, index: int) -> t.ArrayType:
        """Return what is known of the array at a place among the results."""
        rule = self._rule(index)
        is_none = self.signature.get("none") or rule.get("none")
        is_nullable = bool(is_none) or self.name in ("detectAndCompute", "compute")
        unknown = t.ArrayType(is_nullable=is_nullable)
        if not rule:
            return unknown
        dtype, ndim, channels = rule.get("dtype", ""), rule.get("ndim", -1), rule.get("channels", 0)
        named = [rule["like"]] if isinstance(rule.get("like"), str) else self.signature["py"]
        first = next((self.bound[name] for name in named if name in self.bound), None)
        source = first.type if first is not None else t.NONE
        if isinstance(source, t.ListType):
            channels = len(first.parts or ()) if first is not None and rule.get("count") else channels
            source = source.item
            if source == t.NONE and first is not None and first.parts:
                source = first.parts[0].type
        if "depth" in rule:
            dtype = self._depth(rule["depth"], dtype or (source.dtype if isinstance(source, t.ArrayType) else ""))
        if rule.get("like"):
            if not isinstance(source, t.ArrayType):
                return unknown
            dtype = dtype or source.dtype
            # OpenCV's images with one channel have two dimensions in Python.
            if ndim < 0 and (source.ndim == 2 or source.channels > 1):
                ndim, channels = source.ndim, source.channels
        if rule.get("colour"):
            dtype, ndim, channels = self._colour(source)
        if "vector" in rule:
            ndim, channels = (2, 0) if _has_rows() else (3, rule["vector"])
        if not dtype or ndim < 0:
            return unknown
        return t.ArrayType(dtype, ndim, channels, is_nullable=is_nullable)

    def _rule(self, index: int) -> Mapping[str, Any]:
        """Return what the table has on the array at a place among the results."""
        name = self.name if self.this is None else f"{self.this.type.name}.{self.name}"
        rules: Any = t.data("results").get(name, {})
        found: Mapping[str, Any] = rules if isinstance(rules, dict) else dict(enumerate(rules)).get(index, {})
        refuse("by_hand" in found, f"cv2.{name}: {found.get('by_hand')}", self.node)
        return found

    def _depth(self, parameter: str, default: str) -> str:
        given = self.bound.get(parameter)
        name = "-1" if given is None else given.text
        if name == "-1":
            return default
        return next((dtype for dtype, depth in t.DEPTHS.items() if name == depth), "")

    def _colour(self, source: t.Type) -> tuple[str, int, int]:
        code = self.bound["code"].text
        to = code.rpartition("2")[2].split("_")[0]
        dtype = source.dtype if isinstance(source, t.ArrayType) else ""
        if code.startswith("cv::COLOR_") and "Bayer" not in code and "dstCn" not in self.bound:
            if to == "GRAY":
                return dtype, 2, 0
            if to in ("BGR", "RGB", "HSV", "HLS", "Lab", "LAB", "Luv", "LUV", "YCrCb", "YCR", "XYZ", "YUV"):
                return dtype, 3, 3
            if to in ("BGRA", "RGBA"):
                return dtype, 3, 4
        return "", -1, 0


def _has_rows() -> bool:
    """Whether the OpenCV of Python makes a row of each item of a vector, not a pixel with channels."""
    import cv2

    return int(cv2.__version__.split(".")[0]) > 4


def member(text: str, kind: str) -> Expr:
    """Return a number or a structure of C++ as Python has it: a float of 64 bits, a tuple."""
    if kind in tuples():
        return tuple_of([member(f"{text}.{name}", inner) for name, inner in tuples()[kind].items()])
    return Expr(f"double{{{text}}}" if kind == "float" else text, _NUMBERS[kind])


def converted(scope: Scope, given: Expr, kind: str, node: Any, *, is_optional: bool = False) -> str:
    """Return an argument as the C++ type of a parameter."""
    own = given.type
    is_numpy = isinstance(own, t.Plain) and own.dtype != ""
    if kind in _INPUTS:
        return _input(scope, given, node, is_optional=is_optional)
    if kind in ("double", "float"):
        if own in (t.FLOAT, t.BOOL, t.MIXED) or isinstance(own, t.Int) or (is_numpy and own.dtype != "bool"):
            return f"static_cast<float>({given.text})" if kind == "float" and given.value is UNKNOWN else given.text
    elif kind in ("int", "bool") and (isinstance(own, t.Int) or own == t.BOOL or (is_numpy and "int" in own.dtype)):
        if kind == "bool":
            return given.text if own == t.BOOL else f"{given.atom} != 0"
        return f"static_cast<int>({given.text})" if own == t.BOOL else narrow(given)
    elif kind == "String" and own == t.TEXT:
        return given.text
    elif kind in tuples():
        return _structure(scope, given, kind, node)
    elif kind.startswith("vector<") and given.parts is not None:
        item = kind[7:-1]
        if item in ("int", "float"):
            parts = [converted(scope, part, item, node) for part in given.parts]
            return f"std::vector<{item}>{{{', '.join(parts)}}}"
    elif kind.rpartition("::")[2][:1].isupper() and "<" not in kind and isinstance(own, t.Int):
        return f"static_cast<cv::{kind}>({narrow(given)})"
    elif isinstance(own, t.ListType | t.RecordType) and own.cpp.replace("cv::", "").replace("std::", "") == kind:
        return given.text
    raise ByHand(f"OpenCV takes {kind} where {t.describe(own)} is given", node)


def narrow(given: Expr) -> str:
    """Return an integer as an int; one that does not fit is an error at run time, as in Python."""
    own = given.type
    if isinstance(own, t.Int) and own.is_within(31):
        is_plain = own.is_int or given.value is not UNKNOWN
        return given.text if is_plain else f"static_cast<int>({given.text})"
    return f"python::narrow<int>({given.text})"


def _structure(scope: Scope, given: Expr, kind: str, node: Any) -> str:
    if kind == "Scalar" and not isinstance(given.type, t.TupleType):
        return f"cv::Scalar({converted(scope, given, 'double', node)})"
    parts, wanted = items(given), [*tuples()[kind].values()]
    wanted = wanted[: len(parts)] if kind == "Scalar" else wanted
    refuse(
        not parts or len(parts) != len(wanted), f"OpenCV takes a {kind} where {t.describe(given.type)} is given", node
    )
    texts = [converted(scope, part, name, node) for part, name in zip(parts, wanted, strict=True)]
    return f"cv::{kind}({', '.join(texts)})"


def items(given: Expr) -> tuple[Expr, ...]:
    """Return the items of a tuple of a fixed length."""
    if given.parts is not None:
        return given.parts
    kinds = given.type.items if isinstance(given.type, t.TupleType) else ()
    return tuple(Expr(f"std::get<{index}>({given.text})", kind) for index, kind in enumerate(kinds))


def _input(scope: Scope, given: Expr, node: Any, *, is_optional: bool) -> str:
    own = given.type
    if given.value is None:
        if is_optional:
            return "cv::noArray()"
        raise ByHand("OpenCV takes an array where None is given", node)
    if isinstance(own, t.ArrayType):
        refuse(own.dtype and own.dtype not in t.DEPTHS, f"OpenCV does not take an array of {own.dtype}", node)
        if not own.is_mat:
            return f"numpy::mat({given.text})"
        if own.is_nullable and not is_optional:
            return f"python::required({given.text})"
        return given.text
    if given.parts and all(isinstance(part.type, t.ArrayType) for part in given.parts):
        images = [_input(scope, part, node, is_optional=False) for part in given.parts]
        return f"std::vector<cv::Mat>{{{', '.join(images)}}}"
    if isinstance(own, t.ListType) and isinstance(own.item, t.ArrayType):
        return _input(scope, replace(given, type=own.item), node, is_optional=False)
    if own == t.FLOAT or isinstance(own, t.Int):
        return f"cv::Scalar({given.text})"
    parts = items(given)
    if 0 < len(parts) <= 4 and all(part.type == t.FLOAT or isinstance(part.type, t.Int) for part in parts):
        # Python makes a column of doubles of a tuple.
        return f"cv::Mat(cv::Vec<double, {len(parts)}>({', '.join(part.text for part in parts)}))"
    raise ByHand(f"OpenCV takes an array where {t.describe(own)} is given", node)
