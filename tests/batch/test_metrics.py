"""Each built-in metric has the value of its definition."""

from __future__ import annotations

import math

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from skimage.metrics import peak_signal_noise_ratio

from epypes.batch.metrics import METRICS, close, count, equal, iou, mean_abs_difference, psnr, value

SHAPES = arrays.array_shapes(min_dims=2, max_dims=2, max_side=8)


@st.composite
def two_masks(draw):
    shape = draw(SHAPES)
    return [draw(arrays.arrays(np.bool_, shape)) for _ in range(2)]


@pytest.mark.slow
@pytest.mark.fuzz
@given(two_masks())
def test_the_iou_of_masks_counts_pixels_in_both_and_in_either(masks):
    one, other = masks
    either = (one | other).sum()
    assert iou(one, other) == ((one & other).sum() / either if either else 1.0)
    # As a file holds it.
    assert iou(one, other.astype(np.uint8) * 255) == iou(one, other) == iou(other, one)


def test_the_iou_of_boxes_pairs_them_so_that_the_sum_is_largest():
    wanted = np.array([[0, 0, 10, 10], [20, 0, 10, 10]])
    assert iou([(20, 0, 10, 10), (0, 0, 10, 10)], wanted) == 1.0
    assert iou([(0, 5, 10, 10)], [(0, 0, 10, 10)]) == pytest.approx(50 / 150)
    # The first one overlaps with both; taken greedily it would keep the second one from its pair.
    assert iou([(1, 0, 4, 1), (0, 0, 1, 1)], [(0, 0, 4, 1), (5, 0, 1, 1)]) == pytest.approx(max(3 / 5, 1 / 4) / 2)


def test_each_box_too_many_or_too_few_costs():
    box = (0, 0, 10, 10)
    assert iou([box, (50, 50, 5, 5)], [box]) == iou([box], [box, (50, 50, 5, 5)]) == 0.5
    assert iou([], [box]) == iou([box], []) == 0.0
    assert iou([], []) == iou(np.empty((0, 4)), []) == 1.0
    assert iou([(0, 0, 0, 0)], [(0, 0, 0, 0)]) == 0.0  # without an area there is nothing in common


def labelled(*objects, dtype=np.int32):
    """A label image of 10 x 20 pixels with an object in each range of columns, numbered from 1."""
    found = np.zeros((10, 20), dtype)
    for number, (first, last) in enumerate(objects, 1):
        found[:, first:last] = number
    return found


@pytest.mark.parametrize("dtype", [np.int32, np.uint8, np.uint16])
def test_two_objects_that_were_merged_are_not_two(dtype):
    two, merged = labelled((2, 8), (8, 12), dtype=dtype), labelled((2, 12), dtype=dtype)
    assert iou(merged, two) == iou(two, merged) == pytest.approx(0.6 / 2)
    assert iou(merged != 0, two) == iou((merged != 0).astype(np.uint8) * 255, two) == pytest.approx(0.6 / 2)
    assert iou(merged != 0, two != 0) == 1.0


def test_the_numbers_of_labels_do_not_matter():
    two = labelled((2, 8), (8, 12))
    assert iou(np.array([0, 700, -3])[two], two) == 1.0
    assert iou(labelled((2, 8), (8, 16)), two) == pytest.approx((1 + 4 / 8) / 2)


def test_each_object_too_many_or_too_few_costs():
    two, nothing = labelled((0, 5), (10, 15)), labelled()
    assert iou(labelled((0, 5), (10, 15), (16, 20)), two) == iou(two, labelled((0, 5), (10, 15), (16, 20))) == 2 / 3
    assert iou(nothing, two) == iou(two, nothing) == 0.0


def test_a_mask_is_compared_as_a_whole_whatever_its_one_value_is():
    one = labelled((2, 8), dtype=np.uint8)
    for other in (one * 255, one != 0, one.astype(np.int32) * 7):
        assert iou(other, labelled((5, 8), dtype=np.uint8)) == 0.5


def test_what_has_a_label_at_every_pixel_is_refused_before_it_fills_the_memory():
    many = np.arange(10_000).reshape(100, 100)
    with pytest.raises(ValueError, match="The value has 10000 labels, what was expected 10000: too many"):
        iou(many, many)


def test_boxes_may_be_two_corners():
    assert iou([(0, 0, 10, 10)], [(5, 0, 15, 10)], boxes="xyxy") == pytest.approx(50 / 150)
    with pytest.raises(ValueError, match="boxes is 'corners', not 'xywh' or 'xyxy'"):
        iou([], [], boxes="corners")


def test_equal_is_the_share_that_is_the_same():
    one = np.arange(8).reshape(2, 4)
    other = one.copy()
    other[0, 0] = 9
    assert equal(one, one) == 1.0
    assert equal(one, other) == 7 / 8
    assert equal(np.array([math.nan, 1.0]), np.array([math.nan, 2.0])) == 0.5


