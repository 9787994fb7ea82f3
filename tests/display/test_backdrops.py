"""Features are drawn over the images that they were found in."""

from __future__ import annotations

import io
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image, ImageDraw
from skimage import data, measure

import epypes as ep
from epypes.display import Preview, view

GREEN = (60, 255, 120)


def grayscale(image):
    return cv2.cvtColor(image, cv2.COLOR_BGR2GRAY)


def previews(run: Any) -> dict[str, Preview]:
    return {token.name: token.preview for token in view(run).tokens}


def pixels(shown: Preview) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(shown.picture.data)).convert("RGB")).astype(int)


def green(shown: Preview) -> np.ndarray:
    """Return where a thumbnail is as green as marks are."""
    red, middle, blue = np.moveaxis(pixels(shown), -1, 0)
    return (middle > 120) & (middle - red > 60) & (middle - blue > 40)


def run_of(**functions: Any) -> ep.Run:
    """Run a chain from ``image``, a grey square of 256 pixels: each function takes the token before it."""
    names = ["image", *functions]
    io = {name: (names[place], name) for place, name in enumerate(functions)}
    return ep.CompGraphRunner(ep.CompGraph(functions, io)).run(
        image=np.full((256, 256), 90, np.uint8) + np.eye(256, dtype=np.uint8)
    )


def detect(image, mask=None, nfeatures=500):
    return cv2.ORB_create(nfeatures).detectAndCompute(image, mask)


def match(descriptors_1, descriptors_2):
    matches = cv2.BFMatcher(cv2.NORM_HAMMING, True).match(descriptors_1, descriptors_2)
    return sorted(matches, key=lambda found: found.distance)


def knn(descriptors_1, descriptors_2):
    return cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(descriptors_1, descriptors_2, k=2)


def gather(keypoints_1, keypoints_2, matches):
    return np.array([(*keypoints_1[m.queryIdx].pt, *keypoints_2[m.trainIdx].pt) for m in matches], np.float32)


@pytest.fixture(scope="module")
def pair_runner() -> ep.CompGraphRunner:
    single = ep.CompGraph.from_functions(ep.outputs("keypoints", "descriptors")(detect))
    two = ep.union(single, single, suffixes=("_1", "_2"), keep=("nfeatures",))
    functions = {"match": match, "knn": knn, "best": lambda found: found[:20], "gather": gather}
    functions["gather_late"] = lambda found, *keypoints: gather(*keypoints, found)
    functions["wrong"] = lambda found: [cv2.DMatch(0, 10_000, 1.0)] * len(found)
    descriptors = ("descriptors_1", "descriptors_2")
    pair = ep.extend(
        two,
        functions,
        {
            "match": (descriptors, "matches"),
            "knn": (descriptors, "knn_matches"),
            "best": ("matches", "best_matches"),
            "gather_late": (("matches", "keypoints_1", "keypoints_2"), "paired_late"),
            "wrong": ("matches", "wrong_matches"),
            "gather": (("keypoints_1", "keypoints_2", "matches"), "paired"),
        },
    )
    return ep.CompGraphRunner(pair)


@pytest.fixture(scope="module")
def pair_run(pair_runner) -> ep.Run:
    left, right, _ = data.stereo_motorcycle()
    return pair_runner.run(image_1=left[..., ::-1].copy(), image_2=255 - right[..., ::-1])


def test_keypoints_are_drawn_over_the_image_that_they_were_found_in(pair_run):
    shown = previews(pair_run)
    for side in "12":
        assert green(shown[f"keypoints_{side}"]).sum() > 100
        assert green(shown[f"image_{side}"]).sum() == 0
        plain, drawn = pixels(shown[f"image_{side}"]), pixels(shown[f"keypoints_{side}"])
        # Dark areas, where no feature is, show the photograph.
        assert np.abs(plain[-20:] * 0.75 - drawn[-20:]).mean() < 12
    assert shown["keypoints_1"].text == "500 keypoints"
    assert "drawn over image_1, 200 of 500 drawn" in shown["keypoints_1"].detail


@pytest.mark.parametrize("token", ["matches", "knn_matches", "best_matches", "paired", "paired_late"])
def test_matches_and_pairs_are_drawn_between_their_two_images(pair_run, token):
    shown = previews(pair_run)
    drawn = shown[token]
    assert "drawn between the images" in drawn.detail
    assert drawn.picture.width == 128
    assert drawn.picture.height == pytest.approx(43, abs=1)
    # The lowest rows of the images have no features: they stand side by side, 1 left of 2.
    halves = [
        np.asarray(Image.fromarray(pixels(shown[f"image_{side}"]).astype(np.uint8)).resize((64, 43))) for side in "12"
    ]
    expected = np.concatenate(halves, axis=1)[-8:] * 0.75
    assert np.abs(expected - pixels(drawn)[:43][-8:]).mean() < 15


