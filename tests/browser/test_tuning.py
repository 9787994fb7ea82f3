"""Does the picture follow the hand, in JupyterLab, in a real browser?"""

from __future__ import annotations

import json
import logging
import statistics
from typing import Any

import pytest

from tests.browser.conftest import SCREENSHOTS, TUTORIAL
from tests.browser.jupyter import JupyterLab, Notebook
from tests.browser.panel import PanelOnScreen

pytestmark = pytest.mark.browser

LOG = logging.getLogger(__name__)
PRESSES = 10

# The time of a key press, and the time at which the picture says that it shows the value that came of it.
WATCH = """() => {
    const img = document.querySelector('img.epypes-picture');
    window.pressed = []; window.shown = [];
    document.addEventListener('keydown', () => window.pressed.push(performance.now()), true);
    new MutationObserver(() => window.shown.push([performance.now(), img.dataset.values]))
        .observe(img, { attributeFilter: ['data-values'] });
}"""
KERNEL_DIGEST = """
import hashlib
from epypes.display.previews.raster import encode_image
panel.wait(10)
print(hashlib.sha256(encode_image(panel.result[panel.token], max_side_px=1400).data).hexdigest())
"""


@pytest.fixture(scope="module")
def panel(notebook: Notebook) -> PanelOnScreen:
    return PanelOnScreen(notebook)


def test_a_key_on_a_slider_changes_the_picture(notebook: Notebook, panel: PanelOnScreen) -> None:
    seq, values, digest = panel.seq, panel.values, panel.digest
    panel.focus("blur_kernel")
    panel.press("ArrowRight", "blur_kernel", values["blur_kernel"] + 2)

    assert panel.seq > seq
    assert panel.values == {**values, "blur_kernel": values["blur_kernel"] + 2}
    assert panel.digest != digest


def test_the_picture_is_what_the_kernel_has(notebook: Notebook, panel: PanelOnScreen) -> None:
    assert notebook.execute(KERNEL_DIGEST).strip() == panel.digest


def test_the_time_from_key_to_picture_is_reported(notebook: Notebook, panel: PanelOnScreen) -> None:
    start = panel.values["canny_lo"]
    panel.focus("canny_lo")
    notebook.page.evaluate(WATCH)
    for step in range(1, PRESSES + 1):
        panel.press("ArrowRight", "canny_lo", start + step)
    pressed, shown = notebook.page.evaluate("() => [window.pressed, window.shown]")
    arrivals = {json.loads(values)["canny_lo"]: at for at, values in reversed(shown)}
    times = [arrivals[start + step] - at for step, at in enumerate(pressed, start=1)]
    LOG.info(
        "key press -> painted: p50 %.0f ms, max %.0f ms over %d presses; an empty request to the kernel: p50 %.0f ms",
        statistics.median(times),
        max(times),
        len(times),
        statistics.median(notebook.echo_ms(PRESSES)),
    )
    assert len(times) == PRESSES


def test_after_many_keys_the_last_value_is_shown(notebook: Notebook, panel: PanelOnScreen) -> None:
    start = panel.values["canny_hi"]
    panel.focus("canny_hi")
    for _ in range(40):
        notebook.page.keyboard.press("ArrowLeft")
    panel.wait_for("canny_hi", start - 40)
    assert notebook.execute(KERNEL_DIGEST).strip() == panel.digest


def test_a_failure_keeps_the_picture_and_a_good_value_clears_it(
    notebook: Notebook, panel: PanelOnScreen, theme: str
) -> None:
    values, digest = panel.values, panel.digest
    height = panel.height
    # The slider refuses even sizes; a cell that sets the runner itself does not.
    assert notebook.execute("runner['blur_kernel'] = 4; panel['canny_hi'] -= 1; panel.wait(10)") == ""
    panel.wait_for_status("blur")
    panel.page.locator(".epypes-panel").screenshot(path=SCREENSHOTS / f"panel-failed-{theme}.png")
    assert (panel.values, panel.digest, panel.height) == (values, digest, height)

    assert notebook.execute("panel['blur_kernel'] = 5; panel.wait(10)") == ""
    panel.wait_for("blur_kernel", 5)
    panel.wait_for_status("")


