"""The signature of a function: the inputs that it takes, and the output tokens that ``@ep.outputs`` names."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from types import FunctionType
from typing import Any, Final, TypeVar

F = TypeVar("F", bound=Callable[..., Any])

_OUTPUTS: Final = "__epypes_outputs__"


def signature_of(function: Callable[..., Any]) -> inspect.Signature | None:
    """Return the signature, or None where there is none (``cv2.Canny`` and other C functions)."""
    try:
        return inspect.signature(function)
    except Exception:  # inspect's own errors, and whatever an object's __signature__ or __getattr__ raises
        return None


def positional_of(signature: inspect.Signature) -> list[inspect.Parameter]:
    """Return the parameters that can be given by position, but for ``*args``."""
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return [parameter for parameter in signature.parameters.values() if parameter.kind in kinds]


def distinct(functions: Mapping[str, Any]) -> dict[int, Any]:
    """Return each function once, by its id: a large graph has few functions under many names."""
    return {id(function): function for function in functions.values()}


def plain_count(function: object) -> int | None:
    """Return how many parameters a plain function has, all of which can be given by position; None for any other.

    It is read from the code: ``inspect.signature`` takes 10 us, and a graph may have 10,000 functions.
    """
    if type(function) is not FunctionType or function.__code__.co_kwonlyargcount:
        return None
    is_plain = not function.__dict__ or function.__dict__.keys().isdisjoint(("__wrapped__", "__signature__"))
    return function.__code__.co_argcount if is_plain else None


def outputs(*names: str) -> Callable[[F], F]:
    """Name the output tokens of a function, for ``CompGraph.from_functions``.

    One name takes the value as it is, n names a sequence of n values; without a name there is no output.

    Examples
    --------
    >>> @outputs("keypoints", "descriptors")
    ... def detect(image):
    ...     return [], None
    """
    for name in names:
        if not isinstance(name, str) or not name:
            text = f"outputs() takes the names of tokens, not {name!r}."
            raise TypeError(text + ' Write @ep.outputs("a", "b") above the function.' * callable(name))
    twice = [name for name in dict.fromkeys(names) if names.count(name) > 1]
    if twice:
        raise ValueError(f"outputs() names {', '.join(map(repr, twice))} twice. Every output is a token of its own.")

    def mark(function: F) -> F:
        try:
            setattr(function, _OUTPUTS, names)
        except (AttributeError, TypeError) as error:
            name = getattr(function, "__name__", function)
            raise TypeError(
                f"{name!r} can't be marked. Write a function (def) that calls it, and mark that."
            ) from error
        return function

    return mark


def declared_outputs(function: object) -> tuple[str, ...] | None:
    """Return the names given to ``outputs``, None if it was not used."""
    found = getattr(function, _OUTPUTS, None)
    return found if isinstance(found, tuple) else None
