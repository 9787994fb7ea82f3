"""What does a function's signature say about its inputs?

A graph of 10,000 functions is checked in milliseconds, so what a plain function says is read from its code;
``inspect.signature`` costs twenty times as much and is asked only where the code is not the whole truth.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from dataclasses import dataclass
from types import FunctionType
from typing import Any, Final

_POSITIONAL = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
NO_DEFAULT: Final = inspect.Parameter.empty


@dataclass(frozen=True, slots=True)
class Parameters:
    """What a function takes.

    Attributes
    ----------
    positional
        Names and defaults of the parameters that can be given by position; NO_DEFAULT where there is none.
    variadic
        Whether it takes any number more (``*args``).
    required_by_keyword
        The parameters that can't be given by position and have no default.
    """

    positional: tuple[tuple[str, Any], ...]
    variadic: bool
    required_by_keyword: tuple[str, ...]

    @property
    def least(self) -> int:
        """The least number of positional inputs."""
        return sum(default is NO_DEFAULT for _, default in self.positional)

    @property
    def most(self) -> float:
        """The largest number of positional inputs; inf for ``*args``."""
        return float("inf") if self.variadic else len(self.positional)


def signature_of(function: Callable[..., Any]) -> inspect.Signature | None:
    """Return the signature, or None where there is none (``cv2.Canny`` and other C functions)."""
    try:
        return inspect.signature(function)
    except Exception:  # inspect's own errors, and whatever an object's __signature__ or __getattr__ raises
        return None


def is_plain(function: object) -> bool:
    """Whether this is a Python function or lambda whose code says all: no wrapper, no signature of its own."""
    return type(function) is FunctionType and not (function.__dict__ and _speaks_for_another(function))


def _speaks_for_another(function: FunctionType) -> bool:
    return "__wrapped__" in function.__dict__ or "__signature__" in function.__dict__


def parameters_of(function: Callable[..., Any]) -> Parameters | None:
    """Return what a function takes, or None where that is not known."""
    if isinstance(function, FunctionType) and is_plain(function):
        return _from_code(function)
    signature = signature_of(function)
    return None if signature is None else _from_signature(signature)


def _from_code(function: FunctionType) -> Parameters:
    code = function.__code__
    count = code.co_argcount
    names = code.co_varnames[:count]
    defaults = function.__defaults__ or ()
    filled = (*(NO_DEFAULT,) * (count - len(defaults)), *defaults)
    given = function.__kwdefaults__ or {}
    by_keyword = code.co_varnames[count : count + code.co_kwonlyargcount]
    return Parameters(
        tuple(zip(names, filled, strict=True)),
        bool(code.co_flags & inspect.CO_VARARGS),
        tuple(name for name in by_keyword if name not in given),
    )


def _from_signature(signature: inspect.Signature) -> Parameters:
    parameters = signature.parameters.values()
    return Parameters(
        tuple((parameter.name, parameter.default) for parameter in parameters if parameter.kind in _POSITIONAL),
        any(parameter.kind is inspect.Parameter.VAR_POSITIONAL for parameter in parameters),
        tuple(
            parameter.name
            for parameter in parameters
            if parameter.kind is inspect.Parameter.KEYWORD_ONLY and parameter.default is NO_DEFAULT
        ),
    )
