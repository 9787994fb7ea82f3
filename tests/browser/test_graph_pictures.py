"""In JupyterLab a graph shows the full pictures of a run that its kernel has, and those that were kept of any other."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.browser.contrast import unreadable
from tests.browser.jupyter import JupyterLab, Notebook, running_notebook

pytestmark = pytest.mark.browser

SET_UP = """
import cv2, numpy as np, epypes as ep
from skimage import data
photograph = cv2.resize(cv2.cvtColor(data.coffee(), cv2.COLOR_RGB2BGR), (1224, 816))
cg = ep.CompGraph(
    {"gray": lambda image: image.mean(axis=2).astype(np.uint8), "above": lambda gray, level: gray > level},
    {"gray": ("image", "gray"), "above": (("gray", "level"), "mask")},
)
runner = ep.CompGraphRunner(cg, {"level": 127})
"""
WIDTH = """where => {
    const image = document.querySelector(where + ' img');
    return image?.complete ? image.naturalWidth : 0;
}"""
HAS_WIDTH = f"([where, width]) => ({WIDTH})(where) === width"
KEPT = "a smaller picture was kept: run the cell again"


class Graph:
    """The first graph of a notebook, as a hand has it."""

    def __init__(self, notebook: Notebook) -> None:
        self.page = notebook.page
        self._figure = self.page.locator("figure:has(#token-mask)").first
        self._figure.scroll_into_view_if_needed()

    def hover(self, token: str) -> None:
        self._figure.locator(f"#token-{token}").hover()

    def wait_for_width(self, width: int, where: str = ".epypes-card") -> None:
        """Return when the picture that is shown is so many pixels wide."""
        self.page.wait_for_function(HAS_WIDTH, arg=[where, width])

    def wait_for_note(self, note: str, where: str = ".epypes-card") -> None:
        """Return when this is said of the picture that is shown."""
        is_said = "([where, note]) => document.querySelector(where + ' small')?.textContent === note"
        self.page.wait_for_function(is_said, arg=[where, note])

    def leave(self) -> None:
        self.page.mouse.move(0, 0)
        self.page.wait_for_selector(".epypes-card", state="hidden")


@pytest.fixture
def notebook(lab_page: Any, lab: JupyterLab) -> Iterator[Notebook]:
    """A notebook with the graph of a run of 1 MP, and cells after it."""
    with running_notebook(
        lab_page, lab.root / "graph.ipynb", SET_UP, "display(runner.run(image=photograph))", "1 + 1", "2 + 2"
    ) as notebook:
        yield notebook
    assert not notebook.page_errors


def test_the_kernel_gives_full_pictures_on_hover_and_on_click(notebook: Notebook) -> None:
    graph = Graph(notebook)
    for token in ("image", "gray", "mask"):
        graph.hover(token)
        graph.wait_for_width(1224)
        graph.wait_for_note("")
    graph.page.click("#token-gray")
    graph.wait_for_width(1224, ".epypes-about")
    assert not graph.page.locator(".epypes-card").is_visible()
    about, later = (graph.page.locator(each).bounding_box() for each in (".epypes-about", ".jp-Cell:nth-of-type(3)"))
    assert about["y"] + about["height"] <= later["y"], "nothing lies over later cells"
    for theme in notebook.each_theme():
        graph.page.locator(".epypes-sheet").evaluate("sheet => sheet.id = 'explored'")
        assert unreadable(graph.page, "#explored") == [], theme


def test_asking_leaves_no_trace_in_the_notebook_or_the_kernel(notebook: Notebook) -> None:
    graph = Graph(notebook)
    graph.hover("image")
    graph.wait_for_width(1224)
    assert notebook.execute("print(len(In), len(Out), _)").strip() == "5 2 4"


def test_of_a_run_that_is_gone_the_kept_picture_is_shown(notebook: Notebook) -> None:
    notebook.execute("import gc; runner.run(image=photograph[::2, ::2]) and None; gc.collect() and None")
    graph = Graph(notebook)
    graph.hover("image")
    graph.wait_for_note(KEPT)
    graph.wait_for_width(512)


def test_after_a_restart_and_in_a_notebook_that_was_opened_again_the_kept_picture_is_shown(notebook: Notebook) -> None:
    notebook.page.evaluate(f"() => {Notebook.KERNEL}.restart()")
    notebook.wait_idle()
    graph = Graph(notebook)
    graph.hover("image")
    graph.wait_for_note(KEPT)
    graph.wait_for_width(512)
    graph.leave()
    notebook.save()
    again = Notebook(notebook.page, notebook.name)
    graph = Graph(again)
    graph.hover("mask")
    graph.wait_for_note(KEPT)
    graph.wait_for_width(612)


def test_while_the_kernel_computes_the_kept_picture_is_shown(notebook: Notebook) -> None:
    notebook.start(
        "import threading, pathlib; gate = pathlib.Path('gate')\nwhile not gate.exists(): threading.Event().wait(0.01)"
    )
    graph = Graph(notebook)
    graph.hover("image")
    graph.wait_for_note("asking the kernel")
    graph.wait_for_width(512)
    # A click wants its picture, too, and what is looked at meanwhile takes no turn from it.
    graph.page.click("#token-gray")
    graph.hover("mask")
    notebook.page.evaluate(
        """() => jupyterapp.serviceManager.contents.save('gate', { type: 'file', format: 'text', content: '' })"""
    )
    graph.wait_for_width(1224)
    graph.wait_for_width(1224, ".epypes-about")
    notebook.page.evaluate("() => jupyterapp.serviceManager.contents.delete('gate')")


def test_a_notebook_that_is_not_trusted_opens_the_kept_pictures(notebook: Notebook, lab: JupyterLab) -> None:
    notebook.save()
    copy = lab.root / "not_trusted.ipynb"
    copy.write_text((lab.root / notebook.name).read_text().replace("2 + 2", "2 + 3"))
    page = Notebook(notebook.page, copy.name).page
    page.locator("summary:has-text('Its images, larger')").click()
    pictures = page.locator("details img")
    assert pictures.count() == 3
    assert [each.evaluate("async img => { await img.decode(); return img.naturalWidth; }") for each in pictures.all()] == [
        612, 512, 512,
    ]  # fmt: skip
    assert "Trust the notebook to explore the graph." in page.locator(".jp-Notebook").inner_text()
