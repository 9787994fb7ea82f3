"""How are values of hyperparameters written in a message?"""

from __future__ import annotations

import enum
import json
import math
import numbers
from collections.abc import Mapping
from typing import Any, Final

from epypes.display.previews.short import short_repr

_MOST_CHARACTERS: Final = 1_000
_MOST_ITEMS: Final = 100
_LARGEST: Final = 2**63


def plain_values(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return hyperparameters as JSON has them."""
    return {name: plain(value) for name, value in values.items()}


def plain(value: Any) -> Any:
    """Return a value as JSON has it: numbers, strings, None, short lists of them; all others by a short repr.

    What every frame carries must be small, whatever a hyperparameter is.
    """
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, enum.Enum):
        return value.name
    if isinstance(value, str):
        return value if len(value) <= _MOST_CHARACTERS else short_repr(value)
    try:
        return _plain_number(value) if isinstance(value, numbers.Real) else _plain_items(value)
    except Exception:  # a number beyond all bounds, an object that is like nothing else
        return short_repr(value)


def _plain_number(value: Any) -> Any:
    if isinstance(value, numbers.Integral):
        return int(value) if abs(int(value)) <= _LARGEST else short_repr(value)
    # JSON has neither infinity nor NaN.
    return float(value) if math.isfinite(float(value)) else short_repr(value)


def _plain_items(value: Any) -> Any:
    if not isinstance(value, tuple | list) or len(value) > _MOST_ITEMS:
        return short_repr(value)
    text = json.dumps(value, allow_nan=False)
    return json.loads(text) if len(text) <= _MOST_CHARACTERS else short_repr(value)
