"""Which tokens does a function make, where its name does not say it?"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final, TypeVar

F = TypeVar("F", bound=Callable[..., Any])

_MARK: Final = "__epypes_outputs__"


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
            setattr(function, _MARK, names)
        except (AttributeError, TypeError) as error:
            name = getattr(function, "__name__", function)
            raise TypeError(
                f"{name!r} can't be marked. Write a function (def) that calls it, and mark that."
            ) from error
        return function

    return mark


def declared_outputs(function: object) -> tuple[str, ...] | None:
    """Return the names given to ``outputs``, None if it was not used."""
    found = getattr(function, _MARK, None)
    return found if isinstance(found, tuple) else None
