"""In which circumstances are values looked at?"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from contextvars import ContextVar
from typing import Any, Final

_is_looking: Final = ContextVar("_is_looking", default=False)


def silent_numpy() -> AbstractContextManager[Any]:
    """Return what keeps numpy from warning of numbers that overflow or are none: they are counted, and shown."""
    numpy = sys.modules.get("numpy")
    return nullcontext() if numpy is None else numpy.errstate(all="ignore")


@contextmanager
def looking() -> Iterator[bool]:
    """Look at a value: numpy keeps silent about numbers that overflow.

    Yields
    ------
    bool
        Whether another value is being looked at meanwhile, since a function or repr of a user's shows a picture. One
        that shows the run that its own value is in would never come to an end.
    """
    is_nested = _is_looking.get()
    token = _is_looking.set(True)
    try:
        with silent_numpy():
            yield is_nested
    finally:
        _is_looking.reset(token)
