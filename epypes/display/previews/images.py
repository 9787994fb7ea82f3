"""What an image is: a mask, labels or a photograph; its display range, and its statistics in a line.

What is decided from the values of a large image is decided from a strided sample.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final, Literal

from epypes.display.previews.introspection import is_of
from epypes.display.text import memory_text
from epypes.optional import LazyModule
from epypes.wording import counted

if TYPE_CHECKING:
    import numpy as np

    from epypes.display.previews import Array
else:
    np = LazyModule("numpy")

Range = tuple[float, float]
ImageKind = Literal["mask", "labels", "photograph"]

SMALLEST_SIDE_PX: Final = 8
# Beyond this many pixels some are looked at, and so many of them: to pick them takes longer than to look at them.
EXACT_PX: Final = 1_000_000
SAMPLE_PX: Final = 250_000
# Of pixels and their neighbours fewer will do.
_PAIRS_PX: Final = 60_000
# Integers that are wide enough may be labels whatever they are; those of cameras only if they are small.
_MOST_LABELS: Final = {1: 63, 2: 1023}
_FEW_LABELS: Final = 7
_MOST_DISTINCT: Final = 4096
_EQUAL_NEIGHBOURS: Final = 0.8
_EQUAL_OF_FEW: Final = 0.6
# Most pixels of objects a few pixels wide lie at their edge; in sparse counts hardly a pixel has an equal neighbour.
_EQUAL_OF_SMALL: Final = 0.2
# Integers so wide are hardly a camera's.
_WIDE_BYTES: Final = 4
_SMALL_STEPS: Final = 0.8


def is_image(value: Any) -> bool:
    """Whether a value can be seen as an image: an array (y, x), (y, x, 3) or (y, x, 4), at least 8 x 8 pixels."""
    if not is_of(value, "numpy", "ndarray") or value.dtype.kind not in "buif":
        return False
    shape = value.shape
    channels = shape[2] if len(shape) == 3 else 1
    return len(shape) in (2, 3) and channels in (1, 3, 4) and min(shape[:2]) >= SMALLEST_SIDE_PX


def one_channel(image: Array) -> Array:
    """Return an image (y, x, 1) as (y, x); any other as it is."""
    return image[:, :, 0] if image.ndim == 3 and image.shape[2] == 1 else image


def sampled(image: Array) -> Array:
    """Return an image of at most a million pixels as it is, of a larger one every n-th row and column."""
    pixels = image.shape[0] * image.shape[1]
    if pixels <= EXACT_PX:
        return image
    stride = math.ceil(math.sqrt(pixels / SAMPLE_PX))
    return image[::stride, ::stride].copy()


def image_kind(image: Array, sample: Array) -> ImageKind:
    """Return what an image is to be seen as; ``sample`` are the pixels of it that are looked at."""
    image, sample = one_channel(image), one_channel(sample)
    if is_mask(sample):
        return "mask"
    return "labels" if _is_labels(image, sample) else "photograph"


def is_mask(image: Array) -> bool:
    """Whether an image of one channel has two values only: bool, or uint8 of 0 and 255, or of 0 and 1."""
    if image.ndim != 2 or image.dtype.kind not in "bu" or image.dtype.itemsize > 1:
        return False
    # A few pixels of a photograph show already that it is none.
    return image.dtype.kind == "b" or (_has_two_values(image[::16, ::16]) and _has_two_values(image))


def _has_two_values(image: Array) -> bool:
    # 0 and 255 are the two values that adding one, within a byte, brings to at most 1.
    is_white: bool = bool(((image.astype(np.uint8, copy=False) + np.uint8(1)) <= 1).all())
    return is_white or int(image.max(initial=0)) <= 1


def _is_labels(image: Array, sample: Array) -> bool:
    """Whether an image of whole numbers is constant by pieces, as those of regions are."""
    if image.ndim != 2 or image.dtype.kind not in "iu" or not sample.size:
        return False
    least, largest = int(sample.min()), int(sample.max())
    is_wide = image.dtype.itemsize >= _WIDE_BYTES
    if least < -1 or not (0 if is_wide else 1) <= largest <= _MOST_LABELS.get(image.dtype.itemsize, largest):
        return False
    if least == largest:
        # One object that fills the image, or none; larger numbers are rather measured.
        return is_wide and largest <= 1
    if not _has_pieces(image, largest):
        return False
    return largest <= _MOST_DISTINCT or len(np.unique(sample)) <= _MOST_DISTINCT


def _has_pieces(image: Array, largest: int) -> bool:
    """Whether most neighbours are equal, of those that are not background."""
    stride = math.ceil(math.sqrt(image.size / _PAIRS_PX))
    at, right, below = image[:-1:stride, :-1:stride], image[:-1:stride, 1::stride], image[1::stride, :-1:stride]
    # Pairs of neighbours: that touch an object, within objects, equal ones of these, and those that differ by one.
    touching = within = equal = by_one = 0
    for near in (right, below):
        near = near[: at.shape[0], : at.shape[1]]
        is_touching = (at != 0) | (near != 0)
        touching += int(np.count_nonzero(is_touching))
        within += int(np.count_nonzero((at != 0) & (near != 0)))
        equal += int(np.count_nonzero(is_touching & (at == near)))
        by_one += int(np.count_nonzero(np.maximum(at, near) - np.minimum(at, near) == 1))
    least_equal = _EQUAL_OF_FEW if largest <= _FEW_LABELS else _EQUAL_NEIGHBOURS
    if image.dtype.itemsize >= _WIDE_BYTES:
        return equal > 0 and equal >= least_equal * within and equal >= _EQUAL_OF_SMALL * touching
    # In a dark and blurred photograph most are equal, too, but there they differ by one where they differ.
    differing = touching - equal
    is_smooth = largest > _FEW_LABELS and by_one > _SMALL_STEPS * differing
    return differing > 0 and not is_smooth and equal >= least_equal * touching


# -- display ranges ---------------------------------------------------------------------------------------------------

# Cameras of 10, 12 and 14 bits write into 16.
_BITS: Final = (8, 10, 12, 14, 16)
_BYTE: Final = (0.0, 255.0)
_UNIT: Final = (0.0, 1.0)


def display_range(image: Array) -> Range:
    """Return the values that are shown black and white, from the image alone."""
    found = own_range(image)
    low, high = found if found is not None else _UNIT
    return (low, high) if high > low else (low, low + 1.0)


def sole_value(image: Array) -> Any:
    """Return the value of an image that has but one and whose dtype does not show how bright that is; None if not so.

    Its own range would make it black, whatever it is.
    """
    if image.dtype.kind == "b" or (image.dtype.itemsize <= 2 and image.dtype.kind == "u"):
        return None
    first = image.flat[0]
    # A few pixels of most images show already that there are more values.
    if not all(((part == first) | ((part != part) & (first != first))).all() for part in (image[::16, ::16], image)):
        return None
    return None if image.dtype.kind == "f" and 0.0 <= first <= 1.0 else first.item()


def is_of_dtype(dtype: Any, ends: Range) -> bool:
    """Whether a range is the usual one of a dtype, which need not be stated."""
    expected = {"b": _UNIT, "f": _UNIT, "u": (0.0, 2.0 ** (8 * dtype.itemsize) - 1)}.get(dtype.kind)
    return ends == expected


def own_range(image: Array) -> Range | None:
    """Return the range of an image; None if it has no finite value or, of 16 bits, none but 0."""
    if image.dtype.kind == "b" or not image.size:
        return _UNIT
    if image.dtype.str[1:] == "u1":
        return _BYTE
    sample = sampled(image)
    if image.dtype.str[1:] == "u2":
        largest = int(sample.max())
        return (0.0, 2.0 ** next(bits for bits in _BITS if largest < 2**bits) - 1) if largest else None
    finite = sample[np.isfinite(sample)] if image.dtype.kind == "f" else sample
    if not finite.size:
        return None
    low, high = float(finite.min()), float(finite.max())
    if image.dtype.kind == "f" and low >= 0.0 and high <= 1.0:
        return _UNIT
    reach = max(-low, high)
    return (low, high) if low >= 0.0 else (-reach, reach)


# -- statistics -------------------------------------------------------------------------------------------------------

_FEW: Final = 4_000


def some_of(array: Array) -> Array:
    """Return an array of at most a million values as it is, of a larger one every n-th."""
    return array if array.size <= EXACT_PX else _sample(array, SAMPLE_PX)


def few_of(array: Array) -> Array:
    """Return a small array as it is, of a larger one a few thousand values: that takes no time worth counting."""
    return array if array.size <= _FEW else _sample(array, _FEW)


def _sample(array: Array, most: int) -> Array:
    """Return about so many values, every n-th of each long axis: to flatten an array may take a copy of all of it."""
    longest = _longest_axis(array.shape, most)
    # A copy, since what lies far apart in memory is to be fetched once.
    return array[tuple(slice(None, None, -(-length // longest)) for length in array.shape)].copy()


def _longest_axis(shape: tuple[int, ...], most: int) -> int:
    """Return the length that axes may have, so that no more than so many values are left and short axes stay whole."""
    room = float(most)
    for axes, length in zip(range(len(shape), 0, -1), sorted(shape), strict=True):
        side = room ** (1 / axes)
        if length > side:
            return max(1, int(side + 1e-9))
        room /= length
    return max(shape)


def statistics_text(sample: Array, array: Array) -> str:
    """Return the range and mean of a sample, what of it is not finite, and how large the array is."""
    return ", ".join(filter(None, (*_numbers(sample, array), memory_text(array.nbytes))))


def _numbers(sample: Array, array: Array) -> list[str]:
    if not array.size:
        return ["empty"]
    if array.dtype.kind in "mM":
        return [f"{sample.min()} to {sample.max()}"]
    if array.dtype.kind == "b":
        return [f"{np.mean(sample):.3g} of it true" + " in a sample" * (sample.size < array.size)]
    if array.dtype.kind not in "iufc":
        return []
    values = np.abs(sample) if array.dtype.kind == "c" else sample
    finite, odd = _finite(values)
    if not finite.size:
        return ["no finite value", *odd]
    marked = " of a sample" if sample.size < array.size else ""
    name = "magnitude " if array.dtype.kind == "c" else ""
    # Without the wrappers of the methods, which take longer than to look at so few values.
    least, most = np.minimum.reduce(finite, axis=None), np.maximum.reduce(finite, axis=None)
    mean = np.add.reduce(finite, axis=None, dtype=np.float64) / finite.size
    return [f"{name}{_text(least)} to {_text(most)}{marked}", f"mean {mean:.4g}", *odd]


def _finite(values: Any) -> tuple[Any, list[str]]:
    """Return the finite values, and how many of the others there are."""
    if values.dtype.kind != "f":
        return values, []
    is_finite = np.isfinite(values)
    if is_finite.all():
        return values, []
    nan = int(np.count_nonzero(np.isnan(values)))
    infinite = values.size - int(np.count_nonzero(is_finite)) - nan
    return values[is_finite], [f"{count} {name}" for count, name in ((nan, "NaN"), (infinite, "inf")) if count]


def _text(value: Any) -> str:
    return f"{value:.6g}" if value.dtype.kind == "f" else str(value)


def label_areas(labels: Array, pixels: int) -> Array:
    """Return how many pixels each label besides 0 has, the largest first; a sample stands for so many pixels in all."""
    positive = labels[labels > 0]
    is_narrow = positive.size > 0 and int(positive.max()) <= 10 * labels.size
    counts = np.bincount(positive) if is_narrow else np.unique(positive, return_counts=True)[1]
    areas = np.sort(counts[counts > 0])[::-1]
    return areas if labels.size == pixels else np.rint(areas * (pixels / labels.size)).astype(np.int64)


def label_text(areas: Array, *, is_sample: bool = False) -> str:
    """Return how many labels there are, and how large they are."""
    text = counted(len(areas), "label")
    if not len(areas):
        return text
    sizes = f"{areas[-1]} to {areas[0]} px, median {np.median(areas):.6g} px" if len(areas) > 1 else f"{areas[0]} px"
    return f"{text} of {'about ' * is_sample}{sizes}{' in a sample' * is_sample}"
