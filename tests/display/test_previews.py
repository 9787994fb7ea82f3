"""Previews of values of each kind stay small and never raise."""

from __future__ import annotations

import colorsys
import enum
import io
import itertools
import os
import re
import subprocess
import sys
import tracemalloc
import warnings
from collections import deque
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pandas as pd
import pytest
from PIL import Image
from skimage import data, measure, segmentation

import epypes as ep
from epypes.display import Chart, encode_image, is_image, mimebundle
from epypes.display.previews.preview import preview
from epypes.errors import MissingPackage
from epypes.optional import LazyModule
from tests.colours import red_image


def pixels(picture: Any, mode: str = "RGB") -> np.ndarray:
    """Return the pixels of an encoded picture."""
    return np.asarray(Image.open(io.BytesIO(picture.data)).convert(mode))


class Hostile:
    def __repr__(self):
        raise RuntimeError("no repr")

    def __str__(self):
        raise RuntimeError("no str")

    def __len__(self):
        raise RuntimeError("no len")


class HostileList(list):
    def __iter__(self):
        raise RuntimeError("no items")

    def __getitem__(self, index):
        raise RuntimeError("no item")


class HostileDict(dict):
    def items(self):
        raise RuntimeError("no items")


class HostileArray:
    __module__ = "numpy.evil"
    dtype, shape = property(lambda self: 1 / 0), (3, 3)


@pytest.mark.slow
@pytest.mark.parametrize(
    "value",
    [
        Hostile(), HostileArray(), [Hostile()], {"k": Hostile()}, "x" * 10**6, b"x" * 10**6, 10**300, list(range(10**6)),
        np.zeros((0, 5)), np.zeros((3, 0, 3), np.uint8), np.full((20, 20), np.nan), np.array([np.inf, 1.0]),
        np.array([object()], dtype=object), np.zeros((2, 3, 4, 5, 6)), np.array("text"), np.float32(2), np.array(3),
        HostileList([1, 2]), HostileDict(a=1), 10**100_000, range(10**9), deque([1] * 10**6), [[[[[[1]]]]]], "\0\ud800",
        np.array([np.datetime64("NaT", "s")]), np.array(["a", None], dtype=object), np.array([b"x", b"yy"]), np.ma.zeros(9),
        np.zeros((0,), dtype=[("a", int)]), np.full((9, 2), np.nan), np.full((9, 1, 4), np.inf), np.array([[1e300, -1e308]]),
        np.full((30, 30), 1e308) * np.where(np.eye(30) > 0, -1, 1), np.zeros((9, 0)), np.array([], dtype="M8[s]"),
        [np.zeros((0, 1, 2), np.int32)], (np.zeros(3), np.zeros(4)), pd.DataFrame(), pd.DataFrame({"a": [Hostile()]}),
        pd.Series([], dtype=float), [{"a": Hostile()}], [{}], {}, [], set(), Path(), ValueError(Hostile()), int, len, pd,
        np.zeros((9, 9), dtype=[("a", int)]), np.zeros((50, 50), np.complex64), float("nan"), None, True, (), 1 + 2j,
    ],
    ids=lambda value: type(value).__name__,
)  # fmt: skip
def test_any_value_has_a_preview_that_is_short_and_never_raises(value):
    shown = preview(value)
    assert 0 < len(shown.text) <= 30
    assert len(shown.detail) < 300
    assert len(shown.rows) <= 4
    cg = ep.CompGraph({"f": lambda: value}, {"f": ((), "y")})
    runner = ep.CompGraphRunner(cg)
    runner.run()
    assert "image/svg+xml" in mimebundle(runner)


@pytest.mark.parametrize(
    ("array", "media_type"),
    [
        (np.arange(100 * 90, dtype=np.uint8).reshape(100, 90), "image/jpeg"),
        (np.zeros((100, 90, 3), np.uint8), "image/jpeg"),
        (np.zeros((100, 90, 4), np.uint8), "image/png"),
        (np.zeros((100, 90, 1), np.uint8), "image/png"),
        (np.eye(100, dtype=bool), "image/png"),
        (np.eye(100, dtype=np.uint8) * 255, "image/png"),
        (np.eye(100, dtype=np.uint8), "image/png"),
        (np.kron(np.arange(12).reshape(3, 4), np.ones((30, 30), int)), "image/png"),
        (np.random.default_rng(0).random((100, 90)), "image/jpeg"),
        (np.full((100, 90), np.nan, np.float32), "image/jpeg"),
        (np.arange(9000, dtype=np.uint16).reshape(100, 90), "image/jpeg"),
        (np.arange(9000, dtype=np.int64).reshape(100, 90) - 50, "image/jpeg"),
    ],
)
def test_images_of_every_kind_are_encoded_small(array, media_type):
    picture = encode_image(array, 64)
    assert picture.media_type == media_type
    assert max(picture.width, picture.height) <= 64
    assert Image.open(io.BytesIO(picture.data)).size == (picture.width, picture.height)


