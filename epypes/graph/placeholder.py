"""Which functions of a graph are still to be written?"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, Final, NoReturn

from epypes.errors import PlaceholderNeeded


class Placeholder:
    """A function that is still to be written; it fits any io and can't be called. ``extend`` fills it.

    Examples
    --------
    >>> Placeholder()
    <Placeholder>
    """

    __slots__ = ("__weakref__",)

    def __call__(self, *inputs: Any) -> NoReturn:
        """Raise PlaceholderNeeded."""
        raise PlaceholderNeeded(())

    def __repr__(self) -> str:
        return "<Placeholder>"


def is_placeholder(function: object) -> bool:
    """Whether a function, or the function that it wraps, is a placeholder."""
    return isinstance(innermost(function), Placeholder)


# A wrapper may wrap itself by mistake; nobody wraps this deep on purpose.
_DEEPEST: Final = 100


def innermost(function: object) -> object:
    """Follow ``__wrapped__`` to the function that a node or a decorator wraps."""
    *_, last = layers(function)
    return last


def layers(function: object) -> Iterator[object]:
    """Give a function, what it wraps, what that wraps ..."""
    for _ in range(_DEEPEST):
        yield function
        try:
            function = vars(function)["__wrapped__"]
        except Exception:  # it has no attributes, it wraps nothing, or it raises when it is looked at
            return
