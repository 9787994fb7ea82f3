"""Metrics: how near a value is to what it should be, as one number.

Each metric takes the value of a token, and most of them what was expected; ``METRICS`` has them by name. What can't be
compared (another shape, another kind of value) is a ``ValueError`` with the reason, never a number.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal

from epypes.errors import InvalidValue
from epypes.nothing import Nothing
from epypes.optional import optional_import

with optional_import("scale"):
    import numpy as np

BoxForm = Literal["xywh", "xyxy"]
# Each label of one side is compared with each of the other; so many pairs take 0.2 GB.
_MOST_PAIRS: Final = 25_000_000


@dataclass(frozen=True, slots=True)
class Metric:
    """A metric of this module.

    Attributes
    ----------
    function
        Is called with the value, with what was expected if it compares, and with its options.
    compares
        Whether it takes what was expected.
    better
        Which numbers are better; None if that is for the threshold to say.
    least
        What the number must be at least where no threshold is given; None if one must be given.
    measures_nothing
        Whether it takes Nothing. Where it does not, a check falls short if nothing was found.
    """

    function: Callable[..., float]
    compares: bool = True
    better: Literal["greater", "less"] | None = "greater"
    least: float | None = None
    measures_nothing: bool = False

    @property
    def options(self) -> tuple[str, ...]:
        """The names of its options."""
        parameters = inspect.signature(self.function).parameters.values()
        return tuple(parameter.name for parameter in parameters if parameter.kind is parameter.KEYWORD_ONLY)


def equal(value: Any, expected: Any) -> float:
    """Return the share of elements that are the same, in [0, 1]; 1.0 means all of them.

    Parameters
    ----------
    value, expected
        Arrays of any dtype and one shape: their elements are compared, NaN with itself, whatever the dtypes are; a mask
        (bool) with what is not zero. Anything else (numbers, texts, lists, keypoints, tables) is compared as a whole,
        as a bundle's replay compares it: 1.0 or 0.0.

    Raises
    ------
    ValueError
        The shapes differ.
    """
    if not (_is_array(value) and _is_array(expected)):
        return float(_is_same(value, expected))
    got, wanted = _pair(value, expected)
    is_alike = (got == wanted) | ((got != got) & (wanted != wanted))
    return float(np.mean(is_alike)) if is_alike.size else 1.0


def close(value: Any, expected: Any, *, atol: float = 0.0, rtol: float = 1e-5) -> float:
    """Return the share of numbers that are near enough, in [0, 1]: ``|value - expected| <= atol + rtol * |expected|``.

    Parameters
    ----------
    value, expected
        Numbers, or arrays of numbers of one shape, or sequences of numbers.
    atol, rtol
        As of ``numpy.isclose``.

    Raises
    ------
    ValueError
        The shapes differ, or these are no numbers.
    """
    got, wanted = _numbers(value, expected)
    is_near = np.isclose(got, wanted, rtol=rtol, atol=atol, equal_nan=True)
    return float(np.mean(is_near)) if is_near.size else 1.0


def iou(value: Any, expected: Any, *, boxes: BoxForm = "xywh") -> float:
    """Return the intersection over the union, in [0, 1] (Jaccard 1912); of nothing and nothing it is 1.0.

    Parameters
    ----------
    value, expected
        Two masks: arrays of one shape (y, x), of which all that is not zero is in. Two label images: such arrays of
        integers, where one of the two has more than one value besides 0; each value is then an object of its own, and
        a mask is one object. Or boxes: arrays (n, 4) and (m, 4) of another dtype than bool and uint8, or sequences of
        four numbers. Objects and boxes are paired one with one so that the sum of their IoU is largest (the Hungarian
        method), whatever their numbers are, and what is returned is that sum divided by max(n, m): each one too many or
        too few costs, and so do two that were merged. To compare label images as masks, give both as bool.
    boxes
        What the four numbers are: ``"xywh"``, a corner with width and height as in OpenCV, or ``"xyxy"``, two corners.

    Raises
    ------
    ValueError
        The shapes differ, one is a mask and the other boxes, or there are too many labels to pair them.
    """
    if boxes not in ("xywh", "xyxy"):
        raise InvalidValue(f"boxes is {boxes!r}, not 'xywh' or 'xyxy'.")
    if _is_boxes(value) and _is_boxes(expected):
        return _boxes_iou(value, expected, boxes)
    got, wanted = _same_shape(value, expected)
    if _is_label_image(got) or _is_label_image(wanted):
        return _labels_iou(got, wanted)
    inside, outside = np.count_nonzero((got != 0) & (wanted != 0)), np.count_nonzero((got != 0) | (wanted != 0))
    return float(inside / outside) if outside else 1.0


def count(value: Any, *, of: Literal["items", "nonzero", "labels"] | None = None) -> float:
    """Return how many there are: keypoints, contours, matches, rows, pixels, objects.

    Parameters
    ----------
    value
        A sequence, a table or an array; of Nothing there are 0.
    of
        ``"items"``: what ``len`` counts, rows of an array; ``"nonzero"``: pixels that are not zero; ``"labels"``:
        different numbers in a label image but 0. Without: the items, of a mask (bool) the pixels that are True. Other
        arrays of integers with two axes may be either, so there it must be given.

    Raises
    ------
    ValueError
        The value can't be counted, or in more than one way.
    """
    if value is Nothing:
        return 0.0
    if of == "nonzero":
        return float(np.count_nonzero(value))
    if of == "labels":
        found = np.unique(np.asarray(value))
        return float(np.count_nonzero(found))
    if of not in (None, "items"):
        raise InvalidValue(f"of is {of!r}, not 'items', 'nonzero' or 'labels'.")
    if of is None and _is_array(value) and value.dtype.kind == "b":
        return float(np.count_nonzero(value))
    if of is None and _is_array(value) and value.ndim == 2 and value.dtype.kind in "iu":
        raise InvalidValue(f"{_kind(value)} can be counted in several ways: give of='items', 'nonzero' or 'labels'.")
    try:
        return float(len(value))
    except TypeError as error:
        raise InvalidValue(f"A {_kind(value)} can't be counted. A number is compared by the metric 'value'.") from error


def value(value: Any) -> float:
    """Return a number as it is, and a truth value as 1.0 or 0.0.

    Raises
    ------
    ValueError
        It is no single number.
    """
    try:
        if isinstance(value, str | bytes):
            raise TypeError
        return float(value)
    except (TypeError, ValueError) as error:
        raise InvalidValue(f"{_kind(value)} is not a single number.") from error


def mean_abs_difference(value: Any, expected: Any) -> float:
    """Return the mean of ``|value - expected|``, in the unit of the elements; computed as float64.

    Parameters
    ----------
    value, expected
        Numbers, or arrays of numbers of one shape.

    Raises
    ------
    ValueError
        The shapes differ, or these are no numbers.
    """
    got, wanted = _numbers(value, expected)
    return float(np.mean(np.abs(got - wanted))) if got.size else 0.0


def psnr(value: Any, expected: Any, *, data_range: float | None = None) -> float:
    """Return the peak signal-to-noise ratio in dB, as ``skimage.metrics`` does; infinite for the same image.

    Parameters
    ----------
    value, expected
        Images of one shape and one dtype.
    data_range
        The distance of the least and the largest possible value. Without, that of an integer dtype: if it is signed
        and nothing that was expected is negative, of 0 and the largest, as there. Of bool and floating-point images it
        must be given.

    Raises
    ------
    ValueError
        The shapes or dtypes differ, or the range must be given.
    """
    got, wanted = _pair(value, expected)
    if got.dtype != wanted.dtype:
        raise InvalidValue(f"The value is {got.dtype}, what was expected {wanted.dtype}. Give one dtype.")
    if data_range is None and got.dtype.kind not in "iu":
        raise InvalidValue(f"Of {got.dtype} images, psnr needs data_range.")
    if np.array_equal(got, wanted):
        return math.inf
    with optional_import():
        from skimage.metrics import peak_signal_noise_ratio
    return float(peak_signal_noise_ratio(wanted, got, data_range=data_range))


METRICS: Final[Mapping[str, Metric]] = {
    "equal": Metric(equal, least=1.0, measures_nothing=True),
    "close": Metric(close, least=1.0),
    "iou": Metric(iou),
    "count": Metric(count, compares=False, better=None, measures_nothing=True),
    "value": Metric(value, compares=False, better=None),
    "mean_abs_difference": Metric(mean_abs_difference, better="less"),
    "psnr": Metric(psnr),
}


# -- overlaps ---------------------------------------------------------------------------------------------------


def _paired_iou(pairs: Any) -> float:
    """Return the mean IoU of objects, paired one with one by the Hungarian method; those left over count 0.

    Parameters
    ----------
    pairs
        The IoU of each object of one side with each of the other: an array (n, m).

    Raises
    ------
    MissingPackage
        scipy is missing.
    """
    most = max(pairs.shape)
    if not most:
        return 1.0
    if not pairs.size:
        return 0.0
    with optional_import():
        from scipy.optimize import linear_sum_assignment
    rows, columns = linear_sum_assignment(pairs, maximize=True)
    return float(pairs[rows, columns].sum() / most)


def _is_boxes(value: Any) -> bool:
    """Whether these are four numbers each, and no mask that is four pixels wide."""
    if _is_array(value):
        is_shaped = (value.ndim == 2 and value.shape[1] == 4) or value.shape in ((4,), (0,))
        return is_shaped and value.dtype not in ("bool", "uint8")
    if not isinstance(value, list | tuple):
        return False
    is_one = len(value) == 4 and all(isinstance(number, int | float) for number in value)
    return is_one or all(hasattr(box, "__len__") and len(box) == 4 for box in value)


def _boxes_iou(value: Any, expected: Any, form: BoxForm) -> float:
    """Return the IoU of boxes, paired one with one."""
    got, wanted = (np.asarray(boxes, np.float64).reshape(-1, 4) for boxes in (value, expected))
    if form == "xywh":
        got, wanted = (np.hstack([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]]) for boxes in (got, wanted))
    first = np.maximum(got[:, None, :2], wanted[None, :, :2])
    last = np.minimum(got[:, None, 2:], wanted[None, :, 2:])
    inside = np.prod(np.clip(last - first, 0, None), axis=2)
    ours, theirs = (np.prod(np.clip(boxes[:, 2:] - boxes[:, :2], 0, None), axis=1) for boxes in (got, wanted))
    union = ours[:, None] + theirs[None, :] - inside
    return _paired_iou(np.divide(inside, union, out=np.zeros_like(inside), where=union > 0))


def _is_label_image(array: Any) -> bool:
    """Whether an array is a label image: integers with more than one value besides 0."""
    if array.dtype.kind not in "iu":
        return False
    found = array[array != 0]
    return bool(found.size) and bool(np.any(found != found.flat[0]))


def _labels_iou(got: Any, wanted: Any) -> float:
    """Return the IoU of the objects in two label images of one shape, paired one with one; a mask is one object.

    Raises
    ------
    ValueError
        There are too many labels to compare each with each.
    """
    (labels, ours), (other_labels, theirs) = (np.unique(array, return_inverse=True) for array in (got, wanted))
    rows, columns = len(labels), len(other_labels)
    if rows * columns > _MOST_PAIRS:
        raise InvalidValue(f"The value has {rows} labels, what was expected {columns}: too many to be label images.")
    codes = ours.ravel() * columns + theirs.ravel()
    inside = np.bincount(codes, minlength=rows * columns).reshape(rows, columns).astype(np.float64)
    union = inside.sum(axis=1, keepdims=True) + inside.sum(axis=0, keepdims=True) - inside
    # The background is no object.
    return _paired_iou((inside / union)[np.ix_(labels != 0, other_labels != 0)])


# -- values -----------------------------------------------------------------------------------------------------


def _is_array(value: Any) -> bool:
    return hasattr(value, "dtype") and hasattr(value, "shape") and not hasattr(value, "columns")


def _is_same(value: Any, expected: Any) -> bool:
    from epypes.bundle.proof.compare import first_difference

    if type(value) is not type(expected) and isinstance(value, float | int) and isinstance(expected, float | int):
        return bool(value == expected)
    if _is_array(value) and isinstance(expected, list | tuple | float | int):
        return equal(value, np.asarray(expected)) == 1.0
    if isinstance(value, list | tuple) and isinstance(expected, list | tuple):
        return len(value) == len(expected) and all(map(_is_same, value, expected))
    return first_difference(expected, value) is None


def _pair(value: Any, expected: Any) -> tuple[Any, Any]:
    """Return two values as arrays of one shape; a mask is compared with what is not zero."""
    got, wanted = _same_shape(value, expected)
    if (got.dtype.kind == "b") != (wanted.dtype.kind == "b"):
        got, wanted = got != 0, wanted != 0
    return got, wanted


def _same_shape(value: Any, expected: Any) -> tuple[Any, Any]:
    got, wanted = np.asarray(value), np.asarray(expected)
    if got.shape != wanted.shape:
        raise InvalidValue(f"The shapes differ: the value is {_kind(got)}, what was expected {_kind(wanted)}.")
    return got, wanted


def _numbers(value: Any, expected: Any) -> tuple[Any, Any]:
    for array in map(np.asarray, (value, expected)):
        if array.dtype.kind not in "biufc":
            raise InvalidValue(f"{_kind(array)} are no numbers.")
    got, wanted = _same_shape(value, expected)
    dtype = np.result_type(got.dtype, wanted.dtype, np.float64)
    return got.astype(dtype), wanted.astype(dtype)


def _kind(value: Any) -> str:
    if not _is_array(value):
        return f"{type(value).__name__} of {len(value)}" if isinstance(value, Sequence) else type(value).__name__
    sides = " x ".join(map(str, value.shape))
    return f"{value.dtype} {sides}" if sides else str(value.dtype)
