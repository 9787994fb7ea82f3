"""What do all controls of a panel share on the page?

Each layout and each style is a model of its own, which costs the browser a message; so there is one of each kind.
"""

from __future__ import annotations

from typing import Any, Final

import ipywidgets

_DESCRIPTION_WIDTH: Final = "112px"


class Look:
    """The layout and the styles of the controls that are made together."""

    def __init__(self) -> None:
        self.layout = ipywidgets.Layout(width="100%")
        self._styles: dict[type, Any] = {}

    def style(self, kind: type) -> Any:
        """Return the style of this kind, the same one each time."""
        if kind not in self._styles:
            self._styles[kind] = kind(description_width=_DESCRIPTION_WIDTH)
        return self._styles[kind]

    def words(self, names: tuple[str, ...], tip: str, style: type) -> dict[str, Any]:
        """Return what the constructor of any control is given: name, tip, layout and style."""
        return {
            "description": " .. ".join(names),
            "tooltip": tip,
            "layout": self.layout,
            "style": self.style(style),
        }


def sendable(text: str) -> str:
    """Return text without halves of surrogate pairs, which no message can hold."""
    return text.encode("utf-8", "replace").decode("utf-8")
