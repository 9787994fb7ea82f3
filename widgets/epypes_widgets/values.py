"""Values of hyperparameters: their type, whether two are the same, and how they are written in texts and messages."""

from __future__ import annotations

import enum
import json
import math
import numbers
import sys
from collections.abc import Mapping, Sequence
from typing import Any, Final

from epypes.display.previews import Look
from epypes.display.previews.preview import sketch
from epypes.display.previews.short import short_repr
from epypes.run.guard import is_array

# Beyond, JavaScript's numbers skip integers; a third of it, since the range offered reaches to three times the value.
_LARGEST_INTEGER: Final = 2**53 // 3
_LARGEST_IN_JSON: Final = 2**63
_CONTAINERS: Final = (tuple, list, dict)
_MAX_NAMED: Final = 3
_CHANGE_CHARACTERS: Final = 40
_MAX_CHARACTERS: Final = 1_000
_MAX_ITEMS: Final = 100


def is_number(value: Any) -> bool:
    """Whether a value is a real, finite number that a float can be near to; truth values are none."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        return False
    try:
        return math.isfinite(float(value))
    except (OverflowError, TypeError, ValueError):  # 10**400, or a duration of NumPy, which calls itself an integer
        return False


def is_truth(value: Any) -> bool:
    """Whether a value is True or False, of Python or of NumPy."""
    return isinstance(value, bool) or getattr(numpy_type(value), "__name__", "") in ("bool", "bool_")


def is_integer(value: Any) -> bool:
    """Whether a value is of a type of whole numbers: 1.0 is a float on purpose, and so is what it ranges over."""
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def is_movable(value: Any) -> bool:
    """Whether a value is a number that the front end can show exactly."""
    return is_number(value) and (not is_integer(value) or abs(int(value)) <= _LARGEST_INTEGER)


def numpy_type(value: Any) -> type | None:
    """Return the type of a scalar of NumPy, None of anything else."""
    numpy = sys.modules.get("numpy")
    return type(value) if numpy is not None and isinstance(value, numpy.generic) else None


def as_python(number: Any) -> Any:
    """Return a truth value or a movable number as Python's, anything else as it is."""
    if is_truth(number):
        return bool(number)
    if not is_movable(number):
        return number
    return int(number) if isinstance(number, numbers.Integral) else _shortest(number)


def _shortest(number: Any) -> float:
    """Return a real number as a float: of NumPy's float32 0.3, not 0.30000001192092896."""
    return float(number if numpy_type(number) is None else str(number))


# -- the same -----------------------------------------------------------------------------------------------------


def is_same(one: Any, other: Any) -> bool:
    """Whether two values are of one type and equal to the last bit; arrays are never compared, but by their memory.

    Unlike for staleness, NaN is the same as NaN: it has not been changed.
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


def _memory(array: Any) -> tuple[object, ...]:
    # The runner gives an array as another view each time.
    return array.__array_interface__["data"][0], array.shape, array.strides, array.dtype


def _is_same_content(one: Any, other: Any) -> bool:
    if type(one) is dict:
        return list(one) == list(other) and _is_same_content(list(one.values()), list(other.values()))
    return len(one) == len(other) and all(map(is_same, one, other))


def _is_equal(one: Any, other: Any) -> bool:
    if isinstance(one, float) or numpy_type(one) is not None:
        # By their texts, which are exact: they tell -0.0 from 0.0, and NaN is NaN.
        return getattr(one, "dtype", None) == getattr(other, "dtype", None) and repr(one) == repr(other)
    # A comparison that gives an array of answers does not tell whether two values are the same.
    return (one == other) is True


# -- texts --------------------------------------------------------------------------------------------------------


def short_text(value: Any) -> str:
    """Return a value as a text of at most 30 characters, the same in every process."""
    return sketch(value, Look("bgr")).shown.text


def setting_text(values: Mapping[str, Any]) -> str:
    """Return values by hyperparameter as ``"canny_lo 90, blur 5"``."""
    return ", ".join(f"{name} {short_text(value)}" for name, value in values.items())


def change_text(before: Mapping[str, Any], after: Mapping[str, Any], most: int = _MAX_NAMED) -> str:
    """Return what has changed, as ``"canny_lo 70 -> 90, blur 3 -> 5"``; of more names than ``most``, how many."""
    names = differing(before, after)
    parts = [f"{name} {_step(before, after, name)}" for name in names[:most]]
    more = [f"and {len(names) - most} more"] if len(names) > most else []
    text, room = ", ".join([*parts, *more]), most * _CHANGE_CHARACTERS
    return text if len(text) <= room else text[: room - 1] + "…"


def _step(before: Mapping[str, Any], after: Mapping[str, Any], name: str) -> str:
    old, new = (short_text(values[name]) if name in values else "nothing" for values in (before, after))
    # Two arrays of one shape have the same text.
    return f"{old} -> {new}" if old != new else "changed"


def listed(names: Sequence[str]) -> str:
    """Return names in a row, such as ``kernel, mask and lut``."""
    return ", ".join(names) if len(names) < 2 else f"{', '.join(names[:-1])} and {names[-1]}"


def sendable(text: str) -> str:
    """Return text without halves of surrogate pairs, which no message can hold."""
    return text.encode("utf-8", "replace").decode("utf-8")


# -- messages -----------------------------------------------------------------------------------------------------


def json_values(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return hyperparameters as JSON has them."""
    return {name: json_value(value) for name, value in values.items()}


def json_value(value: Any) -> Any:
    """Return a value as JSON has it: numbers, strings, None, short lists of them; all others by a short repr.

    What every frame carries must be small, whatever a hyperparameter is.
    """
    if isinstance(value, enum.Enum):
        return value.name
    try:
        if is_truth(value):
            return bool(value)
        if isinstance(value, numbers.Integral):
            value = int(value) if abs(int(value)) <= _LARGEST_IN_JSON else short_repr(value)
        elif isinstance(value, numbers.Real):
            value = _shortest(value)
        elif isinstance(value, tuple | list) and len(value) > _MAX_ITEMS:
            return short_repr(value)
        # JSON has neither infinity nor NaN.
        text = json.dumps(value, allow_nan=False) if not isinstance(value, dict) else ""
        return json.loads(text) if 0 < len(text) <= _MAX_CHARACTERS else short_repr(value)
    except Exception:  # a number beyond all bounds, an object that is like nothing else
        return short_repr(value)
