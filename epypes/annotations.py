"""What do the annotations of a function say, once their text is evaluated?"""

from __future__ import annotations

from collections.abc import Mapping
from types import FunctionType
from typing import Any, Final, get_type_hints
from weakref import WeakKeyDictionary

_NOTHING: Final[Mapping[str, Any]] = {}
# Weak, so that a function of a notebook that was defined again can go. To evaluate annotations takes some 30 us.
_EVALUATED: Final[WeakKeyDictionary[FunctionType, Mapping[str, Any]]] = WeakKeyDictionary()


def hints_of(function: object) -> Mapping[str, Any]:
    """Return the type hints of a function by parameter, and that of ``return``; not to be changed.

    ``Annotated`` is kept. Empty where there are none, and where they can't be evaluated: a name that is not defined
    yet, a class that others have nothing to do with, whatever the text of an annotation raises.
    """
    if not isinstance(function, FunctionType):
        return _evaluated(function) or _NOTHING
    if not function.__annotations__:
        return _NOTHING
    hints = _EVALUATED.get(function)
    if hints is None:
        hints = _evaluated(function)
        if hints is None:
            return _NOTHING  # and not for good: the names may be defined later
        _EVALUATED[function] = hints
    return hints


def _evaluated(function: Any) -> Mapping[str, Any] | None:
    try:
        return get_type_hints(function, include_extras=True)
    except Exception:  # what the text of an annotation raises is the user's
        return None
