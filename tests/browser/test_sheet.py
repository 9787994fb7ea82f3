"""All tiles of a contact sheet have one size, whatever their pictures are; plots are seen on light and dark pages."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

import epypes as ep
from tests.browser.contrast import unreadable
from tests.browser.jupyter import open_page
from tests.browser.test_figures import PAGES

pytestmark = pytest.mark.browser


def over(image: Any, threshold: int) -> Any:
    return np.where(image > threshold, image, 0)


def test_pictures_of_all_shapes_fill_squares_of_one_size(browser: Any) -> None:
    rng = np.random.default_rng(0)
    # Noise is encoded smaller, a long image is low, a small one has fewer pixels than a tile.
    images = [rng.integers(0, 255, shape, dtype=np.uint8) for shape in ((400, 400), (60, 240), (240, 60), (16, 16))]
    cg = ep.CompGraph({"over": over}, {"over": (("image", "threshold"), "bright")})
    runner = ep.CompGraphRunner(cg, {"threshold": 0})
    sheet = ep.sweep(runner, {"threshold": [0, 254]}, images).sheet("bright", columns="threshold")
    page = open_page(browser)
    page.set_content(sheet._repr_mimebundle_()["text/html"])
    boxes = "query => [...document.querySelectorAll(query)].map(one => [one.offsetWidth, one.offsetHeight])"
    assert page.evaluate(boxes, ".epypes-contact img") == [[128, 128]] * 8
    assert {tuple(box) for box in page.evaluate(boxes, ".epypes-contact .cell")} == {(136, 136)}
    page.context.close()


def searched() -> Any:
    """A search, as it shows itself."""
    cg = ep.CompGraph({"parabola": lambda x, k: (k - 3.0) ** 2}, {"parabola": (("x", "k"), "y")})
    return ep.optimize(ep.CompGraphRunner(cg, {"k": 9}), "y", [0], 20, direction="minimize", ranges={"k": (0, 9)})


@pytest.mark.parametrize("kind", PAGES)
def test_the_plot_of_a_search_has_the_colours_of_the_page(browser: Any, kind: str) -> None:
    page = open_page(browser, viewport={"width": 1024, "height": 800})
    html = searched()._repr_mimebundle_()["text/html"]
    page.set_content(f"<!doctype html><meta charset=utf-8><style>{PAGES[kind]}</style><div class=output>{html}</div>")
    assert page.locator(".epypes-figure svg").count() == 1, "the script puts the plot itself into the page"
    paper = page.locator("#patch_1 path").evaluate("one => getComputedStyle(one).fill")
    if kind.startswith(("JupyterLab", "VS Code")):
        assert paper == page.evaluate("getComputedStyle(document.body).backgroundColor"), "no frame is seen"
    assert unreadable(page, ".output") == []
    box = page.locator(".epypes-figure svg").bounding_box()
    assert box["width"] / box["height"] == pytest.approx(6.4 / 4.8, rel=0.02)
    page.context.close()


def test_a_page_that_is_not_trusted_shows_the_plot_on_paper(browser: Any) -> None:
    page = open_page(browser)
    html = re.sub("(?s)<script.*?</script>", "", searched()._repr_mimebundle_()["text/html"])
    page.set_content(f"<style>{PAGES['JupyterLab dark']}</style>{html}")
    image = page.locator(".epypes-figure img")
    image.evaluate("one => one.decode()")
    assert image.evaluate("one => one.naturalWidth") == pytest.approx(6.4 * 96, abs=2)
    page.context.close()
