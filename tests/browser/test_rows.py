"""The rows of a panel in JupyterLab: names in full, ranges that widen and return, ticks, and what is typed wrongly."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest

from tests.browser.jupyter import JupyterLab, Notebook, running_notebook
from tests.browser.panel import PanelOnScreen

pytestmark = pytest.mark.browser

SET_UP = """
import numpy as np, epypes as ep
from epypes_widgets import tune

def above(image, level_of_the_foreground_of_each_image=100, weight=np.float32(0.3)):
    return image * weight > level_of_the_foreground_of_each_image

def inverted(above, is_inverted_in_the_end=np.bool_(False), seed=123456789, method="mean"):
    return ~above if is_inverted_in_the_end else above

def within(image, low_end_of_the_range_of_brightness=20, high_end_of_the_range_of_brightness=90, seed=123456789):
    return (image > low_end_of_the_range_of_brightness) & (image < high_end_of_the_range_of_brightness)

image = np.add.outer(np.arange(200), np.arange(255)).astype(np.uint8)
runner = ep.CompGraphRunner(ep.CompGraph.from_functions(above, inverted, within))
run = runner.run(image=image)
"""
LEVEL = "level_of_the_foreground_of_each_image"
SHOW = f"""
panel = tune(runner, {LEVEL}=ep.Param(soft=(0, 255)), method=["mean", "median"])
panel
"""


@pytest.fixture(scope="module")
def notebook(lab_page: Any, lab: JupyterLab) -> Iterator[Notebook]:
    with running_notebook(lab_page, lab.root / "rows.ipynb", SET_UP, SHOW, width=1440, height=900) as notebook:
        yield notebook


@pytest.fixture
def panel(notebook: Notebook) -> PanelOnScreen:
    """The panel at its first values."""
    panel = PanelOnScreen(notebook)
    assert notebook.execute("panel.reset(); panel.wait(60)") == ""
    panel.wait_for(LEVEL, 100)
    return panel


def box(panel: PanelOnScreen, name: str) -> Any:
    return panel.page.locator(f"input[data-name={name}]")


def test_a_typed_value_widens_the_slider_until_it_is_undone_or_reset(notebook: Notebook, panel: PanelOnScreen) -> None:
    most = f"document.querySelector('.epypes-row:has([data-name={LEVEL}]) .noUi-target').noUiSlider.options.range.max"
    for way_back in (".epypes-undo", f".epypes-row:has([data-name={LEVEL}]) .epypes-reset"):
        box(panel, LEVEL).fill("700")
        box(panel, LEVEL).press("Enter")
        panel.wait_for(LEVEL, 700)
        panel.wait(f"() => {most} == 700")
        box(panel, LEVEL).fill("300")
        box(panel, LEVEL).press("Enter")
        panel.wait_for(LEVEL, 300)
        assert panel.page.evaluate(most) == 700
        panel.settle()
        for _ in range(2 if "undo" in way_back else 1):
            panel.page.locator(way_back).click()
            panel.settle()
        panel.wait_for(LEVEL, 100)
        panel.wait(f"() => {most} == 255")


def test_what_is_no_number_says_what_to_type(panel: PanelOnScreen) -> None:
    box(panel, LEVEL).fill("")
    box(panel, LEVEL).press_sequentially("abc")
    box(panel, LEVEL).press("Enter")
    panel.wait_for_status(f"Type a number for {LEVEL}, not abc.")
    box(panel, LEVEL).press("Escape")
    panel.wait_for_status("")


def test_a_tick_box_moves_a_truth_value_of_numpy(notebook: Notebook, panel: PanelOnScreen) -> None:
    panel.row("is_inverted_in_the_end").locator("input[type=checkbox]").check()
    panel.wait_for("is_inverted_in_the_end", True)
    assert notebook.execute("print(type(runner['is_inverted_in_the_end']).__module__)").strip() == "numpy"


def test_numbers_are_as_short_as_they_are_and_whole(panel: PanelOnScreen) -> None:
    assert [box(panel, name).input_value() for name in ("weight", "seed")] == ["0.3", "123456789"]
    assert box(panel, "seed").evaluate("box => box.scrollWidth <= box.clientWidth")


@pytest.mark.parametrize("width", [1440, 1024])
def test_names_are_whole_and_sliders_wide(notebook: Notebook, panel: PanelOnScreen, width: int) -> None:
    panel.page.set_viewport_size({"width": width, "height": 900})
    names = panel.page.locator(
        ".epypes-controls :is(.epypes-label, .epypes-row:not(:has(.epypes-label)) .widget-label)"
    )
    assert [name.text_content() for name in names.all()][-2:] == [
        "low_end_of_the_range_of_brightness", "high_end_of_the_range_of_brightness"
    ]  # fmt: skip
    cut = "each => each.scrollWidth > each.clientWidth + 1 || each.scrollHeight > each.clientHeight + 1"
    assert [name.text_content() for name in names.all() if name.evaluate(cut)] == []
    widths = "[...document.querySelectorAll('.epypes-controls .noUi-target')].map(each => each.offsetWidth)"
    assert min(panel.page.evaluate(widths)) >= 120
    places = [panel.page.locator(css).bounding_box() for css in (".epypes-controls", ".epypes-box")]
    assert (places[0]["y"] + places[0]["height"] <= places[1]["y"]) == (width == 1024)
    panel.page.set_viewport_size({"width": 1440, "height": 900})


def test_picture_save_and_promote_are_on_the_screen_together(panel: PanelOnScreen) -> None:
    panel.page.locator(".epypes-panel").evaluate("panel => panel.scrollIntoView()")
    top, end = panel.page.locator(".jp-WindowedPanel-outer").evaluate(
        "outer => [outer.getBoundingClientRect().top, outer.getBoundingClientRect().bottom]"
    )
    for css in (".epypes-bar", ".epypes-box", ".epypes-save", ".epypes-promote"):
        place = panel.page.locator(css).bounding_box()
        assert top <= place["y"] + 1
        assert place["y"] + place["height"] <= end


def test_what_two_functions_take_has_a_heading_of_its_own(panel: PanelOnScreen) -> None:
    headings = panel.page.locator(".epypes-heading .epypes-name").all_text_contents()
    assert headings == ["above", "inverted", "shared: inverted, within", "within"]
    shared = panel.page.locator(".epypes-folder", has_text="shared")
    assert shared.locator(".epypes-row").count() == 1
    assert shared.locator("input[data-name=seed]").count() == 1


def test_the_arrow_of_a_choice_can_be_seen_in_both_themes(notebook: Notebook, panel: PanelOnScreen) -> None:
    arrow = "select => [getComputedStyle(select).backgroundImage, getComputedStyle(select).color]"
    for _ in notebook.each_theme():
        image, colour = panel.row("method").locator("select").evaluate(arrow)
        assert colour in image
        assert "url" not in image
