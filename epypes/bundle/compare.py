"""Comparison of two values, to the last bit or within a tolerance, and the first place where they differ."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final

from epypes.wire.encoder import set_sort_key
from epypes.wire.opencv_pandas import FIELDS, is_table, record_fields, record_type, table_parts
from epypes.wording import counted

# As Python and OpenCV write them; other text may hold numbers that look alike.
_ADDRESS: Final = re.compile(r"( at |< ?[\w.]+ )0x[0-9a-fA-F]+")
# Whose repr says all of it.
_EXACT: Final = (bool, int, float, complex, str, bytes, bytearray, type(None))


# What is left where large numbers of an array cancel each other is a few of the last digits of those.
FLOOR: Final = 16.0


@dataclass(frozen=True, slots=True)
class Tolerance:
    """How far floating-point numbers of a token may be from what was recorded; both bounds hold.

    Attributes
    ----------
    absolute
        The largest difference.
    relative
        The largest difference of each number, as a part of its own magnitude; of one that is almost nothing beside the
        largest of its array, as a part of FLOOR * sqrt(epsilon) of that.
    """

    absolute: float
    relative: float


@dataclass(frozen=True, slots=True)
class Difference:
    """A number, text or array that is not what was expected; or all of a token's, at the first of them.

    Attributes
    ----------
    text
        What differs, with the first index and both values.
    index
        The indices and keys that lead to it, and into it: ``[2]['size']``, ``[17, 4]``.
    expected, got
        The first values that differ, as text.
    count, size
        How many values differ, of how many.
    largest
        The largest difference; None if they are no numbers.
    relative
        The largest difference of a floating-point number as a part of its magnitude, see Tolerance; 0.0 for others.
    is_noise
        Whether all that differ are floating-point numbers, in less than half of their digits.
    sample, token
        The names of both; "" where there are none.
    """

    text: str
    index: str = ""
    expected: str = ""
    got: str = ""
    count: int = 1
    size: int = 1
    largest: float | None = None
    relative: float = 0.0
    is_noise: bool = False
    sample: str = ""
    token: str = ""

    def __str__(self) -> str:
        return f"sample {self.sample}, token {self.token!r}: {self.text}" if self.token else self.text


def first_difference(expected: Any, got: Any, tolerance: Tolerance | None = None) -> str | None:
    """Return where two values first differ, as text, or None if they agree in type and to the last bit."""
    return next((found.text for found in differences(expected, got, tolerance)), None)


def differences(expected: Any, got: Any, tolerance: Tolerance | None = None, where: str = "") -> Iterator[Difference]:
    """Yield every place where two values differ, in order; none if they agree in type and to the last bit.

    Parameters
    ----------
    expected, got
        Values of any type. Objects that neither numpy, OpenCV nor pandas made are compared by their repr, without
        addresses.
    tolerance
        How far floating-point numbers may be apart.
    where
        What leads to the values.
    """
    if type(expected) is not type(got):
        yield _named(where, f"type {type(expected).__name__}", type(got).__name__)
    elif hasattr(expected, "dtype") and hasattr(expected, "shape") and not is_table(expected):
        yield from _in_arrays(expected, got, tolerance, where)
    else:
        inside = next((inside for is_kind, inside in _INSIDE if is_kind(expected)), _in_others)
        yield from inside(expected, got, tolerance, where)


def difference(sample: str, token: str, found: Iterable[Difference]) -> Difference | None:
    """Return the difference of a token of all places where it differs; None if there are none."""
    places = [*found]
    if not places:
        return None
    more = len(places) - 1
    others = f"; {counted(more, 'other place')} of it differ{'s' * (more == 1)}" if more else ""
    return replace(
        places[0],
        text=places[0].text + others,
        count=sum(place.count for place in places),
        size=sum(place.size for place in places),
        largest=max((place.largest for place in places if place.largest is not None), default=None),
        relative=max(place.relative for place in places),
        is_noise=is_noise(places),
        sample=sample,
        token=token,
    )


def is_noise(found: Iterable[Difference]) -> bool:
    """Whether all that differ are floating-point numbers, in less than half of their digits."""
    return all(place.is_noise for place in found)


def _named(where: str, expected: str, got: str) -> Difference:
    return Difference(f"{where}expected {expected}, got {got}", where.replace(" ", ""), expected, got)


def _in_mappings(
    expected: Mapping[Any, Any], got: Mapping[Any, Any], tolerance: Tolerance | None, where: str
) -> Iterator[Difference]:
    if _keys(expected) != _keys(got):
        yield _named(where, f"the keys {list(expected)!r:.80}", f"{list(got)!r:.80}")
        return
    for key in expected:
        yield from differences(expected[key], got[key], tolerance, f"{where}[{key!r}] ")


def _keys(mapping: Mapping[Any, Any]) -> list[tuple[type, str]]:
    # 1, 1.0 and True are equal, but not the same.
    return [(type(key), _described(key)) for key in mapping]


def _in_sequences(expected: Any, got: Any, tolerance: Tolerance | None, where: str) -> Iterator[Difference]:
    if len(expected) != len(got):
        yield _named(where, f"{len(expected)} items", f"{len(got)}")
        return
    for index, (left, right) in enumerate(zip(expected, got, strict=True)):
        yield from differences(left, right, tolerance, f"{where}[{index}] ")


def _in_sets(expected: Any, got: Any, tolerance: Tolerance | None, where: str) -> Iterator[Difference]:
    left, right = ({*map(set_sort_key, items)} for items in (expected, got))
    if left != right:
        yield _named(where, f"{sorted(left - right)!r:.60} in the set", f"{sorted(right - left)!r:.60}")


def _in_records(expected: Any, got: Any, tolerance: Tolerance | None, where: str) -> Iterator[Difference]:
    names = FIELDS[record_type(expected)]
    for name, left, right in zip(names, record_fields(expected), record_fields(got), strict=True):
        yield from differences(left, right, tolerance, f"{where}.{name} ")


def _in_tables(expected: Any, got: Any, tolerance: Tolerance | None, where: str) -> Iterator[Difference]:
    left, right = table_parts(expected), table_parts(got)
    ours_at, theirs_at = ([place for place, _ in parts] for parts in (left, right))
    if ours_at != theirs_at:
        yield _named(where, f"the parts {ours_at!r:.80}", f"{theirs_at!r:.80}")
        return
    for (place, ours), (_, theirs) in zip(left, right, strict=True):
        yield from differences(ours, theirs, tolerance, f"{where}{place} ")


def _in_numbers(expected: complex, got: complex, tolerance: Tolerance | None, where: str) -> Iterator[Difference]:
    # repr tells -0.0 from 0.0 and makes NaN agree with itself.
    if repr(expected) == repr(got):
        return
    largest, magnitude = abs(got - expected), abs(expected)
    is_finite = math.isfinite(largest)
    if is_finite and tolerance and largest <= min(tolerance.absolute, tolerance.relative * magnitude):
        return
    relative = largest / magnitude if is_finite and magnitude else math.inf
    yield replace(
        _named(where, repr(expected), repr(got)),
        largest=_finite(largest),
        relative=relative,
        is_noise=relative <= _noise(2.0**-52),
    )


def _in_others(expected: Any, got: Any, tolerance: Tolerance | None, where: str) -> Iterator[Difference]:
    left, right = _described(expected), _described(got)
    if left != right:
        is_integer = type(expected) is int and abs(expected) < 2**1000 > abs(got)
        largest = float(abs(got - expected)) if is_integer else None
        yield replace(_named(where, f"{left:.60}", f"{right:.60}"), largest=largest)


def _described(value: Any) -> str:
    """Return the repr of a value, of an object without its address."""
    return repr(value) if type(value) in _EXACT else _ADDRESS.sub(r"\g<1>0x", repr(value))


_Inside = Callable[[Any, Any, Tolerance | None, str], Iterator[Difference]]
_INSIDE: Final[tuple[tuple[Callable[[Any], object], _Inside], ...]] = (
    (lambda value: isinstance(value, Mapping), _in_mappings),
    (lambda value: isinstance(value, list | tuple), _in_sequences),
    (lambda value: isinstance(value, set | frozenset), _in_sets),
    (lambda value: type(value) in (float, complex), _in_numbers),
    (record_type, _in_records),
    (is_table, _in_tables),
)


def _in_arrays(expected: Any, got: Any, tolerance: Tolerance | None, where: str) -> Iterator[Difference]:
    import numpy as np

    if expected.dtype != got.dtype or expected.shape != got.shape:
        yield _named(where, f"{expected.dtype} {expected.shape}", f"{got.dtype} {got.shape}")
        return
    if expected.dtype.hasobject:
        yield from _in_sequences(np.asarray(expected).reshape(-1).tolist(), got.reshape(-1).tolist(), tolerance, where)
        return
    left, right = np.ascontiguousarray(expected).reshape(-1), np.ascontiguousarray(got).reshape(-1)
    if left.tobytes() == right.tobytes():
        return
    size = left.dtype.itemsize
    unlike = (left.view(np.uint8).reshape(-1, size) != right.view(np.uint8).reshape(-1, size)).any(axis=1)
    distance, magnitude, epsilon = _distances(left, right)
    if tolerance and epsilon:
        unlike &= ~(distance <= np.minimum(tolerance.absolute, tolerance.relative * magnitude))
    if unlike.any():
        yield _in_elements(left, right, unlike, expected.shape, where, (distance, magnitude, epsilon))


def _in_elements(left: Any, right: Any, unlike: Any, shape: tuple[int, ...], where: str, measured: Any) -> Difference:
    import numpy as np

    distance, magnitude, epsilon = measured
    first, count = int(unlike.argmax()), int(unlike.sum())
    index = list(map(int, np.unravel_index(first, shape))) if shape else []
    text = f"{where}{count} of {left.size} values differ, first at {index}: expected {left[first]}, got {right[first]}"
    largest = None if distance is None else _finite(float(distance[unlike].max()))
    if largest is not None and count > 1:
        text += f"; the largest difference is {largest:.6g}"
    relative = 0.0
    if epsilon:
        with np.errstate(all="ignore"):
            relative = float((distance[unlike] / magnitude[unlike]).max())
    place = where.replace(" ", "") + str(index)
    is_noise = epsilon > 0 and relative <= _noise(epsilon)
    values = str(left[first]), str(right[first])
    return Difference(text, place, *values, count, left.size, largest, relative, is_noise)


def _distances(left: Any, right: Any) -> tuple[Any, Any, float]:
    """Return how far numbers are apart, the magnitudes of the left ones, and their epsilon; see Tolerance, Unlike."""
    import numpy as np

    kind = left.dtype.kind
    if kind not in "iufc":
        return None, None, 0.0
    with np.errstate(all="ignore"):
        wide = np.complex128 if kind == "c" else np.float64
        distance = np.abs(right.astype(wide) - left.astype(wide))
        if kind in "iu":
            return distance, None, 0.0
        # What is NaN on both sides, or the same infinity, agrees.
        distance[(left == right) | ((left != left) & (right != right))] = 0.0
        magnitude = np.abs(left.astype(wide))
        magnitude[~np.isfinite(magnitude)] = 0.0
        epsilon = float(np.finfo(left.dtype).eps)
        magnitude = np.maximum(magnitude, FLOOR * math.sqrt(epsilon) * magnitude.max(initial=0.0))
    return distance, magnitude, epsilon if np.isfinite(distance).all() else 0.0


def _noise(epsilon: float) -> float:
    """Return the relative difference up to which less than half of the digits are others."""
    return math.sqrt(epsilon)


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None