def test_matches_whose_indices_do_not_fit_are_rows(pair_run):
    shown = previews(pair_run)["wrong_matches"]
    assert shown.picture is None
    assert shown.rows[0] == "0 - 10000: 1"


def test_points_are_drawn_where_they_are():
    points = np.array([[64, 32], [192, 224]], np.float32)
    for form in (points, points[:, None], points.astype(np.int32), points[:, None].astype(float)):
        marked = green(previews(run_of(points=lambda image, form=form: form))["points"])
        assert marked.shape == (128, 128)
        for x, y in points // 2:
            assert marked[int(y) - 1 : int(y) + 2, int(x) - 1 : int(x) + 2].any()
        assert marked.sum() < 60


def test_points_of_numpy_are_row_and_column_and_say_so():
    rows = np.array([[32, 64], [224, 192]])
    for form, order in ((rows, "(row, column)"), (rows.astype(float), "(row, column)"), (rows.astype("f4"), "(x, y)")):
        shown = previews(run_of(points=lambda image, form=form: form))["points"]
        assert f"points {order}, x " in shown.detail
        x, y = (32, 16) if "row" in order else (16, 32)
        assert green(shown)[y - 1 : y + 2, x - 1 : x + 2].any()


def test_points_that_lie_on_the_image_only_the_other_way_round_are_taken_so():
    wide = {"image": np.full((100, 400), 90, np.uint8)}
    for form, order in (
        (np.array([[300, 20], [20, 20]]), "(x, y)"),
        (np.array([[20, 300], [20, 20]], "f4"), "(row, column)"),
    ):
        cg = ep.CompGraph({"find": lambda image, form=form: form}, {"find": ("image", "points")})
        shown = previews(ep.CompGraphRunner(cg).run(**wide))["points"]
        assert f"points {order}" in shown.detail
        assert "drawn over image" in shown.detail


def test_contours_of_opencv_are_x_y_and_of_scikit_image_row_column():
    mask = np.zeros((256, 256), np.uint8)
    mask[40:60, 20:220] = 255
    run = run_of(
        contours=lambda image: cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)[0],
    )
    ours = previews(run)["contours"]
    theirs = previews(run_of(contours=lambda image: measure.find_contours(mask, 128)))["contours"]
    for shown in (ours, theirs):
        rows, columns = np.nonzero(green(shown))
        assert (rows.min(), columns.min()) == pytest.approx((20, 10), abs=2)
        assert (rows.max(), columns.max()) == pytest.approx((30, 110), abs=2)
    assert "(row, column)" in theirs.detail
    assert "(row, column)" not in ours.detail


@pytest.mark.parametrize("shape", [(-1, 1, 4), (-1, 4)])
def test_segments_are_drawn_as_either_opencv_returns_them(shape):
    ends = np.array([[20, 20, 220, 20], [200, 240, 240, 100]], np.int32).reshape(shape)
    shown = previews(run_of(segments=lambda image: ends))["segments"]
    marked = green(shown)
    assert marked[9:12, 20:100].any(axis=0).all()
    assert "segments" in shown.detail


def test_boxes_are_drawn_as_rectangles():
    shown = previews(run_of(boxes=lambda image: np.array([[20, 40, 100, 60], [150, 150, 50, 50]])))["boxes"]
    marked = green(shown)
    assert marked[19:22, 12:58].any(axis=0).all(), "the upper side"
    assert marked[49:52, 12:58].any(axis=0).all(), "the lower side"
    assert "boxes" in shown.detail


def test_a_photograph_is_drawn_upon_rather_than_a_mask_of_its_size(photograph):
    functions = {
        "gray": grayscale,
        "canny": lambda gray: cv2.Canny(gray, 100, 200),
        "find": lambda edges: np.argwhere(edges)[:, ::-1],
    }
    cg = ep.CompGraph(functions, {"gray": ("image", "gray"), "canny": ("gray", "edges"), "find": ("edges", "points")})
    shown = previews(ep.CompGraphRunner(cg).run(image=photograph))
    between = ~green(shown["points"])
    assert np.abs(pixels(shown["points"]) - 0.75 * pixels(shown["gray"]))[between].mean() < 25


def test_an_image_of_another_size_is_not_drawn_upon(photograph):
    functions = {
        "mask": lambda image: cv2.resize(grayscale(image), (90, 50)) > 100,
        "find": lambda mask: np.argwhere(mask)[:, ::-1],
    }
    cg = ep.CompGraph(functions, {"mask": ("image", "mask"), "find": ("mask", "points")})
    shown = previews(ep.CompGraphRunner(cg).run(image=photograph))["points"]
    assert (shown.picture.width, shown.picture.height) == (128, 71), "the mask, not the photograph, of 128 x 85"


