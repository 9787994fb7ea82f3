"""The other tutorials in JupyterLab: cells run, panels are painted, and figures are drawn, run or only opened."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.browser.conftest import TUTORIAL, TUTORIALS
from tests.browser.jupyter import JupyterLab, Notebook
from tests.browser.panel import PanelOnScreen

pytestmark = pytest.mark.browser


# Tutorials whose cells are run in JupyterLab: all kinds of figures, and a panel. `make test` runs the cells of all
# tutorials without a browser; panels of a service, of cases and of a search have files of their own here.
RUN = ("02_seeing", "03_tuning")


def wait_until_drawn(notebook: Notebook) -> None:
    """Return when no figure of the notebook is left an image."""
    notebook.render_all()
    notebook.page.wait_for_function(
        """() => {
            const figures = [...document.querySelectorAll('figure.epypes-figure')];
            return figures.length && figures.every(each => each.querySelector('svg'));
        }"""
    )
    assert not notebook.page_errors


@pytest.mark.parametrize("name", RUN)
def test_every_cell_runs_and_every_graph_is_drawn(lab_page: Any, name: str) -> None:
    notebook = Notebook(lab_page, f"{name}.ipynb")
    notebook.run_all()
    if "tune(" in (TUTORIAL.parent / f"{name}.ipynb").read_text():
        PanelOnScreen(notebook).settle()
    wait_until_drawn(notebook)
    assert notebook.page.locator(".epypes-log:not([hidden])").count() == 0
    notebook.close()


@pytest.mark.parametrize(
    "tutorial",
    [path for path in TUTORIALS[1:] if path.stem not in RUN and "epypes-figure" in path.read_text()],
    ids=lambda path: path.stem,
)
def test_every_graph_that_is_saved_in_a_tutorial_is_drawn_when_it_is_opened(
    lab_page: Any, lab: JupyterLab, tutorial: Path
) -> None:
    copy = lab.root / f"saved_{tutorial.name}"
    copy.write_bytes(tutorial.read_bytes())
    lab.api(f"contents/{copy.name}/trust", "POST")
    notebook = Notebook(lab_page, copy.name)
    wait_until_drawn(notebook)
    notebook.close()


@pytest.mark.parametrize(
    ("name", "slider", "key"),
    [
        ("03_tuning", "low", "ArrowRight"),
        ("06_operate", "quality", "ArrowRight"),
        ("07_many_images", "lo", "ArrowRight"),
    ],
)
def test_a_tutorial_ends_with_a_panel_that_can_be_moved(lab_page: Any, name: str, slider: str, key: str) -> None:
    notebook = Notebook(lab_page, f"{name}.ipynb")
    notebook.run_all()
    panel = lab_page.locator(".jp-CodeCell").last.locator(".epypes-panel")
    panel.scroll_into_view_if_needed()
    picture = panel.locator("img.epypes-picture")
    value = "(picture, name) => JSON.parse(picture.dataset.values ?? '{}')[name]"
    lab_page.wait_for_function("picture => picture.dataset.values", arg=picture.element_handle())
    before = picture.evaluate(value, slider)
    panel.locator(".widget-slider", has_text=slider).first.locator(".noUi-handle").first.focus()
    lab_page.keyboard.press(key)
    lab_page.wait_for_function(
        "([picture, name, before]) => JSON.parse(picture.dataset.values)[name] > before",
        arg=[picture.element_handle(), slider, before],
    )
    notebook.close()
