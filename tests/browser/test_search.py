"""Hyperparameters are searched from the panel, in a real browser: started, followed, stopped, used and undone."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.browser.jupyter import JupyterLab, Notebook, running_notebook
from tests.browser.panel import PanelOnScreen

pytestmark = pytest.mark.browser

_CELLS = (
    "import cv2, numpy as np, epypes as ep\nfrom skimage import data\nfrom epypes_widgets import tune\n"
    "cg = ep.CompGraph({'blur': lambda image, k: cv2.GaussianBlur(image, (k, k), 0), 'canny': cv2.Canny},\n"
    "    {'blur': (('image', 'k'), 'blurred'), 'canny': (('blurred', 'lo', 'hi'), 'edges')})\n"
    "runner = ep.CompGraphRunner(cg, {'k': 21, 'lo': 150, 'hi': 230})\n"
    "picture = data.camera()\n"
    "cases = [ep.Case(picture[::2, ::2], expected={'edges': cv2.Canny(cv2.GaussianBlur(picture[::2, ::2], (5, 5), 0), 60, 120)})]\n"
    "def iou(tokens, case):\n"
    "    one, other = tokens['edges'] > 0, case.expected['edges'] > 0\n"
    "    return (one & other).sum() / (one | other).sum()\n"
    "_ = runner.run(image=picture)",
    "panel = tune(runner, cases=cases, metric=iou, k=ep.Param(1, 31, odd=True), lo=(0, 255), hi=(0, 255))\npanel",
)
_STATE = "state => document.querySelector('.epypes-search').dataset.state === state"


@pytest.fixture(scope="module")
def searched(lab_page: Any, lab: JupyterLab) -> Iterator[Notebook]:
    with running_notebook(lab_page, lab.root / "search.ipynb", *_CELLS) as notebook:
        yield notebook


def test_a_search_is_followed_and_its_best_is_used_and_undone(searched: Notebook) -> None:
    panel = PanelOnScreen(searched)
    before = panel.values
    panel.page.locator(".epypes-trials").fill("40")
    panel.page.locator(".epypes-search-start").click()
    panel.wait(_STATE, "done")
    search = panel.page.locator(".epypes-search")
    assert search.get_attribute("data-trials") == "40"
    assert "40 trials; best 0." in search.locator(".epypes-search-message").inner_text()
    assert panel.values == before, "a search sets nothing"
    assert search.locator(".epypes-search-best").get_attribute("d").startswith("M")
    search.scroll_into_view_if_needed()

    best = searched.execute("import json; print(json.dumps(panel.search.result.best))").strip()
    search.locator(".epypes-search-use").click()
    panel.wait("best => document.querySelector('img.epypes-picture').dataset.values === best", best.replace(" ", ""))
    panel.settle()
    assert searched.execute(
        "print(panel.undo()); panel.wait(60); print(dict(runner.hyperparameters) == dict(k=21, lo=150, hi=230))"
    ).split() == ["True", "True"]


def test_a_search_that_can_not_be_begun_says_why(searched: Notebook) -> None:
    panel = PanelOnScreen(searched)
    panel.page.locator(".epypes-trials").fill("0")
    panel.page.locator(".epypes-search-start").click()
    said = panel.page.locator(".epypes-search-message")
    assert said.inner_text() == "! Give a number of trials from 1 to 10000."
    searched.execute("k = panel.search._metric; panel.search._metric = 'no token'")
    panel.page.locator(".epypes-trials").fill("5")
    panel.page.locator(".epypes-search-start").click()
    panel.wait(_STATE, "refused")
    assert "No token 'no token'" in said.inner_text()
    panel.page.locator(".epypes-search").scroll_into_view_if_needed()
    searched.execute("panel.search._metric = k")


def test_a_search_is_stopped_while_the_panel_goes_on(searched: Notebook) -> None:
    panel = PanelOnScreen(searched)
    panel.page.locator(".epypes-trials").fill("5000")
    panel.page.locator(".epypes-search-start").click()
    panel.wait(_STATE, "running")
    panel.focus("lo")
    panel.press("ArrowRight", "lo", panel.values["lo"] + 1)
    panel.page.locator(".epypes-search").scroll_into_view_if_needed()
    panel.page.locator(".epypes-search-stop").click()
    panel.wait(_STATE, "done")
    assert "Stopped after" in panel.page.locator(".epypes-search-message").inner_text()
