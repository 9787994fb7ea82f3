"""A panel on a graph with state in JupyterLab: the slider of a sequence, with the state as of each frame."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.browser.contrast import unreadable
from tests.browser.jupyter import JupyterLab, Notebook, running_notebook
from tests.browser.panel import PanelOnScreen

pytestmark = pytest.mark.browser

SET_UP = """
import numpy as np, epypes as ep
from typing import Annotated
from epypes_widgets import tune

frames = []
for number in range(60):
    image = np.zeros((120, 300), np.float32)
    image[40:80, 4 * number:4 * number + 40] = 255
    frames.append(image)

def background(image, before, rate: Annotated[float, ep.Param(0.0, 1.0)] = 0.2):
    return image if before is None else rate * image + (1 - rate) * before

def picture(background):
    return background.astype(np.uint8)

cg = ep.CompGraph.from_functions(background, picture)
runner = ep.CompGraphRunner(ep.delay(cg, "background", "before"))

def expected(count, rate):
    found = None
    for image in frames[:count]:
        found = background(image, found, rate)
    return found
"""
SHOW = """
panel = tune(runner, images=frames, token="picture")
panel
"""
TEXT = "() => document.querySelector('.epypes-frame-text').textContent"


@pytest.fixture(scope="module")
def notebook(lab_page: Any, lab: JupyterLab) -> Iterator[Notebook]:
    with running_notebook(lab_page, lab.root / "states.ipynb", SET_UP, SHOW, height=1100) as notebook:
        yield notebook


@pytest.fixture
def panel(notebook: Notebook) -> PanelOnScreen:
    return PanelOnScreen(notebook)


def slider(panel: PanelOnScreen) -> Any:
    return panel.page.get_by_role("slider", name="Frame of the sequence")


def wait_for_frame(panel: PanelOnScreen, number: int) -> None:
    panel.wait(f"text => ({TEXT})() === text", f"frame {number} of the sequence")


def is_right(notebook: Notebook, count: int) -> str:
    made = f"np.array_equal(panel.result['background'], expected({count}, panel['rate']))"
    return notebook.execute(f"panel.wait(60); print({made})").strip()


def test_each_frame_has_the_state_that_those_before_it_leave(notebook: Notebook, panel: PanelOnScreen) -> None:
    wait_for_frame(panel, 0)
    slider(panel).focus()
    panel.page.keyboard.press("End")
    wait_for_frame(panel, 59)
    panel.settle()
    assert is_right(notebook, 60) == "True"
    panel.page.get_by_label("Frame before").click()
    wait_for_frame(panel, 58)
    panel.settle()
    assert is_right(notebook, 59) == "True"
    before = panel.digest
    notebook.execute("panel['rate'] = 0.5")
    panel.wait_for("rate", 0.5)
    panel.settle()
    assert panel.digest != before
    assert is_right(notebook, 59) == "True"
    assert not notebook.page_errors


def test_it_can_be_read_in_both_themes(notebook: Notebook, panel: PanelOnScreen) -> None:
    for colours in notebook.each_theme():
        assert unreadable(panel.page, ".epypes-panel") == [], colours