def test_a_mask_keeps_its_thin_lines_when_it_shrinks():
    mask = np.zeros((1000, 1000), np.uint8)
    mask[500, :] = 255
    shown = np.asarray(Image.open(io.BytesIO(encode_image(mask, 100).data)))
    assert shown.any(axis=0).all()


@pytest.mark.slow
def test_full_size_masks_are_encoded_without_loss(straight_edges):
    shown = np.asarray(Image.open(io.BytesIO(encode_image(straight_edges).data)))
    assert np.array_equal(shown, straight_edges > 0)


@pytest.mark.parametrize("shape", [(7, 100), (100, 2), (100, 100, 2), (5,), (9, 9, 9, 9)])
def test_what_is_not_an_image_is_not_taken_for_one(shape):
    assert not is_image(np.zeros(shape, np.uint8))


@pytest.mark.parametrize(("shape", "is_shown"), [((500, 32), False), ((32, 500), False), ((180, 32), True)])
def test_a_table_so_narrow_that_it_shows_nothing_has_no_thumbnail(shape, is_shown):
    shown = preview(np.zeros(shape, np.uint8))
    assert (shown.picture is not None) == is_shown
    assert shown.text == f"uint8 {shape[0]} x {shape[1]}"


def test_alpha_stays_where_it_is_in_both_orders():
    image = np.full((16, 16, 4), (200, 20, 10, 90), np.uint8)
    for order, pixel in (("rgb", (200, 20, 10, 90)), ("bgr", (10, 20, 200, 90))):
        picture = Image.open(io.BytesIO(encode_image(image, order=order).data))
        assert picture.getpixel((5, 5)) == pixel


def test_a_mask_of_twelve_megapixels_keeps_lines_that_no_sample_would_hit():
    mask = np.zeros((3000, 4000), np.uint8)
    mask[1501, :] = mask[:, 2003] = 255
    shown = pixels(preview(mask).picture, "L")
    assert shown.any(axis=0).all()
    assert shown.any(axis=1).all()


def test_a_mask_of_zeros_and_ones_is_black_and_white():
    shown = pixels(preview(np.tri(64, dtype=np.uint8)).picture, "L")
    assert set(np.unique(shown)) == {0, 255}


# Labels


def test_regions_are_labels_whichever_way_they_were_found(photograph):
    coins = data.coins()
    regions = measure.label(coins > 110)
    superpixels = segmentation.slic(photograph, 60, start_label=1)
    for labels in (regions, superpixels, regions.astype(np.uint16), (superpixels % 60).astype(np.uint8)):
        shown = preview(labels)
        assert shown.picture.media_type == "image/png"
        assert f"{len(np.unique(labels[labels > 0]))} labels" in shown.detail


@pytest.mark.parametrize("radii", [(1,), (2,), (2, 4), (2, 8)])
@pytest.mark.parametrize("seed", range(5))
def test_many_small_objects_are_labels_whatever_their_size(radii, seed):
    labels, rng = np.zeros((128, 170), np.int32), np.random.default_rng(seed)
    for number in range(1, 36):
        centre = (int(rng.integers(8, 162)), int(rng.integers(8, 120)))
        cv2.circle(labels, centre, int(rng.integers(radii[0], radii[-1] + 1)), number, -1)
    assert f", {len(np.unique(labels)) - 1} labels of " in preview(labels).detail


def test_one_object_that_fills_an_image_and_none_at_all_are_labels():
    assert preview(np.ones((64, 64), np.int32)).detail == "int32 64 x 64, 1 label of 4096 px, 16.4 kB"
    assert preview(np.zeros((64, 64), np.int32)).detail == "int32 64 x 64, 0 labels, 16.4 kB"
    assert "label" not in preview(np.full((64, 64), 127, np.int32)).detail
    assert "label" not in preview(np.zeros((64, 64), np.int16)).detail


def test_sparse_counts_are_no_labels():
    rng = np.random.default_rng(0)
    for mean in (0.05, 0.3, 1):
        for dtype in (np.int32, np.uint16):
            assert "label" not in preview(rng.poisson(mean, (128, 170)).astype(dtype)).detail


