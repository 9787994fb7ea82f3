"""Pictures of reruns: what changed alone is looked at and painted again; each is the same as a first one."""

from __future__ import annotations

import gc
import re
import sys
import weakref
from collections import Counter
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import Any

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.display import mimebundle, to_svg, view

PACKAGE = str(Path(ep.__file__).parent)
MOST_CALLS = 1_000


def calls_of(function: Callable[[], object]) -> Counter[str]:
    """Return the number of Python calls in each file of epypes."""
    calls: Counter[str] = Counter()

    def count(frame: FrameType, event: str, argument: Any) -> None:
        if event == "call" and frame.f_code.co_filename.startswith(PACKAGE):
            calls[frame.f_code.co_filename] += 1

    sys.setprofile(count)
    try:
        function()
    finally:
        sys.setprofile(None)
    return calls


def thumbnail(svg: str, token: str) -> str:
    found = re.search(rf'<g id="token-{token}".*?href="([^"]*)"', svg)
    assert found is not None
    return found[1]


def test_the_picture_of_a_rerun_costs_few_calls(edge_runner, photograph):
    edge_runner.run(image=photograph)
    for low in (50, 60):
        mimebundle(edge_runner.rerun(canny_lo=low))
    run = edge_runner.rerun(canny_lo=80)
    assert sum(calls_of(lambda: mimebundle(run)).values()) <= MOST_CALLS


def test_a_picture_of_a_rerun_is_that_of_a_first_run(edge_graph, edge_runner, photograph):
    edge_runner.run(image=photograph)
    for changes in ({"canny_lo": 50}, {"blur_kernel": 5}, {}, {"canny_hi": 90, "blur_kernel": 11}, {"canny_lo": 70}):
        edge_runner.rerun(**changes)
        fresh = ep.CompGraphRunner(edge_graph, dict(edge_runner.hyperparameters)).run(image=photograph)
        seen, expected = (
            [(token.name, token.state, token.preview) for token in view(shown).tokens]
            for shown in (edge_runner.last, fresh)
        )
        assert seen == expected


def test_a_payload_that_its_owner_fills_again_is_looked_at_again(edge_runner, photograph):
    image = photograph.copy()
    run = edge_runner.run(image=image)
    before = thumbnail(to_svg(run), "image")
    image[:] = 255 - image
    assert thumbnail(to_svg(run), "image") != before
    assert thumbnail(to_svg(run), "image_gray") == thumbnail(to_svg(edge_runner.last), "image_gray")


def test_an_image_that_a_function_passes_through_is_that_of_the_payload():
    image = np.zeros((60, 60), np.uint8)
    runner = ep.CompGraphRunner(ep.CompGraph({"f": lambda x: x[10:]}, {"f": ("x", "y")}))
    before = thumbnail(to_svg(runner.run(x=image)), "y")
    image[30:] = 200
    assert thumbnail(to_svg(runner.run(x=image)), "y") != before


def test_what_was_found_in_an_image_is_drawn_over_the_one_of_the_run():
    find = {"light": lambda image, k: image + np.uint8(k), "find": lambda light: np.float32([[[10, 10]], [[20, 30]]])}
    cg = ep.CompGraph(find, {"light": (("image", "k"), "bright"), "find": ("bright", "points")})
    runner = ep.CompGraphRunner(cg, {"k": 10})
    before = thumbnail(to_svg(runner.run(image=np.zeros((60, 80), np.uint8))), "points")
    assert thumbnail(to_svg(runner.rerun(k=200)), "points") != before


def test_a_preview_function_that_is_registered_later_is_used(edge_runner, photograph):
    class Shade(float):
        pass

    runner = ep.CompGraphRunner(ep.CompGraph({"f": lambda k: Shade(k)}, {"f": ("k", "shade")}), {"k": 0.5})
    run = runner.run()
    assert "0.5" in to_svg(run)
    ep.register_preview(Shade, lambda shade: "half a shade")
    assert "half a shade" in to_svg(run)


@pytest.mark.parametrize("reset", [False, True])
def test_a_kept_range_is_that_of_the_first_image_until_it_is_reset(reset):
    image = np.tile(np.linspace(0, 1, 64, dtype=np.float32), (64, 1))
    runner = ep.CompGraphRunner(
        ep.CompGraph({"f": lambda image, k: image * k}, {"f": (("image", "k"), "y")}), {"k": 10.0}
    )
    first = thumbnail(to_svg(runner.run(image=image)), "y")
    assert thumbnail(to_svg(runner.rerun(k=5.0)), "y") != first
    if reset:
        ep.reset_display_ranges(runner)
    assert (thumbnail(to_svg(runner.last), "y") == first) == reset


def test_pictures_keep_no_image_alive(edge_graph, photograph):
    runner = ep.CompGraphRunner(edge_graph, {"blur_kernel": 11, "canny_lo": 70, "canny_hi": 200})
    gone = weakref.ref(runner.run(image=photograph).tokens.values[edge_graph.tokens.index("edges")])
    to_svg(runner)
    runner.run(image=cv2.flip(photograph, 1))
    gc.collect()
    assert gone() is None
