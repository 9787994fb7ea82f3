"""How are values of hyperparameters written in a message?"""

from __future__ import annotations

import enum
import json
import math
import numbers
import reprlib
from collections.abc import Mapping
from typing import Any


def plain_values(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return hyperparameters as JSON has them."""
    return {name: plain(value) for name, value in values.items()}


def plain(value: Any) -> Any:
    """Return a value as JSON has it: numbers, strings, None; all others by a short repr."""
    if value is None or isinstance(value, bool | str):
        return value
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, numbers.Integral):
        return int(value)
    # JSON has neither infinity nor NaN.
    if isinstance(value, numbers.Real) and math.isfinite(float(value)):
        return float(value)
    try:
        return json.loads(json.dumps(value, allow_nan=False))
    except (TypeError, ValueError):
        return reprlib.repr(value)
