"""Do two values agree to the last bit, and if not, where do they first differ?"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from epypes.wording import counted


@dataclass(frozen=True, slots=True)
class Difference:
    """The first place where a token is not what was recorded."""

    sample: str
    token: str
    text: str

    def __str__(self) -> str:
        return f"sample {self.sample}, token {self.token!r}: {self.text}"


@dataclass(frozen=True, slots=True)
class ReplayReport:
    """What a replay found.

    Attributes
    ----------
    samples
        How many samples were replayed.
    tokens
        How many tokens were compared.
    differences
        The first difference of each token that differs.
    requirements
        What the replay imported, pinned, one requirement per entry.
    """

    samples: int
    tokens: int
    differences: tuple[Difference, ...]
    requirements: tuple[str, ...]

    @property
    def identical(self) -> bool:
        """Whether every token was what had been recorded, and there was one."""
        return self.tokens > 0 and not self.differences

    def __str__(self) -> str:
        if self.identical:
            return f"identical: {counted(self.tokens, 'token')} of {counted(self.samples, 'sample')}"
        return "\n".join(map(str, self.differences)) or "nothing was compared: the bundle has no samples"


def first_difference(expected: Any, got: Any, where: str = "") -> str | None:
    """Return where two values first differ, as text, or None if they agree in type and to the last bit."""
    if type(expected) is not type(got):
        return f"{where}expected type {type(expected).__name__}, got {type(got).__name__}"
    if hasattr(expected, "dtype") and hasattr(expected, "shape"):
        return _array_difference(expected, got, where)
    if isinstance(expected, Mapping):
        return _mapping_difference(expected, got, where)
    if isinstance(expected, list | tuple):
        return _sequence_difference(expected, got, where)
    # repr tells -0.0 from 0.0 and makes NaN agree with itself.
    return None if repr(expected) == repr(got) else f"{where}expected {expected!r:.60}, got {got!r:.60}"


def _mapping_difference(expected: Mapping[Any, Any], got: Mapping[Any, Any], where: str) -> str | None:
    if list(expected) != list(got):
        return f"{where}expected the keys {list(expected)!r:.80}, got {list(got)!r:.80}"
    pairs = ((expected[key], got[key], f"{where}[{key!r}] ") for key in expected)
    return next((found for pair in pairs if (found := first_difference(*pair))), None)


def _sequence_difference(expected: Any, got: Any, where: str) -> str | None:
    if len(expected) != len(got):
        return f"{where}expected {len(expected)} items, got {len(got)}"
    items = enumerate(zip(expected, got, strict=True))
    found = (first_difference(left, right, f"{where}[{index}] ") for index, (left, right) in items)
    return next((text for text in found if text), None)


def _array_difference(expected: Any, got: Any, where: str) -> str | None:
    import numpy as np

    if expected.dtype != got.dtype or expected.shape != got.shape:
        kinds = f"{expected.dtype} {expected.shape}, got {got.dtype} {got.shape}"
        return f"{where}expected {kinds}"
    left, right = np.ascontiguousarray(expected).reshape(-1), np.ascontiguousarray(got).reshape(-1)
    if left.tobytes() == right.tobytes():
        return None
    size = left.dtype.itemsize
    unlike = (left.view(np.uint8).reshape(-1, size) != right.view(np.uint8).reshape(-1, size)).any(axis=1)
    first = int(unlike.argmax())
    index = tuple(map(int, np.unravel_index(first, expected.shape))) if expected.shape else ()
    count = f"{int(unlike.sum())} of {left.size} values differ"
    return f"{where}{count}, first at {list(index)}: expected {left[first]}, got {right[first]}"
