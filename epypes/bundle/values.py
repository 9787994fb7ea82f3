"""Which expression makes a value again?"""

from __future__ import annotations

import dataclasses
import pathlib
import re
import sys
from collections.abc import Callable
from datetime import timedelta
from decimal import Decimal
from fractions import Fraction
from operator import attrgetter, itemgetter, methodcaller
from typing import TYPE_CHECKING, Annotated, Any, Final, get_origin

from epypes.bundle.literal import literal_source
from epypes.bundle.records import made_again
from epypes.bundle.source import Importable, Refused, importable
from epypes.hints import Param
from epypes.images import Image
from epypes.run.guard import is_plain_array

if TYPE_CHECKING:
    from epypes.bundle.slicer import Slice

FunctionWriter = Callable[[Any], str]
_TELL_THEIR_CALL: Final = (itemgetter, attrgetter, methodcaller, timedelta, Fraction, Decimal)
# What a person still reads.
_MOST_NUMBERS: Final = 200


def expression(gathered: Slice, value: Any, what: str, function: FunctionWriter | None = None) -> str:
    """Return the expression of a value, with what it needs imported; "" if there is none.

    Parameters
    ----------
    gathered
        The module that it is for; is added to.
    value
        A literal, a small array, a number of NumPy's, a member of an enumeration, something that can be imported, a
        simple object such as a range or an itemgetter, or a tuple, list or dict of these.
    what
        How to call it in a reason.
    function
        Returns the expression of a function of the notebook; without, there is none.
    """
    return (
        literal_source(value)
        or _container(gathered, value, what, function)
        or _called(gathered, value, what, function)
        or _object(gathered, value, what, function)
    )


def _container(gathered: Slice, value: Any, what: str, function: FunctionWriter | None) -> str:
    if type(value) in (tuple, list):
        parts = [expression(gathered, item, what, function) for item in value]
        inner = ", ".join(parts)
        whole = f"[{inner}]" if type(value) is list else f"({inner},)" if len(parts) == 1 else f"({inner})"
        return whole if all(parts) else ""
    if type(value) is dict:
        pairs = [[expression(gathered, part, what, function) for part in pair] for pair in value.items()]
        return f"{{{', '.join(map(': '.join, pairs))}}}" if all(map(all, pairs)) else ""
    if type(value) is frozenset:
        inner = literal_source(set(value)) if value else ""
        name = gathered.reference(Importable("builtins", "frozenset"), what)
        return f"{name}({inner})" if inner or not value else ""
    return ""


def _called(gathered: Slice, value: Any, what: str, function: FunctionWriter | None) -> str:
    """Return the call that makes a simple object again."""
    if isinstance(value, re.Pattern):
        return _pattern(gathered, value, what)
    made_by, arguments = _call_of(value)
    home = importable(made_by) if made_by is not None else None
    parts = [expression(gathered, argument, what, function) for argument in arguments] if home else []
    return f"{gathered.reference(home, what)}({', '.join(parts)})" if home and all(parts) else ""


def _pattern(gathered: Slice, value: re.Pattern[Any], what: str) -> str:
    """Return the call that compiles a pattern again, its flags by name."""
    # The flag for text is what re.compile adds by itself.
    flags = re.RegexFlag(value.flags) & ~(re.UNICODE if isinstance(value.pattern, str) else re.NOFLAG)
    module = gathered.module_name("re", what)
    named = " | ".join(f"{module}.{flag.name}" for flag in flags)
    return f"{module}.compile({', '.join(filter(None, (literal_source(value.pattern), named)))})"


