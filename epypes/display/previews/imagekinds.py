"""Is an array an image, and is it to be seen as a mask, as labels or as a photograph?

What is decided from the values of a large image is decided from a strided sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final, Literal

from epypes.display.previews.kinds import is_of

if TYPE_CHECKING:
    import numpy.typing as npt

    Array = npt.NDArray[Any]

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


def stride_of(image: Array) -> int:
    """Return the n whose every n-th row and column make a sample; 1 if the image is small enough."""
    pixels = image.shape[0] * image.shape[1]
    return math.ceil(math.sqrt(pixels / SAMPLE_PX)) if pixels > EXACT_PX else 1


def sampled(image: Array) -> Array:
    """Return an image of at most a million pixels as it is, of a larger one every n-th row and column."""
    stride = stride_of(image)
    return image if stride == 1 else image[::stride, ::stride].copy()


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
    # A few pixels of a photograph tell already that it is none.
    return image.dtype.kind == "b" or (_has_two_values(image[::16, ::16]) and _has_two_values(image))


def _has_two_values(image: Array) -> bool:
    import numpy as np

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
    return _has_pieces(image, largest) and _has_few_values(sample, largest)


def _has_few_values(sample: Array, largest: int) -> bool:
    import numpy as np

    return largest <= _MOST_DISTINCT or len(np.unique(sample)) <= _MOST_DISTINCT


@dataclass(frozen=True, slots=True)
class _Neighbours:
    """How many pairs of pixels there are: touching an object, within objects, equal within them, differing, by one."""

    touching: int
    within: int
    equal: int
    by_one: int

    @property
    def differing(self) -> int:
        return self.touching - self.equal


def _has_pieces(image: Array, largest: int) -> bool:
    """Whether most neighbours are equal, of those that are not background."""
    pairs = _neighbours(image)
    least_equal = _EQUAL_OF_FEW if largest <= _FEW_LABELS else _EQUAL_NEIGHBOURS
    if image.dtype.itemsize >= _WIDE_BYTES:
        return pairs.equal > 0 and (
            pairs.equal >= least_equal * pairs.within and pairs.equal >= _EQUAL_OF_SMALL * pairs.touching
        )
    # In a dark and blurred photograph most are equal, too, but there they differ by one where they differ.
    is_smooth = largest > _FEW_LABELS and pairs.by_one > _SMALL_STEPS * pairs.differing
    return pairs.differing > 0 and not is_smooth and pairs.equal >= least_equal * pairs.touching


def _neighbours(image: Array) -> _Neighbours:
    import numpy as np

    stride = math.ceil(math.sqrt(image.size / _PAIRS_PX))
    at, right, below = image[:-1:stride, :-1:stride], image[:-1:stride, 1::stride], image[1::stride, :-1:stride]
    touching = within = equal = by_one = 0
    for side in (right, below):
        ours, theirs = at, side[: at.shape[0], : at.shape[1]]
        is_touching = (ours != 0) | (theirs != 0)
        touching += int(np.count_nonzero(is_touching))
        within += int(np.count_nonzero((ours != 0) & (theirs != 0)))
        equal += int(np.count_nonzero(is_touching & (ours == theirs)))
        by_one += int(np.count_nonzero(np.maximum(ours, theirs) - np.minimum(ours, theirs) == 1))
    return _Neighbours(touching, within, equal, by_one)
