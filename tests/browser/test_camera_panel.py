"""A panel on a camera in JupyterLab: its newest frame, and its settings as controls."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.browser.contrast import unreadable
from tests.browser.jupyter import JupyterLab, Notebook, running_notebook
from tests.browser.panel import PanelOnScreen
from tests.fake_camera import FakeCamera

pytestmark = pytest.mark.browser

SET_UP = """
import cv2, epypes as ep
from epypes_widgets import tune

def smooth(image, size=5):
    return cv2.blur(image, (size, size))

def mean(smooth):
    return float(smooth.mean())

camera = ep.camera("genicam:EP02")
camera.settings.set(Width=256, Height=192, PixelFormat="Mono8", AcquisitionFrameRate=20.0, ExposureTimeAbs=3_000.0)
"""
SHOW = """
panel = tune([smooth, mean], camera=camera, token="smooth", ExposureTimeAbs=(1_000.0, 50_000.0))
panel
"""
# The mean gray value of the picture on the screen.
BRIGHTNESS = """() => {
    const image = document.querySelector('img.epypes-picture');
    if (!image.naturalWidth) return NaN;  // the next one is loading
    const canvas = new OffscreenCanvas(image.naturalWidth, image.naturalHeight);
    const context = canvas.getContext('2d');
    context.drawImage(image, 0, 0);
    const data = context.getImageData(0, 0, canvas.width, canvas.height).data;
    return data.filter((_, index) => index % 4 === 0).reduce((sum, value) => sum + value, 0) / (data.length / 4);
}"""


@pytest.fixture(scope="module")
def fake() -> Iterator[FakeCamera]:
    with FakeCamera("EP02") as fake:
        yield fake


@pytest.fixture(scope="module")
def notebook(lab_page: Any, lab: JupyterLab, fake: FakeCamera) -> Iterator[Notebook]:
    with running_notebook(lab_page, lab.root / "camera.ipynb", SET_UP, SHOW, height=1300) as notebook:
        yield notebook


@pytest.fixture
def panel(notebook: Notebook) -> PanelOnScreen:
    return PanelOnScreen(notebook)


def wait_for_frames(panel: PanelOnScreen, count: int) -> None:
    panel.wait(f"seq => document.querySelector('img.epypes-picture').dataset.seq >= seq + {count}", panel.seq)


def test_a_slider_of_the_exposure_makes_the_picture_brighter_while_it_goes_on(
    notebook: Notebook, panel: PanelOnScreen
) -> None:
    wait_for_frames(panel, 3)
    dark = panel.page.wait_for_function(BRIGHTNESS).json_value()
    before = panel.history
    panel.focus("ExposureTimeAbs")
    panel.page.keyboard.press("End")
    panel.wait(f"dark => ({BRIGHTNESS})() > dark + 50", dark)
    panel.wait("count => document.querySelectorAll('.epypes-history [data-number]').length > count", before)
    assert notebook.execute("print(camera.settings['ExposureTimeAbs'].value)").strip() == "50000.0"
    wait_for_frames(panel, 3)
    panel.page.get_by_label("Undo").click()
    panel.wait(f"dark => ({BRIGHTNESS})() < dark + 20", dark)
    assert notebook.execute("print(panel.values['ExposureTimeAbs'])").strip() == "3000.0"
    assert not notebook.page_errors


def test_choices_and_settings_of_a_cell_are_followed(notebook: Notebook, panel: PanelOnScreen) -> None:
    panel.row("PixelFormat").locator("select").select_option("RGB8")
    panel.settle()
    assert notebook.execute("print(camera.settings['PixelFormat'].value)").strip() == "RGB8"
    wait_for_frames(panel, 3)
    assert notebook.execute("print(panel.result['image'].shape)").strip() == "(192, 256, 3)"
    notebook.execute("camera.settings['GainRaw'] = 7")
    panel.wait(
        "() => [...document.querySelectorAll('.epypes-row')].find(row => row.textContent.includes('GainRaw'))"
        ".querySelector('input.epypes-number').value === '7'"
    )


def test_the_controls_of_a_camera_can_be_read_in_both_themes(notebook: Notebook, panel: PanelOnScreen) -> None:
    for colours in notebook.each_theme():
        assert unreadable(panel.page, ".epypes-panel") == [], colours


def test_an_unplugged_camera_is_told_and_the_picture_goes_on_when_it_is_back(
    panel: PanelOnScreen, fake: FakeCamera
) -> None:
    fake.kill()
    panel.wait_for_status("it was unplugged")
    fake.start()
    wait_for_frames(panel, 3)
    panel.wait_for_status("")


def test_closing_the_panel_closes_the_camera(notebook: Notebook, panel: PanelOnScreen) -> None:
    assert "closed" in notebook.execute("panel.close(); print(camera)")
