"""Contracts of images: the arrays that a function takes as images, and the order of their colours.

The mark stands in the function's annotation: ``Annotated[np.ndarray, Image("uint8", (None, None, 3), order="rgb")]``,
or alone, ``image: Image("uint8")``, which type checkers don't like.
It is read without numpy: a value that is an array brings what is asked of it.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final, Literal

from epypes.errors import InvalidValue

Order = Literal["bgr", "rgb"]

ORDERS: Final[tuple[Order, ...]] = ("bgr", "rgb")
_DTYPES: Final = (
    "bool",
    *(f"{sign}int{bits}" for sign in ("", "u") for bits in (8, 16, 32, 64)),
    *("float16", "float32", "float64", "complex64", "complex128"),
)
# Python's own types, as numpy reads them.
_PYTHON: Final = {bool: "bool", int: "int64", float: "float64", complex: "complex128"}
_AXES: Final = ("h", "w", "c")


@dataclass(frozen=True, slots=True)
class Image:
    """What an image must be: the contract of an input or output, and the order of its colours.

    Only what is given is checked. It is written into the annotation of a parameter or of what is returned:
    ``Annotated[np.ndarray, ep.Image("uint8", ("h", "w"))]``, which a type checker reads as an array, or by itself,
    ``image: ep.Image("uint8", ("h", "w"))``.

    Attributes
    ----------
    dtype
        The dtypes allowed: a name such as ``"uint8"``, a numpy dtype or type, or a tuple of them; kept as names.
    shape
        The length of every axis; None, or the axis's name, where any length will do.
    range
        The least and the largest value allowed. NaN lies outside.
    order
        ``"bgr"`` or ``"rgb"``: what three and four channels are. Where nothing says it, they are BGR, as in OpenCV.

    Raises
    ------
    ValueError
        A dtype or an order that does not exist, an empty range, a shape that no array has.

    Examples
    --------
    >>> print(Image("uint8", ("h", "w", 3), order="rgb"))
    uint8 (h, w, 3) rgb
    """

    dtype: Any = None
    shape: tuple[int | str | None, ...] | None = None
    range: tuple[float, float] | None = None
    order: Order | None = None

    def __post_init__(self) -> None:
        if self.dtype is not None:
            given = self.dtype if isinstance(self.dtype, tuple | list) else (self.dtype,)
            object.__setattr__(self, "dtype", tuple(map(_dtype_name, given)))
        if self.shape is not None:
            object.__setattr__(self, "shape", _checked_shape(self.shape))
        if self.range is not None:
            object.__setattr__(self, "range", _checked_range(self.range))
        if self.order is not None and self.order not in ORDERS:
            raise InvalidValue(_unknown("order", self.order, ORDERS))
        if self.order is not None and self.shape is not None and not _has_colours(self.shape):
            axes = _shape_text(self.shape)
            raise InvalidValue(f"An image of shape {axes} has no order {self.order!r}. Leave it out, or add channels.")

    def found(self, value: Any) -> str | None:
        """Return what a value is, in a few words, if it breaks the contract; None if it keeps it."""
        dtype, shape = getattr(value, "dtype", None), getattr(value, "shape", None)
        if not hasattr(dtype, "kind") or not isinstance(shape, tuple):
            return f"of type {type(value).__name__!r}"
        allowed = self._allows_dtype(dtype) and self._allows_shape(shape)
        outside = self._outside(value) if allowed else ""
        if allowed and not outside:
            return None
        return f"{dtype} {' x '.join(map(str, shape)) or 'without axes'} {outside}".rstrip()

    def findings(self, value: Any) -> str | None:
        """Return what is wrong with a value, ``"float64 480 x 640, expected uint8 (h, w, 3)"``, or None."""
        found = self.found(value)
        return found and f"{found}, expected {self}"

    def fits(self, other: Image) -> bool:
        """Whether one image may keep both contracts, their orders aside."""
        dtypes = self.dtype is None or other.dtype is None or not set(self.dtype).isdisjoint(other.dtype)
        shapes = self.shape is None or other.shape is None or _may_be_equal(self.shape, other.shape)
        ranges = self.range is None or other.range is None or _overlap(self.range, other.range)
        return dtypes and shapes and ranges

    def _allows_dtype(self, dtype: Any) -> bool:
        return self.dtype is None or dtype.name in self.dtype

    def _allows_shape(self, shape: tuple[int, ...]) -> bool:
        if self.shape is None:
            return True
        return len(shape) == len(self.shape) and all(
            not isinstance(wanted, int) or side == wanted for side, wanted in zip(shape, self.shape, strict=True)
        )

    def _outside(self, array: Any) -> str:
        """Return the values of an array, if some lie outside of the range; they are looked at only if they can."""
        if self.range is None or not array.size or _fits(array.dtype, self.range):
            return ""
        if array.dtype.kind not in "biuf":
            return "without a range"
        low, high = array.min().item(), array.max().item()
        if math.isnan(low):
            return "with NaN"
        return "" if self.range[0] <= low and high <= self.range[1] else f"from {low:g} to {high:g}"

    def __str__(self) -> str:
        parts = (
            self.dtype and " or ".join(self.dtype),
            _shape_text(self.shape) if self.shape is not None else "",
            self.order,
            self.range and f"from {self.range[0]:g} to {self.range[1]:g}",
        )
        return " ".join(part for part in parts if part) or "array"


def _may_be_equal(shape: tuple[int | str | None, ...], other: tuple[int | str | None, ...]) -> bool:
    return len(shape) == len(other) and all(
        side == opposite or not isinstance(side, int) or not isinstance(opposite, int)
        for side, opposite in zip(shape, other, strict=True)
    )


def _overlap(ends: tuple[float, float], others: tuple[float, float]) -> bool:
    return ends[0] <= others[1] and others[0] <= ends[1]


def _unknown(kind: str, name: object, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(str(name).lower(), tuple(known), n=1, cutoff=0.6)
    way_out = f"Did you mean {near[0]!r}?" if near else f"There are: {', '.join(known)}."
    return f"No {kind} {name!r} of an image. {way_out}"


def _dtype_name(dtype: Any) -> str:
    if isinstance(dtype, str):
        name = dtype
    elif isinstance(dtype, type):
        name = _PYTHON.get(dtype, dtype.__name__)
    else:
        name = str(getattr(dtype, "name", dtype))
    if name not in _DTYPES:
        raise InvalidValue(_unknown("dtype", name, _DTYPES))
    return name


def _checked_shape(shape: Any) -> tuple[int | str | None, ...]:
    good = isinstance(shape, tuple | list) and len(shape) > 0
    if not good or not all(_is_axis(side) for side in shape):
        raise InvalidValue(f"shape must be a tuple such as (None, None, 3), not {shape!r}. Write None for any length.")
    return tuple(shape)


def _is_axis(side: Any) -> bool:
    return side is None or isinstance(side, str) or (type(side) is int and side > 0)


def _checked_range(ends: Any) -> tuple[float, float]:
    good = isinstance(ends, tuple | list) and len(ends) == 2
    if not good or not all(isinstance(end, int | float) for end in ends):
        raise InvalidValue(f"range must be (low, high), not {ends!r}.")
    low, high = ends
    if not low <= high:
        raise InvalidValue(f"The range from {low} to {high} is empty. Give the lower end first.")
    return low, high


def _has_colours(shape: tuple[int | str | None, ...]) -> bool:
    return len(shape) == 3 and (not isinstance(shape[2], int) or shape[2] in (3, 4))


def _shape_text(shape: tuple[int | str | None, ...]) -> str:
    names = (*_AXES, *("any" for _ in shape)) if len(shape) in (2, 3) else ("any",) * len(shape)
    sides = [names[axis] if side is None else str(side) for axis, side in enumerate(shape)]
    return f"({', '.join(sides)}{',' if len(sides) == 1 else ''})"


def _fits(dtype: Any, ends: tuple[float, float]) -> bool:
    """Whether no value of an integer dtype can lie outside of a range."""
    bits = 8 * dtype.itemsize
    least, largest = {"u": (0, 2**bits - 1), "i": (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1), "b": (0, 1)}.get(
        dtype.kind, (-math.inf, math.inf)
    )
    return dtype.kind in "uib" and ends[0] <= least and largest <= ends[1]


def has_colours(value: Any) -> bool:
    """Whether a value is an array (y, x, 3) or (y, x, 4), whose channels have an order."""
    shape = getattr(value, "shape", None)
    return isinstance(shape, tuple) and len(shape) == 3 and shape[2] in (3, 4)


def swapped(image: Any) -> Any:
    """Return a copy of an array (y, x, 3) or (y, x, 4) with red and blue exchanged: BGR as RGB, and back."""
    copy = image.copy()
    copy[..., 0], copy[..., 2] = image[..., 2], image[..., 0]
    return copy


def in_order(image: Any, order: Order) -> Any:
    """Return an image of OpenCV's, which is BGR, in an order; it is copied only if it has to be changed."""
    return swapped(image) if order == "rgb" and has_colours(image) else image


# By input and by output token of a function, the mark of an image or None.
Contracts = tuple[tuple[Image | None, ...], tuple[Image | None, ...]]


def mark_of(annotation: Any) -> Image | None:
    """Return the mark that an annotation is or has, None without any."""
    # Of Annotated; typing.get_origin() takes five times as long, and a graph may have 10,000 functions.
    marks = getattr(annotation, "__metadata__", None)
    found = (annotation, *marks) if isinstance(marks, tuple) else (annotation,)
    return next((mark for mark in found if isinstance(mark, Image)), None)
