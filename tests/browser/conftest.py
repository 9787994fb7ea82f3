"""Which notebook, server and browser do the tests in this folder use?"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.browser.jupyter import JupyterLab, Notebook, chromium

ROOT = Path(__file__).parents[2]
TUTORIAL = ROOT / "notebooks" / "01_edge_detection.ipynb"


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="module", params=["light", "dark"])
def theme(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def lab(theme: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[JupyterLab]:
    """JupyterLab over a folder with a copy of the tutorial, so that what it writes stays there."""
    folder = tmp_path_factory.mktemp("notebooks")
    shutil.copy(TUTORIAL, folder)
    with JupyterLab(folder, tmp_path_factory.mktemp(f"lab-{theme}"), theme) as lab:
        yield lab


@pytest.fixture(scope="module")
def notebook(browser: Any, lab: JupyterLab) -> Iterator[Notebook]:
    """The tutorial, with all its cells run."""
    notebook = Notebook(browser, lab, TUTORIAL.name)
    notebook.run_all()
    yield notebook
    notebook.close()
