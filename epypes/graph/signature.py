"""The signature of a function: the inputs that it takes, and the output tokens that ``@ep.outputs`` names."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import FunctionType
from typing import Any, Final, TypeVar

F = TypeVar("F", bound=Callable[..., Any])

NO_DEFAULT: Final = inspect.Parameter.empty
_OUTPUTS: Final = "__epypes_outputs__"


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


def parameters_of(function: Callable[..., Any]) -> Parameters | None:
    """Return what a function takes, or None where that is not known."""
    signature = signature_of(function)
    if signature is None:
        return None
    parameters = signature.parameters.values()
    return Parameters(
        tuple(
            (parameter.name, parameter.default)
            for parameter in parameters
            if parameter.kind in (parameter.POSITIONAL_ONLY, parameter.POSITIONAL_OR_KEYWORD)
        ),
        any(parameter.kind is parameter.VAR_POSITIONAL for parameter in parameters),
        tuple(
            parameter.name
            for parameter in parameters
            if parameter.kind is parameter.KEYWORD_ONLY and parameter.default is NO_DEFAULT
        ),
    )


def distinct(functions: Mapping[str, Any]) -> dict[int, Any]:
    """Return each function once, by its id: a large graph has few functions under many names."""
    return {id(function): function for function in functions.values()}


def takes_exactly(function: object, count: int) -> bool:
    """Whether this is a plain function of that many parameters, as its code says: the usual case.

    ``inspect.signature`` takes 10 us, and a graph may have 10,000 functions.
    """
    return (
        type(function) is FunctionType
        and function.__code__.co_argcount == count
        and not function.__code__.co_kwonlyargcount
        and not {"__wrapped__", "__signature__"} & function.__dict__.keys()
    )


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
