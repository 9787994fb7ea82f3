"""A panel in JupyterLab does what its tutorial says: look, remember, follow cells, fail well and stay in the file."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.browser.contrast import unreadable
from tests.browser.jupyter import JupyterLab, Notebook, write_notebook
from tests.browser.panel import PanelOnScreen

pytestmark = pytest.mark.browser

SET_UP = """
import threading, cv2, numpy as np, epypes as ep
from typing import Annotated
from skimage import data
from epypes_widgets import tune

def cut(image, region: Annotated[tuple, ep.Roi("image")] = (0, 0, 600, 400)):
    x, y, width, height = region
    return image[y:y + height, x:x + width]

def gray(cut):
    return cv2.cvtColor(cut, cv2.COLOR_BGR2GRAY)

def above(gray, threshold: Annotated[int, ep.Param(1, 255, cuts="gray")] = 100):
    return cv2.threshold(gray, threshold, 255, cv2.THRESH_BINARY)[1]

def outlines(above):
    return cv2.findContours(above, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]

photograph = cv2.cvtColor(data.coffee(), cv2.COLOR_RGB2BGR)
runner = ep.CompGraphRunner(ep.CompGraph.from_functions(cut, gray, above, outlines))
"""
SHOW = """
panel = tune(runner, images=[photograph, photograph[:, ::-1].copy()], token="above")
panel
"""
# A page counts the addresses of blobs that it has not given back.
COUNT_BLOBS = """
window.blobs = new Set();
const make = URL.createObjectURL.bind(URL), give = URL.revokeObjectURL.bind(URL);
URL.createObjectURL = blob => { const url = make(blob); window.blobs.add(url); return url; };
URL.revokeObjectURL = url => { window.blobs.delete(url); give(url); };
"""
MANY_FRAMES = """
frames, pause = panel._screen.view.frames, threading.Event()
for count in range({count}):
    seq = frames.newest.seq
    panel._tuning.want({{"threshold": 60 + count % 100}}, commit=False)
    while frames.newest.seq == seq or frames.in_flight is not None:
        pause.wait(0.005)
