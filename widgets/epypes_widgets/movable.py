"""Which values are numbers that a slider can be moved along?"""

from __future__ import annotations

import math
import numbers
from typing import Any, Final

# Beyond, JavaScript's numbers skip integers; a third of it, since the range offered reaches to three times the value.
_LARGEST_INTEGER: Final = 2**53 // 3


def is_number(value: Any) -> bool:
    """Whether a value is a finite number, not a bool, that the front end can show exactly."""
    if isinstance(value, bool) or not isinstance(value, numbers.Real):
        return False
    try:
        size = abs(float(value))
    except (OverflowError, TypeError, ValueError):  # 10**400, or a duration of NumPy, which calls itself an integer
        return False
    return math.isfinite(size) and (size <= _LARGEST_INTEGER or not isinstance(value, numbers.Integral))


def is_integer(value: Any) -> bool:
    """Whether a value is an integer, of Python's or NumPy's."""
    return isinstance(value, numbers.Integral) and not isinstance(value, bool)


def plain(value: Any) -> Any:
    """Return a number of NumPy as Python's, anything else as it is: ranges are guessed from Python's types."""
    if not is_number(value):
        return value
    return int(value) if isinstance(value, numbers.Integral) else float(value)