def test_another_token_can_be_chosen(panel: PanelOnScreen) -> None:
    digest = panel.digest
    panel.choose("image_gray")
    assert panel.digest != digest
    panel.choose("edges")
    assert panel.digest == digest


def test_showing_a_panel_changes_no_value(browser: Any, lab: JupyterLab) -> None:
    import nbformat  # takes seconds

    cells = (
        "import numpy as np, epypes as ep\nfrom epypes_widgets import tune\n"
        "cg = ep.CompGraph({'f': lambda im, a, b, c: im + a + b + c}, {'f': (('im', 'a', 'b', 'c'), 'y')})\n"
        "runner = ep.CompGraphRunner(cg, {'a': 1.5, 'b': 0.123456, 'c': 0.0375})\n"
        "_ = runner.run(im=np.zeros((64, 64)))",
        "panel = tune(runner, b=(0.0, 1.0), c=ep.Param(0.001, 10, log=True))\npanel",
    )
    document = nbformat.v4.new_notebook(
        cells=[nbformat.v4.new_code_cell(cell) for cell in cells],
        # Without a kernel named, JupyterLab would ask for one.
        metadata={"kernelspec": {"name": "python3", "display_name": "Python 3"}},
    )
    nbformat.write(document, lab.root / "f.ipynb")
    notebook = Notebook(browser, lab, "f.ipynb")
    try:
        notebook.run_all()
        panel = PanelOnScreen(notebook)
        panel.focus("a")
        said = notebook.execute("panel.wait(10); print(dict(runner.hyperparameters), panel.code())").strip()
        assert said == "{'a': 1.5, 'b': 0.123456, 'c': 0.0375} runner.rerun()"
        notebook.page.keyboard.press("ArrowRight")
        panel.wait_for("a", 1.51)
        assert panel.values == {"a": 1.51, "b": 0.123456, "c": 0.0375}
    finally:
        notebook.close()


def test_a_notebook_that_is_not_trusted_shows_its_pictures(browser: Any, lab: JupyterLab, theme: str) -> None:
    copy = lab.root / "untrusted.ipynb"
    copy.write_bytes(TUTORIAL.read_bytes())
    notebook = Notebook(browser, lab, copy.name)
    try:
        picture = notebook.page.locator("figure img[alt^='Computational graph']").first
        picture.scroll_into_view_if_needed()
        assert picture.evaluate("async img => { await img.decode(); return img.naturalWidth; }") > 100
        assert notebook.page.locator("figure svg").count() == 0
        notebook.screenshot(SCREENSHOTS / f"untrusted-{theme}.png")
    finally:
        notebook.close()


def test_graphs_take_the_colours_of_the_theme(notebook: Notebook, theme: str) -> None:
    text, shape = notebook.page.evaluate(
        """() => ['text', '.shape'].map(kind => {
            const canvas = document.createElement('canvas').getContext('2d');
            canvas.fillStyle = getComputedStyle(document.querySelector(`figure svg.epypes-graph ${kind}`)).fill;
            canvas.fillRect(0, 0, 1, 1);
            return canvas.getImageData(0, 0, 1, 1).data.slice(0, 3).reduce((sum, part) => sum + part, 0);
        })"""
    )
    assert (text < shape) == (theme == "light"), "dark text on light shapes, or the other way round"


def test_the_notebook_can_be_looked_at(notebook: Notebook, panel: PanelOnScreen, theme: str) -> None:
    notebook.screenshot(SCREENSHOTS / f"{TUTORIAL.stem}-{theme}.png")
    assert not notebook.page_errors
