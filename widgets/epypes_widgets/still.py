"""How does the last picture stay in a notebook that is saved, and opened again without a kernel?

The widget alone leaves nothing there: beside it an output of plain HTML is shown, which the live panel hides.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any


class Still:
    """An output beside the panel, replaced from time to time.

    Parameters
    ----------
    html
        Returns what it shows now.
    """

    def __init__(self, html: Callable[[], str]) -> None:
        self._html = html
        self._handle: Any = None
        self._shown = ""

    def display(self) -> None:
        """Show it below what the running cell has shown."""
        from IPython.display import HTML, display

        self._shown = self._html()
        self._handle = display(HTML(self._shown), display_id=True)

    def update(self) -> None:
        """Replace it where it is shown, if anything has changed."""
        from IPython.display import HTML

        if self._handle is None:
            return
        new = self._html()
        if new != self._shown:
            self._shown = new
            self._handle.update(HTML(new))