def test_without_an_image_points_are_a_chart():
    run = ep.CompGraphRunner(
        ep.CompGraph({"f": lambda: np.random.default_rng(0).random((50, 2)) * 9}, {"f": ((), "points")})
    ).run()
    assert previews(run)["points"].chart.kind == "points"


def test_points_that_do_not_lie_on_the_image_are_not_drawn_upon_it():
    far = np.arange(40.0).reshape(20, 2) + 5000
    shares = np.linspace(0, 1, 40).reshape(20, 2)
    for points in (far, shares):
        assert previews(run_of(points=lambda image, points=points: points))["points"].picture is None


def test_an_image_that_is_newer_than_the_points_is_not_drawn_upon():
    functions = {"scale": lambda image, k: image * k, "find": lambda gray: np.arange(40.0).reshape(20, 2)}
    cg = ep.CompGraph(functions, {"scale": (("image", "k"), "gray"), "find": ("gray", "points")})
    runner = ep.CompGraphRunner(cg, {"k": 1})
    assert previews(runner.run(image=np.arange(10_000.0).reshape(100, 100)))["points"].picture is not None
    runner.rerun("gray", k=2)
    shown = {token.name: token for token in view(runner).tokens}["points"]
    assert shown.state == "stale"
    assert shown.preview.picture is None
    assert shown.preview.chart is not None


def test_no_features_leave_the_image_as_it_is():
    shown = previews(run_of(points=lambda image: np.zeros((0, 1, 2), np.float32)))["points"]
    assert shown.text == "float32 0 x 1 x 2"


def test_coordinates_that_are_not_finite_are_not_drawn():
    points = np.array([[20, 20], [np.nan, 3], [np.inf, 4], [1e30, 5], [40, 40], [60, 60]])
    shown = previews(run_of(points=lambda image: points))["points"]
    assert shown.picture is not None
    assert 0 < green(shown).sum() < 60


@pytest.mark.parametrize("far", [np.nan, np.inf, 1e300, 1e9, 1e6, 99_999.0])
def test_places_that_are_far_off_are_left_out_or_cut_off(far, monkeypatch):
    """Pillow takes seconds for each line that leaves the picture far behind."""
    near, away = cv2.KeyPoint(100.0, 100.0, 5.0), cv2.KeyPoint(far, 1.0, 5.0)
    marks = {
        "points": np.array([[20, 20], [40, 40], [60, far]]),
        "segments": np.array([[[20, 20, 220, 20]], [[30, 30, 200, 30]], [[5, 5, far, 5]]]),
        "pairs": np.array([[20, 20, 30, 30], [40, 40, 50, 50], [9, 9, far, far]]),
        "contours": [np.array([[20, 20], [200, 20], [200, 200], [20, far]], np.float64)],
        "matches": [cv2.DMatch(0, 0, 1.0), cv2.DMatch(1, 1, 1.0)],
    }
    functions = {
        "k1": lambda image: [near, away],
        "k2": lambda other: [near] * 2,
        "draw": lambda k1, k2: tuple(marks.values()),
    }
    io = {"k1": ("image", "k1"), "k2": ("other", "k2"), "draw": (("k1", "k2"), tuple(marks))}
    image = np.full((256, 256), 90, np.uint8) + np.eye(256, dtype=np.uint8)
    drawn = []
    for name in ("line", "ellipse"):
        original = getattr(ImageDraw.ImageDraw, name)

        def told(pen, places, *arguments, original=original, **options):
            drawn.append(np.abs(np.array(places, float)).max())
            if np.isfinite(drawn[-1]) and drawn[-1] < 10_000:
                original(pen, places, *arguments, **options)

        monkeypatch.setattr(ImageDraw.ImageDraw, name, told)
    shown = previews(ep.CompGraphRunner(ep.CompGraph(functions, io)).run(image=image, other=image))
    assert drawn
    assert all(largest <= 3 * 256 for largest in drawn)
    for name in marks:
        assert shown[name].picture is not None, name
    assert green(shown["segments"])[9:12, 20:100].any(axis=0).all()


def test_a_line_that_ends_far_off_keeps_its_direction():
    far = np.array([[[-20_000, 128, 40_000, 128]], [[20, 20, 220, 20]], [[20, 30, 220, 30]]], np.float32)
    marked = green(previews(run_of(segments=lambda image: far))["segments"])
    assert marked[62:67].any(axis=0).all()
    slanted = far.copy()
    slanted[0] = (0, 0, 51_200, 25_600)
    marked = green(previews(run_of(segments=lambda image: slanted))["segments"])
    assert all(marked[place // 2 - 2 : place // 2 + 3, place - 2 : place + 3].any() for place in range(50, 120, 10))
