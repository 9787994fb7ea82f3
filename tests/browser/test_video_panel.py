"""A panel on a video in JupyterLab: the slider of its frames."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.browser.contrast import unreadable
from tests.browser.jupyter import JupyterLab, Notebook, running_notebook
from tests.browser.panel import PanelOnScreen
from tests.videos import write_video

pytestmark = pytest.mark.browser

SET_UP = """
import cv2, epypes as ep
from typing import Annotated
from epypes_widgets import tune

def gray(image):
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)

def above(gray, threshold: Annotated[int, ep.Param(1, 255)] = 100):
    return cv2.threshold(gray, threshold, 255, cv2.THRESH_BINARY)[1]

runner = ep.CompGraphRunner(ep.CompGraph.from_functions(gray, above))
"""
SHOW = """
panel = tune(runner, images="belt.mp4", token="gray")
panel
"""
READ = """
def shown(panel):
    import sys; sys.path.insert(0, ROOT)
    from tests.videos import number_in
    return number_in(panel.result["image"])
"""
TEXT = "() => document.querySelector('.epypes-frame-text').textContent"


@pytest.fixture(scope="module")
def notebook(lab_page: Any, lab: JupyterLab, request: pytest.FixtureRequest) -> Iterator[Notebook]:
    write_video(lab.root / "belt.mp4", 100)
    root = f"ROOT = {str(request.config.rootpath)!r}"
    with running_notebook(lab_page, lab.root / "video.ipynb", f"{root}\n{READ}", SET_UP, SHOW, height=1100) as notebook:
        yield notebook


@pytest.fixture
def panel(notebook: Notebook) -> PanelOnScreen:
    return PanelOnScreen(notebook)


def slider(panel: PanelOnScreen) -> Any:
    return panel.page.get_by_role("slider", name="Frame of the video")


def wait_for_frame(panel: PanelOnScreen, number: int) -> None:
    panel.wait(f"text => ({TEXT})() === text", f"frame {number} of belt.mp4 · {number / 25:.3f} s")


def test_keys_and_buttons_step_and_the_picture_is_that_of_the_frame(notebook: Notebook, panel: PanelOnScreen) -> None:
    wait_for_frame(panel, 0)
    assert panel.page.get_by_label("Frame before").is_disabled()
    first = panel.digest
    slider(panel).focus()
    panel.page.keyboard.press("End")
    wait_for_frame(panel, 99)
    panel.settle()
    assert panel.digest != first
    assert notebook.execute("print(shown(panel))").strip() == "99"
    panel.page.get_by_label("Frame before").click()
    wait_for_frame(panel, 98)
    panel.page.keyboard.press("Enter")
    wait_for_frame(panel, 97)
    panel.settle()
    assert notebook.execute("print(shown(panel))").strip() == "97"
    slider(panel).focus()
    panel.page.keyboard.press("Home")
    wait_for_frame(panel, 0)
    panel.settle()
    assert panel.digest == first
    assert not notebook.page_errors


def test_a_drag_ends_with_its_last_frame_and_is_one_entry_of_the_history(
    notebook: Notebook, panel: PanelOnScreen
) -> None:
    panel.settle()
    before = panel.history
    box = slider(panel).bounding_box()
    y = box["y"] + box["height"] / 2
    with panel.restless():
        slider(panel).focus()
        panel.page.mouse.move(box["x"] + 8, y)
        panel.page.mouse.down()
        panel.page.mouse.move(box["x"] + box["width"] * 0.7, y, steps=25)
        panel.page.mouse.up()
        place = int(slider(panel).input_value())
        assert 50 < place < 90
        wait_for_frame(panel, place)
        assert panel.history == before
    slider(panel).press("ArrowRight")
    wait_for_frame(panel, place + 1)
    panel.settle()
    panel.wait("count => document.querySelectorAll('.epypes-history [data-number]').length === count", before + 1)
    entry = panel.page.locator(".epypes-history [aria-current=true]").get_attribute("aria-label")
    assert f"-> {place + 1}" in entry
    assert "frame " in entry
    panel.page.get_by_label("Undo").click()
    wait_for_frame(panel, 0)


def test_the_slider_can_be_read_in_both_themes(notebook: Notebook, panel: PanelOnScreen) -> None:
    for colours in notebook.each_theme():
        assert unreadable(panel.page, ".epypes-panel") == [], colours


def test_a_cell_that_runs_again_goes_on_with_the_frame(notebook: Notebook, panel: PanelOnScreen) -> None:
    slider(panel).focus()
    panel.page.keyboard.press("End")
    wait_for_frame(panel, 99)
    panel.settle()
    assert (
        notebook.execute(
            "panel = tune(runner, images='belt.mp4', token='gray'); panel.wait(60); print(panel._session.image)"
        ).strip()
        == "99"
    )
