"""Comparison of two values, to the last bit or within a tolerance, and the first place where they differ.

Noise is floating-point numbers that differ in less than half of their digits, which is what summing in another order
does. A bundle tolerates noise that its proof has seen, SAFETY times as large. Nothing else is tolerated.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from epypes.optional import optional_import
from epypes.wire.encoder import set_sort_key
from epypes.wire.opencv_pandas import FIELDS, is_table, record_fields, record_type, table_parts
from epypes.wording import counted

# As Python and OpenCV write them; other text may hold numbers that look alike.
_ADDRESS: Final = re.compile(r"( at |< ?[\w.]+ )0x[0-9a-fA-F]+")
# Whose repr says all of it.
_EXACT: Final = (bool, int, float, complex, str, bytes, bytearray, type(None))
# What is left where large numbers of an array cancel each other is a few of the last digits of those.
FLOOR: Final = 16.0
# The next run may be further off than the worst of a few; ten times that is far below any change of an algorithm.
SAFETY: Final = 10.0
_MEANING: Final = (
    "Replays of the samples gave other last digits: a replay may differ by {:g} times as",
    "much, and each number by no more than the relative part of its own magnitude.",
)


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
    count
        How many values differ.
    largest
        The largest difference; None if they are no numbers.
    relative
        The largest difference of a floating-point number as a part of its magnitude, see Tolerance; 0.0 for others.
    is_noise
        Whether all that differ are floating-point numbers, in less than half of their digits.
    sample, token
        The names of both; "" where there are none.
    function
        The first function that computes something else each time it is called in one process; "" if there is none.
    """

    text: str
    index: str = ""
    count: int = 1
    largest: float | None = None
    relative: float = 0.0
    is_noise: bool = False
    sample: str = ""
    token: str = ""
    function: str = ""

    def __str__(self) -> str:
        return f"sample {self.sample}, token {self.token!r}: {self.text}" if self.sample else self.text


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
        How far floating-point numbers may differ.
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
    count = sum(place.count for place in places)
    return replace(largest_of(places), text=places[0].text + others, count=count, sample=sample, token=token)


def largest_of(found: Sequence[Difference]) -> Difference:
    """Return the first of some differences, as large as the largest of them."""
    return replace(
        found[0],
        largest=max((each.largest for each in found if each.largest is not None), default=None),
        relative=max(each.relative for each in found),
        is_noise=all(each.is_noise for each in found),
    )


def _named(where: str, expected: str, got: str) -> Difference:
    return Difference(f"{where}expected {expected}, got {got}", where.replace(" ", ""))


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
    is_noise = epsilon > 0 and relative <= _noise(epsilon)
    return Difference(text, where.replace(" ", "") + str(index), count, largest, relative, is_noise)


def _distances(left: Any, right: Any) -> tuple[Any, Any, float]:
    """Return how far numbers differ, the magnitudes of the left ones, and their epsilon; see Tolerance."""
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


def add_tolerances(document: Any, differing: Iterable[Difference]) -> None:
    """Add tolerances of noise to the document of pipeline.toml, with a comment of what they mean.

    A tolerance covers the one that stood there before too.

    Parameters
    ----------
    document
        The document of tomlkit.
    differing
        The noise of tokens; those of one token may be several.
    """
    with optional_import():
        import tomlkit

    for noise in differing:
        entries = document.setdefault("tolerance", tomlkit.table(is_super_table=True))
        known, entry = entries.get(noise.token, {}), tomlkit.table()
        for line in _MEANING:
            entry.add(tomlkit.comment(line.format(SAFETY)))
        for name, bound in (("absolute", noise.largest or 0.0), ("relative", noise.relative)):
            # One digit is enough, rounded up: people read the file, and small changes of the noise don't change it.
            entry.add(name, max(_rounded_up(SAFETY * bound), known.get(name, 0.0)))
        entries[noise.token] = entry


def _rounded_up(number: float) -> float:
    """Return a number rounded up to one digit."""
    if number == 0.0:
        return 0.0
    step = 10.0 ** (math.floor(math.log10(number)))
    return float(f"{math.ceil(number / step) * step:.0e}")


def read_tolerances(document: Mapping[str, Any]) -> dict[str, Tolerance]:
    """Return the tolerances of pipeline.toml.

    Raises
    ------
    KeyError, TypeError
        An entry lacks a bound, or has one that is no number of 0 or more.
    """
    found = {}
    for token, entry in document.get("tolerance", {}).items():
        bounds = (entry["absolute"], entry["relative"])
        if not all(type(bound) in (int, float) and 0 <= bound < math.inf for bound in bounds):
            raise TypeError(f"the tolerance of {token!r} is {bounds!r}, not two numbers of 0 or more")
        found[token] = Tolerance(*map(float, bounds))
    return found
