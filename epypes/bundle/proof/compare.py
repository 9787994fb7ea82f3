"""Comparison of two values, to the last bit or within a tolerance, and the first place where they differ.

Noise is floating-point numbers that differ in less than half of their digits, which is what summing in another order
does. A bundle tolerates noise that its proof has seen, SAFETY times as large. Nothing else is tolerated.
"""

from __future__ import annotations

import decimal
import math
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

from epypes.errors import InvalidType
from epypes.optional import optional_import
from epypes.wire.encoder import set_sort_key
from epypes.wire.opencv import FIELDS, record_fields, record_type
from epypes.wire.tables import is_table, table_parts
from epypes.wording import counted

# As Python and OpenCV write them; other text may hold numbers that look alike.
_ADDRESS: Final = re.compile(r"( at |< ?[\w.]+ )0x[0-9a-fA-F]+")
# Whose repr says all of it.
_EXACT: Final = (bool, int, str, bytes, bytearray, type(None))
# What is left where large numbers of an array cancel each other is a few of the last digits of those.
FLOOR: Final = 16.0
# The next run may be further off than the worst of a few; ten times that is far below any change of an algorithm.
SAFETY: Final = 10.0
_MEANING: Final = (
    f"Replays of the samples gave other last digits: a replay may differ by {SAFETY:g} times as",
    "much, and each number by no more than the relative part of its own magnitude.",
)
# One digit is enough: people read the file, and small changes of the noise don't change it.
_ONE_DIGIT_UP: Final = decimal.Context(prec=1, rounding=decimal.ROUND_UP)


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
    elif isinstance(expected, set | frozenset):
        left, right = ({*map(set_sort_key, items)} for items in (expected, got))
        if left != right:
            yield _named(where, f"{sorted(left - right)!r:.60} in the set", f"{sorted(right - left)!r:.60}")
    elif (parts := _parts(expected)) is not None:
        others = _parts(got) or []
        left_at, right_at = ([place for place, _ in side] for side in (parts, others))
        if left_at == right_at:
            for (place, left), (_, right) in zip(parts, others, strict=True):
                yield from differences(left, right, tolerance, f"{where}{place} ")
        elif isinstance(expected, list | tuple):
            yield _named(where, f"{len(parts)} items", f"{len(others)}")
        else:
            yield _named(where, f"the keys {', '.join(left_at):.80}", f"{', '.join(right_at):.80}")
    else:
        yield from _in_objects(expected, got, tolerance, where)


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


def _parts(value: Any) -> list[tuple[str, Any]] | None:
    """Return what a container, an OpenCV record or a table consists of, each with its place; None for another value."""
    if isinstance(value, Mapping):
        # 1, 1.0 and True are equal, but not the same: by their text they differ.
        return [(f"[{_described(key)}]", part) for key, part in value.items()]
    if isinstance(value, list | tuple):
        return [(f"[{index}]", part) for index, part in enumerate(value)]
    if name := record_type(value):
        return [(f".{field}", part) for field, part in zip(FIELDS[name], record_fields(value), strict=True)]
    return table_parts(value) if is_table(value) else None


def _described(value: Any) -> str:
    """Return the repr of a value, of an object without its address."""
    if type(value) in (float, complex):
        return exact_text(value)
    return repr(value) if type(value) in _EXACT else _ADDRESS.sub(r"\g<1>0x", repr(value))


def exact_text(number: complex) -> str:
    """Return a number as a text that tells -0.0 from 0.0 and -NaN from NaN, and makes each agree with itself."""
    if type(number) is complex and number != number:
        return f"({exact_text(number.real)}, {exact_text(number.imag)})"
    is_negative = type(number) is float and number != number and math.copysign(1.0, number) < 0
    return f"-{number!r}" if is_negative else repr(number)


def _in_objects(expected: Any, got: Any, tolerance: Tolerance | None, where: str) -> Iterator[Difference]:
    left, right = _described(expected), _described(got)
    if left == right:
        return
    found = _named(where, f"{left:.60}", f"{right:.60}")
    if type(expected) in (int, float, complex):
        import numpy as np

        numbers = np.array([expected, got])
        if not numbers.dtype.hasobject:  # as integers beyond 64 bits have
            for measured in _in_arrays(numbers[:1], numbers[1:], tolerance, where):
                yield replace(measured, text=found.text, index=found.index)
            return
    yield found


def _in_arrays(expected: Any, got: Any, tolerance: Tolerance | None, where: str) -> Iterator[Difference]:
    import numpy as np

    if expected.dtype != got.dtype or expected.shape != got.shape:
        yield _named(where, f"{expected.dtype} {expected.shape}", f"{got.dtype} {got.shape}")
        return
    left, right = (np.ascontiguousarray(side).reshape(-1) for side in (expected, got))
    if left.dtype.hasobject:
        yield from differences(left.tolist(), right.tolist(), tolerance, where)
        return
    if left.tobytes() == right.tobytes():
        return
    unlike = (left.view(np.uint8).reshape(left.size, -1) != right.view(np.uint8).reshape(left.size, -1)).any(axis=1)
    distance, relative, epsilon = _distances(left, right)
    if tolerance and epsilon:
        unlike &= (distance > tolerance.absolute) | (relative > tolerance.relative)
    if not unlike.any():
        return
    first, count = int(unlike.argmax()), int(unlike.sum())
    index = list(map(int, np.unravel_index(first, expected.shape))) if expected.shape else []
    text = f"{where}{count} of {left.size} values differ, first at {index}: expected {left[first]}, got {right[first]}"
    largest = None if distance is None else float(distance[unlike].max())
    largest = None if largest is None or not math.isfinite(largest) else largest
    if largest is not None and count > 1:
        text += f"; the largest difference is {largest:.6g}"
    part = float(relative[unlike].max()) if epsilon else 0.0
    is_noise = epsilon > 0 and part <= math.sqrt(epsilon)
    yield Difference(text, where.replace(" ", "") + str(index), count, largest, part, is_noise)


def _distances(left: Any, right: Any) -> tuple[Any, Any, float]:
    """Return how far numbers differ, also as parts of the left ones (see Tolerance), and their epsilon.

    Epsilon is 0.0 for what no tolerance covers: integers, and what is infinite or NaN on one side alone.
    """
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
        relative = np.where(distance == 0.0, 0.0, distance / magnitude)
    return distance, relative, epsilon if np.isfinite(distance).all() else 0.0


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
            entry.add(tomlkit.comment(line))
        for name, bound in (("absolute", noise.largest or 0.0), ("relative", noise.relative)):
            rounded = float(_ONE_DIGIT_UP.create_decimal_from_float(SAFETY * bound))
            entry.add(name, max(rounded, known.get(name, 0.0)))
        entries[noise.token] = entry


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
            raise InvalidType(f"the tolerance of {token!r} is {bounds!r}, not two numbers of 0 or more")
        found[token] = Tolerance(*map(float, bounds))
    return found