def _call_of(value: Any) -> tuple[Any, tuple[Any, ...]]:
    """Return what makes an object again, and with which arguments; None for what is no simple object."""
    if type(value) is range:
        every = (value.start, value.stop, value.step)
        return range, every if value.step != 1 else every[not value.start : 2]
    if type(value) is slice:
        return slice, (value.start, value.stop) if value.step is None else (value.start, value.stop, value.step)
    if isinstance(value, pathlib.PurePath):
        return pathlib.Path, (str(value),)
    if type(value).__module__.partition(".")[0] == "numpy" and isinstance(value, sys.modules["numpy"].dtype):
        return sys.modules["numpy"].dtype, (value.str if value.names is None else "",)
    if type(value) in _TELL_THEIR_CALL:
        made_by, arguments = value.__reduce__()[:2]
        return made_by, arguments
    return None, ()


def _object(gathered: Slice, value: Any, what: str, function: FunctionWriter | None) -> str:
    if is_plain_array(value):
        return gathered.arrays.written(gathered, value, what, _array(gathered, value, what))
    if type(value) is float:
        # Only what is no number has no literal.
        return f'{gathered.reference(Importable("builtins", "float"), what)}("{value!r}")'
    if _is_numpy_number(value):
        number = expression(gathered, value.item(), what)
        return f"{gathered.reference(Importable('numpy', type(value).__name__), what)}({number})"
    mark = _mark(gathered, value, what)
    if mark:
        return mark
    made = made_again(
        value,
        lambda part: expression(gathered, part, what),
        lambda kind: gathered.add_class(kind, None, f"Class {kind.__name__!r} of {what[0].lower()}{what[1:]}"),
    )
    if made:
        return made
    home = importable(value)
    if home is None and function is not None and callable(value) and not isinstance(value, type):
        return function(value)
    return gathered.reference(home, what) if home else ""


def _is_numpy_number(value: Any) -> bool:
    """Whether this is a scalar of NumPy's that Python's own numbers hold to the last bit."""
    numpy = sys.modules.get("numpy")
    if numpy is None or not isinstance(value, numpy.number | numpy.bool_):
        return False
    return value.dtype.kind in "biuf" and value.dtype.itemsize <= 8


def _array(gathered: Slice, array: Any, what: str) -> str:
    """Return a small array of numbers as source that makes it again, to the last bit; "" for any other."""
    import numpy as np

    if array.dtype.kind not in "biuf" or array.dtype.itemsize > 8 or array.size > _MOST_NUMBERS:
        return ""
    listed = repr(array.tolist())
    if "nan" in listed or "inf" in listed or np.array(array.tolist(), array.dtype).shape != array.shape:
        return ""
    if not array.flags.c_contiguous and not array.flags.f_contiguous:
        text = (
            f"{what} has an array that is a view of another, with gaps or reversed, which would be laid out otherwise"
        )
        raise Refused(f"{text}. Make it a whole one in the notebook: np.ascontiguousarray(...).")
    order = "" if array.flags.c_contiguous else ", order='F'"
    return f"{gathered.module_name('numpy', what)}.array({listed}, dtype={str(array.dtype)!r}{order})".replace("'", '"')


def _mark(gathered: Slice, value: Any, what: str) -> str:
    """Return the source of a mark, or of ``Annotated`` with marks, as annotations use them; "" for any other."""
    if isinstance(value, Image | Param):
        given = [(field.name, getattr(value, field.name), field.default) for field in dataclasses.fields(value)]
        words = [(name, literal_source(setting)) for name, setting, default in given if setting != default]
        if not all(source for _, source in words):
            return ""
        listed = ", ".join(f"{name}={source}" for name, source in words)
        return f"{gathered.module_name('epypes', what)}.{type(value).__name__}({listed})"
    home = importable(value.__origin__) if get_origin(value) is Annotated else None
    parts = [_mark(gathered, mark, what) for mark in value.__metadata__] if home else [""]
    if home is None or not all(parts):
        return ""
    plain = home.qualname if home.module == "builtins" else f"{gathered.module_name(home.module, what)}.{home.qualname}"
    return f"{gathered.reference(Importable('typing', 'Annotated'), what)}[{plain}, {', '.join(parts)}]"
