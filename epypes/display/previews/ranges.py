"""Which values of an image are black and white?

Those of its dtype for bytes, 0 to 1 for floats that fit; for all others what the first image of a token had, and that
is kept: if every frame had a range of its own, a change of brightness would not be seen.
"""

from __future__ import annotations

import threading
from typing import TYPE_CHECKING, Any, Final
from weakref import WeakKeyDictionary

from epypes.display.previews.imagekinds import sampled
from epypes.display.previews.kinds import kind_name
from epypes.run import CompGraphRunner, Run
from epypes.run.program import Program

if TYPE_CHECKING:
    import numpy.typing as npt

    Array = npt.NDArray[Any]

Range = tuple[float, float]

# Cameras of 10, 12 and 14 bits write into 16.
_BITS: Final = (8, 10, 12, 14, 16)
_BYTE: Final = (0.0, 255.0)
_UNIT: Final = (0.0, 1.0)
_kept: WeakKeyDictionary[Program, dict[tuple[str, str], Range]] = WeakKeyDictionary()
_lock = threading.Lock()


def display_range(image: Array) -> Range:
    """Return the values that are shown black and white, from the image alone."""
    found = _own_range(image)
    low, high = found if found is not None else _UNIT
    return (low, high) if high > low else (low, low + 1.0)


def sole_value(image: Array) -> Any:
    """Return the value of an image that has but one and whose dtype does not tell how bright that is; None if not so.

    Its own range would make it black, whatever it is.
    """
    if image.dtype.kind == "b" or (image.dtype.itemsize <= 2 and image.dtype.kind == "u"):
        return None
    first = image.flat[0]
    # A few pixels of most images tell already that there are more values.
    if not all(((part == first) | ((part != part) & (first != first))).all() for part in (image[::16, ::16], image)):
        return None
    return None if image.dtype.kind == "f" and 0.0 <= first <= 1.0 else first.item()


def kept_range(program: Program, token: str, image: Array) -> Range:
    """Return the values that are shown black and white in a token's images: what its first one had.

    Of an image of one value nothing is kept, since it does not tell what is to come.
    """
    if image.dtype.kind == "b" or image.dtype.str[1:] == "u1":
        return display_range(image)
    key = token, image.dtype.str
    with _lock:
        ranges = _kept.setdefault(program, {})
        if key in ranges:
            return ranges[key]
    found = _own_range(image)
    if found is None or found[0] >= found[1]:
        return display_range(image)
    with _lock:
        return ranges.setdefault(key, found)


def reset_display_ranges(shown: Any) -> None:
    """Forget which values are shown black and white; those of the next images are kept instead.

    Parameters
    ----------
    shown
        A runner, a run or a pipeline; of all its tokens.
    """
    runner = getattr(shown, "runner", shown)
    run = runner.last if isinstance(runner, CompGraphRunner) else runner
    if not isinstance(run, Run):
        if isinstance(runner, CompGraphRunner):
            return
        raise TypeError(f"A runner, a run or a pipeline has display ranges, not {kind_name(type(shown))!r}.")
    with _lock:
        _kept.pop(run.tokens.program, None)


def is_of_dtype(dtype: Any, ends: Range) -> bool:
    """Whether a range is what everybody expects of a dtype: nothing has to be said of it then."""
    expected = {"b": _UNIT, "f": _UNIT, "u": (0.0, 2.0 ** (8 * dtype.itemsize) - 1)}.get(dtype.kind)
    return ends == expected


def _own_range(image: Array) -> Range | None:
    """Return the range of an image; None if it has no finite value or, of 16 bits, none but 0."""
    import numpy as np

    if image.dtype.kind == "b" or not image.size:
        return _UNIT
    if image.dtype.str[1:] == "u1":
        return _BYTE
    sample = sampled(image)
    if image.dtype.str[1:] == "u2":
        return _range_of_bits(int(sample.max()))
    finite = sample[np.isfinite(sample)] if image.dtype.kind == "f" else sample
    return _range_of(float(finite.min()), float(finite.max()), image.dtype.kind == "f") if finite.size else None


def _range_of_bits(largest: int) -> Range | None:
    bits = next(bits for bits in _BITS if largest < 2**bits)
    return (0.0, 2.0**bits - 1) if largest else None


def _range_of(low: float, high: float, is_float: bool) -> Range:
    if is_float and low >= 0.0 and high <= 1.0:
        return _UNIT
    if low >= 0.0:
        return low, high
    reach = max(-low, high)
    return -reach, reach