@pytest.mark.parametrize("name", ["dark", "gradient", "distance", "negative", "constant", "noise"])
def test_photographs_and_measurements_are_no_labels(name, photograph):
    gray = cv2.cvtColor(photograph, cv2.COLOR_BGR2GRAY)
    image = {
        "dark": cv2.GaussianBlur(gray, (31, 31), 0) // 6,
        "gradient": np.abs(cv2.Sobel(gray, cv2.CV_16S, 1, 0)),
        "distance": cv2.distanceTransform((gray > 100).astype(np.uint8), cv2.DIST_L1, 3).astype(np.int32),
        "negative": gray.astype(np.int32) - 100,
        "constant": np.full_like(gray, 7),
        "noise": np.random.default_rng(0).integers(0, 9, gray.shape),
    }[name]
    assert "label" not in preview(image).detail


def test_the_colour_of_a_label_does_not_depend_on_the_others():
    few, many = np.zeros((64, 64), int), np.zeros((64, 64), int)
    few[8:30, 8:30] = many[8:30, 8:30] = 5
    many[40:60, 40:60] = 3
    many[40:60, 2:20] = 900
    ours, theirs = pixels(preview(few).picture), pixels(preview(many).picture)
    assert np.array_equal(ours[20, 20], theirs[20, 20])
    assert len({tuple(theirs[place]) for place in ((0, 0), (20, 20), (50, 50), (50, 10))}) == 4
    assert not theirs[0, 0].any(), "0 is black"


def test_neighbouring_labels_have_colours_that_differ():
    stripes = np.repeat(np.arange(1, 17), 16)[None].repeat(64, axis=0)
    row = pixels(preview(stripes).picture)[20, 4::8].astype(float) / 255
    hues = [colorsys.rgb_to_hsv(*colour)[0] for colour in row]
    gaps = [min(abs(a - b), 1 - abs(a - b)) for a, b in itertools.pairwise(hues)]
    assert min(gaps) > 0.1


# Sizes and samples


@pytest.mark.parametrize("shape", [(300, 300), (300, 300, 3), (300, 300, 4)])
def test_even_noise_makes_a_thumbnail_of_at_most_five_kilobytes(shape):
    shown = preview(np.random.default_rng(0).integers(0, 256, shape).astype(np.uint8))
    assert len(shown.picture.data) <= 5_000
    assert 16 <= max(shown.picture.width, shown.picture.height) <= 128


@pytest.mark.parametrize("dtype", ["uint8", "uint16", "float32", "int32"])
def test_large_images_are_looked_at_on_a_sample_and_say_so(dtype):
    small, large = (np.random.default_rng(0).integers(0, 200, (side, side)).astype(dtype) for side in (1000, 3000))
    assert "sample" not in preview(small).detail
    assert "of a sample" in preview(large).detail


def test_statistics_are_told_and_what_is_not_finite_is_counted():
    image = np.full((10, 10), 2.0, np.float32)
    image[0, :4] = np.nan, np.nan, np.inf, 8.0
    detail = preview(image).detail
    assert detail.startswith("float32 10 x 10, 2 to 8, mean 2.062, 2 NaN, 1 inf, 400 B")


@pytest.mark.parametrize(("order", "said"), [("bgr", "10 x 10 x 3 bgr"), ("rgb", "10 x 10 x 3 rgb")])
def test_the_order_of_colours_is_said(order, said):
    assert said in preview(red_image(10), order).detail


# Numbers, texts and containers


class Mode(enum.Enum):
    FAST = 1


class Flavour(str, enum.Enum):  # noqa: UP042 - which people still write
    SWEET = "sweet"


@dataclass
class Pose:
    x: float
    rotation: Any


class Size(NamedTuple):
    width: int
    height: int


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (3, "3"), (2.0, "2.0"), (1 / 3, "0.333333"), (1e-9, "1e-09"), (np.float32(2), "2.0"), (np.int16(7), "7"), (True, "True"),
        (Mode.FAST, "Mode.FAST"), (Flavour.SWEET, "Flavour.SWEET"), ((5, 5), "(5, 5)"), ([1, 2], "list of 2"), (None, "None"),
        (Path("/data/left.png"), "left.png"), (ValueError("no image"), "ValueError: no image"), (object(), "object"),
        (len, "len"), (Pose, "Pose"), (np.zeros((2, 3, 4, 5, 6)), "float64 2 x 3 x 4 x 5 x 6"), (Size(3, 4), "Size"),
    ],
    ids=lambda value: value if type(value) is str else type(value).__name__,
)  # fmt: skip
def test_values_are_written_short(value, text):
    assert preview(value).text == text


