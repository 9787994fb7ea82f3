"""Which values are numbers that a slider can be moved along?"""

from __future__ import annotations

import math
import numbers
from typing import Any, Final

# Beyond, JavaScript's numbers skip integers; a third of it, since the range offered reaches to three times the value.
_LARGEST_INTEGER: Final = 2**53 // 3


def is_number(value: Any) -> bool:
    """Whether a value is a real, finite number that a float can be near to; truth values are none."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        return False
    try:
        return math.isfinite(float(value))
    except (OverflowError, TypeError, ValueError):  # 10**400, or a duration of NumPy, which calls itself an integer
        return False


def is_movable(value: Any) -> bool:
    """Whether a value is a number that the front end can show exactly."""
    return is_number(value) and (not isinstance(value, numbers.Integral) or abs(int(value)) <= _LARGEST_INTEGER)


def is_integer(value: Any) -> bool:
    """Whether a value is of a type of whole numbers: 1.0 is a float on purpose, and so is what it ranges over."""
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def plain(value: Any) -> Any:
    """Return a number of NumPy as Python's, anything else as it is: ranges are guessed from Python's types."""
    if not is_movable(value):
        return value
    return int(value) if isinstance(value, numbers.Integral) else float(value)
