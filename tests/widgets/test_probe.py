"""Which values are told of a pixel?"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import epypes as ep
from epypes.display import Backdrop, Scene
from epypes_widgets.picture.stages import probe, stages
from tests.colours import red_image, red_runner

SIZE = (40, 30)


def shown(run: ep.Run, token: str, size: tuple[int, int] = SIZE) -> Scene:
    """Return a picture of this size that is shown for a token."""
    return Scene(Backdrop(np.zeros(size[::-1], np.uint8), "bgr", (0, 255), token))


def texts(images: dict[str, Any], x: float, y: float, size: tuple[int, int] = SIZE) -> list[str]:
    """Return what is told of these images at a pixel of one of this size."""
    cg = ep.CompGraph({"end": lambda *images: None}, {"end": (tuple(images), "end")})
    run = ep.CompGraphRunner(cg).run(**images)
    told = probe(run, dict.fromkeys(images, True), x, y, shown(run, next(iter(images)), size))
    assert {row["state"] for row in told} <= {"fresh"}
    assert [row["token"] for row in told] == list(images)[: len(told)]
    return [row["text"] for row in told]


def image(dtype: Any, value: Any, channels: tuple[int, ...] = ()) -> Any:
    """Return an image whose pixel in column 7 and row 3 has a value, all others another."""
    made = np.zeros((30, 40, *channels), dtype)
    made[3, 7] = value
    return made


def test_the_very_pixel_is_told_in_images_of_one_size() -> None:
    noise = np.random.default_rng(0).integers(0, 255, (30, 40), np.uint8)
    assert texts({"noise": noise}, 7, 3) == [str(noise[3, 7])]
    assert texts({"noise": noise}, 7.99, 3.99) == [str(noise[3, 7])]
    assert texts({"noise": noise}, 39.5, 29.5) == [str(noise[29, 39])]


@pytest.mark.parametrize(
    ("dtype", "value", "text"),
    [
        (bool, True, "True"),
        (np.uint8, 255, "255"),
        (np.int16, -12, "-12"),
        (np.uint16, 60_000, "60000"),
        (np.float32, 0.132, "0.132"),
        (np.float64, 1e-9 / 3, "3.333e-10"),
        (np.float32, math.nan, "nan"),
        (np.float16, math.inf, "inf"),
    ],
)
def test_a_value_is_told_as_its_dtype_has_it(dtype: Any, value: Any, text: str) -> None:
    assert texts({"image": image(dtype, value)}, 7, 3) == [text]
    assert texts({"image": image(dtype, value, (1,))}, 7, 3) == [text]


def test_colours_are_named_in_their_order() -> None:
    assert texts({"image": image(np.uint8, (12, 40, 200), (3,))}, 7, 3) == ["B 12 G 40 R 200"]
    assert texts({"image": image(np.float32, (0.5, 1, 0, 0.25), (4,))}, 7, 3) == ["B 0.5 G 1 R 0 A 0.25"]
    run = red_runner().run(image=red_image())
    assert [row["text"] for row in probe(run, stages(run), 3, 3, shown(run, "red", (64, 64)))][:2] == [
        "R 200 G 20 B 10",
        "R 200 G 0 B 0",
    ]


def test_a_region_is_told_by_its_label_and_its_background_too() -> None:
    labels = np.zeros((30, 40), np.int32)
    labels[5:20, 5:20] = 7
    labels[5:20, 22:35] = 12
    assert texts({"labels": labels}, 6, 6) == ["label 7"]
    assert texts({"labels": labels}, 0, 0) == ["label 0"]


def test_labels_of_a_new_run_are_looked_at_anew() -> None:
    labels = np.zeros((30, 40), np.int32)
    labels[5:20, 5:20] = 7
    runner = ep.CompGraphRunner(ep.CompGraph({"as_is": lambda image: image}, {"as_is": ("image", "same")}))
    same = {"same": True}
    noise = np.random.default_rng(0).integers(0, 100_000, (30, 40))
    runs = (runner.run(image=seen) for seen in (labels, noise, labels))
    told = [probe(run, same, 6, 6, shown(run, "same"))[0]["text"] for run in runs]
    assert told == ["label 7", str(noise[6, 6]), "label 7"]


def test_in_an_image_of_another_size_the_pixel_at_the_same_place_is_told() -> None:
    small = np.arange(15 * 20).reshape(15, 20) * 1000
    assert texts({"small": small}, 7, 3) == [f"{small[1, 3]} (at 3, 1)"]
    assert texts({"small": small}, 39, 29) == [f"{small[14, 19]} (at 19, 14)"]
    large = np.arange(60 * 80).reshape(60, 80) * 1000
    assert texts({"large": large}, 7, 3) == [f"{large[7, 15]} (at 15, 7)"]


@pytest.mark.parametrize(
    ("x", "y"), [(-1, 0), (-0.1, 0), (0, -1), (40, 0), (0, 30), (math.nan, 3), (3, math.nan), (math.inf, 3)]
)
def test_outside_of_the_picture_nothing_is_told(x: float, y: float) -> None:
    assert texts({"image": image(np.uint8, 1)}, x, y) == []


def test_what_is_no_image_or_not_computed_is_left_out_and_what_is_stale_is_said_to_be() -> None:
    cg = ep.CompGraph(
        {"add": lambda image, n: image + n, "double": lambda added: 2 * added, "count": lambda added: added.size},
        {"add": (("image", "n"), "added"), "double": ("added", "doubled"), "count": ("added", "count")},
    )
    runner = ep.CompGraphRunner(cg, {"n": 1})
    run = runner.run(image=image(float, 10))
    kept = stages(run)
    assert [(row["token"], row["text"]) for row in probe(run, kept, 7, 3, shown(run, "added"))] == [
        ("image", "10"), ("added", "11"), ("doubled", "22"),
    ]  # fmt: skip
    run = runner.rerun("added", n=2)
    assert [(row["text"], row["state"]) for row in probe(run, kept, 7, 3, shown(run, "added"))] == [
        ("10", "fresh"), ("12", "fresh"), ("22", "stale"),
    ]  # fmt: skip
    run = runner.run("added", image=run["image"])
    assert [row["token"] for row in probe(run, kept, 7, 3, shown(run, "added"))] == ["image", "added"]


def test_in_a_picture_that_is_no_image_of_the_run_there_is_no_pixel() -> None:
    cg = ep.CompGraph({"pose": lambda image: (1, 2)}, {"pose": ("image", "pose")})
    run = ep.CompGraphRunner(cg).run(image=image(np.uint8, 1))
    assert probe(run, stages(run), 7, 3, shown(run, "pose")) == []
    assert len(probe(run, stages(run), 7, 3, shown(run, "image"))) == 1


_SHAPES = st.tuples(st.integers(8, 50), st.integers(8, 50)) | st.tuples(
    st.integers(8, 50), st.integers(8, 50), st.sampled_from([1, 3, 4])
)
_DTYPES = st.sampled_from(["?", "u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f2", "f4", "f8"])
_PLACE = st.floats(-5, 60)
_IMAGES = _DTYPES.flatmap(lambda dtype: hnp.arrays(np.dtype(dtype), _SHAPES))


@pytest.mark.slow
@given(_IMAGES, _PLACE, _PLACE)
def test_every_place_of_any_image_is_told(made: Any, x: float, y: float) -> None:
    told = texts({"image": made}, x, y)
    assert len(told) == (0 <= x < 40 and 0 <= y < 30)
    assert all(told)
