"""Do the other tutorials run in JupyterLab, are their panels painted, and what do they look like?"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.browser.conftest import SCREENSHOTS, TUTORIALS
from tests.browser.jupyter import JupyterLab, Notebook
from tests.browser.panel import PanelOnScreen

pytestmark = pytest.mark.browser


# Each takes half a minute, so each in one theme; how both look is tested on the views and panels themselves.
IN_TURN = [("dark" if number % 2 else "light", tutorial) for number, tutorial in enumerate(TUTORIALS[1:])]


@pytest.mark.parametrize(("theme", "tutorial"), IN_TURN, indirect=["theme"], ids=[path.stem for _, path in IN_TURN])
def test_every_cell_runs_and_every_graph_is_drawn(browser: Any, lab: JupyterLab, theme: str, tutorial: Path) -> None:
    notebook = Notebook(browser, lab, tutorial.name)
    try:
        notebook.run_all()
        if "tune(" in tutorial.read_text():
            PanelOnScreen(notebook).settle()
        notebook.screenshot(SCREENSHOTS / f"{tutorial.stem}-{theme}.png")
        assert notebook.page.locator(".epypes-log:not([hidden])").count() == 0
        figures = notebook.page.locator("figure.epypes-figure")
        assert figures.count() > 0
        assert notebook.page.locator("figure svg.epypes-graph").count() == figures.count(), "none is left an image"
        assert not notebook.page_errors
    finally:
        notebook.close()
