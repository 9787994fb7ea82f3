"""The other tutorials in JupyterLab: cells run, panels are painted, and figures are drawn, run or only opened."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.browser.conftest import TUTORIAL, TUTORIALS
from tests.browser.jupyter import JupyterLab, Notebook

pytestmark = pytest.mark.browser


# Tutorials whose cells are run in JupyterLab: all kinds of figures, and a panel, which a reader moves. `make test` runs
# the cells of all tutorials without a browser; panels of a service, of cases and of a search have files of their own.
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
        move_last_panel(notebook, "low")
    wait_until_drawn(notebook)
    assert notebook.page.locator(".epypes-log:not([hidden])").count() == 0
    notebook.close()


def move_last_panel(notebook: Notebook, slider: str) -> None:
    """Move a slider of the panel in the last cell by a key, and wait for the picture of a larger value."""
    page = notebook.page
    panel = page.locator(".jp-CodeCell").last.locator(".epypes-panel")
    panel.scroll_into_view_if_needed()
    picture = panel.locator("img.epypes-picture").element_handle()
    value = "([picture, name]) => JSON.parse(picture.dataset.values ?? '{}')[name]"
    before = page.wait_for_function(value, arg=[picture, slider]).json_value()
    panel.locator(".widget-slider", has_text=slider).first.locator(".noUi-handle").first.focus()
    page.keyboard.press("ArrowRight")
    page.wait_for_function(
        f"([picture, name, before]) => ({value})([picture, name]) > before", arg=[picture, slider, before]
    )


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