@pytest.mark.parametrize(
    ("value", "rows"),
    [
        ({"a": 1, "b": [1, 2], "c": np.zeros((3, 4), np.uint8)}, ("a: 1", "b: [1, 2]", "c: uint8 3 x 4")),
        ([7, "x", None, 2.5, 1], ("7", "'x'", "None", "... 2 more")),
        (Pose(1.5, np.eye(3)), ("x: 1.5", "rotation: float64 3 x 3")),
        (Size(3, 4), ("width: 3", "height: 4")),
        ([], ("(empty)",)),
        (
            np.array([[800.5, 0, 320], [0, 800.5, 240], [0, 0, 1]]),
            ("800.5     0 320", "    0 800.5 240", "    0     0   1"),
        ),
        (np.array([(1, 0.5), (2, 1.5)], dtype=[("id", int), ("area", float)]), ("id  area", "1   0.5", "2   1.5")),
        ([{"id": 1, "name": "nut"}, {"id": 2, "name": "bolt"}], ("id  name", "1   nut", "2   bolt")),
        (pd.DataFrame({"id": [1, 2, 3, 4], "area": [0.5, 1.5, 2, 3]}), ("id  area", "1   0.5", "2   1.5", "3   2")),
        (pd.Series([0.5, 1.5], index=["a", "b"]), ("'a': 0.5", "'b': 1.5")),
    ],
    ids=lambda value: type(value).__name__,
)
def test_what_is_inside_stands_in_rows(value, rows):
    assert preview(value).rows == rows


@pytest.mark.slow
def test_a_subclass_of_a_container_is_bounded_too():
    class Many(list):
        pass

    detail = preview({"all": Many(range(10**6)), "nested": Pose(1.0, Many([Many(range(10**6))] * 10**5))}).detail
    assert len(detail) < 300
    assert preview(Many(range(10**6))).text == "Many of 1000000"


def test_what_is_long_is_not_asked_for_its_repr():
    class Huge(dict):
        def __repr__(self):
            raise AssertionError("asked")

    assert preview(Huge.fromkeys(range(10**4)).keys()).text == "dict_keys of 10000"
    assert preview(Huge.fromkeys(range(10**4))).text == "Huge of 10000"


def test_a_repr_that_raises_gives_its_reason():
    assert "RuntimeError: no repr" in preview(Hostile()).detail
    assert "RuntimeError: no repr" in preview([Hostile()]).rows[0]


# Charts


def test_a_histogram_is_bars_and_a_signal_a_line():
    counts = cv2.calcHist([data.coins()], [0], None, [256], [0, 256])
    values = data.coins()[100].astype(float)
    for histogram in (counts, counts.reshape(-1, 1), np.histogram(data.coins(), 20)):
        assert preview(histogram).chart.kind == "bars"
    for signal in (values, values[:, None], values[None]):
        assert preview(signal).chart.kind == "line"


def test_a_peak_of_a_long_signal_is_not_lost():
    signal = np.zeros(100_000)
    signal[31_416] = 1
    (points,) = preview(signal).chart.series
    assert max(y for _, y in points) == 1.0
    assert len(points) <= 128


def test_points_without_an_image_keep_their_shape_and_point_downwards():
    (points,) = preview(np.array([[0, 0], [100, 0], [0, 50], [100, 50], [0, 0]], np.float32)).chart.series
    (left, top), (right, _), (_, bottom) = points[:3]
    assert top > bottom
    assert (right - left) * 4 / 3 == pytest.approx(2 * (top - bottom), abs=0.01)


# Registration by type


def test_a_mask_tells_thin_lines_from_areas():
    mask = np.zeros((1000, 1000), bool)
    mask[500, :] = True
    mask[700:900, 100:900] = True
    shown = np.asarray(Image.open(io.BytesIO(preview(mask).picture.data)).convert("L"))
    line, area = shown[60:68].max(axis=0), shown[95:110, 20:100]
    assert line.min() > 60, "it can be seen"
    assert area.min() == 255
    assert (shown[60:68] > 0).sum(axis=0).max() <= 2
    assert line.max() < 255


def test_a_preview_function_may_give_words_and_an_image():
    class Pose:
        pass

    image = np.full((60, 80, 3), (0, 0, 200), np.uint8)
    ep.register_preview(Pose, lambda pose: ep.Preview("3 mm", "pose, 3 mm", picture=image))
    shown = preview(Pose())
    assert (shown.text, shown.detail) == ("3 mm", "pose, 3 mm")
    red = np.asarray(Image.open(io.BytesIO(shown.picture.data)))
    assert red[..., 0].mean() > 190
    ep.register_preview(Pose, lambda pose: ep.Preview("3 mm", picture="pose.png"))
    assert "picture must be an image" in preview(Pose()).text + preview(Pose()).detail