@pytest.mark.parametrize(
    ("one", "other", "same"),
    [
        (3, 3, True),
        (3, 3.0, True),
        (np.int64(3), 3, True),
        (3, 4, False),
        ("a", "a", True),
        (None, None, True),
        (None, 0, False),
        ([1, 2], (1, 2), True),
        ([1, 2], [1, 2, 3], False),
        ([np.arange(3), 1], [np.arange(3), 1], True),
        ((cv2.KeyPoint(1, 2, 3),), (cv2.KeyPoint(1, 2, 3),), True),
        ((cv2.KeyPoint(1, 2, 3),), (cv2.KeyPoint(1, 2, 4),), False),
        (np.array([1.0, 2.0]), [1, 2], True),
        (True, 1, True),
    ],
)
def test_what_is_no_array_is_equal_as_a_whole(one, other, same):
    assert equal(one, other) == float(same)


def test_a_mask_is_equal_to_the_image_that_it_was_stored_as():
    mask = np.eye(4, dtype=bool)
    assert equal(mask, mask.astype(np.uint8) * 255) == 1.0
    assert equal(mask, np.zeros((4, 4), np.uint8)) == 12 / 16


def test_close_is_the_share_within_the_tolerance():
    one, other = np.array([1.0, 2.0, 3.0, math.nan]), np.array([1.05, 2.2, 3.0, math.nan])
    assert close(one, other, atol=0.1, rtol=0) == 3 / 4
    assert close(one, other) == 2 / 4
    assert close(1.0, 1.05, rtol=0.1) == 1.0
    with pytest.raises(ValueError, match="no numbers"):
        close("a", "b")


def test_what_is_counted_is_said_where_it_could_be_two_things():
    mask = np.eye(4, dtype=bool)
    labels = np.array([[0, 1, 1], [0, 3, 3]])
    assert count(mask) == 4
    assert count([1, 2, 3]) == count(np.zeros((3, 2), np.float32)) == 3
    assert count(labels, of="labels") == 2
    assert count(labels, of="nonzero") == 4
    assert count(labels, of="items") == 2
    with pytest.raises(ValueError, match="int64 2 x 3 can be counted in several ways: give of="):
        count(labels)
    with pytest.raises(ValueError, match="compared by the metric 'value'"):
        count(3)
    with pytest.raises(ValueError, match="of is 'all'"):
        count([], of="all")


def test_a_value_is_a_single_number():
    assert (value(3), value(True), value(np.float32(0.5)), value(np.array(7))) == (3.0, 1.0, 0.5, 7.0)
    for wrong in ("3", [1, 2], None, np.zeros(3)):
        with pytest.raises(ValueError, match="is not a single number"):
            value(wrong)


def test_the_mean_difference_does_not_wrap_around():
    assert mean_abs_difference(np.array([0, 10], np.uint8), np.array([255, 10], np.uint8)) == 127.5
    assert mean_abs_difference(3, 5) == 2.0


def test_psnr_is_that_of_scikit_image():
    rng = np.random.default_rng(1)
    one, other = (rng.integers(0, 255, (20, 30), np.uint8) for _ in range(2))
    assert psnr(one, other) == pytest.approx(peak_signal_noise_ratio(other, one, data_range=255))
    assert psnr(one, one) == math.inf
    assert psnr(one / 255, other / 255, data_range=1.0) == pytest.approx(psnr(one, other))
    with pytest.raises(ValueError, match="float64 images, psnr needs data_range"):
        psnr(one / 255, other / 255)
    with pytest.raises(ValueError, match="Give one dtype"):
        psnr(one, other / 255)


@pytest.mark.parametrize("least", ["least", "zero"])
@pytest.mark.parametrize("dtype", ["int8", "int16", "int32", "int64", ">i2", "uint8", "uint16", "uint32", "uint64"])
def test_psnr_of_integers_is_that_of_scikit_image_whatever_their_sign(dtype, least):
    rng, most = np.random.default_rng(1), np.iinfo(dtype)
    low = most.min if least == "least" else 0
    one, other = (rng.integers(low, most.max, (20, 30), np.dtype(dtype).newbyteorder("=")) for _ in range(2))
    one, other = one.astype(dtype), other.astype(dtype)
    assert psnr(one, other) == peak_signal_noise_ratio(other, one)


@pytest.mark.parametrize("name", [name for name, metric in METRICS.items() if metric.compares])
def test_another_shape_is_a_reason_and_no_number(name):
    with pytest.raises(ValueError, match="The shapes differ: the value is uint8 2 x 3, what was expected uint8 3 x 2"):
        METRICS[name].function(np.zeros((2, 3), np.uint8), np.zeros((3, 2), np.uint8))
