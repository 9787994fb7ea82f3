"""How is a value shown that nothing on screen moves, and set from code?"""

from __future__ import annotations

import html
from collections.abc import Callable, Mapping
from typing import Any

import ipywidgets
from ipywidgets.widgets.widget_string import HTMLStyle

from epypes.display.previews.short import short_repr
from epypes.hints import Param, Roi, Text
from epypes_widgets.controls.control import Control
from epypes_widgets.controls.look import Look, sendable
from epypes_widgets.controls.scale import refused
from epypes_widgets.ranges import allows


class Words:
    """A line that says a value in words.

    Parameters
    ----------
    name
        The token.
    value
        What is said at first.
    line
        The widget.
    said
        Returns the words for a value, as plain text.
    checked
        Returns a value as the hyperparameter takes it, or raises ValueError.
    """

    def __init__(
        self, name: str, value: Any, line: Any, said: Callable[[Any], str], checked: Callable[[Any], Any]
    ) -> None:
        self._name, self._value, self._line, self._said, self._checked = name, value, line, said, checked

    def read(self) -> dict[str, Any]:
        """Return the value."""
        return {self._name: self._value}

    def checked(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """Return a value that is allowed."""
        return {name: self._checked(value) for name, value in values.items()}

    def place(self, values: Mapping[str, Any]) -> None:
        """Say another value."""
        for value in values.values():
            self._value, self._line.value = value, html.escape(self._said(value))


def shown(name: str, value: Any, param: Param | Roi | Text | None, first: Any, look: Look, tip: str) -> Control:
    """Return a line with a short repr of any value."""

    def checked(new: Any) -> Any:
        if param is not None and not allows(param, new):
            raise refused(name, new, param)
        return new

    line = line_of(said(value), look.words((name,), tip, HTMLStyle))
    return Control((name,), "shown", (param,), line, Words(name, value, line, said, checked), first=(first,))


def line_of(words: str, look: Mapping[str, Any]) -> Any:
    """Return a line of text that nobody can type into; unlike a Label it stands beside its name."""
    line = ipywidgets.HTML(value=html.escape(words), **look)
    line.add_class("epypes-read-only")
    return line


def said(value: Any) -> str:
    """Return any value in a few words; never raises."""
    return sendable(short_repr(value))
