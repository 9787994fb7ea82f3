"""Which expression makes a value again?"""

from __future__ import annotations

import sys
from typing import Any

from epypes.bundle.classes import made_again
from epypes.bundle.literal import literal_source
from epypes.bundle.slicer import Slice
from epypes.bundle.source import Importable, importable
from epypes.run.guard import is_plain_array


def expression(gathered: Slice, value: Any, what: str) -> str:
    """Return the expression of a value, with what it needs imported; "" if there is none.

    Parameters
    ----------
    gathered
        The module that it is for; is added to.
    value
        A literal, a small array, a number of NumPy's, a member of an enumeration, something that can be imported, or a
        tuple, list or dict of these.
    what
        How to call it in a reason.
    """
    return literal_source(value) or _container(gathered, value, what) or _object(gathered, value, what)


def _container(gathered: Slice, value: Any, what: str) -> str:
    if type(value) in (tuple, list):
        parts = [expression(gathered, item, what) for item in value]
        inner = ", ".join(parts)
        whole = f"[{inner}]" if type(value) is list else f"({inner},)" if len(parts) == 1 else f"({inner})"
        return whole if all(parts) else ""
    if type(value) is dict:
        pairs = [(expression(gathered, key, what), expression(gathered, item, what)) for key, item in value.items()]
        return f"{{{', '.join(map(': '.join, pairs))}}}" if all(map(all, pairs)) else ""
    if type(value) is frozenset:
        inner = literal_source(set(value)) if value else ""
        name = gathered.reference(Importable("builtins", "frozenset"), what)
        return f"{name}({inner})" if inner or not value else ""
    return ""


def _object(gathered: Slice, value: Any, what: str) -> str:
    if is_plain_array(value):
        return gathered.array_source(value, what)
    if type(value) is float:
        # Only what is no number has no literal.
        return f'{gathered.reference(Importable("builtins", "float"), what)}("{value!r}")'
    if _is_numpy_number(value):
        number = expression(gathered, value.item(), what)
        return f"{gathered.reference(Importable('numpy', type(value).__name__), what)}({number})"
    made = made_again(
        value,
        lambda part: expression(gathered, part, what),
        lambda kind: gathered.add_class(kind, None, f"Class {kind.__name__!r} of {what[0].lower()}{what[1:]}"),
    )
    if made:
        return made
    home = importable(value)
    return gathered.reference(home, what) if home else gathered.annotation_source(value, what)


def _is_numpy_number(value: Any) -> bool:
    """Whether this is a scalar of NumPy's that Python's own numbers hold to the last bit."""
    numpy = sys.modules.get("numpy")
    if numpy is None or not isinstance(value, numpy.number | numpy.bool_):
        return False
    return value.dtype.kind in "biuf" and value.dtype.itemsize <= 8
