"""How is a text typed?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import ipywidgets
from ipywidgets.widgets.widget_string import TextStyle

from epypes.hints import Text
from epypes_widgets.controls.control import Control
from epypes_widgets.controls.kinds import like
from epypes_widgets.controls.look import Look, sendable
from epypes_widgets.controls.scale import refused

# A longer text is a document, not a parameter: it would travel with every message about its box.
_LONGEST: Final = 2_000


class _Typed:
    """A box of text. What was put into it counts to the last character, even where the box can't show it."""

    def __init__(self, name: str, value: Any, box: Any) -> None:
        self._name, self._box, self._like = name, box, like(value)
        self._exact, self._shown = value, box.value

    def read(self) -> dict[str, Any]:
        text = self._box.value
        return {self._name: self._exact if text == self._shown else self._like(text)}

    def checked(self, values: Mapping[str, Any]) -> dict[str, Any]:
        for value in values.values():
            if not isinstance(value, str):
                raise refused(self._name, value, Text())
        return {name: self._like(value) for name, value in values.items()}

    def place(self, values: Mapping[str, Any]) -> None:
        for value in values.values():
            self._exact, self._shown = value, sendable(value)
            self._box.value = self._shown


def text(name: str, value: Any, param: Text, first: Any, look: Look, tip: str) -> Control | None:
    """Return a box of text, which commits on Enter or when it is left; None for what is no short text."""
    if not isinstance(value, str) or len(value) > _LONGEST:
        return None
    # A box of one line drops the ends of lines as soon as somebody types into it.
    kind = ipywidgets.Textarea if "\n" in value else ipywidgets.Text
    box = kind(value=sendable(value), continuous_update=False, **look.words((name,), tip, TextStyle))
    return Control((name,), "text", (param,), box, _Typed(name, value, box), first=(first,))
