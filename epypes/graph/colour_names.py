"""Names that say an order of colours: functions and constants of OpenCV, scikit-image and Matplotlib.

The names of OpenCV's conversions say the order, as ``COLOR_RGB2GRAY`` does, and so do scikit-image's, as
``rgb2gray``, and Matplotlib's imshow, which shows RGB. ``COLOR_BGR2RGB`` and ``COLOR_RGB2BGR`` are one operation, and
programs exchange the names: what they say is a hint, not sure. No library is imported.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from functools import lru_cache
from types import BuiltinFunctionType, FunctionType, ModuleType
from typing import Final, Literal, NamedTuple

from epypes.images import Order

PLOT: Final = "matplotlib"
_CHANNELS: Final[Mapping[str, Order]] = {"BGR": "bgr", "BGRA": "bgr", "RGB": "rgb", "RGBA": "rgb"}
# Methods of arrays that keep the channels.
PASSING_METHODS: Final = frozenset(("astype", "clip", "copy"))
_CONVERSION: Final = re.compile(r"COLOR_([A-Za-z]+?)2([A-Za-z]\w*)")


def _words(text: str) -> frozenset[str]:
    return frozenset(text.split())


_SPACES: Final = _words("hed hsv lab luv rgbcie xyz ycbcr ydbdr yiq ypbpr yuv")
_TO_RGB: Final = {f"{space}2rgb" for space in _SPACES} | {"label2rgb", "combine_stains"}
_OF_RGB: Final = {f"rgb2{space}" for space in _SPACES} | {"rgb2gray", "separate_stains"}
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
}
# A function whose code has none of these names tells nothing, unless one that it calls does.
TELLING: Final = _TO_RGB | _OF_RGB | {"cvtColor", "imread", "imshow"}


class Passed(NamedTuple):
    """The image that an input brings, in its order or with red and blue exchanged."""

    place: int
    is_swapped: bool = False


# An image of an input, an image in a certain order, a figure or axes of Matplotlib, or nothing known.
Seen = Passed | Order | Literal["matplotlib"] | None


def opposite(order: Order) -> Order:
    """Return the other order."""
    return "rgb" if order == "bgr" else "bgr"


@lru_cache(maxsize=1)
def names_of_codes() -> Mapping[int, tuple[str, ...]]:
    """Return the names of OpenCV's conversions by their number; one number may have several."""
    found: dict[int, tuple[str, ...]] = {}
    for name, code in vars(sys.modules["cv2"]).items():
        if name.startswith("COLOR_"):
            found[code] = (*found.get(code, ()), name)
    return found


def full_name(found: object, written: str = "") -> str:
    """Return the dotted name of a module, a function or a constant of OpenCV; empty for anything else."""
    if isinstance(found, ModuleType):
        return found.__name__
    if isinstance(found, FunctionType):
        return f"{found.__module__}.{found.__qualname__}"
    opencv = sys.modules.get("cv2")
    if isinstance(found, BuiltinFunctionType):
        written = found.__name__
    is_constant = written.startswith("COLOR_") and type(found) is int
    if (isinstance(found, BuiltinFunctionType) or is_constant) and getattr(opencv, written, None) is not None:
        return f"cv2.{written}" if getattr(opencv, written) == found else ""
    if isinstance(found, type) and found.__module__ == "numpy":
        return f"numpy.{found.__name__}"
    return ""


def library_name(full: str) -> tuple[str, str]:
    """Return the package and the last part of a dotted name."""
    return full.partition(".")[0], full.rpartition(".")[2]


class ColourCalls:
    """The orders that calls of libraries show, with what local names are."""

    def __init__(self, names: dict[str, Seen], places: Iterable[int]) -> None:
        self.names = names
        self.taken: dict[int, set[Order]] = {place: set() for place in places}
        self.hinted: dict[int, set[Order]] = {place: set() for place in places}

    @staticmethod
    def agreed(orders: Mapping[int, set[Order]]) -> dict[int, Order]:
        """Return the orders of the inputs of which one is known: a function that takes both knows what it does."""
        return {place: next(iter(found)) for place, found in orders.items() if len(found) == 1}

    def take(self, seen: Seen, order: Order, *, is_hint: bool = False) -> None:
        """Note that an image is taken in an order."""
        if isinstance(seen, Passed):
            orders = self.hinted if is_hint else self.taken
            orders.setdefault(seen.place, set()).add(opposite(order) if seen.is_swapped else order)

    def convert(self, seen: Seen, name: str) -> Seen:
        """Note what a conversion of OpenCV takes, and return what it makes."""
        parts = _CONVERSION.fullmatch(name)
        if parts is None or parts[1].startswith("Bayer"):
            return None  # OpenCV calls the patterns of sensors otherwise than their makers
        before, after = _CHANNELS.get(parts[1]), _CHANNELS.get(parts[2].partition("_")[0])
        if before is None:
            return None if parts[1] == "GRAY" else after
        self.take(seen, before, is_hint=after is not None)
        if after is None:
            return None
        return swapped(seen) if before != after else seen

    def library_call(self, library: str, name: str, images: Sequence[Seen], keywords: Iterable[str] = ()) -> Seen:
        """Note what a function of a library takes, and return what it makes."""
        first = images[0] if images else None
        if library == "cv2" and name == "imread" and len(images) == 1 and not keywords:
            return "bgr"
        if name in _PASSED_ON.get(library, ()):
            return first
        if library == "skimage" and "channel_axis" not in keywords:
            if name in _OF_RGB:
                self.take(first, "rgb")
            return "rgb" if name in _TO_RGB else None
        if library == PLOT:
            if name == "imshow" and "cmap" not in keywords:
                self.take(first, "rgb")
            return PLOT
        return None


def swapped(seen: Seen) -> Seen:
    """Return what an image is after red and blue are exchanged."""
    if isinstance(seen, Passed):
        return seen._replace(is_swapped=not seen.is_swapped)
    return opposite(seen) if seen == "bgr" or seen == "rgb" else None
