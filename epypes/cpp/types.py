"""The types of values: which C++ type a value of Python gets, from the recorded samples and in the translation.

An array is a `cv::Mat` where OpenCV has its dtype and it has two dimensions, or a third one as channels; any other is
an `Array<T, N>` of array.hpp, the C++ form of NumPy's arrays.
"""

from __future__ import annotations

import ast
import functools
import keyword
import re
import tomllib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from importlib.resources import files
from typing import Any, Final

from epypes.wire.opencv import record_fields, record_type

INT_BITS: Final = 31
LOW, HIGH = -(2**63), 2**63 - 1
# The elements that both NumPy and C++ have. OpenCV has the first seven.
ELEMENTS: Final[Mapping[str, str]] = {
    "uint8": "std::uint8_t",
    "int8": "std::int8_t",
    "uint16": "std::uint16_t",
    "int16": "std::int16_t",
    "int32": "std::int32_t",
    "float32": "float",
    "float64": "double",
    "bool": "bool",
    "uint32": "std::uint32_t",
    "int64": "std::int64_t",
    "uint64": "std::uint64_t",
}
DEPTHS: Final = dict(
    zip(tuple(ELEMENTS)[:7], ("CV_8U", "CV_8S", "CV_16U", "CV_16S", "CV_32S", "CV_32F", "CV_64F"), strict=True)
)
# The most channels of a cv::Mat.
MOST_CHANNELS: Final = 512


@dataclass(frozen=True, slots=True)
class Type:
    """A type; the subclasses say which."""

    @property
    def dtype(self) -> str:
        """The dtype of an array or a number of NumPy; "" of all others."""
        return ""

    @property
    def cpp(self) -> str:
        """The type in C++."""
        raise NotImplementedError

    @property
    def passed(self) -> str:
        """The type of a parameter in C++."""
        return f"const {self.cpp}&"


@dataclass(frozen=True, slots=True)
class Int(Type):
    """An integer of Python, from ``low`` to ``high``; an int of C++ if ``is_int``."""

    low: int = LOW
    high: int = HIGH
    is_int: bool = False

    @property
    def cpp(self) -> str:
        """The type in C++."""
        return "int" if self.is_int else "std::int64_t"

    @property
    def passed(self) -> str:
        """The type of a parameter in C++."""
        return self.cpp

    def is_within(self, bits: int) -> bool:
        """Whether a signed integer of so many bits and a sign holds it."""
        return self.low >= -(1 << bits) and self.high < 1 << bits


@dataclass(frozen=True, slots=True)
class Plain(Type):
    """A float, a truth value, a text or nothing; or a number of NumPy, of a dtype."""

    name: str
    dtype: str = ""

    @property
    def cpp(self) -> str:
        """The type in C++."""
        return (
            ELEMENTS[self.dtype]
            if self.dtype
            else {"str": "std::string", "None": "std::optional<double>", "mixed": "double"}.get(self.name, self.name)
        )

    @property
    def passed(self) -> str:
        """The type of a parameter in C++."""
        return "const std::string&" if self.name == "str" else self.cpp


INT: Final = Int(-(2**INT_BITS), 2**INT_BITS - 1, is_int=True)
FLOAT: Final = Plain("double")
BOOL: Final = Plain("bool")
TEXT: Final = Plain("str")
NONE: Final = Plain("None")
# A float in one sample and an integer, or a number of NumPy, in another.
MIXED: Final = Plain("mixed")


def number(dtype: str) -> Plain:
    """Return the type of a number of NumPy."""
    return Plain("numpy", dtype)


_FLOATS: Final = (number("float32"), number("float64"))
_FLAGS: Final = ("is_readonly", "is_nullable", "is_strided", "is_other")


@dataclass(frozen=True, slots=True)
class ArrayType(Type):
    """An array of NumPy.

    Attributes
    ----------
    dtype
        Its dtype; "" if it isn't known.
    ndim
        The number of its dimensions; -1 if it isn't known.
    channels
        The size of the third dimension; 0 if it isn't known.
    is_mat
        Whether it is a cv::Mat in C++.
    is_readonly
        Whether its memory may be that of a parameter.
    is_nullable
        Whether it may be None, which is an empty cv::Mat.
    is_strided
        Whether the elements may lie in another order, in which NumPy adds floats, or apart.
    is_other
        Whether they may lie otherwise in C++ than in NumPy, which keeps the order of a transposed operand.
    """

    dtype: str = ""
    ndim: int = -1
    channels: int = 0
    is_mat: bool = True
    is_readonly: bool = False
    is_nullable: bool = False
    is_strided: bool = False
    is_other: bool = False

    @property
    def cpp(self) -> str:
        """The type in C++."""
        return "cv::Mat" if self.is_mat else f"numpy::Array<{ELEMENTS[self.dtype]}, {self.ndim}>"


@dataclass(frozen=True, slots=True)
class ListType(Type):
    """A list, or a tuple of any length, whose items have one type; ``origin`` is the place of an empty list."""

    item: Type
    is_tuple: bool = False
    origin: tuple[int, int] = field(default=(0, 0), compare=False)

    @property
    def cpp(self) -> str:
        """The type in C++."""
        # Of a list that is always empty, any type does.
        return f"std::vector<{'double' if self.item == NONE else self.item.cpp}>"


