"""What do the numbers of an array say in one line?"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from epypes.display.previews.imagekinds import EXACT_PX, SAMPLE_PX

_FEW: Final = 4_000

if TYPE_CHECKING:
    import numpy.typing as npt

    Array = npt.NDArray[Any]


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
    import numpy as np

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
