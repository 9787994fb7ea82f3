"""What does a function's signature say about its inputs?"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import Any

_POSITIONAL = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)


def signature_of(function: Callable[..., Any]) -> inspect.Signature | None:
    """Return the signature, or None where there is none (``cv2.Canny`` and other C functions)."""
    try:
        return inspect.signature(function)
    except Exception:  # inspect's own errors, and whatever an object's __signature__ or __getattr__ raises
        return None


def accepted_inputs(signature: inspect.Signature) -> tuple[int, float]:
    """Return the least and the largest number of positional inputs; the largest is inf for ``*args``."""
    least, most = 0, 0.0
    for parameter in signature.parameters.values():
        if parameter.kind in _POSITIONAL:
            most += 1
            least += parameter.default is inspect.Parameter.empty
        elif parameter.kind is inspect.Parameter.VAR_POSITIONAL:
            most = float("inf")
    return least, most


def keyword_only_required(signature: inspect.Signature) -> tuple[str, ...]:
    """Return the parameters that can't be given by position and have no default."""
    return tuple(
        parameter.name
        for parameter in signature.parameters.values()
        if parameter.kind is inspect.Parameter.KEYWORD_ONLY and parameter.default is inspect.Parameter.empty
    )