panel.wait(60)
"""


@pytest.fixture(scope="module")
def running(lab_page: Any, lab: JupyterLab) -> Iterator[tuple[Notebook, Path]]:
    """A notebook whose last cell runs until its pipe is opened for writing."""
    pipe = lab.state / "cell below"
    write_notebook(lab.root / "panel.ipynb", SET_UP.strip(), SHOW.strip(), runs_until(pipe))
    notebook = Notebook(lab_page, "panel.ipynb")
    notebook.page.evaluate(COUNT_BLOBS)
    ran = "() => jupyterapp.commands.execute('notebook:run-all-cells').then(() => { window.hasRun = true; })"
    notebook.page.evaluate(f"() => {{ window.hasRun = false; ({ran})(); }}")
    yield notebook, pipe
    notebook.close()


@pytest.fixture(scope="module")
def notebook(running: tuple[Notebook, Path]) -> Notebook:
    """The notebook, all of whose cells have run."""
    notebook, pipe = running
    pipe.open("w").close()
    notebook.page.wait_for_function("() => window.hasRun")
    notebook.wait_idle()
    notebook.check_outputs()
    return notebook


@pytest.fixture
def panel(notebook: Notebook) -> PanelOnScreen:
    """The panel at its first values, on its first image."""
    panel = PanelOnScreen(notebook)
    said = "panel.reset(); panel.token = 'above'; panel._tuning.want_image(0); panel.wait(60)"
    assert notebook.execute(said) == ""
    panel.wait_for("threshold", 100)
    return panel


def runs_until(pipe: Path) -> str:
    """Return code that runs until the pipe is opened for writing."""
    os.mkfifo(pipe)
    return f"open({str(pipe)!r}).close()"


def test_a_panel_can_be_used_while_the_cell_below_it_runs(running: tuple[Notebook, Path]) -> None:
    # The first of all tests: no control has sent anything while the main thread of the kernel was free.
    notebook, _ = running
    panel = PanelOnScreen(notebook)
    panel.focus("threshold")
    panel.press("ArrowRight", "threshold", 101)
    assert not notebook.page.evaluate("() => window.hasRun")


def test_a_cell_that_runs_does_not_stop_the_panel(notebook: Notebook, panel: PanelOnScreen, lab: JupyterLab) -> None:
    pipe = lab.state / "cell"
    notebook.start(runs_until(pipe))
    panel.wait(f"() => {notebook.KERNEL}.status === 'busy'")
    panel.focus("threshold")
    for step in range(1, 6):
        panel.press("ArrowRight", "threshold", 100 + step)
    panel.choose("gray")
    assert notebook.is_running
    pipe.open("w").close()
    panel.wait("() => !window.isRunning")


def test_a_drag_is_followed_and_committed_when_it_ends(notebook: Notebook, panel: PanelOnScreen) -> None:
    assert notebook.execute("before = len(panel.history)") == ""
    seq, height = panel.seq, panel.height
    with panel.restless():
        x, y = panel.grab("threshold")
        for step in range(1, 41):
            panel.page.mouse.move(x + step, y)
            panel.page.evaluate("() => new Promise(done => requestAnimationFrame(done))")
        panel.wait("() => JSON.parse(document.querySelector('img.epypes-picture').dataset.values).threshold > 110")
        panel.page.mouse.up()
        panel.settle()
    assert panel.seq > seq
    assert int(notebook.execute("print(len(panel.history) - before)")) == 1
    assert panel.height == height
    said = notebook.execute("print(runner['threshold'], panel['threshold'], panel.result.hyperparameters['threshold'])")
    assert set(said.split()) == {str(int(panel.number("threshold")))}


def test_a_cell_moves_the_control_but_never_under_the_hand(notebook: Notebook, panel: PanelOnScreen) -> None:
    assert notebook.execute("runner['threshold'] = 120; panel.wait(60)") == ""
    panel.wait_for("threshold", 120)
    assert panel.number("threshold") == 120
    panel.grab("threshold")
    assert notebook.execute("runner['threshold'] = 50; panel.wait(60); print(panel['threshold'])").strip() == "120"
    assert panel.number("threshold") == 120
    panel.page.mouse.up()
    panel.wait_for("threshold", 50)
    panel.wait("() => [...document.querySelectorAll('input.epypes-number')].some(box => box.value === '50')")


def test_typed_numbers_steps_and_reset(panel: PanelOnScreen) -> None:
    box = panel.row("threshold").locator("input.epypes-number")
    box.fill("77")
    box.press("Enter")
    panel.wait_for("threshold", 77)
    box.press("ArrowUp")
    panel.wait_for("threshold", 78)
    box.fill("700")
    box.press("Enter")
    panel.wait_for_status("255")
    assert panel.values["threshold"] == 78
    box.press("Escape")
    panel.row("threshold").locator(".epypes-reset").click()
    panel.wait_for("threshold", 100)


def test_undo_and_redo_from_the_toolbar(notebook: Notebook, panel: PanelOnScreen) -> None:
    for value in (110, 120):
        assert notebook.execute(f"panel['threshold'] = {value}; panel.wait(60)") == ""
    panel.page.locator(".epypes-undo").click()
    panel.wait_for("threshold", 110)
    panel.page.locator(".epypes-redo").click()
    panel.wait_for("threshold", 120)


def test_every_entry_of_the_history_has_its_picture_and_goes_back_to_its_values(
    notebook: Notebook, panel: PanelOnScreen
) -> None:
    for value in (110, 120, 130):
        assert notebook.execute(f"panel['threshold'] = {value}; panel.wait(60)") == ""
    panel.wait("() => document.querySelector('.epypes-entry[aria-current=true]').title.includes('120 -> 130')")
    seen = "() => [...document.querySelectorAll('.epypes-entry img')].filter(img => img.naturalWidth > 10).length"
    panel.wait(f"() => ({seen})() === document.querySelectorAll('.epypes-entry').length")
    panel.page.locator(".epypes-entry").nth(-2).click()
    panel.wait_for("threshold", 120)
    panel.wait("() => document.querySelector('.epypes-code').textContent === 'runner.rerun(threshold=120)'")


def test_a_threshold_is_dragged_on_the_histogram_of_what_it_cuts(panel: PanelOnScreen) -> None:
    line = panel.page.locator(".epypes-cut[data-name=threshold] .epypes-cut-hit")
    line.scroll_into_view_if_needed()
    box = line.bounding_box()
    panel.page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    panel.page.mouse.down()
    panel.page.mouse.move(box["x"] + box["width"] / 2 + 40, box["y"] + box["height"] / 2, steps=8)
    panel.page.mouse.up()
    panel.wait("() => JSON.parse(document.querySelector('img.epypes-picture').dataset.values).threshold > 105")
    panel.wait("() => +document.querySelector('.epypes-changed input.epypes-number').value > 105")
    panel.settle()


def test_a_region_is_drawn_on_the_picture_that_it_is_of(panel: PanelOnScreen) -> None:
    panel.choose("image")
    panel.page.locator(".epypes-roi-button").first.click()
    x, y = panel.middle(".epypes-box")
    panel.page.mouse.move(x - 90, y - 60)
    panel.page.mouse.down()
    panel.page.mouse.move(x + 90, y + 60, steps=10)
    panel.page.mouse.up()
    panel.wait("() => JSON.parse(document.querySelector('img.epypes-picture').dataset.values).region[0] > 50")
    panel.settle()
    region = panel.values["region"]
    assert 0.8 < region[2] / region[3] / 1.5 < 1.25
    panel.choose("gray")
    shape = panel.page.locator(".epypes-kind").inner_text()
    assert f"{region[3]} x {region[2]}" in shape


def test_every_token_with_a_picture_has_a_tab(panel: PanelOnScreen) -> None:
    tabs = panel.page.locator(".epypes-chip")
    panel.choose("outlines")
    assert [tab.get_attribute("data-token") for tab in tabs.all()] == ["image", "cut", "gray", "above", "outlines"]
    panel.wait("() => document.querySelectorAll('.epypes-pin').length === 5")
    panel.page.keyboard.press("ArrowLeft")
    panel.wait("() => document.querySelector('img.epypes-picture').alt.startsWith('above ')")


def test_stages_are_compared_probed_and_zoomed(panel: PanelOnScreen) -> None:
    panel.choose("outlines")
    panel.wait("() => document.querySelectorAll('svg.epypes-overlay path, svg.epypes-overlay polygon').length > 0")
    x, y = panel.middle(".epypes-box")
    panel.page.mouse.move(x, y)
    panel.wait("() => document.querySelector('.epypes-probe').textContent.includes('gray')")
    panel.page.select_option(".epypes-compare", '{"kind":"default"}')
    panel.page.locator(".epypes-side-button, [aria-label^='Side by side']").first.click()
    panel.wait("() => document.querySelector('img.epypes-other')?.naturalWidth > 0")
    panel.page.select_option(".epypes-compare", index=0)


def test_zoom_and_place_stay_when_values_and_images_change(panel: PanelOnScreen) -> None:
    panel.wait("() => document.querySelector('.epypes-second').hidden")
    panel.page.evaluate("() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(done)))")
    panel.page.locator(".epypes-box").focus()
    for key in ("+", "+", "ArrowRight", "ArrowDown"):
        panel.page.keyboard.press(key)
    place = panel.page.locator(".epypes-canvas").first.bounding_box()
    panel.focus("threshold")
    panel.press("ArrowRight", "threshold", 101)
    panel.choose("gray")
    panel.settle()
    assert panel.page.locator(".epypes-canvas").first.bounding_box() == place
    panel.page.locator(".epypes-fit").click()


def test_test_images_are_switched_on_the_film(notebook: Notebook, panel: PanelOnScreen) -> None:
    seq, digest = panel.seq, panel.digest
    panel.page.locator(".epypes-filmstrip button").nth(1).click()
    panel.wait("before => document.querySelector('img.epypes-picture').dataset.seq > before", seq)
    assert notebook.execute("panel.wait(60); print(panel._session.image)").strip() == "1"
    assert panel.digest != digest


def test_what_fails_is_said_at_its_chip_and_control(notebook: Notebook, panel: PanelOnScreen) -> None:
    values, digest, height = panel.values, panel.digest, panel.height
    assert notebook.execute("panel['region'] = (0, 0, 0, 0); panel.wait(60)") == ""
    panel.wait_for_status("gray")
    assert panel.row("region").evaluate("row => row.classList.contains('epypes-failed')")
    assert panel.page.locator("[data-state=failed] .epypes-chip[data-token=gray]").count() == 1
    assert (panel.values, panel.digest, panel.height) == (values, digest, height)
    assert notebook.execute("print(runner['region'])").strip() == "(0, 0, 600, 400)"
    for colours in notebook.each_theme():
        assert unreadable(panel.page, ".epypes-panel") == [], colours
    assert notebook.execute("panel.reset(); panel.wait(60)") == ""
    panel.wait_for_status("")
    assert panel.page.locator(".epypes-failed, [data-state=failed]").count() == 0


def test_what_fails_in_the_panel_itself_is_in_its_log(notebook: Notebook, panel: PanelOnScreen) -> None:
    assert notebook.execute("runner['threshold'] = 300; panel.wait(60)") == ""
    panel.wait("() => document.querySelector('.epypes-log').textContent.includes(\"can't be 300\")")
    assert notebook.execute("panel.reset(); panel.wait(60)") == ""


def test_settings_are_saved_and_loaded(notebook: Notebook, panel: PanelOnScreen, lab: JupyterLab) -> None:
    assert notebook.execute("panel['threshold'] = 88; panel.wait(60)") == ""
    panel.page.locator(".epypes-setting").fill("afternoon")
    panel.page.locator(".epypes-save").click()
    panel.wait("() => document.querySelector('.epypes-foot').textContent.includes('Saved afternoon.toml')")
    assert "threshold = 88" in (lab.root / "afternoon.toml").read_text()
    assert notebook.execute("panel.reset(); panel.wait(60)") == ""
    panel.page.locator(".epypes-load").click()
    panel.wait_for("threshold", 88)


def test_promote_tells_whether_the_bundle_computes_the_same(
    notebook: Notebook, panel: PanelOnScreen, lab: JupyterLab
) -> None:
    panel.page.locator(".epypes-promote").click()
    panel.wait("() => document.querySelector('.epypes-foot').textContent.includes('identical')")
    assert (lab.root / "services" / "outlines" / "pipeline.py").is_file()


def test_at_600_px_everything_is_there_and_nothing_jumps(panel: PanelOnScreen) -> None:
    size = panel.page.viewport_size
    panel.page.set_viewport_size({"width": 740, "height": 1200})
    try:
        panel.wait("() => document.querySelector('.epypes-panel').getBoundingClientRect().width < 640")
        place = panel.page.locator(".epypes-box").bounding_box()
        panel.focus("threshold")
        panel.press("ArrowRight", "threshold", 101)
        panel.focus("threshold")
        assert panel.page.locator(".epypes-box").bounding_box()["height"] == place["height"]
        assert panel.page.evaluate(
            "() => { const panel = document.querySelector('.epypes-panel');"
            " return panel.scrollWidth <= panel.clientWidth; }"
        )
    finally:
        panel.page.set_viewport_size(size)


def test_running_the_cell_again_goes_on_from_its_values(notebook: Notebook, panel: PanelOnScreen) -> None:
    assert notebook.execute("panel['threshold'] = 91; panel.wait(60); before = len(panel.history)") == ""
    panel.wait_for("threshold", 91)
    panel.page.evaluate("() => { document.querySelector('img.epypes-picture').dataset.isOld = 'yes'; }")
    panel.page.evaluate(
        "() => { jupyterapp.shell.currentWidget.content.activeCellIndex = 1;"
        " return jupyterapp.commands.execute('notebook:run-cell'); }"
    )
    panel.wait("() => document.querySelector('img.epypes-picture')?.dataset.isOld === undefined")
    panel.wait("() => document.querySelector('img.epypes-picture')?.dataset.seq > 0")
    panel.wait_for("threshold", 91)
    assert notebook.execute("print(panel['threshold'], len(panel.history) - before)").strip() == "91 0"
    panel.wait("() => +document.querySelector('.epypes-changed input.epypes-number')?.value === 91")


FRAMES = 200


def test_many_frames_leave_neither_blobs_nor_bytes_behind(
    notebook: Notebook, panel: PanelOnScreen, lab: JupyterLab
) -> None:
    path = lab.root / "panel.ipynb"
    notebook.save()
    before, blobs = path.stat().st_size, panel.page.evaluate("() => window.blobs.size")
    seq = panel.seq
    assert notebook.execute(MANY_FRAMES.format(count=FRAMES)) == ""
    last = seq + FRAMES
    panel.wait("last => document.querySelector('img.epypes-picture').dataset.seq >= last", last)
    # The films and the history, of which so many are listed, are pictures too.
    assert panel.page.evaluate("() => window.blobs.size") <= blobs + 45
    notebook.save()
    assert path.stat().st_size - before < 200_000
    assert path.stat().st_size < 300_000


def test_opened_again_without_its_kernel_the_last_picture_and_values_are_there(
    lab_page: Any, notebook: Notebook, panel: PanelOnScreen, lab: JupyterLab
) -> None:
    # The last of all tests: one notebook at a time is open.
    assert notebook.execute("panel['threshold'] = 66; panel.wait(60); panel._static.update()") == ""
    assert panel.page.locator(".epypes-static").is_hidden()
    panel.wait("() => JSON.stringify(jupyterapp.shell.currentWidget.content.model.toJSON()).includes('66')")
    notebook.save()
    shutil.copy(lab.root / "panel.ipynb", lab.root / "again.ipynb")
    again = Notebook(lab_page, "again.ipynb")
    static = again.page.locator(".epypes-static")
    static.scroll_into_view_if_needed()
    assert static.is_visible()
    assert static.locator("img").evaluate("async img => { await img.decode(); return img.naturalWidth; }") > 300
    assert "66" in static.inner_text()
    again.close()
    assert json.loads((lab.root / "again.ipynb").read_text())["cells"][1]["outputs"][1]["output_type"] == "display_data"
