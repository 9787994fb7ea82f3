"""Circles, boxes in lists and optical flow are drawn over their image, and what only looks like them is not."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
import pytest
from skimage import measure, registration

import epypes as ep
from epypes.display import Most, Scene, scalar_owners, scene_of, view
from tests.display.test_backdrops import green, previews, run_of

HEIGHT, WIDTH = 240, 320
MANY = Most(marks=2_000)


def disks() -> np.ndarray:
    image = np.full((HEIGHT, WIDTH), 40, np.uint8)
    for middle, radius in (((80, 70), 30), ((220, 130), 45)):
        cv2.circle(image, middle, radius, 200, -1, cv2.LINE_AA)
    return cv2.GaussianBlur(image, (5, 5), 0)


def scene(find: Callable[[Any], Any], name: str = "found") -> Scene | None:
    """Return the scene of what a function finds in an image of two disks, as a token of this name."""
    cg = ep.CompGraph({"look": find}, {"look": ("image", name)})
    return scene_of(ep.CompGraphRunner(cg).run(image=disks()), name, MANY)


def drawn(find: Callable[[Any], Any], name: str = "found") -> str:
    """Return what marks are drawn over the image; empty if none are."""
    found = scene(find, name)
    return "" if found is None or found.marks is None else found.what


# -- circles --------------------------------------------------------------------------------------------------


def hough(image: Any) -> Any:
    return cv2.HoughCircles(image, cv2.HOUGH_GRADIENT, 1, 40, param1=100, param2=20)


def test_the_circles_of_hough_are_drawn_where_the_disks_are() -> None:
    found = scene(hough)
    assert found is not None
    assert found.marks is not None
    assert (found.backdrop.name, found.what, found.marks.total) == ("image", "circles", 2)
    middles = sorted(found.marks.points.tolist())
    np.testing.assert_allclose(middles, [[80, 70], [220, 130]], atol=1.5)
    np.testing.assert_allclose(sorted(found.marks.extents[:, 0]), [60, 90], atol=4)


def test_the_thumbnail_has_outlines_and_the_detail_says_what_they_are() -> None:
    shown = previews(run_of(circles=lambda image: np.array([[[100, 120, 60]]], np.float32)))["circles"]
    assert "circles (x, y, radius), radius 60 to 60, drawn over image" in shown.detail
    marks = green(shown)
    assert marks[30, 50]
    assert marks[60, 80]
    assert not marks[60, 50]


@pytest.mark.parametrize(
    "find",
    [
        lambda image: hough(image)[0],
        lambda image: np.uint16(np.around(hough(image))),
        lambda image: np.round(hough(image)[0]).astype(int),
        lambda image: [circle for circle in hough(image)][0],  # noqa: C416, RUF015
    ],
)
def test_circles_that_were_rounded_or_taken_out_are_known_by_a_name(find: Callable[[Any], Any]) -> None:
    assert drawn(find) == ""
    assert drawn(find, "circles") == "circles"


def test_a_function_that_uses_hough_circles_returns_circles() -> None:
    def look(image: Any) -> Any:
        return cv2.HoughCircles(image, cv2.HOUGH_GRADIENT, 1, 40, param1=100, param2=20)[0].astype(int)

    assert drawn(look) == "circles"


def test_enclosing_circles_in_a_list_are_drawn() -> None:
    contours = [np.array([[[10, 10]], [[30, 10]], [[20, 40]]]), np.array([[[90, 90]], [[120, 90]], [[100, 130]]])]
    assert drawn(lambda image: [cv2.minEnclosingCircle(contour) for contour in contours]) == "circles"
    assert drawn(lambda image: [((500.0, 20.0), 5.0)]) == ""
    assert drawn(lambda image: [((50.0, 20.0), -5.0)]) == ""


RNG = np.random.default_rng(0)


@pytest.mark.parametrize(
    "value",
    [
        RNG.integers(0, 255, (1, 256, 3), np.uint8),  # a look-up table
        RNG.uniform(0, 1, (1, 20, 3)).astype(np.float32),  # colours from 0 to 1
        np.float32([[[50, 60, -20]]]),  # no radius
        np.float32([[[50, 60, 900]]]),  # larger than the image
        np.float32([[[500, 60, 20]]]),  # not on the image
        np.float32([[[50, 60, 20], [70, 80, 20], [900, 60, 20]]]),  # not all on the image
        np.float32([[[50, 60, np.nan]]]),
        RNG.uniform(0, 200, (5, 3)).astype(np.float32),  # colours of k-means, a cloud of points
        RNG.uniform(0, 200, (5, 3)),  # row, column and scale of blobs
        RNG.uniform(0, 200, (5, 1, 3)).astype(np.float32),  # points in space, as cv2 takes them
        np.zeros((1, 0, 3), np.float32),
    ],
)
def test_what_only_has_the_shape_of_circles_is_not_drawn(value: Any) -> None:
    assert drawn(lambda image: value) == ""
    assert "circles" not in previews(run_of(found=lambda image: value))["found"].detail


def test_bytes_are_colours_whatever_they_are_called() -> None:
    assert drawn(lambda image: RNG.integers(0, 200, (1, 20, 3), np.uint8), "circle_colours") == ""


# -- boxes ----------------------------------------------------------------------------------------------------

SPREAD = [(50, 40, 60, 61), (175, 85, 91, 91)]


def contours_of(image: Any) -> Any:
    return cv2.findContours((image > 120).astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0]


def test_bounding_rectangles_are_drawn_around_what_they_bound() -> None:
    found = scene(lambda image: [cv2.boundingRect(contour) for contour in contours_of(image)])
    assert found is not None
    assert found.marks is not None
    assert (found.what, found.marks.total, found.marks.are_closed) == ("boxes", 2, True)
    corners = sorted((*line.min(axis=0), *line.max(axis=0)) for line in found.marks.lines)
    np.testing.assert_allclose(corners, [(50, 40, 111, 101), (175, 85, 266, 176)], atol=2)


def test_boxes_of_scikit_image_are_rows_and_columns_of_corners() -> None:
    def look(image: Any) -> Any:
        return [region.bbox for region in measure.regionprops(measure.label(image > 120))]

    found = scene(look)
    assert found is not None
    assert found.marks is not None
    corners = sorted((*line.min(axis=0), *line.max(axis=0)) for line in found.marks.lines)
    np.testing.assert_allclose(corners, [(50, 40, 111, 101), (175, 85, 266, 176)], atol=2)


@pytest.mark.parametrize("name", ["boxes", "rects", "large_box_list", "face_rectangles"])
def test_a_list_that_is_called_boxes_is_drawn(name: str) -> None:
    assert drawn(lambda image: SPREAD, name) == "boxes"
    assert drawn(lambda image: [[np.int32(number) for number in box] for box in SPREAD], name) == "boxes"
    assert drawn(lambda image: tuple(SPREAD), name) == "boxes"


def test_boxes_that_may_as_well_be_two_corners_are_drawn_only_if_their_function_tells() -> None:
    near = [(10, 10, 100, 90)]
    assert drawn(lambda image: near, "boxes") == ""
    assert drawn(lambda image: near if contours_of(image) else cv2.boundingRect(image), "boxes") == "boxes"


@pytest.mark.parametrize(
    "value",
    [
        SPREAD,  # counts, or anything: no name tells
        [(10, 2, 3, 85)],
        [(200, 30, 60, 255)],
    ],
)
def test_four_whole_numbers_without_a_name_are_no_boxes(value: Any) -> None:
    assert drawn(lambda image: value) == ""
    assert drawn(lambda image: value, "counts") == ""


@pytest.mark.parametrize(
    "value",
    [
        [(50, 40, 60, 0)],
        [(-5, 40, 60, 30)],
        [(300, 40, 60, 60)],
        [(10.5, 40.0, 5.0, 6.0)],
        [(50, 40, 60, 60), (1, 2, 3)],
        [(50, 40, 60, 60), None],
        [(50, 40, 60, float("nan"))],
        [("a", "b", "c", "d")],
        (50, 40, 60, 60),
    ],
)
def test_what_is_called_boxes_and_does_not_fit_is_shown_as_text(value: Any) -> None:
    assert drawn(lambda image: value, "boxes") == ""
    cg = ep.CompGraph({"look": lambda image: value}, {"look": ("image", "boxes")})
    shown = previews(ep.CompGraphRunner(cg).run(image=disks()))["boxes"]
    assert shown.picture is None
    assert "no picture" not in shown.detail


def test_a_short_list_says_boxes_only_once_they_are_known() -> None:
    texts = {}
    for name in ("boxes", "counts"):
        cg = ep.CompGraph({"look": lambda image: SPREAD}, {"look": ("image", name)})
        texts[name] = {token.name: token.preview for token in view(ep.CompGraphRunner(cg).run(image=disks())).tokens}[
            name
        ]
    assert (texts["boxes"].text, texts["counts"].text) == ("2 boxes", "list of 2")
    assert "list of 2 boxes (x, y, width, height), drawn over image" in texts["boxes"].detail


# -- optical flow ---------------------------------------------------------------------------------------------


def texture(seed: int = 0) -> np.ndarray:
    noise = np.random.default_rng(seed).normal(0, 1, (HEIGHT, WIDTH)).astype(np.float32)
    return cv2.normalize(cv2.GaussianBlur(noise, (0, 0), 3), None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def flow_scene(find: Callable[[Any, Any], Any], later: Any = None) -> Scene | None:
    """Return the scene of what a function makes of a texture and of the same three pixels further right."""
    first = texture()
    later = np.roll(first, 3, axis=1) if later is None else later
    cg = ep.CompGraph({"look": find}, {"look": (("before", "now"), "found")})
    return scene_of(ep.CompGraphRunner(cg).run(before=first, now=later), "found", MANY)


def farneback(before: Any, now: Any) -> Any:
    return cv2.calcOpticalFlowFarneback(before, now, None, 0.5, 3, 21, 3, 5, 1.2, 0)


def of_scikit_image(before: Any, now: Any) -> Any:
    return registration.optical_flow_ilk(before, now, radius=9).astype(np.float32)


@pytest.mark.parametrize(("find", "sign"), [(farneback, 1), (of_scikit_image, 1)])
def test_flow_is_drawn_as_arrows_where_things_move_and_says_how_long_they_are(find: Any, sign: int) -> None:
    found = flow_scene(find)
    assert found is not None
    assert found.marks is not None
    assert (found.backdrop.name, found.marks.are_closed) == ("before", False)
    assert found.what == "arrows of flow, 2 times as long"
    moves = np.array([line[1] - line[0] for line in found.marks.lines])
    assert abs(np.median(moves, axis=0) - (6 * sign, 0)).max() < 0.6
    heads = np.array([np.hypot(*(line[2] - line[1])) for line in found.marks.lines])
    assert (heads < np.hypot(*moves.T)).all()


def test_flow_of_frames_that_a_delay_keeps_is_drawn() -> None:
    def look(before: Any, now: Any) -> Any:
        return farneback(now if before is None else before, now)

    cg = ep.delay(ep.CompGraph({"look": look}, {"look": (("before", "now"), "found")}), "now", "before")
    runner = ep.CompGraphRunner(cg)
    runner.run(now=texture())
    found = scene_of(runner.run(now=np.roll(texture(), 3, axis=1)), "found")
    assert found is not None
    assert found.what.startswith("arrows of flow")
    assert len(found.marks.lines if found.marks else ()) <= 200


def test_where_nothing_moves_the_image_has_no_arrows() -> None:
    found = flow_scene(lambda before, now: np.zeros((*before.shape, 2), np.float32))
    assert found is not None
    assert found.marks is not None
    assert (found.marks.total, found.marks.lines) == (0, ())


def spectrum(before: Any, now: Any) -> Any:
    return cv2.dft(before.astype(np.float32), flags=cv2.DFT_COMPLEX_OUTPUT)


def coordinates(before: Any, now: Any) -> Any:
    return np.stack(np.meshgrid(np.arange(WIDTH), np.arange(HEIGHT)), axis=-1).astype(np.float32)


def gradients(before: Any, now: Any) -> Any:
    return np.stack([cv2.Sobel(before, cv2.CV_32F, *order) for order in ((1, 0), (0, 1))], axis=-1)


NO_FLOW = {
    "spectrum": spectrum,
    "scaled spectrum": lambda before, now: spectrum(before, now) / before.size,
    "coordinates": coordinates,
    "coordinates with fractions": lambda before, now: coordinates(before, now) + np.float32(0.25),
    "gradients": lambda before, now: gradients(np.random.default_rng(0).integers(0, 255, before.shape, np.uint8), now),
    "levels": lambda before, now: np.stack([before, now], axis=-1).astype(np.float32),
    "dark levels": lambda before, now: np.stack([before, now], axis=-1).astype(np.float32) // 32,
    "shares": lambda before, now: np.stack([before, now], axis=-1).astype(np.float32) / 255,
    "noise": lambda before, now: np.random.default_rng(0).normal(0, 2, (*before.shape, 2)).astype(np.float32),
    "not finite": lambda before, now: np.full((*before.shape, 2), np.nan, np.float32),
    "another size": lambda before, now: farneback(before, now)[::2, ::2],
    "double": lambda before, now: farneback(before, now).astype(float),
}


@pytest.mark.parametrize("name", NO_FLOW)
def test_what_only_has_the_shape_of_flow_is_not_drawn(name: str) -> None:
    assert flow_scene(NO_FLOW[name]) is None


def test_flow_without_two_images_is_not_drawn() -> None:
    flow = farneback(texture(), np.roll(texture(), 3, axis=1))
    assert flow_scene(lambda before, now: flow) is not None
    assert scene(lambda image: flow) is None


# -- numbers --------------------------------------------------------------------------------------------------


def test_the_numbers_that_were_made_from_an_image_stand_with_it() -> None:
    functions = {
        "blur": lambda image: cv2.blur(image, (3, 3)),
        "above": lambda blurred, level: blurred > level,
        "area": lambda mask: int(mask.sum()),
        "name": lambda mask: "large" if mask.sum() > 50 else "small",
        "mean": lambda image: np.float32(image.mean()),
        "share": lambda n, image: n / image.size,
        "double": lambda level: 2 * level,
    }
    io = {
        "blur": ("image", "blurred"),
        "above": (("blurred", "level"), "mask"),
        "area": ("mask", "n"),
        "name": ("mask", "size"),
        "mean": ("image", "mean"),
        "share": (("n", "image"), "share"),
        "double": ("level", "twice"),
    }
    runner = ep.CompGraphRunner(ep.CompGraph(functions, io), {"level": 120})
    run = runner.run(image=disks())
    assert scalar_owners(run) == {"n": "mask", "size": "mask", "mean": "image", "share": "image"}
    shown = previews(run)
    assert shown["mask"].detail.endswith(f"mask, n = {run['n']}, size = 'large'")
    assert f", mean = {run['mean']:.6g}, share = " in shown["image"].detail
    assert " = " not in shown["blurred"].detail


def test_a_number_that_is_out_of_date_does_not_stand_with_its_image() -> None:
    cg = ep.CompGraph.from_functions(_above, _n)
    runner = ep.CompGraphRunner(cg, {"level": 120})
    assert ", _n = " in previews(runner.run(image=disks()))["_above"].detail
    assert ", _n = " not in previews(runner.rerun("_above", level=130))["_above"].detail


def _above(image: Any, level: int) -> Any:
    return image > level


def _n(_above: Any) -> int:
    return int(_above.sum())
