"""What do the numbers of an array say in one line?"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any, Final

from epypes.display.previews.imagekinds import EXACT_PX, SAMPLE_PX

_FEW: Final = 4_000

if TYPE_CHECKING:
    import numpy.typing as npt

    Array = npt.NDArray[Any]


def some_of(array: Array) -> Array:
    """Return an array of at most a million values as it is, of a larger one every n-th."""
    if array.size <= EXACT_PX:
        return array
    step = -(-array.size // SAMPLE_PX)
    # Along the first axis, since an array that is not contiguous would be copied to be flattened.
    along = array[:: min(step, array.shape[0])]
    return along.reshape(-1)[:: -(-along.size // SAMPLE_PX)] if along.size > SAMPLE_PX else along


def few_of(array: Array) -> Array:
    """Return a small array as it is, of a larger one a few thousand values: that takes no time worth counting."""
    if array.size <= _FEW:
        return array
    if array.ndim == 1:
        return array[:: -(-array.size // _FEW)]
    step = math.isqrt(array.shape[0] * array.shape[1] // _FEW) + 1
    few = array[::step, ::step]
    # To flatten what is not contiguous takes a copy.
    return few if few.size <= 4 * _FEW else few.reshape(-1)[:: -(-few.size // _FEW)]


def statistics_text(sample: Array, array: Array) -> str:
    """Return the range and mean of a sample, what of it is not finite, and how large the array is."""
    return ", ".join(filter(None, (*_numbers(sample, array), memory_text(array.nbytes))))


def _numbers(sample: Array, array: Array) -> list[str]:
    import numpy as np

    if not array.size:
        return ["empty"]
    if array.dtype.kind in "mM":
        return [f"{sample.min()} to {sample.max()}"]
    if array.dtype.kind == "b":
        return [f"{np.mean(sample):.3g} of it true" + " in a sample" * (sample.size < array.size)]
    if array.dtype.kind not in "iufc":
        return []
    with np.errstate(all="ignore"):
        values = np.abs(sample) if array.dtype.kind == "c" else sample
        finite, odd = _finite(values)
        if not finite.size:
            return ["no finite value", *odd]
        marked = " of a sample" if sample.size < array.size else ""
        name = "magnitude " if array.dtype.kind == "c" else ""
        mean = np.mean(finite, dtype=np.float64 if array.dtype.kind == "f" else None)
        return [f"{name}{_text(finite.min())} to {_text(finite.max())}{marked}", f"mean {mean:.4g}", *odd]


def _finite(values: Any) -> tuple[Any, list[str]]:
    """Return the finite values, and how many of the others there are."""
    import numpy as np

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


def memory_text(size: int) -> str:
    """Return a number of bytes with its unit, to three digits."""
    for limit, unit in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if size >= limit:
            return f"{size / limit:.3g} {unit}"
    return f"{size} B"
