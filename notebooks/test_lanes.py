"""The functions of lanes.py, each on what can be checked by hand."""

import lanes
import numpy as np
import pytest


def drawn(*lines):
    """Return an RGB image, 100 x 200, with white lines between points."""
    import cv2

    image = np.zeros((100, 200, 3), np.uint8)
    for start, end in lines:
        cv2.line(image, start, end, (255, 255, 255), 3)
    return image


def found(image):
    import cv2

    edges = cv2.Canny(lanes.gray(image), 60, 160)
    return lanes.lane(lanes.segments(lanes.road(edges), votes=20, min_length=15, max_gap=5), edges)


def test_two_lines_are_found_where_they_were_drawn():
    lines = found(drawn(((40, 99), (90, 55)), ((160, 99), (110, 55))))
    np.testing.assert_allclose(lines, [[39, 90], [161, 110]], atol=4)


def test_a_line_that_is_missing_is_nan():
    left, right = found(drawn(((160, 99), (110, 55))))
    assert np.isnan(left).all()
    assert not np.isnan(right).any()


def test_an_empty_road_has_no_line():
    assert np.isnan(found(drawn())).all()


def test_the_first_frame_is_taken_as_it_is():
    lines = np.array([[40.0, 90.0], [160.0, 110.0]])
    assert lanes.smooth(lines, None, 0.3) is lines


def test_a_line_moves_by_its_weight_and_one_that_is_missing_stays():
    before = np.array([[40.0, 90.0], [160.0, 110.0]])
    lines = np.array([[np.nan, np.nan], [170.0, 110.0]])
    np.testing.assert_allclose(lanes.smooth(lines, before, 0.3), [[40, 90], [163, 110]])


@pytest.mark.parametrize(("left", "expected"), [(40, 0.0), (20, 0.071), (np.nan, np.nan)])
def test_the_offset_is_a_share_of_the_lane(left, expected):
    steady = np.array([[left, 90.0], [160.0, 110.0]])
    assert lanes.offset(steady, drawn()) == pytest.approx(expected, abs=0.001, nan_ok=True)