def registered(returned: Any) -> Any:
    """Return a value of a class whose previews are this."""

    class Thing:
        pass

    ep.register_preview(Thing, lambda thing: returned)
    return Thing()


@pytest.mark.parametrize(
    ("returned", "expected"),
    [
        ("a text", ("a text", None, ())),
        (red_image(), ("Thing", "image/jpeg", ())),
        (ep.Preview("pose", rows=("x: 1", "y: 2")), ("pose", None, ("x: 1", "y: 2"))),
        (ep.Preview("big", picture=encode_image(red_image(400))), ("big", "image/jpeg", ())),
        (ep.Preview("line", chart=Chart("line", (((0, 0), (1, 5)),))), ("line", "chart", ())),
    ],
    ids=["text", "image", "rows", "picture", "chart"],
)
def test_a_type_of_ones_own_is_shown_as_its_function_says(returned, expected):
    shown = preview(registered(returned))
    thumbnail = shown.picture.media_type if shown.picture else "chart" if shown.chart else None
    assert (shown.text, thumbnail, shown.rows) == expected
    assert shown.picture is None or max(shown.picture.width, shown.picture.height) <= 128


def test_the_detail_of_an_image_that_a_function_returned_tells_of_both():
    assert preview(registered(red_image())).detail.startswith("Thing, shown as uint8 64 x 64 x 3 bgr, 10 to 200")


@pytest.mark.parametrize(
    "nonsense",
    [
        None, 3, object(), np.zeros(3), ep.Preview(3), ep.Preview("a", picture=b"bytes"), ep.Preview("a", rows=(1,)),
        ep.Preview("a", chart=Chart("pie", ())), ep.Preview("a", chart=Chart("line", ((1, 2),))), ep.Preview("a", detail=None),
    ],
    ids=range(10),
)  # fmt: skip
def test_nonsense_shows_its_reason_in_place(nonsense):
    shown = preview(registered(nonsense))
    assert shown.text.startswith("no preview: ")
    assert re.search(r"(Error|InvalidType|InvalidValue): ", shown.detail)


def test_a_preview_that_raises_shows_its_reason_and_never_breaks_the_picture():
    class Part:
        pass

    @ep.register_preview(Part)
    def show(part):
        raise ValueError("<script>alert(1)</script>" + "x" * 10_000)

    cg = ep.CompGraph({"f": Part, "g": lambda: 1}, {"f": ((), "part"), "g": ((), "one")})
    bundle = mimebundle(ep.CompGraphRunner(cg).run())
    assert "no preview: ValueError" in bundle["image/svg+xml"]
    assert "<script>alert" not in bundle["image/svg+xml"]
    assert len(bundle["image/svg+xml"]) < 10_000


def test_a_preview_function_can_not_spoil_what_it_shows():
    class Frame(np.ndarray):
        pass

    @ep.register_preview(Frame)
    def show(frame):
        frame[:] = 0
        return "spoilt"

    image = red_image().view(Frame)
    assert preview(image).text.startswith("no preview: ValueError")
    assert image.max() == 200


def test_the_nearest_class_decides_and_for_one_class_the_user():
    class Pathlike(dict):
        pass

    class Special(Pathlike):
        pass

    ep.register_preview(Pathlike, lambda value: "ours")
    assert preview(Special(a=1)).text == "ours"
    ep.register_preview(Special, lambda value: "special")
    assert (preview(Special()).text, preview(Pathlike()).text, preview({}).text) == ("special", "ours", "dict of 0")


