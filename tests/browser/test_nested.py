"""A pipeline in a graph opens in JupyterLab, and what is inside is tuned in its folder."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.browser.conftest import SCREENSHOTS
from tests.browser.contrast import unreadable
from tests.browser.jupyter import JupyterLab, Notebook, running_notebook
from tests.browser.panel import PanelOnScreen

pytestmark = pytest.mark.browser

SET_UP = """
import cv2, numpy as np, epypes as ep
from typing import Annotated
from skimage import data
from epypes_widgets import tune

def gray(image):
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)

def corners(gray, quality: Annotated[float, ep.Param(0.01, 0.5)], count):
    return cv2.goodFeaturesToTrack(gray, count, quality, 5)

def ransac(corners, threshold: Annotated[int, ep.Param(1, 300)]):
    points = corners.reshape(-1, 2)
    if threshold == 299:
        raise ValueError("299 is too loose")
    return points[np.linalg.norm(points - np.median(points, axis=0), axis=1) < threshold]

def outline(inliers):
    return cv2.convexHull(inliers.astype(np.float32))

inner = ep.CompGraph(
    {"find": corners, "ransac": ransac, "outline": outline},
    {"find": (("gray", "quality", "count"), "corners"), "ransac": (("corners", "threshold"), "inliers"),
     "outline": ("inliers", "hull")},
)
geometry = ep.Pipeline("geometry", inner, {"quality": 0.05, "count": 200, "threshold": 150})
cg = ep.CompGraph({"to_gray": gray, "geometry": geometry, "area": cv2.contourArea},
                  {"to_gray": ("image", "gray"), "geometry": ("gray", "shape"), "area": ("shape", "size")})
runner = ep.CompGraphRunner(cg)
run = runner.run(image=cv2.cvtColor(data.coffee(), cv2.COLOR_RGB2BGR))
"""


@pytest.fixture(scope="module")
def notebook(lab_page: Any, lab: JupyterLab) -> Iterator[Notebook]:
    cells = (
        SET_UP,
        "print('printed before')\nrun",
        "ep.show(run, depth=1)",
        'panel = tune(runner, token="shape")\npanel',
    )
    with running_notebook(lab_page, lab.root / "nested.ipynb", *cells, width=1440) as notebook:
        yield notebook


def test_a_click_opens_what_is_inside_a_pipeline(notebook: Notebook) -> None:
    closed = notebook.page.locator(".jp-Cell >> nth=1")
    closed.locator("#function-geometry").click()
    inside = closed.locator("details[open] svg.epypes-graph")
    assert inside.locator("[id^=function-]").count() == 3
    inside.locator("#function-ransac").click()
    assert "np.median" in closed.locator("details[open] .epypes-about").inner_text()


def test_an_open_pipeline_is_in_the_picture_and_can_be_read_in_both_themes(notebook: Notebook) -> None:
    shown = notebook.page.locator(".jp-Cell >> nth=2").locator("svg.epypes-graph").first
    assert shown.locator("#function-geometry__ransac").is_visible()
    assert shown.locator("#token-geometry__inliers image").count() == 1
    SCREENSHOTS.mkdir(parents=True, exist_ok=True)
    for theme in notebook.each_theme():
        for width in (1440, 1024):
            notebook.page.set_viewport_size({"width": width, "height": 900})
            shown.scroll_into_view_if_needed()
            shown.screenshot(path=SCREENSHOTS / f"nested-{theme}-{width}.png")
        assert not unreadable(notebook.page)
    notebook.page.set_viewport_size({"width": 1440, "height": 900})


def test_a_panel_on_the_page_neither_hides_what_was_printed_before_a_graph_nor_squeezes_it(notebook: Notebook) -> None:
    notebook.page.wait_for_selector(".epypes-panel")
    assert notebook.page.locator(".jp-Cell >> nth=1").get_by_text("printed before", exact=True).is_visible()
    shown = notebook.page.locator(".jp-Cell >> nth=2").locator(".epypes-figure").first
    graph, view = (shown.locator(css).first.bounding_box()["width"] for css in ("svg.epypes-graph", ".epypes-window"))
    assert view >= graph


def test_a_slider_inside_a_pipeline_moves_the_picture(notebook: Notebook) -> None:
    panel = PanelOnScreen(notebook)
    folder = notebook.page.locator(".epypes-folder", has_text="geometry")
    assert folder.locator(".epypes-row").count() == 3
    panel.focus("threshold")
    panel.press("ArrowRight", "geometry__threshold", 151)
    assert (
        notebook.execute("panel.wait(60); print(runner['geometry__threshold'], geometry['threshold'])") == "151 150\n"
    )
    assert notebook.execute("print(panel.result.nested['geometry'].report.ran)") == "('ransac', 'outline')\n"
    assert notebook.execute("panel['geometry__threshold'] = 299; panel.wait(60)") == ""
    panel.wait("() => document.querySelector('.epypes-panel').innerText.includes('geometry: ransac: ValueError')")
    for theme in notebook.each_theme():
        for width in (1440, 1024):
            notebook.page.set_viewport_size({"width": width, "height": 900})
            notebook.page.locator(".epypes-panel").scroll_into_view_if_needed()
            notebook.page.locator(".epypes-panel").screenshot(path=SCREENSHOTS / f"nested-panel-{theme}-{width}.png")
    notebook.page.set_viewport_size({"width": 1440, "height": 900})
    assert notebook.execute("panel.undo() or panel.reset(); panel.wait(60)") == ""
