"""When are two values the same to the hand that set them, and how is a value said in a few words?"""

from __future__ import annotations

import enum
import math
from collections.abc import Mapping, Sequence
from typing import Any, Final

from epypes.display.previews.model import Look
from epypes.display.previews.preview import sketch
from epypes.run.guard import is_array

_CONTAINERS: Final = (tuple, list, dict)
_MOST_NAMED: Final = 3
_TEXT_CHARACTERS: Final = 120


def is_same(one: Any, other: Any) -> bool:
    """Whether two values are of one type and equal to the last bit; arrays are never compared, but by their memory.

    Unlike for staleness, NaN is the same as NaN: nobody has moved it.
    """
    if one is other:
        return True
    if type(one) is not type(other) or isinstance(one, enum.Enum):
        return False
    if is_array(one):
        return _memory(one) == _memory(other)
    try:
        return _is_same_content(one, other) if type(one) in _CONTAINERS else _is_equal(one, other)
    except Exception:  # whatever a user's own __eq__ raises, or RecursionError
        return False


def differing(before: Mapping[str, Any], after: Mapping[str, Any]) -> tuple[str, ...]:
    """Return the names whose values are not the same, or that one of the two lacks."""
    names = dict.fromkeys((*after, *before))
    return tuple(
        name for name in names if not (name in before and name in after and is_same(before[name], after[name]))
    )


def said(value: Any) -> str:
    """Return a value as a text of at most 30 characters, the same in every process."""
    return sketch(value, Look("bgr")).shown.text


def said_change(before: Mapping[str, Any], after: Mapping[str, Any]) -> str:
    """Return what has changed, as ``"canny_lo 70 -> 90, blur 3 -> 5"``; of more than three names the number is said."""
    names = differing(before, after)
    parts = [f"{name} {_said_step(before, after, name)}" for name in names[:_MOST_NAMED]]
    more = [f"and {len(names) - _MOST_NAMED} more"] if len(names) > _MOST_NAMED else []
    text = ", ".join([*parts, *more])
    return text if len(text) <= _TEXT_CHARACTERS else text[: _TEXT_CHARACTERS - 1] + "…"


def _said_step(before: Mapping[str, Any], after: Mapping[str, Any], name: str) -> str:
    old, new = _side(before, name), _side(after, name)
    # Two arrays of one shape are said alike.
    return f"{old} -> {new}" if old != new else "changed"


def _side(values: Mapping[str, Any], name: str) -> str:
    return said(values[name]) if name in values else "nothing"


def _memory(array: Any) -> tuple[object, ...]:
    # The runner gives an array as another view each time.
    return array.__array_interface__["data"][0], array.shape, array.strides, array.dtype


def _is_same_content(one: Any, other: Any) -> bool:
    if type(one) is dict:
        return list(one) == list(other) and _is_same_content(list(one.values()), list(other.values()))
    return len(one) == len(other) and all(map(is_same, one, other))


def _is_equal(one: Any, other: Any) -> bool:
    if isinstance(one, float):
        # 0.0 == -0.0, but they do not always compute the same.
        return (math.isnan(one) and math.isnan(other)) or (
            one == other and math.copysign(1, one) == math.copysign(1, other)
        )
    if hasattr(one, "dtype") and hasattr(one, "tobytes"):
        # By their texts, which are exact, and tell -0.0 from 0.0: a long double has bytes that mean nothing.
        return bool(one.dtype == other.dtype and repr(one) == repr(other))
    # What answers with an array of answers is told apart by identity, like arrays.
    return (one == other) is True


def listed(names: Sequence[str]) -> str:
    """Return names in a row, such as ``kernel, mask and lut``."""
    return ", ".join(names) if len(names) < 2 else f"{', '.join(names[:-1])} and {names[-1]}"
