"""How do tokens of a run become a frame?"""

from __future__ import annotations

import io
import json
from typing import Any

import cv2
import numpy as np
from PIL import Image

import epypes as ep
from epypes_widgets.picture.frames import make_frame
from epypes_widgets.picture.screen import Comparison, Shown
from epypes_widgets.values import json_value
from tests.colours import red_image, red_runner


def pictures(run: ep.Run, token: str, **shown: Any) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = make_frame(run, token, 1, Shown(token, **shown)).content["pictures"]
    return found


def test_a_frame_carries_the_values_that_it_was_computed_with(runner: ep.CompGraphRunner) -> None:
    made = make_frame(runner.rerun(threshold=50), "mask", 3, Shown("mask"), stale=False)
    assert (made.content["seq"], made.content["values"]) == (3, {"gain": 2, "threshold": 50})
    assert (made.content["ran"], made.content["reused"], made.content["stale"]) == (1, 1, False)
    (picture,) = made.content["pictures"]
    assert (picture["media_type"], made.buffers[0][1:4]) == ("image/png", b"PNG")
    assert (picture["width"], picture["height"], picture["full_width"], picture["full_height"]) == (64, 48, 64, 48)
    assert (picture["role"], picture["shape"], picture["dtype"]) == ("main", "48 x 64", "uint8")


def test_a_large_image_is_sent_small_and_measured_in_its_own_pixels() -> None:
    runner = ep.CompGraphRunner(ep.CompGraph({"f": lambda x: x}, {"f": ("x", "y")}))
    run = runner.run(x=np.random.default_rng(0).integers(0, 256, (1000, 3000), np.uint8))
    (picture,) = pictures(run, "y")
    assert (picture["width"], picture["full_width"], picture["full_height"]) == (1400, 3000, 1000)


def test_a_token_that_is_no_image_goes_as_short_text() -> None:
    runner = ep.CompGraphRunner(ep.CompGraph({"f": lambda x: "a" * x}, {"f": ("x", "y")}))
    made = make_frame(runner.run(x=10_000), "y", 1, Shown("y"))
    assert made.content["pictures"][0]["media_type"] == "text/plain"
    assert len(made.content["pictures"][0]["text"]) < 500
    assert made.buffers == ()


def test_pinned_stages_and_the_one_compared_with_come_in_the_same_frame(runner: ep.CompGraphRunner) -> None:
    shown = Shown("mask", pinned=("image", "image_bright"), comparison=Comparison("stage", token="image"))
    made = make_frame(runner.rerun(), "mask", 1, shown)
    roles = [(picture["token"], picture["role"]) for picture in made.content["pictures"]]
    assert roles == [("mask", "main"), ("image", "other"), ("image", "pinned"), ("image_bright", "pinned")]
    assert len(made.buffers) == 4
    assert shown.targets == ("mask", "image", "image_bright")


def test_marks_go_as_vectors_over_the_image_that_they_were_found_in() -> None:
    def corners(image: Any) -> Any:
        return cv2.goodFeaturesToTrack(image, 20, 0.01, 5)

    image = np.zeros((100, 120), np.uint8)
    image[20:60, 30:90] = 255
    run = ep.CompGraphRunner(ep.CompGraph({"corners": corners}, {"corners": ("image", "points")})).run(image=image)
    (picture,) = pictures(run, "points")
    assert (picture["media_type"], picture["full_width"]) == ("image/png", 120)
    assert len(picture["overlay"]["points"]) == picture["overlay"]["total"] == 4


def test_histograms_come_only_when_they_are_shown(runner: ep.CompGraphRunner) -> None:
    run = runner.rerun()
    hidden = make_frame(run, "image", 1, Shown("image", cut=("image_bright",))).content
    assert (hidden["histogram"], hidden["histograms"]) == (None, {})
    shown = Shown("image", cut=("image_bright",), has_histogram=True)
    content = make_frame(run, "image", 1, shown).content
    assert sum(content["histogram"]["channels"][0]["counts"]) == 64 * 48
    assert list(content["histograms"]) == ["image_bright"]
    assert shown.targets == ("image", "image_bright")


def test_values_can_always_be_written_as_json() -> None:
    values = [1, np.int64(2), 0.5, float("nan"), float("inf"), None, True, "a", (1, 2), object(), np.zeros(3)]
    assert json.loads(json.dumps([json_value(value) for value in values], allow_nan=False))[:3] == [1, 2, 0.5]


def test_the_big_picture_has_the_colours_that_the_annotations_say() -> None:
    run = red_runner().run(image=red_image())
    strongest = {}
    for token in run:
        picture = np.asarray(Image.open(io.BytesIO(make_frame(run, token, 1, Shown(token)).buffers[0])))
        strongest[token] = int(picture.reshape(-1, 3).mean(axis=0).argmax())
    assert strongest == {"image": 0, "red": 0, "unsaid": 2}


def test_where_nothing_is_found_a_text_takes_the_place_of_the_last_picture() -> None:
    functions = {
        "find": lambda image, least: image if image.max() >= least else ep.Nothing,
        "mark": lambda image: image,
    }
    cg = ep.CompGraph(functions, {"find": (("image", "least"), "found"), "mark": ("found", "marked")})
    runner = ep.CompGraphRunner(cg, {"least": 100})
    runner.run(image=np.full((20, 30), 200, np.uint8))
    shown, had = Shown("marked", pinned=("found",), has_histogram=True), {"image", "found", "marked"}
    assert make_frame(runner.last, "marked", 1, shown, had_pictures=had).content["pictures"][0]["width"] == 30
    made = make_frame(runner.rerun(least=250), "marked", 2, shown, had_pictures=had)
    assert [picture["text"] for picture in made.content["pictures"]] == [
        "marked: nothing found.",
        "found: nothing found.",
    ]
    assert (made.content["ran"], made.content["reused"], made.content["skipped"], made.buffers) == (1, 0, 1, ())
    assert made.content["histogram"] is None


def test_a_frame_names_the_order_of_colours_and_whether_it_is_assumed(runner: ep.CompGraphRunner) -> None:
    run = red_runner().run(image=red_image())
    assert {token: pictures(run, token)[0]["order"] for token in run} == {
        "image": "rgb", "red": "rgb", "unsaid": "bgr, assumed",
    }  # fmt: skip
    assert pictures(runner.rerun(threshold=50), "mask")[0]["order"] == "", "it has one channel"
