"""Are the values of an image counted right, whatever its dtype?"""

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import epypes as ep
from epypes.display import Backdrop, reset_display_ranges
from epypes.display.previews.images import display_range
from epypes_widgets.picture.histogram import histogram, histogram_of


def counted(image: Any, order: Any = "bgr", ends: Any = None) -> dict[str, Any]:
    said = histogram(Backdrop(image, order, ends or display_range(image), "image"))
    assert json.loads(json.dumps(said, allow_nan=False)) == said
    for channel in said["channels"]:
        assert len(channel["counts"]) == said["bins"]
    return said


def gray(said: dict[str, Any]) -> list[int]:
    (channel,) = said["channels"]
    assert channel["name"] == "gray"
    return list(channel["counts"])


def test_bytes_have_one_bin_for_each_value() -> None:
    image = np.random.default_rng(0).integers(0, 256, (90, 70), np.uint8)
    said = counted(image)
    assert gray(said) == np.bincount(image.ravel(), minlength=256).tolist()
    assert (said["low"], said["high"], said["bins"], said["sampled"]) == (0, 255, 256, False)


@pytest.mark.parametrize(("order", "names"), [("bgr", "BGR"), ("rgb", "RGB")])
@pytest.mark.parametrize("channels", [3, 4])
def test_colours_are_named_by_their_order_and_alpha_is_left_out(order: str, names: str, channels: int) -> None:
    image = np.zeros((20, 30, channels), np.uint8)
    image[:] = (10, 20, 30, 40)[:channels]
    said = counted(image, order)
    assert [channel["name"] for channel in said["channels"]] == list(names)
    assert [int(np.argmax(channel["counts"])) for channel in said["channels"]] == [10, 20, 30]