def test_a_user_may_show_what_is_shown_already_in_another_way():
    code = (
        "import epypes as ep, pathlib; from epypes.display.previews.preview import preview\n"
        "before = preview(pathlib.Path('a')).text; ep.register_preview(pathlib.PurePath, lambda path: 'mine')\n"
        "print(before, preview(pathlib.Path('a')).text)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["a", "mine"]


def test_a_class_is_known_by_its_dotted_name_before_it_exists():
    ep.register_preview(f"{__name__}.Late", lambda value: "at last")
    late = type("Late", (), {"__module__": __name__, "__qualname__": "Late"})
    assert preview(late()).text == "at last"


@pytest.mark.parametrize("kind", [3, "Pose", None, ("a.B",)])
def test_what_is_no_class_is_refused(kind):
    with pytest.raises(TypeError, match="a class or its dotted name"):
        ep.register_preview(kind, str)
    with pytest.raises(TypeError, match="must be a function"):
        ep.register_preview(Pose, "text")


# What is looked at is not asked


def meta(**attributes: Any) -> Any:
    """Return an object whose class has a class of its own, with these attributes."""
    return type("Meta", (type,), attributes)("Thing", (), {})()


def boom(*arguments: Any, **options: Any) -> Any:
    raise RuntimeError("boom")


@pytest.mark.parametrize("name", ["__name__", "__module__", "__mro__", "__getattribute__", "__getattr__", "dtype"])
def test_a_class_that_does_not_tell_its_name_has_one(name):
    hostile = meta(**{name: boom if name.startswith("__get") else property(boom)})
    assert preview(hostile).text == "Thing"
    assert preview([hostile, {"k": hostile}]).rows == ("Thing", "{'k': Thing}")
    assert "image/svg+xml" in mimebundle(
        ep.CompGraphRunner(ep.CompGraph({"f": lambda: hostile}, {"f": ((), "y")})).run()
    )


def test_a_name_that_is_no_text_does_not_hide_the_picture():
    assert preview(meta(__name__=5, __repr__=boom)).text == "Thing"


def test_what_would_have_to_be_computed_is_not_asked_for():
    asked = []

    class Lazy:
        shape, ndim, dtype, size = (100, 100), 2, np.dtype("uint8"), 10_000

        def __len__(self):
            asked.append("len")
            return 100

        def __array__(self, *arguments, **options):
            asked.append("array")
            return np.zeros((100, 100), np.uint8)

        __getitem__ = astype = copy = __iter__ = __array__

    groups = pd.DataFrame({"a": [1, 2], "b": [3, 4]}).groupby("a")
    for value in (Lazy(), [Lazy()], (Lazy(), Lazy()), groups):
        assert preview(value).picture is None
    cg = ep.CompGraph(
        {"f": lambda x: x, "g": lambda y: np.arange(60.0).reshape(30, 2)}, {"f": ("x", "y"), "g": ("y", "z")}
    )
    mimebundle(ep.CompGraphRunner(cg).run(x=Lazy()))
    assert asked == []
    assert not is_image(Lazy())


def test_a_subclass_is_shown_by_what_it_holds_whatever_its_methods_say():
    class Text(str):
        __getitem__ = __len__ = __iter__ = split = strip = isprintable = __str__ = __repr__ = boom

    class Numbers(list):
        __getitem__ = __len__ = __iter__ = boom

    class Names(dict):
        __getitem__ = __len__ = __iter__ = items = keys = boom

    class Both(set):
        __len__ = __iter__ = boom

    assert preview(Text("abc")).text == "'abc'"
    assert preview(Numbers([1, 2])).rows == ("1", "2")
    assert preview(Names(a=1)).rows == ("a: 1",)
    assert preview(Both({1, 2})).rows == ("1", "2")
    assert preview({"all": [Text("abc"), Numbers([1]), Both({3})]}).rows == ("all: ['abc', [1], {3}]",)
    shown = preview(registered(ep.Preview(Text("a" * 99), Text("b"), rows=(Text("c" * 99),))))
    assert (type(shown.text), len(shown.text), shown.detail, len(shown.rows[0])) == (str, 30, "b", 60)
    assert preview(registered(Text("a text"))).text == "a text"


def test_fields_that_are_kept_from_the_repr_are_not_shown():
    @dataclass
    class Login:
        host: str = "cam1"
        password: str = field(default="hunter2", repr=False)

    @dataclass
    class Written:
        password: str = "hunter2"

        def __repr__(self):
            return "Written(***)"

    @dataclass(repr=False)
    class Unwritten:
        password: str = "hunter2"

    class Inheriting(Login):
        def __repr__(self):
            return "Inheriting(***)"

    assert preview(Login()).rows == ("host: 'cam1'",)
    assert preview([Login()]).rows == ("Login(host='cam1')",)
    assert [preview(kind()).text for kind in (Written, Unwritten, Inheriting)] == [
        "Written(***)",
        "Unwritten",
        "Inheriting(***)",
    ]
    assert "hunter2" not in repr([preview(kind()) for kind in (Login, Written, Unwritten, Inheriting)])


def test_a_field_that_is_computed_is_left_out():
    @dataclass(slots=True)
    class Kept:
        x: int = 1

    @dataclass
    class Computed:
        x: int = 1
        y: int = 2

    Computed.x = property(boom, lambda self, value: None)
    assert preview(Kept()).rows == ("x: 1",)
    assert preview(Computed()).rows == ("y: 2",)


# Same object, same bytes


@pytest.mark.slow
def test_sets_and_objects_look_the_same_in_every_process():
    code = (
        "import functools, types, pathlib; from epypes.display.previews.preview import preview\n"
        "class Thing:\n    def method(self): pass\n"
        "def function(): pass\n"
        "names = set('abcdefgh')\n"
        "mixed = {1, 'a', None, 2.5, ('t',), frozenset(names), frozenset('xyz'), Thing}\n"
        "values = [names, frozenset(names), [names], {'k': names}, (names, 1), mixed, types.SimpleNamespace(s=names, o=Thing()),\n"
        "          Thing().method, functools.partial(function), (i for i in names), ValueError(Thing()), ValueError(names), [ValueError(names)], {str(i) for i in range(5000)}]\n"
        "print([(p.text, p.detail, p.rows) for p in map(preview, values)])"
    )
    environment = {**os.environ, "PYTHONHASHSEED": "random"}
    ran = [
        subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, env=environment)
        for _ in range(3)
    ]
    assert len({done.stdout for done in ran}) == 1
    assert " at 0x" not in ran[0].stdout


