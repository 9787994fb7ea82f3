"""What is drawn over which image?"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import epypes as ep
from epypes.display import Preview, register_preview, scene_of
from epypes_widgets.picture.frames import overlay, scene


def run_of(find: Callable[[Any], Any], image: Any = None) -> ep.Run:
    """Return a run that finds something in an image of 300 x 200 pixels."""
    cg = ep.CompGraph({"find": find}, {"find": ("image", "found")})
    image = np.eye(200, 300, dtype=np.uint8) * 90 if image is None else image
    return ep.CompGraphRunner(cg).run(image=image)


def drawn(find: Callable[[Any], Any]) -> dict[str, Any]:
    run = run_of(find)
    found = scene(run, "found")
    assert found is not None
    assert found.backdrop.name == "image"
    assert np.shares_memory(found.backdrop.image, run["image"])
    said = overlay(found)
    assert said is not None
    return dict(json.loads(json.dumps(said, allow_nan=False)))


def test_keypoints_have_a_size_and_an_angle() -> None:
    said = drawn(lambda image: [cv2.KeyPoint(20, 30, 8, 45), cv2.KeyPoint(120.25, 60, 4, -1)])
    assert sorted(said["points"]) == [[20.5, 30.5, 8, 45], [120.75, 60.5, 4, -1]]
    assert (said["what"], said["total"], said["lines"]) == ("keypoints", 2, [])


def test_of_many_keypoints_the_strongest_are_drawn_and_all_counted() -> None:
    made = [cv2.KeyPoint(n % 300, n // 300 + 10, 3, -1, response=n) for n in range(5000)]
    said = drawn(lambda image: made)
    assert said["total"] == 5000
    assert len(said["points"]) == 2000
    strongest = {made[n].pt for n in range(3000, 5000)}
    assert {(x - 0.5, y - 0.5) for x, y, *_ in said["points"]} == strongest


def test_points_have_neither_size_nor_angle() -> None:
    said = drawn(lambda image: np.array([[[10, 20]], [[30, 40]]], np.float32))
    assert said["points"] == [[10.5, 20.5, 0, -1], [30.5, 40.5, 0, -1]]
    assert said["what"] == "points"


def test_many_points_are_spread_from_the_first_to_the_last() -> None:
    places = np.stack([np.arange(9000) % 290, np.arange(9000) // 50], axis=1)[:, None].astype(np.int32)
    said = drawn(lambda image: places)
    assert said["total"] == 9000
    assert len(said["points"]) == 2000
    assert said["points"][0][:2] == (places[0, 0] + 0.5).tolist()
    assert said["points"][-1][:2] == (places[-1, 0] + 0.5).tolist()


def test_contours_are_closed_lines_of_x_and_y_in_turn() -> None:
    triangle = np.array([[[10, 20]], [[50, 20]], [[30, 60]]], np.int32)
    said = drawn(lambda image: [triangle])
    assert said["lines"] == [[10.5, 20.5, 50.5, 20.5, 30.5, 60.5]]
    assert (said["closed"], said["total"], said["what"]) == (True, 1, "contours")


def test_a_long_contour_stays_within_bounds_and_short_ones_beside_it_stay_whole() -> None:
    angle = np.linspace(0, 6.28, 60_000)
    circle = np.stack([150 + 90 * np.cos(angle), 100 + 90 * np.sin(angle)], axis=1)[:, None].astype(np.float32)
    square = np.array([[[5, 5]], [[15, 5]], [[15, 15]], [[5, 15]]], np.float32)
    said = drawn(lambda image: [circle, *[square] * 100])
    assert sum(map(len, said["lines"])) <= 20_000
    lengths = sorted(map(len, said["lines"]))
    assert lengths[:100] == [8] * 100
    assert lengths[-1] > 10_000


@pytest.mark.slow
@given(st.lists(st.integers(1, 3000), min_size=1, max_size=40), st.integers(1, 150))
def test_whatever_the_contours_are_no_more_than_the_bound_is_drawn(lengths: list[int], repeats: int) -> None:
    contours = [np.full((length, 1, 2), 20, np.int32) for length in lengths] * repeats
    found = scene(run_of(lambda image: contours), "found")
    said = overlay(found) if found is not None else None
    assert said is not None
    assert said["total"] == len(contours)
    assert len(said["lines"]) == min(len(contours), 2000)
    assert sum(map(len, said["lines"])) <= 20_000


def test_boxes_lie_between_pixels_and_segments_on_them() -> None:
    assert drawn(lambda image: np.array([[10, 20, 30, 40]], np.int32))["lines"] == [[10, 20, 40, 20, 40, 60, 10, 60]]
    segments = drawn(lambda image: np.array([[[10, 20, 290, 190]]], np.int32))
    assert segments["lines"] == [[10.5, 20.5, 290.5, 190.5]]
    assert (segments["closed"], segments["what"]) == (False, "segments")


def test_matches_are_lines_between_the_two_images_side_by_side() -> None:
    functions = {
        "detect_left": lambda left: [cv2.KeyPoint(20, 30, 8), cv2.KeyPoint(40, 60, 8)],
        "detect_right": lambda right: [cv2.KeyPoint(25, 35, 8), cv2.KeyPoint(45, 65, 8)],
        "match": lambda keypoints_left, keypoints_right: [cv2.DMatch(0, 1, 1.0), cv2.DMatch(1, 0, 2.0)],
    }
    io = {
        "detect_left": ("left", "keypoints_left"),
        "detect_right": ("right", "keypoints_right"),
        "match": (("keypoints_left", "keypoints_right"), "matches"),
    }
    left, right = np.random.default_rng(0).integers(64, 255, (2, 200, 300), np.uint8)
    run = ep.CompGraphRunner(ep.CompGraph(functions, io)).run(left=left, right=right[:90])
    found = scene(run, "matches")
    assert found is not None
    said = overlay(found)
    assert said is not None
    assert said["lines"] == [[20.5, 30.5, 345.5, 65.5], [40.5, 60.5, 325.5, 35.5]]
    assert (said["what"], said["closed"], said["total"]) == ("matches", False, 2)
    image = found.backdrop.image
    assert image.shape == (200, 600, 3)
    assert (image[:, :300, 0] == left).all()
    assert (image[:90, 300:, 2] == right[:90]).all()
    assert not image[90:, 300:].any()


def test_what_is_not_a_number_is_not_drawn() -> None:
    places = np.array([[[10, 20]], [[math.nan, 5]], [[math.inf, 5]], [[30, 40]]], np.float32)
    said = drawn(lambda image: places)
    assert [point[:2] for point in said["points"]] == [[10.5, 20.5], [30.5, 40.5]]
    line = np.array([[[10, 20]], [[math.nan, 20]], [[30, 60]]], np.float32)
    square = np.array([[[5, 5]], [[9, 5]], [[9, 9]]], np.float32)
    assert drawn(lambda image: [line, square])["lines"] == [[10.5, 20.5, 30.5, 60.5], [5.5, 5.5, 9.5, 5.5, 9.5, 9.5]]
    keypoints = [cv2.KeyPoint(math.nan, 5, 6, 7), cv2.KeyPoint(20, 30, 8, 45)]
    assert drawn(lambda image: keypoints)["points"] == [[20.5, 30.5, 8, 45]]
    broken = drawn(lambda image: [cv2.KeyPoint(20, 30, math.nan, math.inf)])
    assert broken["points"] == [[20.5, 30.5, 0, -1]]


def test_an_image_is_its_own_backdrop_with_nothing_over_it() -> None:
    run = run_of(lambda image: image + 1)
    found = scene(run, "found")
    assert found is not None
    assert found.backdrop.name == "found"
    assert overlay(found) is None


def test_a_photograph_in_colour_tells_the_order_of_its_colours() -> None:
    def find(image: ep.Image("uint8", (None, None, 3), order="rgb")) -> Any:  # type: ignore[valid-type]
        return [cv2.KeyPoint(20, 30, 8)]

    found = scene(run_of(find, np.random.default_rng(0).integers(0, 255, (200, 300, 3), np.uint8)), "found")
    assert found is not None
    assert found.backdrop.order == "rgb"


@pytest.mark.parametrize("value", [None, 3, "text", [], {}, [1, 2], np.zeros(3), np.array("x"), object()])
def test_what_can_not_be_drawn_has_no_scene(value: Any) -> None:
    assert scene(run_of(lambda image: value), "found") is None


@pytest.mark.parametrize("nothing", [None, [], (), np.empty((0, 1, 2), np.float32)])
def test_of_what_had_marks_and_has_none_the_image_is_left(nothing: Any) -> None:
    found = scene(run_of(lambda image: nothing), "found", had_marks=True)
    assert found is not None
    assert found.backdrop.name == "image"
    said = overlay(found)
    assert said is not None
    assert (said["points"], said["lines"], said["total"]) == ([], [], 0)


def test_a_token_that_is_not_computed_or_stale_has_no_scene() -> None:
    cg = ep.CompGraph({"add": lambda image, n: image + n}, {"add": (("image", "n"), "sum")})
    runner = ep.CompGraphRunner(cg, {"n": 1})
    assert scene(runner.run("image", image=np.eye(64)), "sum") is None
    runner.rerun()
    runner.rerun("image", n=2)
    assert runner.last is not None
    assert runner.last.tokens.is_stale("sum")
    assert scene(runner.last, "sum", had_marks=True) is None


class Pose:
    def __init__(self, image: Any) -> None:
        self.image = image


class Framed(Pose):
    pass


class Broken(Pose):
    pass


register_preview(Pose, lambda pose: pose.image)
register_preview(Framed, lambda pose: Preview("pose", picture=pose.image))
register_preview(Broken, lambda pose: pose.missing)


@pytest.mark.parametrize("kind", [Pose, Framed])
def test_what_a_preview_function_shows_as_an_image_is_seen_as_that_image(kind: Any) -> None:
    found = scene(run_of(lambda image: kind(image)), "found")
    assert found is not None
    assert found.backdrop.name == "found"
    assert found.backdrop.image.shape == (200, 300)


def test_a_preview_function_that_fails_shows_no_picture() -> None:
    assert scene(run_of(lambda image: Broken(image)), "found") is None


def test_thumbnails_keep_their_number_of_marks() -> None:
    places = np.stack([np.arange(900) % 290, np.arange(900) // 5], axis=1)[:, None].astype(np.int32)
    found = scene_of(run_of(lambda image: places), "found")
    assert found is not None
    assert found.marks is not None
    assert (found.marks.drawn, found.marks.total) == (200, 900)
