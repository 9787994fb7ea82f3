"""Which values does a hyperparameter get: those of its hint, its annotation, the table, or its value?"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Annotated, Any

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.errors import UnknownName
from epypes.hints import Roi, Text
from epypes_widgets.controls.ranges import range_text, ranges


def runner_of(function: Callable[..., Any], *inputs: str, **values: Any) -> ep.CompGraphRunner:
    """Return a runner of one function, whose other inputs are payload."""
    return ep.CompGraphRunner(ep.CompGraph({"f": function}, {"f": ((*inputs, *values), "out")}), values)


def found(runner: ep.CompGraphRunner, **hints: Any) -> Mapping[str, Any]:
    return ranges(runner, hints)


def alone(value: Any, name: str = "x") -> Any:
    return found(runner_of(lambda x: x, **{name: value}))[name]


def test_a_hint_comes_before_an_annotation_before_the_table_before_the_value() -> None:
    def soften(image, k, sigma: Annotated[float, ep.Param(0.5, 2.0)], depth, strange):
        return cv2.GaussianBlur(image, (k, k), sigma)

    runner = runner_of(soften, "image", k=11, s=1.0, d=2, strange=7)
    assert {token: param.soft or (param.low, param.high) for token, param in found(runner, d=(0, 5)).items()} == {
        "k": (1, 31),
        "s": (0.5, 2.0),
        "d": (0, 5),
        "strange": (0, 21),
    }
    assert found(runner)["k"].odd
    assert found(runner, k=ep.Param(1, 99))["k"] == ep.Param(1, 99)


def test_two_ends_alone_are_of_odd_numbers_where_a_library_function_takes_no_others() -> None:
    runner = runner_of(lambda im, k: cv2.GaussianBlur(im, (k, k), 0), "image", k=11)
    assert found(runner, k=(1, 99))["k"] == ep.Param(1, 99, odd=True)
    assert found(runner, k=(0, 30))["k"] == ep.Param(0, 30, odd=True)
    assert found(runner, k=(1, 99, 2))["k"] == ep.Param(1, 99, 2)
    assert found(runner, k=[3, 4, 11])["k"].choices == (3, 4, 11)
    even = runner_of(lambda im, k: cv2.GaussianBlur(im, (k, k), 0), "image", k=4)
    assert not found(even, k=(1, 99))["k"].odd, "it holds the value that the runner has"
    assert not found(runner_of(lambda im, k: cv2.blur(im, (k, k)), "image", k=5), k=(1, 99))["k"].odd


def test_the_table_is_asked_for_the_function_itself() -> None:
    ends = found(runner_of(cv2.Canny, "image", lo=70, hi=200))
    assert [param.soft for param in ends.values()] == [(0, 500), (0, 500)]
    assert found(runner_of(cv2.medianBlur, "image", x=5))["x"].odd


@pytest.mark.parametrize("value", [0, 1, 70, 0.0, 0.5, 3.0, np.uint8(200), np.float32(0.5)])
@pytest.mark.parametrize("name", ["x", "sigma", "C", "beta", "angle", "offset", "threshold"])
def test_a_value_that_is_not_negative_is_offered_no_negative_ones(name: str, value: Any) -> None:
    soft = alone(value, name).soft
    assert soft[0] >= 0
    assert soft[0] <= value <= soft[1]
    beta = found(runner_of(lambda im, b: cv2.convertScaleAbs(im, alpha=1, beta=b), "im", b=value))["b"]
    assert beta.soft[0] == 0
    assert beta.low is None, "it may be typed"


def test_sigma_is_never_negative() -> None:
    assert alone(1.0, "sigma").low == 0
    assert found(runner_of(lambda im, s: cv2.GaussianBlur(im, (3, 3), s), "im", s=0))["s"].low == 0


def test_a_range_that_does_not_hold_the_value_is_not_used() -> None:
    even = found(runner_of(lambda im, k: cv2.medianBlur(im, k), "im", k=4))["k"]
    assert not even.odd
    assert even.soft == (0, 12)


def test_a_value_beyond_what_is_usual_widens_what_is_offered() -> None:
    assert alone(45, "ksize").soft == (1, 45)


def test_constants_have_their_names() -> None:
    how = found(runner_of(lambda im, how: cv2.resize(im, (9, 9), interpolation=how), "im", how=1))["how"]
    assert dict(zip(how.labels, how.choices, strict=True))["INTER_LINEAR"] == 1
    assert "INTER_LINEAR" in range_text(how)
    kind = found(runner_of(lambda im, t: cv2.threshold(im, 0, 255, t)[1], "im", t=cv2.THRESH_OTSU))["t"]
    assert dict(zip(kind.labels, kind.choices, strict=True))["THRESH_BINARY_INV|THRESH_OTSU"] == 9


@pytest.mark.parametrize(
    "value",
    [None, object(), np.zeros(1), [1], (1, 2), float("nan"), 10**400, -(10**30), b"x", {}, np.timedelta64(5, "s")],
)
def test_what_no_control_can_move_is_shown(value: Any) -> None:
    assert alone(value) is None
    assert alone(value, "threshold") is None


def test_an_object_that_can_not_be_asked_is_shown() -> None:
    class Odd:
        def __eq__(self, other: object) -> bool:
            raise RuntimeError

        def __hash__(self) -> int:
            raise RuntimeError

    assert alone(Odd()) is None
    with pytest.raises(ValueError, match="soft"):
        found(runner_of(lambda x: x, x=1), x=ep.Param(0, 3, soft=(0, 9)))


def test_an_annotation_that_can_not_be_compared_gives_way_to_that_of_the_next_function() -> None:
    def first(image, mode: Annotated[int, ep.Param(0, 9)]):
        return image

    def second(image, mode: Annotated[str, ep.Param(choices=("fast", "exact"))]):
        return image

    graph = {"f": (("image", "mode"), "a"), "g": (("image", "mode"), "b")}
    runner = ep.CompGraphRunner(ep.CompGraph({"f": first, "g": second}, graph, types=False), {"mode": "fast"})
    assert found(runner)["mode"].choices == ("fast", "exact")


def test_a_text_is_typed_and_a_branch_is_chosen() -> None:
    assert alone("canny") == Text()
    choose = ep.switch("choose", {"canny": "a", "sobel": "b"}, by="method", output="out")
    branches = ep.CompGraph({"f": lambda x: x, "g": lambda x: x}, {"f": ("image", "a"), "g": ("image", "b")})
    assert found(ep.CompGraphRunner(branches | choose, {"method": "canny"}))["method"].choices == ("canny", "sobel")


def test_what_a_switch_chooses_among_comes_before_what_its_name_says() -> None:
    choose = ep.switch("choose", {4: "a", 5: "b"}, by="connectivity", output="out")
    branches = ep.CompGraph({"f": lambda x: x, "g": lambda x: x}, {"f": ("image", "a"), "g": ("image", "b")})
    assert found(ep.CompGraphRunner(branches | choose, {"connectivity": 4}))["connectivity"].choices == (4, 5)


def test_one_is_not_true() -> None:
    def match(cross):
        return cv2.BFMatcher(cv2.NORM_L2, cross)

    assert found(runner_of(match, cross=True))["cross"].choices == (False, True)
    assert found(runner_of(match, cross=1))["cross"].choices is None


def test_a_value_that_the_table_does_not_know_makes_no_threshold_of_an_edge_s_gradient() -> None:
    assert found(runner_of(lambda im, threshold1: cv2.Canny(im, threshold1, 9), "im", t=-5))["t"].cuts == ""


@pytest.mark.parametrize("name", ["roi", "crop_box", "searchWindow", "rect_1"])
def test_four_numbers_called_like_a_rectangle_are_one(name: str) -> None:
    assert alone((1, 2, 30, 40), name) == Roi()
    assert alone([0, 0, 3, 4], name) == Roi()
    assert alone((1, 2, 30), name) is None
    assert alone((1, 2, -3, 4), name) is None


def test_four_numbers_called_otherwise_are_shown() -> None:
    assert alone((1, 2, 30, 40)) is None
    runner = runner_of(lambda x: x, x=(1, 2, 30, 40))
    assert found(runner, x=ep.Roi())["x"] == ep.Roi()


def test_a_rectangle_in_an_annotation_is_on_the_token_of_that_parameter() -> None:
    def cut(picture, part: Annotated[tuple, ep.Roi(on="picture")]):
        return picture

    assert found(runner_of(cut, "image", p=(0, 0, 9, 9)))["p"] == ep.Roi(on="image")


def canny(image: Any, lo: int, hi: int) -> Any:
    return cv2.Canny(image, lo, hi)


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ("lo", "hi"), ("canny_low", "canny_high"), ("minArea", "maxArea"), ("area_min", "area_max"), ("lower", "upper"),
        ("low_threshold", "high_threshold"), ("threshold1", "threshold2"), ("canny_lo_1", "canny_hi_1"), ("a", "b"),
    ],
)  # fmt: skip
def test_two_ends_of_a_range_are_a_pair_by_their_names_or_their_parameters(low: str, high: str) -> None:
    ends = found(runner_of(canny, "image", **{low: 70, high: 200}))
    assert [param.below for param in ends.values()] == [high, ""]
    assert found(runner_of(cv2.Canny, "image", p=70, q=200))["p"].below == "q"


@pytest.mark.parametrize(
    ("values", "hints"),
    [
        ({"lo": 200, "hi": 70}, {}),
        ({"lo": 70, "hi": 200.0}, {}),
        ({"lo": None, "hi": 200}, {}),
        ({"lo": 70, "hi": 200}, {"lo": (0, 255)}),
        ({"lo": 70, "hi": 200}, {"hi": (0, 255)}),
    ],
)
def test_others_are_no_pair(values: dict[str, Any], hints: dict[str, Any]) -> None:
    assert not any(param and param.below for param in found(runner_of(canny, "im", **values), **hints).values())


def test_ends_that_go_into_different_functions_are_no_pair() -> None:
    cg = ep.CompGraph(
        {"f": lambda im, k: im, "g": lambda im, k: im}, {"f": (("im", "lo"), "a"), "g": (("a", "hi"), "b")}
    )
    assert found(ep.CompGraphRunner(cg, {"lo": 1, "hi": 2}))["lo"].below == ""


def test_a_hint_makes_a_pair_and_is_refused_where_there_can_be_none() -> None:
    runner = runner_of(lambda im, a, b, c: im, "im", a=1, b=5, c="x")
    assert found(runner, a=ep.Param(0, 9, below="b"))["a"].below == "b"
    for below in ("c", "a"):
        with pytest.raises(ValueError, match=f"hinted to stay below '{below}'"):
            found(runner, a=ep.Param(0, 9, below=below))
    with pytest.raises(UnknownName, match="Did you mean"):
        found(runner_of(lambda im, first, last: im, "im", first=1, last=5), first=ep.Param(0, 9, below="lastt"))
    with pytest.raises(UnknownName):
        found(runner, a=ep.Param(0, 9, cuts="imm"))


def test_an_annotation_makes_a_pair_by_its_parameters() -> None:
    def between(image, small: Annotated[int, ep.Param(0, 255, below="large", cuts="image")], large):
        return image

    small = found(runner_of(between, "photo", s=1, t=9))["s"]
    assert (small.below, small.cuts) == ("t", "photo")
    assert found(runner_of(between, "photo", s=9, t=9.5))["s"].below == ""


def compared(image: Any, brightness: int) -> Any:
    return image > brightness


def checked(image: Any, brightness: int, most: int = 9) -> Any:
    return image > brightness if brightness < most else image


def named(picture: Any, threshold: int) -> Any:
    return [corner for corner in cv2.ORB.create().detect(picture) if corner.response > threshold]


@pytest.mark.parametrize(
    ("function", "inputs", "cuts"),
    [
        (compared, ["photo"], "photo"),
        (checked, ["photo"], "photo"),
        (named, ["photo"], ""),
        (lambda im, t: cv2.threshold(im, t, 255, cv2.THRESH_BINARY)[1], ["photo"], "photo"),
        (lambda im, threshold1: cv2.Canny(im, threshold1, 200), ["photo"], ""),
        (lambda im, k: cv2.medianBlur(im, k), ["photo"], ""),
    ],
)
def test_a_threshold_says_which_token_it_cuts(function: Callable[..., Any], inputs: list[str], cuts: str) -> None:
    assert found(runner_of(function, *inputs, level_of_it=101))["level_of_it"].cuts == cuts
    assert found(runner_of(cv2.inRange, "photo", lo=1, hi=9))["lo"].cuts == "photo"


def test_what_is_compared_with_an_image_is_a_threshold_whatever_it_is_called() -> None:
    assert found(runner_of(compared, "photo", brightness=100))["brightness"].soft == (0, 255)
    assert found(runner_of(compared, "photo", brightness=0.5))["brightness"].soft == (0.0, 1.0)


@pytest.mark.parametrize(
    ("param", "words"),
    [
        (ep.Param(1, 31, odd=True), "odd 1 to 31"),
        (ep.Param(0), "from 0"),
        (ep.Param(high=9), "up to 9"),
        (ep.Param(), "any number"),
        (ep.Param(choices=("a", "b")), "one of 'a', 'b'"),
        (ep.Param(choices=(1, 2), labels=("ONE", "TWO")), "one of ONE, TWO"),
        (ep.Roi(), "x, y, width, height in pixels"),
        (Text(), "any text"),
    ],
)
def test_a_range_is_told_in_words(param: Any, words: str) -> None:
    assert range_text(param) == words