def test_the_items_of_a_set_stand_in_order():
    assert preview({10, 9, 2, 1}).rows == ("1", "2", "9", "10")
    assert preview(frozenset("hgfedcba")).rows == ("'a'", "'b'", "'c'", "... 5 more")
    assert preview([{3, 1, 2}]).rows == ("{1, 2, 3}",)


# Numbers of every size


@pytest.mark.parametrize(
    "value",
    [
        np.array([[-1.7e308, 1.7e308] * 10] * 20), np.full((20, 20), 3e38, np.float32), np.full((20, 20), 60_000, np.float16),
        np.full((300, 1), 3e38, np.float32), np.array([np.inf, np.nan] * 20, np.float32), np.full(500, 1.7e308),
        np.full(50, np.longdouble("1e4000")), np.full((20, 2), np.longdouble("1e4000")), np.full((20, 20), 5e-324),
        np.full((20, 20), np.longdouble("1e4000")), np.full((5, 2), np.inf), np.full((9, 1, 4), 2**31 - 1, np.int32),
        np.full((20, 20), 1e308 + 1e308j), np.array([[0, 2**64 - 1] * 10] * 20, np.uint64),
    ],
    ids=range(14),
)  # fmt: skip
def test_numpy_does_not_warn_of_numbers_that_are_only_looked_at(value):
    with np.errstate(all="raise"), warnings.catch_warnings():
        warnings.simplefilter("error")
        assert "no p" not in preview(value).detail
        if is_image(value):
            encode_image(value)


@pytest.mark.parametrize(
    ("shape", "order", "dtype"),
    [
        ((1, 3, 1500, 2000), (0, 2, 3, 1), np.float32),
        ((200, 300, 400), (2, 1, 0), np.float32),
        ((4, 3_000_000), (1, 0), np.float32),
        ((3, 1000, 2000), (2, 1, 0), "M8[s]"),
        ((3, 1000, 2000), (2, 1, 0), [("a", "i4"), ("b", "f8")]),
    ],
)
def test_no_large_array_is_copied_to_be_looked_at(shape, order, dtype):
    array = np.zeros(shape, dtype).transpose(order)
    preview(array)
    tracemalloc.start()
    try:
        preview(array)
        assert tracemalloc.get_traced_memory()[1] < array.nbytes / 3
    finally:
        tracemalloc.stop()


def test_a_very_large_mask_is_shown_by_a_sample_and_says_so():
    whole = np.broadcast_to(np.uint8(255), (30_000, 30_000))
    shown = preview(whole)
    assert "of a sample: thin lines may be missing" in shown.detail
    assert pixels(shown.picture, "L").min() == 255
    assert "thin lines" not in preview(np.zeros((3000, 4000), bool)).detail


# Lists that only begin as something else


def test_a_list_that_is_no_list_of_features_after_all_is_shown_as_a_list():
    keypoint, found = cv2.KeyPoint(1, 1, 1), cv2.DMatch(0, 0, 1.0)
    contour = np.zeros((3, 1, 2), np.int32)
    for value in (
        [keypoint] * 150 + ["x"] + [keypoint] * 60,
        [found] * 150 + ["x"] + [found] * 60,
        [[found]] * 150 + [["x"]] + [[found]] * 60,
        [contour] * 150 + [np.zeros((3, 3))] + [contour] * 60,
        [contour] * 150 + [np.zeros((3, 2))] + [contour] * 60,
        [[], []],
    ):
        shown = preview(value)
        assert shown.text == f"list of {len(value)}"
        assert "no p" not in shown.detail
        assert shown.picture is shown.chart is None


