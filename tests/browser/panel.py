"""A panel in JupyterLab, as tests move and read it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from tests.browser.jupyter import Notebook

DIGEST = """async () => {
    const bytes = await (await fetch(document.querySelector('img.epypes-picture').src)).arrayBuffer();
    const digest = await crypto.subtle.digest('SHA-256', bytes);
    return [...new Uint8Array(digest)].map(byte => byte.toString(16).padStart(2, '0')).join('');
}"""


# All is computed, and no frame is on its way or waits for that.
_SETTLED = """
import threading
panel.wait(60)
while panel._screen.view.frames.in_flight is not None or panel._worker.is_pending("frame"):
    threading.Event().wait(0.005)
print(panel._screen.view.frames.newest.seq)
"""


class PanelOnScreen:
    """The panel of a notebook as a hand and an eye have it."""

    def __init__(self, notebook: Notebook) -> None:
        self.notebook, self.page = notebook, notebook.page
        self.page.wait_for_function("() => document.querySelector('img.epypes-picture')?.dataset.seq")

    @property
    def seq(self) -> int:
        return int(self._read("seq"))

    @property
    def values(self) -> dict[str, Any]:
        values: dict[str, Any] = json.loads(self._read("values"))
        return values

    @property
    def digest(self) -> str:
        """The hash of the picture's bytes."""
        return str(self.page.evaluate(DIGEST))

    def focus(self, name: str) -> None:
        """Put the keyboard on the slider of a hyperparameter."""
        handle = self.page.locator(".widget-slider", has_text=name).first.locator(".noUi-handle")
        handle.scroll_into_view_if_needed()
        handle.focus()

    def press(self, key: str, name: str, value: Any) -> None:
        """Press a key and wait until the picture shows the value that it makes."""
        self.page.keyboard.press(key)
        self.wait_for(name, value)

    def wait_for(self, name: str, value: Any) -> None:
        self.page.wait_for_function(
            "([name, value]) => JSON.parse("
            "document.querySelector('img.epypes-picture').dataset.values)[name] === value",
            arg=[name, value],
        )

    def row(self, name: str) -> Any:
        """The row of a hyperparameter."""
        return self.page.locator(".epypes-row", has_text=name).first

    def number(self, name: str) -> float:
        """What the number box of a hyperparameter shows."""
        return float(self.row(name).locator("input.epypes-number").first.input_value())

    def middle(self, selector: str) -> tuple[float, float]:
        """The middle of an element, which is scrolled to, in pixels of the window."""
        found = self.page.locator(selector).first
        found.scroll_into_view_if_needed()
        box = found.bounding_box()
        return box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

    def grab(self, name: str) -> tuple[float, float]:
        """Press the mouse on the handle of a slider and return where it is; it stays pressed."""
        handle = self.row(name).locator(".noUi-handle").first
        handle.scroll_into_view_if_needed()
        box = handle.bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        self.page.mouse.move(x, y)
        self.page.mouse.down()
        return x, y

    @contextmanager
    def restless(self) -> Iterator[None]:
        """Only a release commits, however long a busy machine takes between two moves of the mouse."""
        assert self.notebook.execute("import epypes_widgets.tuning as _t; _rest_s, _t.REST_S = _t.REST_S, 3600.0") == ""
        try:
            yield
        finally:
            self.notebook.execute("_t.REST_S = _rest_s")

    def wait(self, condition: str, argument: Any = None) -> None:
        """Return when a condition in JavaScript holds."""
        self.page.wait_for_function(condition, arg=argument)

    @property
    def history(self) -> int:
        """How many entries the history on the screen has."""
        return int(self.page.locator(".epypes-history [data-number]").count())

    @property
    def height(self) -> float:
        """Of the panel down to its foot, in pixels; at the very end of that a log may appear."""
        top, foot = (self.page.locator(css).bounding_box()["y"] for css in (".epypes-panel", ".epypes-foot"))
        return float(foot - top)

    def settle(self) -> None:
        """Return when everything is computed, committed and on the screen; the panel is called that in the kernel."""
        seq = int(self.notebook.execute(_SETTLED))
        self.wait("seq => document.querySelector('img.epypes-picture').dataset.seq >= seq", seq)

    def wait_for_status(self, text: str) -> None:
        """Return when the status line has this text in it; when it is empty, if the text is."""
        self.page.wait_for_function(
            "text => { const said = document.querySelector('.epypes-status').textContent;"
            " return text ? said.includes(text) : said === ''; }",
            arg=text,
        )

    def choose(self, token: str) -> None:
        """Click a token and wait for its picture."""
        self.page.locator(f".epypes-chip[data-token={token}]").click()
        self.page.wait_for_function(
            "token => document.querySelector('img.epypes-picture').alt.startsWith(token + ' ')",
            arg=token,
        )

    def _read(self, key: str) -> str:
        return str(self.page.evaluate(f"document.querySelector('img.epypes-picture').dataset.{key}"))
