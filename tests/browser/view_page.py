"""The view of a panel in a page, driven without a kernel.

::

    view = ViewPage(browser)
    view.open(theme="dark")
    view.click(".epypes-chip[data-token=gray]")
    view.until("kernel.kinds('stage').length === 1")

The page loads the very script and styles that a notebook gets; what a kernel would answer is in
``tests/widgets/view/kernel.js``, as ``window.kernel``.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import cv2
from skimage import data

from epypes_widgets.view import script, styles
from tests.browser.jupyter import open_page

_HERE = Path(__file__).parents[1] / "widgets" / "view"
_THEMES = Path(sys.prefix) / "share" / "jupyter" / "lab" / "themes" / "@jupyterlab"
_ORIGIN = "http://panel.test/"
# Counts the URLs of pictures that are made and not revoked.
_COUNT_URLS = """
    window.urls = new Set();
    const [make, revoke] = [URL.createObjectURL, URL.revokeObjectURL];
    URL.createObjectURL = (blob) => { const url = make(blob); urls.add(url); return url; };
    URL.revokeObjectURL = (url) => { urls.delete(url); revoke(url); };
"""


class ViewPage:
    """A page with a view, rows beside it, and a kernel that is scripted.

    Parameters
    ----------
    browser
        Of Playwright.
    """

    def __init__(self, browser: Any) -> None:
        self.page = open_page(browser)
        self.errors: list[str] = []
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.add_init_script(_COUNT_URLS)
        self._files = {
            "": ("text/html", (_HERE / "harness.html").read_text()),
            "kernel.js": ("text/javascript", (_HERE / "kernel.js").read_text()),
            "view.js": ("text/javascript", script()),
            "view.css": ("text/css", styles()),
            "photo.jpg": ("image/jpeg", _photo()),
        }
        self.page.route("**/*", self._serve)

    def open(self, theme: str = "light", width: int = 1280, height: int = 1200) -> None:
        """Load the page anew, in a theme, in a window of so many pixels, with the mouse at its corner."""
        self.errors.clear()
        self._files["theme.css"] = ("text/css", (_THEMES / f"theme-{theme}-extension" / "index.css").read_text())
        self.page.set_viewport_size({"width": width, "height": height})
        self.page.mouse.move(0, 0)
        self.page.goto(_ORIGIN)
        self.until("document.querySelector('img.epypes-picture')?.dataset.seq")
        self.until("document.querySelectorAll('.epypes-tail').length === 5")
        self.until("document.querySelector('.epypes-entry')")

    def js(self, expression: str, given: Any = None) -> Any:
        """Return what an expression is in the page; promises are awaited."""
        return self.page.evaluate(f"async given => ({expression})", given)

    def do(self, statement: str) -> None:
        """Run statements in the page."""
        self.page.evaluate(f"async () => {{ {statement} }}")

    def until(self, condition: str) -> None:
        """Return when a condition holds in the page."""
        self.page.wait_for_function(f"() => {{ {_WITH_KERNEL} return {condition}; }}")

    def sent(self, kind: str) -> list[dict[str, Any]]:
        """Return the messages of a kind that the view has sent."""
        found: list[dict[str, Any]] = self.js(f"kernel.kinds({kind!r})")
        return found

    @property
    def moves(self) -> list[dict[str, Any]]:
        """What was moved and not committed, as it was sent: by itself, or with an acknowledgement."""
        found: list[dict[str, Any]] = self.js("kernel.moves()")
        return found

    def click(self, selector: str) -> None:
        self.page.click(selector)

    def press(self, *keys: str) -> None:
        for key in keys:
            self.page.keyboard.press(key)

    def focus(self, selector: str = ".epypes-box") -> None:
        self.page.locator(selector).first.focus()

    def box(self, selector: str) -> dict[str, float]:
        """Return where an element is on the page."""
        found: dict[str, float] = self.page.locator(selector).first.bounding_box()
        return found

    def text(self, selector: str) -> str:
        return str(self.page.locator(selector).first.text_content())

    def attribute(self, selector: str, name: str) -> str | None:
        found: str | None = self.page.locator(selector).first.get_attribute(name)
        return found

    def shown(self, selector: str) -> bool:
        return bool(self.page.locator(selector).first.is_visible())

    def seen(self) -> int:
        """Return the number of the frame on the screen."""
        return int(self.attribute("img.epypes-picture", "data-seq") or 0)

    def pixel(self, x: float, y: float) -> tuple[float, float]:
        """Return where a pixel of the picture is on the page."""
        at, size = self.box(".epypes-canvas"), self.js("kernel.size")
        return at["x"] + x * at["width"] / size["width"], at["y"] + y * at["height"] / size["height"]

    def drag(self, start: tuple[float, float], end: tuple[float, float], steps: int = 8) -> None:
        """Press, move and release the mouse."""
        self.page.mouse.move(*start)
        self.page.mouse.down()
        self.page.mouse.move(*end, steps=steps)
        self.page.mouse.up()

    def middle(self, selector: str) -> tuple[float, float]:
        """Return the middle of an element, on the page."""
        at = self.box(selector)
        return at["x"] + at["width"] / 2, at["y"] + at["height"] / 2

    def settle(self) -> None:
        """Return when the last frame is on the screen and what it says is written down."""
        self.js("kernel.painted()")
        # A frame is acknowledged before it is decoded, which takes some milliseconds.
        self.until(
            "[...document.querySelectorAll('.epypes-picture, .epypes-text')]"
            ".some(node => node.dataset.seq === String(kernel.seq))"
        )
        self.js("new Promise(done => setTimeout(() => setTimeout(done)))")

    def close(self) -> None:
        self.page.context.close()

    def _serve(self, route: Any) -> None:
        name = route.request.url.removeprefix(_ORIGIN)
        if name not in self._files:
            route.fulfill(status=404, body="")
            return
        kind, body = self._files[name]
        route.fulfill(content_type=kind, body=body)


_WITH_KERNEL = "const kernel = window.kernel; if (!kernel) return false;"


def _photo() -> bytes:
    bgr = cv2.cvtColor(data.coffee(), cv2.COLOR_RGB2BGR)
    return bytes(cv2.imencode(".jpg", cv2.resize(bgr, (512, 384)))[1])