def test_two_series_are_no_histogram():
    two = (pd.Series([1, 2, 3], index=list("abc")), pd.Series([1, 2, 3, 4], index=list("abcd")))
    assert preview(two).text == "tuple of 2"
    assert preview((np.arange(3), np.arange(4.0))).text == "3 bins"


# Pictures and charts of a user's own


def picture(**changes: Any) -> Any:
    return replace(encode_image(red_image(40)), **changes)


@pytest.mark.parametrize(
    "data",
    [b"<script>alert(1)</script>", "text", [1, 2], b"", encode_image(red_image(40)).data[:-200]],
    ids=range(5),
)
def test_a_picture_whose_bytes_are_none_is_not_painted(data):
    value = registered(ep.Preview("mine", picture=picture(data=data)))
    shown = preview(value)
    assert shown.picture is None
    assert (shown.text, "no picture: " in shown.detail) == ("mine", True)
    painted = mimebundle(ep.CompGraphRunner(ep.CompGraph({"f": lambda: value}, {"f": ((), "y")})).run())["text/html"]
    assert "<script>alert" not in painted


@pytest.mark.parametrize(
    "changes",
    [{"media_type": 'image/png"/><script>alert(1)</script>'}, {"media_type": "text/html"}, {"media_type": b"image/png"},
     {"width": 0}, {"height": -5}, {"width": float("nan")}, {"width": "40"}],
    ids=range(7),
)  # fmt: skip
def test_the_bytes_of_a_picture_decide_what_it_is(changes):
    assert preview(registered(ep.Preview("mine", picture=picture(**changes)))).picture == encode_image(red_image(40))


def test_a_picture_has_the_size_that_its_file_has():
    shown = preview(registered(ep.Preview("mine", picture=picture(width=3, height=7)))).picture
    assert (shown.width, shown.height) == (40, 40)


def test_a_chart_has_few_series_and_none_without_points():
    shown = preview(
        registered(ep.Preview("mine", chart=Chart("line", (((np.nan, 1), (0, 1)), (), *[((0, 0), (1, 1))] * 10_000))))
    )
    assert len(shown.chart.series) <= 32
    assert all(shown.chart.series)
    assert sum(map(len, shown.chart.series)) <= 128
    assert preview(registered(ep.Preview("mine", chart=Chart("line", ((),) * 10_000)))).chart is None


def test_a_preview_that_shows_the_run_that_it_is_in_ends():
    class Part:
        pass

    called = []

    @ep.register_preview(Part)
    def show(part):
        called.append(part)
        assert ">Part<" in mimebundle(run)["image/svg+xml"]
        return "shown"

    cg = ep.CompGraph({"f": lambda x, z: 0}, {"f": (("x", "z"), "y")})
    run = ep.CompGraphRunner(cg).run(x=Part(), z=Part())
    assert mimebundle(run)["image/svg+xml"].count(">shown<") == 2
    assert len(called) == 2


@pytest.mark.slow
def test_a_graph_without_arrays_is_shown_where_neither_numpy_nor_pillow_is_installed():
    code = (
        "import sys; sys.modules.update(numpy=None, PIL=None, cv2=None)\n"
        "import epypes as ep; from epypes.display import mimebundle\n"
        "cg = ep.CompGraph({'f': lambda x, k: ([x, k], {'x': x})}, {'f': (('x', 'k'), ('y', 'z'))})\n"
        "runner = ep.CompGraphRunner(cg, {'k': 2}); runner.run(x=1.5); shown = mimebundle(runner)\n"
        "assert 'list of 2' in shown['image/svg+xml'] and 'no p' not in shown['image/svg+xml'], shown"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_package_that_is_missing_is_named_where_it_is_used_first(monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    lazy = LazyModule("optuna")
    assert not hasattr(lazy, "__wrapped__"), "looking at a module loads nothing"
    with pytest.raises(MissingPackage, match=r"epypes\[scale\]"):
        lazy.create_study  # noqa: B018


@pytest.mark.parametrize("way", ["preview function", "repr"])
def test_what_a_users_function_shows_of_its_own_run_names_its_values(way):
    shown = []

    class Seen:
        def __repr__(self):
            shown.append(mimebundle(runner)["image/svg+xml"])
            return "seen"

    if way == "preview function":
        ep.register_preview(Seen, repr)
    runner = ep.CompGraphRunner(ep.CompGraph({"f": lambda x: Seen()}, {"f": ("x", "y")}))
    runner.run(x="some text")
    assert "seen" in mimebundle(runner)["image/svg+xml"]
    assert shown, "once, and not without end"
    assert "Seen" in shown[0]
