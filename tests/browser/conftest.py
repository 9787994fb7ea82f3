"""The browser, JupyterLab and notebooks of the tests in this folder, and the two groups that the files are run in.

Each file belongs to one of two groups, which pytest-xdist gives to one worker each (``tests/conftest.py``). A group has
one Chromium, one JupyterLab server in the theme of the group, and one page of it, in which the files open their
notebooks one after the other. A test that looks at colours sets both themes itself.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest

from tests.browser.jupyter import JupyterLab, Notebook, chromium, open_lab

ROOT = Path(__file__).parents[2]
TUTORIALS = sorted((ROOT / "notebooks").glob("*.ipynb"))
TUTORIAL = TUTORIALS[0]
SCREENSHOTS = ROOT / "test-output" / "screenshots"
# The files of the dark group; all others are light. Both groups take about as long: measure with --durations=0.
DARK = frozenset(
    {
        "test_kernel_end.py",
        "test_panel.py",
        "test_remote_panel.py",
        "test_search.py",
        "test_service_page.py",
        "test_view.py",
    }
)


def theme_of(file: str | Path) -> str:
    """Return the group of a file: ``"light"`` or ``"dark"``."""
    return "dark" if Path(file).name in DARK else "light"


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Give each test that uses JupyterLab the server of its group."""
    if "theme" in metafunc.fixturenames:
        theme = theme_of(metafunc.definition.path)
        metafunc.parametrize("theme", [theme], indirect=True, scope="session")


@pytest.hookimpl(wrapper=True)
def pytest_runtest_makereport(item: pytest.Item) -> Any:
    """Save what a failing test has on the screen."""
    report = yield
    browser = getattr(item, "funcargs", {}).get("browser")
    if report.failed and browser is not None:
        SCREENSHOTS.mkdir(parents=True, exist_ok=True)
        pages = [page for context in browser.contexts for page in context.pages]
        for number, page in enumerate(pages):
            with suppress(Exception):  # the failure itself is what counts
                page.screenshot(path=SCREENSHOTS / f"{item.name.replace('/', '-')}-{report.when}-{number}.png")
    return report


@pytest.fixture(scope="session")
def browser() -> Iterator[Any]:
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="session")
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


@pytest.fixture(scope="session")
def lab_page(browser: Any, lab: JupyterLab) -> Iterator[Any]:
    """The page of JupyterLab in which the tests of a group open their notebooks, one at a time."""
    page = open_lab(browser, lab)
    yield page
    page.context.close()


@pytest.fixture(scope="module")
def notebook(lab_page: Any) -> Iterator[Notebook]:
    """The first tutorial, with all its cells run."""
    notebook = Notebook(lab_page, TUTORIAL.name)
    notebook.run_all()
    yield notebook
    notebook.close()
