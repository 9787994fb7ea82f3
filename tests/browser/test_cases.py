"""The test images of a panel in JupyterLab say whether they pass."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.browser.contrast import unreadable
from tests.browser.jupyter import JupyterLab, Notebook, running_notebook, wait_for_lab
from tests.browser.panel import PanelOnScreen

pytestmark = pytest.mark.browser

SET_UP = """
import cv2, numpy as np, epypes as ep
from typing import Annotated
from skimage import data
from epypes_widgets import tune

def above(gray, threshold: Annotated[int, ep.Param(1, 255)] = 100):
    return cv2.threshold(gray, threshold, 255, cv2.THRESH_BINARY)[1]

def count(above):
    return cv2.connectedComponents(above)[0] - 1

runner = ep.CompGraphRunner(ep.CompGraph.from_functions(above, count))
coins = data.coins()
cases = [
    ep.Case(coins, {"above": coins > 100}, {"iou": 0.95}, name="coins"),
    ep.Case(data.camera(), {"above": data.camera() > 130}, {"iou": 0.95}, name="camera"),
    ep.Case(data.page(), metrics={"value": {"token": "count", "max": 60}}, name="page"),
]
"""
SHOW = """
panel = tune(runner, cases=cases, token="above")
panel
"""
STATES = """() => [...document.querySelectorAll('.epypes-filmstrip .epypes-verdict')].map(one => one.dataset.state)"""


@pytest.fixture(scope="module")
def notebook(lab_page: Any, lab: JupyterLab) -> Iterator[Notebook]:
    with running_notebook(lab_page, lab.root / "cases.ipynb", SET_UP, SHOW, height=1100) as notebook:
        yield notebook


@pytest.fixture
def panel(notebook: Notebook) -> PanelOnScreen:
    """The panel at its first values, with all cases checked."""
    panel = PanelOnScreen(notebook)
    assert notebook.execute("panel.reset(); checked = panel.check(60)") == ""
    panel.wait_for("threshold", 100)
    wait_for_states(panel, "passed", "failed", "failed")
    return panel


def wait_for_states(panel: PanelOnScreen, *states: str) -> None:
    panel.wait(f"wanted => JSON.stringify(({STATES})()) === JSON.stringify(wanted)", list(states))


def test_every_test_image_says_whether_it_passes_and_why_not(notebook: Notebook, panel: PanelOnScreen) -> None:
    films = panel.page.locator(".epypes-filmstrip button")
    assert films.locator(".epypes-verdict").all_inner_texts() == ["✓ pass", "✗ fail", "✗ fail"]
    assert films.nth(0).get_attribute("aria-label") == "coins: passed, 1 check passed"
    assert "camera: failed, iou of above: 0." in films.nth(1).get_attribute("title")
    assert panel.page.locator(".epypes-tally").inner_text() == "1 of 3 cases pass"
    for colours in notebook.each_theme():
        assert unreadable(panel.page, ".epypes-panel") == [], colours


def test_verdicts_stay_while_the_hand_drags_and_follow_when_it_lets_go(panel: PanelOnScreen) -> None:
    with panel.restless():
        x, y = panel.grab("threshold")
        panel.page.mouse.move(x + 26, y, steps=5)  # a slider has the width of its column
        panel.wait("() => JSON.parse(document.querySelector('img.epypes-picture').dataset.values).threshold > 115")
        assert panel.page.evaluate(STATES) == ["passed", "failed", "failed"]
        panel.page.mouse.up()
        wait_for_states(panel, "failed", "passed", "failed")

    panel.page.get_by_label("Undo").click()
    wait_for_states(panel, "passed", "failed", "failed")


def test_a_click_on_a_case_that_fails_shows_it(notebook: Notebook, panel: PanelOnScreen) -> None:
    panel.page.locator(".epypes-filmstrip button").nth(2).click()
    panel.settle()
    assert notebook.execute("print(panel.result['gray'].shape)").strip() == "(191, 384)"
    wait_for_states(panel, "passed", "failed", "failed")


def test_a_page_that_is_loaded_anew_has_the_verdicts(notebook: Notebook, panel: PanelOnScreen) -> None:
    panel.page.reload()
    wait_for_lab(panel.page)
    panel.page.wait_for_selector(".jp-Notebook .jp-Cell")
    notebook.wait_idle()
    notebook.run_all()
    PanelOnScreen(notebook)
    wait_for_states(panel, "passed", "failed", "failed")
    assert not notebook.page_errors
