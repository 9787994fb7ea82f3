"""The view controls of the panel: what they ask for, what is then on the screen, and what they leave alone."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from PIL import Image

from tests.browser.contrast import unreadable
from tests.browser.view_page import ViewPage

pytestmark = pytest.mark.browser


@pytest.fixture(scope="module")
def shared_view(browser: Any) -> Iterator[ViewPage]:
    view = ViewPage(browser)
    yield view
    view.close()


@pytest.fixture
def view(shared_view: ViewPage) -> Iterator[ViewPage]:
    shared_view.open()
    shared_view.focus()
    shared_view.press("c")
    yield shared_view
    assert shared_view.errors == []


def show(view: ViewPage, token: str) -> None:
    view.click(f".epypes-chip[data-token={token}]")
    view.until(f"document.querySelector('.epypes-header .epypes-token').textContent === '{token}'")


def picture(view: ViewPage) -> Any:
    """Return the pixels of the box, as they are on the screen, without its frame, which shows the focus."""
    data = view.page.locator(".epypes-box").screenshot()
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).astype(int)[4:-4, 4:-4]


def spread(pixels: Any) -> int:
    """Return how far apart the channels of a pixel are at most: of grey pixels, hardly at all."""
    return int((pixels.max(axis=2) - pixels.min(axis=2)).max())


def changes(view: ViewPage) -> list[tuple[str, dict[str, Any]]]:
    return [(each["token"], each["change"]) for each in view.sent("picture")]


def test_a_button_and_a_key_open_the_controls_and_close_them(view: ViewPage) -> None:
    assert view.shown(".epypes-look")
    assert view.attribute(".epypes-look-button", "aria-pressed") == "true"
    view.click(".epypes-look-button")
    assert not view.shown(".epypes-look")


def test_a_slider_asks_for_limits_again_when_the_picture_with_the_last_ones_is_there(view: ViewPage) -> None:
    show(view, "gray")
    view.do("window.answer = kernel.run; kernel.run = async () => undefined;")
    view.focus(".epypes-limit[data-name=black]")
    view.press(*["ArrowRight"] * 5)
    assert changes(view) == [("gray", {"limits": [1, 255]})]
    view.do("kernel.run = answer; await kernel.run()")
    view.until("kernel.kinds('picture').length === 2")
    view.settle()
    assert changes(view)[1:] == [("gray", {"limits": [5, 255]})]
    assert view.page.input_value(".epypes-limit-box >> nth=0") == "5"


def test_a_number_is_typed_and_what_is_none_is_put_back(view: ViewPage) -> None:
    show(view, "gray")
    view.page.fill(".epypes-limit-box >> nth=1", "300")
    view.press("Enter")
    view.until("kernel.kinds('picture').length === 1")
    assert changes(view) == [("gray", {"limits": [0, 300]})]
    assert view.attribute(".epypes-limit[data-name=white]", "max") == "300"
    view.page.fill(".epypes-limit-box >> nth=1", "bright")
    view.press("Enter")
    assert view.page.input_value(".epypes-limit-box >> nth=1") == "300"
    assert len(changes(view)) == 1


def test_auto_and_reset_ask_the_kernel_and_show_what_it_found(view: ViewPage) -> None:
    show(view, "gray")
    view.click(".epypes-contrast >> text=Auto")
    view.until("document.querySelector('.epypes-limit-box').value === '20'")
    assert view.page.input_value(".epypes-limit[data-name=white]") == "180"
    view.click(".epypes-contrast >> text=Reset")
    view.until("document.querySelector('.epypes-limit-box').value === '0'")
    assert changes(view) == [("gray", {"limits": "auto"}), ("gray", {"limits": None})]


def test_a_colour_map_colours_the_token_and_no_other_and_nothing_is_computed(view: ViewPage) -> None:
    show(view, "gray")
    assert spread(picture(view)) < 20
    seq = view.seen()
    view.page.select_option("select[data-name=colour_map]", "viridis")
    assert spread(picture(view)) > 100
    assert changes(view) == [("gray", {"colour_map": "viridis"})]
    assert view.seen() == seq
    show(view, "blurred")
    assert spread(picture(view)) < 20
    show(view, "gray")
    assert spread(picture(view)) > 100


def test_an_image_in_colour_has_contrast_and_no_colour_map(view: ViewPage) -> None:
    show(view, "image")
    assert view.shown(".epypes-limit")
    assert not view.shown("select[data-name=colour_map]")
    assert not view.shown("select[data-name=over]")


def test_a_mask_lies_over_an_image_as_opaque_as_is_wanted(view: ViewPage) -> None:
    view.do("kernel.masks = ['edges']; await kernel.run()")
    view.settle()
    assert not view.shown(".epypes-contrast")
    assert not view.shown(".epypes-opacity")
    alone = picture(view)
    view.page.select_option("select[data-name=over]", "image")
    view.until("document.querySelector('.epypes-under').src")
    view.until("document.querySelector('.epypes-picture').style.filter.includes('mask')")
    assert spread(picture(view)) > 60 > spread(alone)
    view.page.locator(".epypes-opacity").fill("0")
    under = picture(view)
    view.page.locator(".epypes-opacity").fill("1")
    over = picture(view)
    assert abs(over - under).max() > 60
    sent = changes(view)
    assert sent[0] == ("edges", {"over": "image"})
    assert {"opacity": 1} in [change for _, change in sent]
    view.page.select_option("select[data-name=over]", "")
    view.until("!document.querySelector('.epypes-under').hasAttribute('src')")
    np.testing.assert_allclose(picture(view), alone, atol=3)


@pytest.mark.parametrize("way", ["epypes-wipe", "epypes-side-button"])
def test_what_a_mask_is_compared_with_lies_over_the_same_image(view: ViewPage, way: str) -> None:
    view.do("kernel.masks = ['edges']; kernel.pictures = { edges: { over: 'image' } }; await kernel.run()")
    view.do("kernel.isQuiet = true")
    view.click(f".{way}")
    view.do(
        "await kernel.run(); kernel.deliver({ kind: 'reference', seq: kernel.seq, label: 'default',"
        " picture: kernel.pictureOf('edges', 'other') }, [await kernel.bytesOf('edges')])"
    )
    view.until("document.querySelector('.epypes-other').style.filter.includes('mask')")
    view.until("[...document.querySelectorAll('.epypes-under')].every(img => img.src && img.naturalWidth)")
    assert view.js("getComputedStyle(document.querySelector('.epypes-other')).opacity") == "0.6"


def test_pixels_are_squares_or_smooth_as_is_wanted(view: ViewPage) -> None:
    rendering = "getComputedStyle(document.querySelector('.epypes-picture')).imageRendering"
    assert view.js(rendering) == "auto"
    view.page.select_option("select[data-name=zoom]", "nearest")
    assert view.js(rendering) == "pixelated"
    view.page.select_option("select[data-name=zoom]", "smooth")
    view.focus()
    view.press(*["+"] * 6)
    assert view.js(rendering) == "auto"
    view.page.select_option("select[data-name=zoom]", "auto")
    assert view.js(rendering) == "pixelated"


def test_a_view_that_is_made_later_shows_pictures_as_they_were(view: ViewPage) -> None:
    show(view, "gray")
    view.do("kernel.pictures = { gray: { colour_map: 'inferno', zoom: 'nearest', over: '', opacity: 0.6 } }")
    view.do(
        "const run = kernel.run; kernel.run = async () => undefined; await kernel.answers.ready(); kernel.run = run"
    )
    view.until("document.querySelector('.epypes-picture').style.filter.includes('inferno')")
    assert view.page.input_value("select[data-name=colour_map]") == "inferno"
    assert view.attribute(".epypes-box", "data-zoom") == "nearest"


def test_labels_have_areas_in_the_place_of_a_histogram_and_no_thresholds(view: ViewPage) -> None:
    show(view, "blurred")
    view.click(".epypes-histogram-button")
    view.until("document.querySelector('.epypes-cut')")
    labels = "3 labels of 25 to 400 px, median 200 px; background 83%"
    counted = (
        "{ low: 1, high: 3, bins: 3, sampled: false, channels: [{ name: 'areas', counts: [400, 200, 25] }], labels }"
    )
    view.do(f"const labels = '{labels}'; await kernel.run({{ histogram: {counted}, histograms: {{}} }})")
    view.until(f"document.querySelector('.epypes-axis').textContent.includes('blurred: {labels}')")
    assert view.js("document.querySelectorAll('.epypes-cut').length") == 0
    assert view.attribute(".epypes-histogram", "aria-label") == f"Areas of blurred: {labels}"


def test_numbers_stand_on_the_picture_while_they_are_wanted(view: ViewPage) -> None:
    view.focus()
    view.press("n")
    view.do("await kernel.run({ scalars: [{ token: 'n_edges', text: '1843' }, { token: 'sharpness', text: '0.52' }] })")
    view.until("document.querySelector('.epypes-numbers').innerText.includes('1843')")
    assert view.sent("scalars") == [{"kind": "scalars", "on": True}]
    box, at = view.box(".epypes-box"), view.box(".epypes-numbers")
    assert (box["x"] < at["x"], box["y"] < at["y"], at["width"] < box["width"] / 2) == (True, True, True)
    view.focus()
    view.press("n")
    assert not view.shown(".epypes-numbers")


@pytest.mark.parametrize("width", [600, 1280])
@pytest.mark.parametrize("colours", ["light", "dark"])
def test_the_controls_can_be_read_and_fit(view: ViewPage, colours: str, width: int) -> None:
    view.open(colours, width)
    view.focus()
    view.press("c")
    show(view, "gray")
    assert unreadable(view.page, ".epypes-look") == []
    assert view.js("document.documentElement.scrollWidth") <= width
    row = view.box(".epypes-look")
    for control in view.page.locator(".epypes-look :is(input, select, button):visible").all():
        at = control.bounding_box()
        assert row["x"] <= at["x"]
        assert at["x"] + at["width"] <= row["x"] + row["width"] + 1
    assert row["height"] < 40 or width < 1280


def test_a_view_that_is_closed_gives_back_the_bytes_beneath(view: ViewPage) -> None:
    view.do("kernel.masks = ['edges']; kernel.pictures = { edges: { over: 'image' } }; await kernel.run()")
    view.until("document.querySelector('.epypes-under').src")
    view.do("kernel.close()")
    assert view.js("urls.size") == 0
