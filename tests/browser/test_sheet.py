"""All tiles of a contact sheet have one size, whatever their pictures are."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import epypes as ep
from tests.browser.jupyter import open_page

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
