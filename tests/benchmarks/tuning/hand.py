"""How does a hand move the sliders of a page, with a real pointer and real keys?"""

from __future__ import annotations

from pathlib import Path
from time import perf_counter, sleep
from typing import Any

from tests.benchmarks.tuning.latency import Seen
from tests.browser.jupyter import Notebook

_WATCH = (Path(__file__).parent / "watch.js").read_text()
_SETTLED_MS = 20_000
_MOVES_PER_S = 60


def begin(notebook: Notebook) -> None:
    """Make the page ready to be watched."""
    notebook.page.evaluate(_WATCH)


class Slider:
    """One slider of 0 to 255 and the pictures that it makes.

    Parameters
    ----------
    cell
        The number of the cell that shows it.
    label
        What stands beside it.
    kind
        How its pictures say what they show; see ``watch.js``.
    """

    def __init__(self, notebook: Notebook, cell: int, label: str, kind: str) -> None:
        self._page, self._name = notebook.page, f"{cell}"
        self._cell = self._page.locator(".jp-Notebook .jp-Cell").nth(cell)
        self._slider = self._cell.locator(".widget-slider", has_text=label).first
        self._handle = self._slider.locator(".noUi-handle")
        self._handle.wait_for()
        self._page.evaluate("([...given]) => bench.watch(...given)", [self._name, cell, label, kind])

    @property
    def value(self) -> int:
        return round(float(self._handle.get_attribute("aria-valuenow")))

    def press(self, key: str, times: int) -> Seen:
        """Press a key so many times, each time when the picture of the last has come."""
        self._begin()
        self._handle.focus()
        for _ in range(times):
            self._page.keyboard.press(key)
            self._settle()
        return self._taken()

    def drag(self, moves: int, step_px: int) -> Seen:
        """Take the handle, move it so many times at 60 per second, let it go, and wait for the last picture."""
        self._begin()
        start, mouse = self.value, self._page.mouse
        box = self._handle.bounding_box()
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        mouse.move(x, y)
        mouse.down()
        begun = perf_counter()
        for turn in range(1, moves + 1):
            sleep(max(0.0, begun + turn / _MOVES_PER_S - perf_counter()))
            mouse.move(x + turn * step_px, y)
        mouse.up()
        self._settle()
        seen = self._taken()
        assert abs(self.value - start) > moves * abs(step_px) / 2, "the hand has hold of the slider"
        return seen

    def _begin(self) -> None:
        self._cell.scroll_into_view_if_needed()
        self._handle.scroll_into_view_if_needed()
        self._taken()

    def _settle(self) -> None:
        assert self._page.evaluate("([...given]) => bench.settled(...given)", [self._name, _SETTLED_MS]), (
            f"the picture of {self.value} never came"
        )

    def _taken(self) -> Seen:
        seen: dict[str, Any] = self._page.evaluate("name => bench.take(name)", self._name)
        return Seen([tuple(move) for move in seen["moves"]], [tuple(picture) for picture in seen["pictures"]])


def echoes_ms(notebook: Notebook, count: int) -> list[float]:
    """Return how long an integer takes through the kernel and back, one after the other."""
    times: list[float] = notebook.page.evaluate(
        """async count => {
            const times = [];
            window.benchAsked ??= 0;
            for (let i = 0; i < count; i++) times.push(await benchEcho(++window.benchAsked));
            return times;
        }""",
        count,
    )
    return times