@dataclass(frozen=True, slots=True)
class TupleType(Type):
    """A tuple of a fixed length."""

    items: tuple[Type, ...]

    @property
    def cpp(self) -> str:
        """The type in C++."""
        return f"std::tuple<{', '.join(item.cpp for item in self.items)}>"


@dataclass(frozen=True, slots=True)
class RecordType(Type):
    """An object of OpenCV: KeyPoint, DMatch, Moments; or a class of algorithms."""

    name: str
    is_pointer: bool = False

    @property
    def cpp(self) -> str:
        """The type in C++."""
        return f"cv::Ptr<cv::{self.name}>" if self.is_pointer else f"cv::{self.name}"


@dataclass(frozen=True, slots=True)
class OptionalType(Type):
    """Either None or a value of a type."""

    item: Type

    @property
    def cpp(self) -> str:
        """The type in C++."""
        return f"std::optional<{self.item.cpp}>"


@dataclass(frozen=True, slots=True)
class TokenType:
    """A token of the graph in C++.

    Attributes
    ----------
    token
        Its name in the graph.
    name
        Its name in C++.
    type
        Its type; ``cpp`` is the one in C++.
    """

    token: str
    name: str
    type: Type

    @property
    def cpp(self) -> str:
        """The type of its member in Hyperparameters, Inputs or Outputs."""
        return self.type.cpp


@functools.cache
def data(name: str) -> Mapping[str, Any]:
    """Return one of the tables in ``data/``."""
    return tomllib.loads((files("epypes.cpp") / "data" / f"{name}.toml").read_text("utf-8"))


def operator(node: ast.AST) -> Mapping[str, str]:
    """Return what an operator of Python is in C++."""
    found: Mapping[str, str] = data("python")["operators"].get(type(node).__name__, {})
    return found


def identifier(name: str) -> str:
    """Return a name that C++ takes, as near as possible to a name of Python."""
    plain = re.sub(r"\W", "_", name, flags=re.ASCII)
    plain = re.sub(r"^_*(?=\d)", "n", plain)
    # Names with two underscores, or one before a capital letter, belong to the compiler.
    plain = re.sub(r"__+", "_", plain).lstrip("_") or "value"
    return f"{plain}_" if plain in data("names")["reserved"] or keyword.iskeyword(plain) else plain


def identifiers(names: Iterable[str], taken: Iterable[str] = ()) -> dict[str, str]:
    """Return a name in C++ for each name, all different."""
    found: dict[str, str] = {}
    used = set(taken)
    for name in names:
        plain = unique = identifier(name)
        count = 1
        while unique in used:
            count += 1
            unique = f"{plain}_{count}"
        used.add(unique)
        found[name] = unique
    return found


def array_type(dtype: str, ndim: int, channels: int = 0, *, is_mat: bool | None = None) -> ArrayType:
    """Return the type of an array, a cv::Mat where one can hold it."""
    fits = dtype in DEPTHS and (ndim == 2 or (ndim == 3 and 0 < channels <= MOST_CHANNELS))
    return ArrayType(dtype, ndim, channels, fits if is_mat is None else is_mat)


def type_of(value: Any) -> Type:
    """Return the type of a recorded value.

    Raises
    ------
    TypeError
        There is none for it.
    """
    kind = type(value)
    if kind is int:
        if not LOW <= value <= HIGH:
            raise TypeError("an integer of more than 64 bits")
        return Int()
    plain: dict[type, Type] = {float: FLOAT, bool: BOOL, str: TEXT, type(None): NONE}
    if kind in plain:
        return plain[kind]
    if name := record_type(value):
        return RecordType(name)
    if kind in (list, tuple):
        return _of_sequence([type_of(item) for item in value], is_tuple=kind is tuple)
    dtype = getattr(value, "dtype", None)
    if dtype is None or dtype.name not in ELEMENTS or not dtype.isnative:
        raise TypeError(f"an array of {dtype}" if dtype is not None else f"a {kind.__name__}")
    if kind.__name__ != "ndarray":
        return number(dtype.name)
    array = array_type(dtype.name, value.ndim, value.shape[-1] if value.ndim == 3 else 0)
    is_strided = not value.flags.c_contiguous
    return replace(array, is_strided=is_strided, is_other=is_strided)


def _of_sequence(items: list[Type], *, is_tuple: bool) -> Type:
    if not items:
        return ListType(NONE, is_tuple)
    if is_tuple and len(items) <= 8 and not any(isinstance(item, ArrayType | RecordType) for item in items):
        return TupleType(tuple(items))
    found = items[0]
    for item in items[1:]:
        found = join(found, item)
    return ListType(found, is_tuple)


def kept(kind: Type) -> Type:
    """Return the type of a value that a list keeps: its integers have 64 bits."""
    if isinstance(kind, Int):
        return Int()
    return TupleType(tuple(map(kept, kind.items))) if isinstance(kind, TupleType) else kind


