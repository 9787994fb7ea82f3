"""The numbers beside the picture in JupyterLab follow the hand."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.browser.contrast import unreadable
from tests.browser.jupyter import JupyterLab, Notebook, running_notebook
from tests.browser.panel import PanelOnScreen

pytestmark = pytest.mark.browser

SET_UP = """
import cv2, numpy as np, epypes as ep
from typing import Annotated
from skimage import data
from epypes_widgets import tune

def above(gray, threshold: Annotated[int, ep.Param(1, 255)] = 100):
    return cv2.threshold(gray, threshold, 255, cv2.THRESH_BINARY)[1]

def area(above):
    return int(np.count_nonzero(above))

def centre(above):
    moments = cv2.moments(above, True)
    return moments["m10"] / moments["m00"], moments["m01"] / moments["m00"]

runner = ep.CompGraphRunner(ep.CompGraph.from_functions(above, area, centre))
coins = data.coins()
areas = [int(np.count_nonzero(coins > level)) for level in range(256)]
cases = [ep.Case(coins, metrics={"value": {"token": "area", "min": areas[110]}}, name="coins")]
"""
SHOW = """
panel = tune(runner, cases=cases, token="above")
panel
"""
AREA = ".epypes-tile[data-token=area]"
# Keeps each value of the tile with the threshold of the picture that it stands beside.
WATCH = f"""() => {{
    window.pairs = [];
    const picture = document.querySelector('img.epypes-picture');
    new MutationObserver(() => {{
        const tile = document.querySelector('{AREA}');
        if (!tile) return;
        const value = tile.querySelector('.epypes-tile-value').textContent;
        pairs.push([JSON.parse(picture.dataset.values).threshold, Number(value), tile.dataset.state]);
    }}).observe(picture, {{ attributes: true, attributeFilter: ['data-seq'] }});
}}"""


@pytest.fixture(scope="module")
def notebook(lab_page: Any, lab: JupyterLab) -> Iterator[Notebook]:
    with running_notebook(lab_page, lab.root / "tiles.ipynb", SET_UP, SHOW, height=1100) as notebook:
        yield notebook


@pytest.fixture
def panel(notebook: Notebook) -> PanelOnScreen:
    """The panel at its first values."""
    panel = PanelOnScreen(notebook)
    assert notebook.execute("panel.reset(); panel.tiles = ['area', 'centre']; panel.wait(60)") == ""
    panel.wait_for("threshold", 100)
    panel.wait(f"() => document.querySelector('{AREA}')")
    return panel


def test_numbers_follow_a_drag_with_their_picture_their_change_and_their_verdict(
    notebook: Notebook, panel: PanelOnScreen
) -> None:
    areas = eval(notebook.execute("print(areas)"))
    assert panel.page.locator(AREA).get_attribute("data-verdict") == "passed"
    x, y = panel.grab("threshold")
    panel.page.evaluate(WATCH)
    panel.page.mouse.move(x + 40, y, steps=20)  # nothing is committed while it is held
    panel.wait("() => JSON.parse(document.querySelector('img.epypes-picture').dataset.values).threshold > 115")
    panel.settle()
    for threshold, area, state in panel.page.evaluate("pairs"):
        assert state != "fresh" or area == areas[threshold], threshold
    threshold = panel.values["threshold"]
    assert panel.page.locator(f"{AREA} .epypes-tile-change").inner_text() == f"{areas[threshold] - areas[100]:+d}"
    assert panel.page.locator(AREA).get_attribute("data-verdict") == "failed"
    assert f"at least {areas[110]}: failed" in panel.page.locator(AREA).get_attribute("title")
    panel.page.mouse.up()
    for theme in notebook.each_theme():
        assert unreadable(panel.page, ".epypes-tiles") == [], theme


def test_a_tile_is_let_go_of_and_pinned_again(notebook: Notebook, panel: PanelOnScreen) -> None:
    panel.page.locator(f"{AREA} .epypes-unpin").click()
    panel.wait(f"() => !document.querySelector('{AREA}')")
    assert notebook.execute("print(panel.tiles)").strip() == "('centre',)"
    panel.page.locator(".epypes-more-tiles").select_option("area")
    panel.wait(f"() => document.querySelector('{AREA}')")
    assert not notebook.page_errors
