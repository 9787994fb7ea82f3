"""Which tokens can be looked at, and in which state are they?"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes_widgets.picture.stages import best_stage, stages, states


def blurred(image: Any, sigma: float) -> Any:
    return cv2.GaussianBlur(image, (0, 0), sigma)


def corners(blurred: Any, quality: float) -> Any:
    if quality > 1:
        raise ValueError("quality is at most 1")
    found = cv2.goodFeaturesToTrack(blurred, 50, quality, 5)
    return [] if found is None else found


def count(corners: Any) -> int:
    return len(corners)


def square() -> Any:
    image = np.zeros((60, 80), np.uint8)
    image[20:40, 30:50] = 200
    return image


@pytest.fixture
def runner() -> ep.CompGraphRunner:
    """image -> blurred -> corners -> count, run once."""
    cg = ep.CompGraph.from_functions(blurred, corners, count)
    runner = ep.CompGraphRunner(cg, {"sigma": 1.0, "quality": 0.1})
    runner.run(image=square())
    return runner


def test_images_and_what_was_found_in_them_have_a_picture_and_sink_tokens_are_texts(runner: Any) -> None:
    found = stages(runner.last)
    assert list(found.items()) == [("image", True), ("blurred", True), ("corners", True), ("count", False)]


def test_a_picture_that_is_not_computed_now_stays(runner: Any) -> None:
    kept = stages(runner.last)
    runner.run("blurred", image=square())
    assert not runner.last.tokens.is_computed("corners")
    assert "corners" not in stages(runner.last)
    assert stages(runner.last, kept) == kept


def test_a_picture_in_which_nothing_is_found_any_more_stays(runner: Any) -> None:
    kept = stages(runner.last)
    runner.run(image=np.zeros((60, 80), np.uint8))
    assert runner.last["corners"] == []
    assert not stages(runner.last).get("corners")
    assert stages(runner.last, kept) == kept


def test_a_token_that_is_asked_for_is_there_in_graph_order(runner: Any) -> None:
    assert [*stages(runner.last, asked="quality")] == [
        token for token in runner.cg.tokens if token in ("image", "blurred", "corners", "count", "quality")
    ]


def test_where_nothing_has_a_picture_all_values_are_shown() -> None:
    cg = ep.CompGraph({"show": lambda text: None}, {"show": ("text", None)})
    run = ep.CompGraphRunner(cg).run(text="no picture")
    assert stages(run) == {"text": False}


def test_the_best_stage_is_a_picture_of_a_sink_token_else_the_last_picture(runner: Any) -> None:
    found = stages(runner.last)
    assert best_stage(runner.last, found) == "corners"
    assert best_stage(runner.last, {"count": False}) == "count"
    assert best_stage(runner.last, {}) is None


def test_descriptors_come_after_the_keypoints_beside_them() -> None:
    @ep.outputs("keypoints", "descriptors")
    def detect(image: Any) -> Any:
        return cv2.ORB_create(500, fastThreshold=5).detectAndCompute(image, None)

    cg = ep.CompGraph.from_functions(detect)
    noise = np.random.default_rng(0).integers(0, 255, (300, 320), np.uint8)
    run = ep.CompGraphRunner(cg).run(image=noise)
    assert len(run["descriptors"]) > 200
    assert best_stage(run, stages(run)) == "keypoints"


def test_what_a_run_left_out_is_stale_or_absent(runner: Any) -> None:
    found = stages(runner.last)
    runner.rerun("blurred", sigma=2.0)
    assert states(runner.last, found) == {"image": "fresh", "blurred": "fresh", "corners": "stale", "count": "stale"}
    runner.run("blurred", image=square())
    assert states(runner.last, found) == {"image": "fresh", "blurred": "fresh", "corners": "absent", "count": "absent"}


def test_what_a_function_failed_to_make_is_failed(runner: Any) -> None:
    found = stages(runner.last)
    with pytest.raises(ValueError, match="at most 1"):
        runner.rerun(quality=2.0)
    said = states(runner.last, found)
    assert said == {"image": "fresh", "blurred": "fresh", "corners": "failed", "count": "absent"}


def test_a_stage_for_which_nothing_was_found_says_so_and_keeps_its_place() -> None:
    functions = {"mark": lambda image, least: image if image.max() >= least else ep.Nothing, "blur": blurred}
    cg = ep.CompGraph(functions, {"mark": (("image", "least"), "marked"), "blur": (("marked", "sigma"), "blurred")})
    runner = ep.CompGraphRunner(cg, {"least": 100, "sigma": 1.0})
    before = stages(runner.run(image=square()))
    run = runner.rerun(least=250)
    assert stages(run, before) == before
    assert states(run, before) == {"image": "fresh", "marked": "nothing", "blurred": "nothing"}
    assert states(runner.rerun(least=100), before) == dict.fromkeys(("image", "marked", "blurred"), "fresh")
