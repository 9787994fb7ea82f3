"""A setting is picked in JupyterLab with the mouse and with the keyboard, and the panel follows."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import pytest

from tests.browser.jupyter import JupyterLab, Notebook, running_notebook

pytestmark = pytest.mark.browser

_CELLS = (
    """import cv2
import epypes as ep
from epypes_widgets import pick, tune
from skimage import data

def grayscale(image):
    return cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)

def blur(image_gray, blur_kernel):
    return cv2.GaussianBlur(image_gray, (blur_kernel, blur_kernel), 0)

def canny(image_blurred, canny_lo, canny_hi):
    if canny_lo > canny_hi:
        raise ValueError(f"canny_lo is {canny_lo}, above canny_hi, which is {canny_hi}")
    return cv2.Canny(image_blurred, canny_lo, canny_hi)

cg = ep.CompGraph(
    {"grayscale": grayscale, "blur": blur, "canny": canny},
    {
        "grayscale": ("image", "image_gray"),
        "blur": (("image_gray", "blur_kernel"), "image_blurred"),
        "canny": (("image_blurred", "canny_lo", "canny_hi"), "edges"),
    },
)
runner = ep.CompGraphRunner(cg, {"blur_kernel": 11, "canny_lo": 70, "canny_hi": 200})
runner.run(image=data.coffee())
None""",
    "panel = tune(runner)\npanel",
    'result = ep.sweep(runner, {"canny_lo": [30, 70, 140], "canny_hi": [100, 200]})\nresult',
    "picker = pick(result)\npicker",
)


@pytest.fixture(scope="module")
def notebook(lab_page: Any, lab: JupyterLab) -> Iterator[Notebook]:
    with running_notebook(lab_page, lab.root / "pick.ipynb", *_CELLS, height=1800) as notebook:
        notebook.page.wait_for_selector(".epypes-picker-tile img")
        yield notebook


def hyperparameters(notebook: Notebook) -> dict[str, Any]:
    printed = notebook.execute("import json; picker.wait(60); print(json.dumps(dict(runner.hyperparameters)))")
    found: dict[str, Any] = json.loads(printed)
    return found


def wait_for_chosen(notebook: Notebook, place: int) -> None:
    notebook.page.wait_for_selector(f".epypes-picker-tile[data-place='{place}'][aria-pressed=true]")
    assert notebook.page.locator(".epypes-picker-tile[aria-pressed=true]").count() == 1


def wait_for_panel(notebook: Notebook, **values: Any) -> None:
    notebook.page.wait_for_function(
        """wanted => {
            const shown = JSON.parse(document.querySelector('img.epypes-picture').dataset.values);
            return Object.entries(wanted).every(([name, value]) => shown[name] === value);
        }""",
        arg=values,
    )


def test_the_sheet_has_a_tile_a_setting_and_marks_the_present_one(notebook: Notebook) -> None:
    page = notebook.page
    assert page.locator(".epypes-picker-tile").count() == 6
    assert page.locator(".epypes-picker-failed").count() == 1
    wait_for_chosen(notebook, 3)
    # The static sheet is for a notebook without a kernel.
    assert page.locator(".epypes-contact").count() == 2
    assert page.locator(".epypes-contact:visible").count() == 1


def test_a_click_sets_the_runner_and_the_panel_follows(notebook: Notebook) -> None:
    notebook.page.locator(".epypes-picker-tile[data-place='1']").click()
    wait_for_chosen(notebook, 1)
    wait_for_panel(notebook, canny_lo=30, canny_hi=200)
    assert hyperparameters(notebook) == {"blur_kernel": 11, "canny_lo": 30, "canny_hi": 200}


def test_arrow_keys_move_and_enter_picks(notebook: Notebook) -> None:
    page = notebook.page
    page.locator(".epypes-picker-tile[data-place='1']").focus()
    for key, place in (("ArrowDown", 3), ("ArrowLeft", 2), ("ArrowUp", 0), ("ArrowLeft", 0), ("End", 5), ("Home", 0)):
        page.keyboard.press(key)
        assert page.evaluate("() => document.activeElement.dataset.place") == str(place), key
    assert hyperparameters(notebook)["canny_hi"] == 200
    page.keyboard.press("Enter")
    wait_for_chosen(notebook, 0)
    wait_for_panel(notebook, canny_lo=30, canny_hi=100)
    assert page.locator(".epypes-picker-tile[tabindex='0']").count() == 1


def test_a_setting_that_fails_is_said_and_not_set(notebook: Notebook) -> None:
    notebook.page.locator(".epypes-picker-failed").click()
    notebook.page.wait_for_function(
        "() => document.querySelector('.epypes-picker-status').textContent.includes('canny_lo is 140')",
    )
    assert hyperparameters(notebook)["canny_lo"] == 30
    wait_for_chosen(notebook, 0)


def test_the_mark_follows_the_hand_on_the_panel(notebook: Notebook) -> None:
    notebook.execute("panel['canny_lo'] = 70; panel.wait(60)")
    wait_for_chosen(notebook, 2)


def test_another_token_is_shown(notebook: Notebook) -> None:
    page = notebook.page
    page.locator(".epypes-picker select").select_option("image_blurred")
    page.wait_for_function("() => document.querySelector('.epypes-picker-tile').title.includes('uint8 400 x 600')")
    images = "() => new Set([...document.querySelectorAll('.epypes-picker-tile img')].map(one => one.src)).size"
    page.wait_for_function(f"() => ({images})() === 1")
    assert not notebook.page_errors
