"""What are the parameters of a function called, a C function's too?"""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable
from typing import Any

# The first line of a docstring of OpenCV: "blur(src, ksize[, dst[, anchor]]) -> dst".
_SIGNATURE = re.compile(r"[\w.]+\(([^()]*)\)")


def parameter_names(function: Callable[..., Any]) -> tuple[str, ...]:
    """Return the names of the parameters that can be given by position; empty if they are not known. Never raises.

    Examples
    --------
    >>> parameter_names(lambda image, k, *rest: image)
    ('image', 'k')
    """
    try:
        signature = inspect.signature(function)
    except Exception:  # C functions have no signature, and what odd objects raise is their own
        return _documented_names(function)
    positional = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    names = tuple(name for name, parameter in signature.parameters.items() if parameter.kind in positional)
    return names or _documented_names(function)


def _documented_names(function: Callable[..., Any]) -> tuple[str, ...]:
    if isinstance(function, type):
        function = getattr(function, "create", function)  # an object of OpenCV is made as its create() makes it
    text = getattr(function, "__doc__", None)
    found = _SIGNATURE.match(text.lstrip()) if isinstance(text, str) else None
    if found is None:
        return ()
    parts = (part.strip() for part in re.sub(r"[\[\]]", "", found[1]).split(","))
    return tuple(part for part in parts if part)
