"""A panel whose kernel has ended says so, and a saved notebook shows its last picture without one."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from typing import Any

import pytest

from tests.browser.contrast import unreadable
from tests.browser.jupyter import JupyterLab, Notebook, running_notebook
from tests.browser.panel import PanelOnScreen

pytestmark = pytest.mark.browser

GRAPH = """
import numpy as np, epypes as ep
from epypes_widgets import tune

def above(image, threshold=100):
    if threshold == 13:
        raise ValueError("13 is no threshold")
    return image > threshold

image = np.add.outer(np.arange(200), np.arange(255)).astype(np.uint8)
runner = ep.CompGraphRunner(ep.CompGraph.from_functions(above))
run = runner.run(image=image)
"""
SHOW = """
panel = tune(runner)
panel
"""
RESTARTED = "The kernel was restarted: run the cells again, up to this one."
KEPT = "Kept from the last run: run the cells up to this one to go on."
ENDED = "The kernel of this panel has ended: run the cells again, up to this one."
CONTEXT = "jupyterapp.shell.currentWidget.sessionContext"
# What ipywidgets draws on a part whose kernel is gone.
BROKEN = """() => [...document.querySelectorAll('.jupyter-widgets-disconnected')]
    .filter(each => getComputedStyle(each, '::before').display !== 'none' && each.checkVisibility()).length"""


@pytest.fixture
def notebook(lab_page: Any, lab: JupyterLab) -> Iterator[Notebook]:
    with running_notebook(lab_page, lab.root / "ended.ipynb", GRAPH, SHOW, width=1440, height=900) as notebook:
        yield notebook


def check_ended(panel: PanelOnScreen, text: str) -> None:
    panel.wait_for_status(text)
    page = panel.page
    assert page.locator(".epypes-live-switch").get_attribute("aria-checked") == "false"
    assert page.locator(".epypes-live-switch").is_disabled()
    assert page.locator(".epypes-controls").evaluate("column => column.inert")
    assert "grayscale" in page.locator(".epypes-box").evaluate("box => getComputedStyle(box).filter")
    assert page.locator("img.epypes-picture").is_visible()
    assert page.evaluate(BROKEN) == 0


def test_after_a_restart_the_panel_says_so_and_runs_again_with_its_cell(notebook: Notebook) -> None:
    panel = PanelOnScreen(notebook)
    assert notebook.execute("panel['threshold'] = 13; panel.wait(60)") == ""
    panel.wait_for_status("13 is no threshold")
    notebook.page.evaluate(f"() => {CONTEXT}.restartKernel()")
    check_ended(panel, RESTARTED)
    for theme in notebook.each_theme():
        assert unreadable(notebook.page, ".epypes-status-place") == [], theme
    notebook.wait_idle()
    panel.page.locator(".epypes-box").focus()
    panel.page.keyboard.press("Control+z")
    assert not notebook.page_errors
    notebook.run_all()
    panel = PanelOnScreen(notebook)
    panel.wait_for_status("")
    panel.focus("threshold")
    panel.press("ArrowRight", "threshold", 101)


def test_a_kernel_that_dies_is_a_restart_and_one_that_is_shut_down_has_ended(notebook: Notebook) -> None:
    panel = PanelOnScreen(notebook)
    notebook.start("import os, signal; os.kill(os.getpid(), signal.SIGKILL)")
    check_ended(panel, RESTARTED)
    panel.page.locator(".jp-Dialog .jp-mod-accept").click()
    notebook.wait_idle()
    notebook.run_all()
    panel = PanelOnScreen(notebook)
    panel.wait_for_status("")
    panel.choose("image")
    notebook.page.evaluate(f"() => {CONTEXT}.shutdown()")
    check_ended(panel, ENDED)
    assert panel.page.locator(".epypes-chip[aria-selected=true]").get_attribute("data-token") == "image"


def test_a_notebook_that_is_opened_again_shows_the_picture_and_the_line_and_no_error(
    lab_page: Any, notebook: Notebook, lab: JupyterLab
) -> None:
    assert notebook.execute("panel['threshold'] = 66; panel.wait(60); panel._static.update()") == ""
    PanelOnScreen(notebook).wait(
        "() => JSON.stringify(jupyterapp.shell.currentWidget.content.model.toJSON()).includes('66')"
    )
    notebook.save()
    saved = json.loads((lab.root / "ended.ipynb").read_text())
    stranger = lab.root / "not trusted.ipynb"
    saved["cells"][1]["source"] += "  # changed elsewhere"
    stranger.write_text(json.dumps(saved))
    shutil.copy(lab.root / "ended.ipynb", lab.root / "opened.ipynb")
    for name in ("opened.ipynb", stranger.name):
        again = Notebook(lab_page, name, 1440, 900)
        kept = again.page.locator(".epypes-kept")
        kept.scroll_into_view_if_needed()
        assert kept.locator("img").evaluate("async img => { await img.decode(); return img.naturalWidth; }") > 200
        assert KEPT in kept.inner_text()
        assert "66" in kept.inner_text()
        if name == "opened.ipynb":  # what it can't find a model for is not even shown in an other notebook
            again.page.wait_for_function(
                "() => document.querySelector('.jp-Notebook').textContent.includes('model not found')"
            )
        assert "model not found" not in again.page.locator(".jp-Notebook").inner_text()
        again.close()


def test_where_the_models_are_saved_too_the_picture_is_shown_and_no_panel_that_is_dead(
    lab_page: Any, notebook: Notebook, lab: JupyterLab
) -> None:
    # As nbconvert saves what it has executed.
    state = notebook.execute("import ipywidgets, json; print(json.dumps(ipywidgets.Widget.get_manager_state()))")
    notebook.page.evaluate(
        "state => jupyterapp.shell.currentWidget.context.model.setMetadata('widgets',"
        " { 'application/vnd.jupyter.widget-state+json': JSON.parse(state) })",
        state,
    )
    notebook.save()
    shutil.copy(lab.root / "ended.ipynb", lab.root / "with models.ipynb")
    again = Notebook(lab_page, "with models.ipynb", 1440, 900)
    again.page.locator(".epypes-kept img").scroll_into_view_if_needed()
    again.page.wait_for_function("() => document.querySelector('.epypes-void')")
    assert again.page.locator(".epypes-kept img").is_visible()
    assert KEPT in again.page.locator(".epypes-kept").inner_text()
    assert not again.page.locator(".epypes-panel").is_visible()
    again.close()
