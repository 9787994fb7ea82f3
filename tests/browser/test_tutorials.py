"""The other tutorials run in JupyterLab: their panels are painted and their graphs are drawn."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from tests.browser.conftest import TUTORIALS
from tests.browser.jupyter import Notebook
from tests.browser.panel import PanelOnScreen

pytestmark = pytest.mark.browser


@pytest.mark.parametrize("tutorial", TUTORIALS[1:], ids=[path.stem for path in TUTORIALS[1:]])
def test_every_cell_runs_and_every_graph_is_drawn(lab_page: Any, tutorial: Path) -> None:
    notebook = Notebook(lab_page, tutorial.name)
    notebook.run_all()
    if "tune(" in tutorial.read_text():
        PanelOnScreen(notebook).settle()
    notebook.render_all()
    assert notebook.page.locator(".epypes-log:not([hidden])").count() == 0
    figures = notebook.page.locator("figure.epypes-figure")
    assert figures.count() > 0
    assert notebook.page.locator("figure svg.epypes-graph").count() == figures.count(), "none is left an image"
    assert not notebook.page_errors
    notebook.close()