def readonly(kind: Type) -> Type:
    """Return the type of a value whose arrays nothing may write to."""
    if isinstance(kind, ArrayType):
        return replace(kind, is_readonly=True)
    if isinstance(kind, ListType | OptionalType):
        return replace(kind, item=readonly(kind.item))
    return TupleType(tuple(map(readonly, kind.items))) if isinstance(kind, TupleType) else kind


def join(left: Type, right: Type) -> Type:
    """Return the type of a value that has one of two types.

    Raises
    ------
    TypeError
        C++ has no common one.
    """
    if left == right:
        return left
    for one, other in ((left, right), (right, left)):
        if one == NONE:
            if isinstance(other, ArrayType) and other.is_mat:
                return replace(other, is_nullable=True)
            return other if isinstance(other, OptionalType) else OptionalType(other)
        if isinstance(one, OptionalType):
            return OptionalType(join(one.item, other.item if isinstance(other, OptionalType) else other))
        if isinstance(one, ListType) and one.item == NONE and isinstance(other, ListType):
            return other
    if isinstance(left, Int) and isinstance(right, Int):
        return Int(min(left.low, right.low), max(left.high, right.high), left.is_int and right.is_int)
    if isinstance(left, ListType) and isinstance(right, ListType) and left.is_tuple == right.is_tuple:
        return ListType(join(left.item, right.item), left.is_tuple)
    if isinstance(left, TupleType) and isinstance(right, TupleType) and len(left.items) == len(right.items):
        return TupleType(tuple(join(*pair) for pair in zip(left.items, right.items, strict=True)))
    if isinstance(left, ArrayType) and isinstance(right, ArrayType):
        return _join_arrays(left, right)
    if all(isinstance(side, Int) or side in (FLOAT, MIXED, *_FLOATS) for side in (left, right)):
        return MIXED
    raise TypeError(f"{describe(left)} and {describe(right)}")


def _join_arrays(left: ArrayType, right: ArrayType) -> ArrayType:
    dtype, ndim = left.dtype if left.dtype == right.dtype else "", left.ndim if left.ndim == right.ndim else -1
    # An array of C++ shares the memory of a cv::Mat, which can't share that of any array.
    is_mat = left.is_mat and right.is_mat
    if not is_mat and (not dtype or ndim < 0):
        raise TypeError(f"{describe(left)} and {describe(right)}")
    flags = (getattr(left, name) or getattr(right, name) for name in _FLAGS)
    return ArrayType(dtype, ndim, left.channels if left.channels == right.channels else 0, is_mat, *flags)


def describe(kind: Type) -> str:
    """Return a type in the words of Python."""
    if isinstance(kind, Int):
        return "int"
    if isinstance(kind, Plain):
        return kind.dtype or {"double": "float"}.get(kind.name, kind.name)
    if isinstance(kind, ArrayType):
        return f"{kind.dtype or 'unknown'} array of {kind.ndim if kind.ndim >= 0 else 'unknown'} dimensions"
    if isinstance(kind, ListType):
        return f"{'tuple' if kind.is_tuple else 'list'} of {describe(kind.item)}"
    if isinstance(kind, TupleType):
        return f"tuple ({', '.join(map(describe, kind.items))})"
    return f"{describe(kind.item)} or None" if isinstance(kind, OptionalType) else kind.cpp


def literal(value: Any, kind: Type) -> str:
    """Return a value as C++ writes it."""
    if value is None:
        return "std::nullopt" if isinstance(kind, OptionalType) else "{}"
    if isinstance(kind, OptionalType):
        return literal(value, kind.item)
    if kind == TEXT:
        return quoted(value)
    if isinstance(kind, TupleType | ListType):
        items = kind.items if isinstance(kind, TupleType) else (kind.item,) * len(value)
        return f"{kind.cpp}{{{', '.join(literal(item, each) for item, each in zip(value, items, strict=True))}}}"
    if isinstance(kind, RecordType):
        return f"{kind.cpp}({', '.join(str(part) for part in record_fields(value))})"
    return _number(value.item() if hasattr(value, "item") else value, kind)


def _number(value: Any, kind: Type) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int):
        if value == LOW:
            return "std::numeric_limits<std::int64_t>::min()"
        return f"{value}" if abs(value) < 2**INT_BITS else f"{value}{'U' if value > HIGH else ''}LL"
    name = "float" if isinstance(kind, Plain) and kind.dtype == "float32" else "double"
    if value != value or value in (float("inf"), float("-inf")):
        limit = "quiet_NaN()" if value != value else "infinity()"
        return f"{'-' if value < 0 else ''}std::numeric_limits<{name}>::{limit}"
    return f"{value!r}F" if name == "float" else repr(value)


def quoted(text: str) -> str:
    """Return a text as a literal of C++."""
    escapes = {'"': '\\"', "\\": "\\\\", "\n": "\\n", "\t": "\\t", "\r": "\\r"}
    parts = []
    for byte in text.encode("utf-8", "surrogateescape"):
        character = chr(byte)
        parts.append(escapes.get(character) or (character if 32 <= byte < 127 else f"\\{byte:03o}"))
    return f'"{"".join(parts)}"'.replace("??", '?""?')