def test_a_mask_has_two_bins_at_its_two_values() -> None:
    mask = np.zeros((20, 30), np.uint8)
    mask[:3] = 255
    said = counted(mask)
    assert (said["low"], said["high"], gray(said)) == (0, 255, [510, 90])
    said = counted(mask // 255)
    assert (said["low"], said["high"], gray(said)) == (0, 1, [510, 90])
    said = counted(mask > 0)
    assert (said["low"], said["high"], gray(said)) == (0, 1, [510, 90])


def test_a_thin_line_of_a_large_mask_is_counted_whole() -> None:
    mask = np.zeros((1500, 1500), np.uint8)
    mask[701] = 255
    said = counted(mask)
    assert gray(said) == [1500 * 1499, 1500]
    assert not said["sampled"]


def test_of_labels_their_number_and_areas_are_told() -> None:
    labels = np.zeros((60, 60), np.int32)
    labels[:20, :10] = 300
    labels[30:50, 30:50] = 7
    labels[55:, :5] = 8
    said = counted(labels)
    assert said["labels"] == "3 labels of 25 to 400 px, median 200 px; background 83%"
    assert said["channels"] == [{"name": "areas", "counts": [400, 200, 25]}]
    assert (said["low"], said["high"], said["bins"]) == (1, 3, 3)


def test_of_one_label_and_of_none_the_area_is_told_if_there_is_one() -> None:
    labels = np.zeros((60, 60), np.int32)
    assert counted(labels)["labels"] == "0 labels; background 100%"
    labels[:20, :10] = 300
    assert counted(labels)["labels"] == "1 label of 200 px; background 94%"


def test_of_very_many_labels_some_have_a_bar_the_largest_and_the_smallest_too() -> None:
    labels = np.repeat(np.repeat(np.arange(900, dtype=np.int32).reshape(30, 30) + 1, 20, axis=0), 20, axis=1)
    labels[:20, :19] = 2
    said = counted(labels)
    assert said["labels"].startswith("900 labels of 20 to 780 px")
    counts = said["channels"][0]["counts"]
    assert (counts[0], counts[-1], len(counts)) == (780, 20, 256)


def test_a_histogram_of_anything_but_labels_tells_of_none() -> None:
    assert "labels" not in counted(np.random.default_rng(0).integers(0, 256, (90, 70), np.uint8))


def test_floats_are_counted_where_they_are_nearest_and_nan_nowhere() -> None:
    image = np.zeros((10, 10), np.float32)
    image[0] = 1.0
    image[1] = 0.5
    image[2] = np.nan
    counts = gray(counted(image))
    assert (counts[0], counts[128], counts[255], sum(counts)) == (70, 10, 10, 90)


def test_what_lies_beyond_the_display_range_is_in_the_outer_bins() -> None:
    image = np.full((10, 10), 0.5)
    image[0], image[1, :5], image[2, 0], image[3, :2] = -3.0, 7.0, np.inf, -np.inf
    counts = gray(counted(image, ends=(0.0, 1.0)))
    assert (counts[0], counts[-1], sum(counts)) == (12, 6, 100)


def test_a_range_that_is_hardly_any_is_counted_too() -> None:
    image = np.zeros((10, 10))
    image[0] = 1e-309
    counts = gray(counted(image, ends=(0.0, 1e-309)))
    assert (counts[0], counts[-1]) == (90, 10)


def test_the_range_of_a_tokens_first_image_is_kept() -> None:
    cg = ep.CompGraph({"scaled": lambda image, gain: image * gain}, {"scaled": (("image", "gain"), "scaled")})
    runner = ep.CompGraphRunner(cg, {"gain": 1.0})
    image = np.linspace(-4.0, 8.0, 100).reshape(10, 10)
    first = histogram_of(runner.run(image=image), "scaled")
    second = histogram_of(runner.rerun(gain=0.5), "scaled")
    assert first is not None
    assert second is not None
    assert (first["low"], first["high"]) == (second["low"], second["high"]) == (-8.0, 8.0)
    reset_display_ranges(runner)
    third = histogram_of(runner.last, "scaled") if runner.last is not None else None
    assert third is not None
    assert third["high"] == 4.0


def test_a_large_image_is_sampled_and_that_is_said() -> None:
    image = np.random.default_rng(0).integers(0, 255, (1000, 1200), np.uint8)
    said = counted(image)
    assert said["sampled"]
    assert 100_000 < sum(gray(said)) <= 262_144


def test_what_is_no_image_or_not_up_to_date_has_no_histogram() -> None:
    cg = ep.CompGraph({"count": lambda image, n: image.sum() + n}, {"count": (("image", "n"), "sum")})
    runner = ep.CompGraphRunner(cg, {"n": 1})
    run = runner.run(image=np.eye(64))
    assert histogram_of(run, "sum") is None
    assert histogram_of(run, "n") is None
    assert histogram_of(run, "image") is not None
    assert histogram_of(runner.run("n"), "image") is None


_SHAPES = st.tuples(st.integers(8, 20), st.integers(8, 20)) | st.tuples(
    st.integers(8, 20), st.integers(8, 20), st.sampled_from([1, 3, 4])
)
_DTYPES = st.sampled_from(["?", "u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f2", "f4", "f8"])


@pytest.mark.slow
@given(_DTYPES.flatmap(lambda dtype: hnp.arrays(np.dtype(dtype), _SHAPES)))
def test_every_pixel_of_any_image_is_counted_once(image: Any) -> None:
    said = counted(image)
    assert said["low"] <= said["high"]
    if "labels" in said:
        assert sum(said["channels"][0]["counts"]) <= np.count_nonzero(image > 0)
        return
    numbers = image.size if image.dtype.kind != "f" else np.count_nonzero(~np.isnan(image))
    if image.ndim == 3 and image.shape[2] == 4:
        kept = image[:, :, :3]
        numbers = kept.size if image.dtype.kind != "f" else np.count_nonzero(~np.isnan(kept))
    assert sum(sum(channel["counts"]) for channel in said["channels"]) == numbers
