"""How far do the boxes, or the labelled objects, of two results overlap, one with one?"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Literal

from epypes.optional import optional_import

BoxForm = Literal["xywh", "xyxy"]

# Each label of one side is compared with each of the other; so many pairs take 0.2 GB.
_MOST_PAIRS: Final = 25_000_000


def paired_iou(pairs: Any) -> float:
    """Return the mean IoU of objects paired one with one so that it is largest, where those left over count 0.

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


# -- boxes ------------------------------------------------------------------------------------------------------


def is_boxes(value: Any) -> bool:
    """Whether these are four numbers each, and no mask that is four pixels wide."""
    if hasattr(value, "dtype") and hasattr(value, "shape") and not hasattr(value, "columns"):
        return value.dtype not in ("bool", "uint8") and (
            (value.ndim == 2 and value.shape[1] == 4) or value.shape in ((4,), (0,))
        )
    return isinstance(value, list | tuple) and (
        all(hasattr(box, "__len__") and len(box) == 4 for box in value) or _is_one_box(value)
    )


def _is_one_box(value: Sequence[Any]) -> bool:
    return len(value) == 4 and all(isinstance(number, int | float) for number in value)


def boxes_iou(value: Any, expected: Any, form: BoxForm) -> float:
    """Return the IoU of boxes, paired one with one."""
    import numpy as np

    got, wanted = _corners(value, form), _corners(expected, form)
    first = np.maximum(got[:, None, :2], wanted[None, :, :2])
    last = np.minimum(got[:, None, 2:], wanted[None, :, 2:])
    inside = np.prod(np.clip(last - first, 0, None), axis=2)
    areas = [np.prod(np.clip(boxes[:, 2:] - boxes[:, :2], 0, None), axis=1) for boxes in (got, wanted)]
    union = areas[0][:, None] + areas[1][None, :] - inside
    return paired_iou(np.divide(inside, union, out=np.zeros_like(inside), where=union > 0))


def _corners(value: Any, form: BoxForm) -> Any:
    """Return boxes as float64 (n, 4): x and y of the first corner, x and y of the second."""
    import numpy as np

    boxes = np.asarray(value, np.float64).reshape(-1, 4)
    if form == "xywh":
        boxes = np.concatenate([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], axis=1)
    return boxes


# -- labels -----------------------------------------------------------------------------------------------------


def is_label_image(array: Any) -> bool:
    """Whether an array tells objects from each other: integers, of which more than one is not zero."""
    import numpy as np

    if array.dtype.kind not in "iu":
        return False
    found = array[array != 0]
    return bool(found.size) and bool(np.any(found != found.flat[0]))


def labels_iou(got: Any, wanted: Any) -> float:
    """Return the IoU of the objects in two label images of one shape, paired one with one; a mask is one object.

    Raises
    ------
    ValueError
        There are too many labels to compare each with each.
    """
    import numpy as np

    (labels, ours), (other_labels, theirs) = (np.unique(array, return_inverse=True) for array in (got, wanted))
    rows, columns = len(labels), len(other_labels)
    if rows * columns > _MOST_PAIRS:
        raise ValueError(f"The value has {rows} labels, what was expected {columns}: too many to be label images.")
    codes = ours.ravel() * columns + theirs.ravel()
    inside = np.bincount(codes, minlength=rows * columns).reshape(rows, columns).astype(np.float64)
    union = inside.sum(axis=1, keepdims=True) + inside.sum(axis=0, keepdims=True) - inside
    # The background is no object.
    return paired_iou((inside / union)[np.ix_(labels != 0, other_labels != 0)])
