"""Which notebook, server and browser do the tests in this folder use?"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.browser.jupyter import JupyterLab, Notebook, chromium

ROOT = Path(__file__).parents[2]
TUTORIALS = sorted((ROOT / "notebooks").glob("*.ipynb"))
TUTORIAL = TUTORIALS[0]
SCREENSHOTS = ROOT / "test-output" / "screenshots"


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="session", params=["light", "dark"])
def theme(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="session")
def lab(theme: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[JupyterLab]:
    """JupyterLab over a folder with copies of the tutorials, so that what they write stays there."""
    folder = tmp_path_factory.mktemp("notebooks")
    for tutorial in TUTORIALS:
        shutil.copy(tutorial, folder)
    with JupyterLab(folder, tmp_path_factory.mktemp(f"lab-{theme}"), theme) as lab:
        yield lab


@pytest.fixture(scope="module")
def notebook(browser: Any, lab: JupyterLab) -> Iterator[Notebook]:
    """The first tutorial, with all its cells run."""
    notebook = Notebook(browser, lab, TUTORIAL.name)
    notebook.run_all()
    yield notebook
    notebook.close()
