"""Placeholders: functions of a graph that are still to be written."""

from __future__ import annotations

from typing import Any, NoReturn

from epypes.errors import PlaceholderNeeded
from epypes.graph.identity import innermost


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
