"""Of which type is a value that a hand has moved?

Numbers and texts of NumPy keep their type: code that runs on ``uint8`` would do something else on ``int``. All others
become Python's own.
"""

from __future__ import annotations

import math
import numbers
import sys
from collections.abc import Callable
from typing import Any

from epypes.run.staleness import is_same_value


def kept_type(value: Any) -> type | None:
    """Return the type of a scalar of NumPy, None of anything else."""
    numpy = sys.modules.get("numpy")
    return type(value) if numpy is not None and isinstance(value, numpy.generic) else None


def like(value: Any) -> Callable[[Any], Any]:
    """Return what makes a moved value one of the type of ``value``."""
    return kept_type(value) or (lambda moved: moved)


def limits(value: Any) -> tuple[float, float]:
    """Return the least and the greatest number of a value's type."""
    kind = kept_type(value)
    if kind is None or not isinstance(value, numbers.Real):
        return -math.inf, math.inf
    import numpy as np

    if issubclass(kind, np.integer):
        return int(np.iinfo(kind).min), int(np.iinfo(kind).max)
    ends: Any = np.finfo(kind)
    return float(ends.min), float(ends.max)


def plain(number: Any) -> Any:
    """Return a number of NumPy as Python's, any other as it is: NumPy's overflow when compared with greater ones."""
    return number.item() if kept_type(number) is not None else number


def is_truth(value: Any) -> bool:
    """Whether a value is True or False, of Python or of NumPy."""
    kind = kept_type(value)
    return isinstance(value, bool) or (kind is not None and kind.__name__ in ("bool", "bool_"))


def is_same(old: Any, new: Any) -> bool:
    """Whether two values are surely the same: of one type and equal."""
    if old is new or is_same_value(old, new):
        return True
    return type(old) is type(new) and kept_type(old) is not None and bool(old == new)
