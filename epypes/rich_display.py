"""The registry that objects ask for their rich display.

What a notebook shows of a graph, a run or a pipeline is made by ``epypes.display``, which imports these rooms and
registers here. They name this module only, so no import leads upwards, and nothing is loaded before something is shown.
"""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any, Final, NamedTuple

# Imported when something is shown first; it registers the formatters.
_PROVIDER: Final = "epypes.display"


class Formatters(NamedTuple):
    """What makes the forms of an object that shows itself; neither raises.

    Attributes
    ----------
    mimebundle
        Returns texts by media type, as ``_repr_mimebundle_`` does.
    text
        Returns what ``print()`` writes of a plan, a report, reports or their summary.
    """

    mimebundle: Callable[[Any], dict[str, str]]
    text: Callable[[Any], str]


_registered: list[Formatters] = []


def register(formatters: Formatters) -> None:
    """Make these the formatters of all that shows itself."""
    _registered[:] = [formatters]


def mimebundle(shown: Any) -> dict[str, str]:
    """Return the text, and the page and picture where they can be made, of what shows itself."""
    return _formatters().mimebundle(shown)


def to_text(shown: Any) -> str:
    """Return a plan, a report, reports or their summary as an aligned table of text."""
    return _formatters().text(shown)


class Displayed:
    """What shows itself: as a table of text when it is printed, with its pictures in a notebook."""

    __slots__ = ()

    def __str__(self) -> str:
        return to_text(self)

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        return mimebundle(self)


def _formatters() -> Formatters:
    if not _registered:
        importlib.import_module(_PROVIDER)
    return _registered[0]
