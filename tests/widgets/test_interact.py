"""One line makes a panel of plain functions: the graph and the runner are made inside, and errors say the way out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Annotated, Any, Literal

import cv2
import ipywidgets
import numpy as np
import pytest

import epypes as ep
from epypes.errors import GraphError, HyperparameterError, PayloadError, UnknownName
from epypes_widgets import Panel, interact, tune


def blur_and_canny(image, low, high=200, sigma=2.0, side: Annotated[int, ep.Param(1, 31, odd=True)] = 5):
    return cv2.Canny(cv2.GaussianBlur(image, (side, side), sigma), low, high)


def bright(image, gain=2):
    return cv2.multiply(image, gain)


@ep.outputs("mask")
def above(bright, level: Annotated[int, ep.Param(1, 31, odd=True)]):
    return bright > level


@pytest.fixture
def made() -> Iterator[Callable[[Panel], Panel]]:
    """Closes the panels that it was called with."""
    panels: list[Panel] = []

    def keep(panel: Panel) -> Panel:
        panels.append(panel)
        return panel

    yield keep
    for panel in panels:
        panel.close(10)


def test_one_line_tunes_one_function(image: Any, made: Callable[[Panel], Panel]) -> None:
    panel = made(interact(blur_and_canny, image, low=(0, 255), sigma=1.5))
    assert panel.token == "blur_and_canny"
    assert panel.values == {"low": 127, "high": 200, "sigma": 1.5, "side": 5}
    panel["low"] = 60
    panel.wait(60)
    np.testing.assert_array_equal(panel.result["blur_and_canny"], blur_and_canny(image, 60, sigma=1.5))
    assert panel.runner["low"] == 60
    assert panel.code() == "panel.runner.rerun(low=60)"
    with pytest.raises(ValueError, match="range is 0 to 255"):
        panel["low"] = 300
    with pytest.raises(ValueError, match="odd 1 to 31"):
        panel["side"] = 4


def test_a_list_of_functions_is_joined_by_the_names_of_their_parameters(
    image: Any, made: Callable[[Panel], Panel]
) -> None:
    for panel in (made(interact([bright, above], image, gain=(1, 4))), made(tune([bright, above], image=image))):
        assert dict(panel.runner.cg.func_io) == {
            "bright": (("image", "gain"), "bright"),
            "above": (("bright", "level"), "mask"),
        }
        assert panel.values == {"gain": 2, "level": 17}
        assert panel.token == "mask"


@pytest.mark.parametrize(
    ("given", "value", "outside"),
    [
        ((0, 255), 100, 256),  # the parameter's default, where it is allowed
        ((0, 50), 50, 51),  # the nearest allowed value
        ((0.0, 200.0), 100.0, 201.0),
        ((0, 255, 10), 100, 256),
        ([1, 2, 3], 1, 4),
        (range(0, 256, 50), 100, 4),
        ({"few": 1, "many": 100}, 100, 2),
        (ep.Param(1, 31, odd=True), 31, 30),
        (ep.Param(0.001, 0.1, log=True), 0.1, 0.2),
        (7, 7, None),
        (True, True, 2),
        ("text", "text", 2),
        (np.float32(0.5), np.float32(0.5), None),
    ],
)
def test_an_abbreviation_is_a_value_a_range_or_choices(
    given: Any, value: Any, outside: Any, made: Callable[[Panel], Panel]
) -> None:
    panel = made(interact(first_and_level, 1, level=given))
    assert panel.values == {"level": value}
    assert type(panel["level"]) is type(value)
    if outside is not None:
        with pytest.raises(ValueError, match="can't be"):
            panel["level"] = outside


def test_a_range_of_a_kernel_begins_at_an_odd_number_and_stays_odd(made: Callable[[Panel], Panel]) -> None:
    def blur(image, k):
        return cv2.GaussianBlur(image, (k, k), 0)

    panel = made(interact(blur, np.zeros((40, 40), np.uint8), k=(1, 31)))
    assert panel["k"] % 2 == 1
    with pytest.raises(ValueError, match="odd 1 to 31"):
        panel["k"] = 16


def first_and_level(image, level=100):
    return image, level


def test_a_parameter_without_default_begins_where_its_annotation_or_its_range_has_its_middle(
    made: Callable[[Panel], Panel],
) -> None:
    def f(
        image,
        how: Literal["dark", "bright"],
        flag: bool,
        gamma: Annotated[float, ep.Param(0.1, 10, log=True)],
        low,
        step,
        share,
    ):
        return how, flag, gamma, low, step, share

    panel = made(interact(f, 1, low=(0, 255), step=(0, 100, 20), share=(0.0, 1.0)))
    assert panel.result["f"] == ("dark", False, 1.0, 127, 40, 0.5)


def test_arrays_and_fixed_values_are_payload_and_have_no_control(image: Any, made: Callable[[Panel], Panel]) -> None:
    def f(image, kernel=None, ksize=(3, 3), sigma=1.0):
        return cv2.GaussianBlur(cv2.erode(image, kernel), ksize, sigma)

    panel = made(interact(f, image, kernel=np.ones((5, 5), np.uint8), ksize=ipywidgets.fixed((9, 9))))
    assert panel.values == {"sigma": 1.0}
    assert panel.runner.free_source_tokens == ("image", "kernel", "ksize")
    np.testing.assert_array_equal(panel.result["f"], f(image, np.ones((5, 5), np.uint8), (9, 9)))


def test_an_image_among_the_values_that_a_function_returns_is_shown(image: Any, made: Callable[[Panel], Panel]) -> None:
    def count(image, level=100):
        return image > level, int((image > level).sum())

    panel = made(interact(count, image))
    assert panel.token == "count_1"
    assert panel.result["count_2"] == count(image)[1]


def test_a_dict_that_a_function_returns_is_shown_in_the_place_of_its_image(
    image: Any, made: Callable[[Panel], Panel]
) -> None:
    def measures(image, level=100):
        return {"share": float((image > level).mean())}

    assert made(interact(measures, image)).token == "measures"


def test_functions_can_be_tuned_on_several_images(image: Any, made: Callable[[Panel], Panel]) -> None:
    panel = made(tune([bright, above], images=[image, 255 - image], level=(0, 255), token="bright"))
    assert panel.values == {"gain": 2, "level": 127}
    np.testing.assert_array_equal(panel.runner["image"], image)


def args(*images: Any) -> Any:
    return images


def by_name(image: Any, *, low: int = 3) -> Any:
    return image


def plain(image: Any) -> Any:
    return image


@pytest.mark.parametrize(
    ("call", "error", "text"),
    [
        (lambda: interact(lambda image, level=3: image, 1), GraphError, "A lambda has no name.*Write it as a function"),
        (lambda: interact(args, 1), TypeError, r"'args' takes \*images.*Write a function \(def\) that names each"),
        (lambda: interact(by_name, 1, low=(0, 9)), TypeError, "'low' of 'by_name' is given by its name.*Take the"),
        (lambda: interact(cv2.Canny, 1), GraphError, "no signature. Write a function"),
        (lambda: interact(plain, 1), ValueError, r"no parameter of 'plain' is left.*def f\(image, threshold=100\)"),
        (lambda: interact([], 1), ValueError, "No function is given"),
        (lambda: interact("f", 1), GraphError, "A graph is made of functions, not of 'str'"),
        (lambda: interact(ep.Pipeline("p", ep.CompGraph.from_functions(plain)), 1), TypeError, r"tune\(runner\)"),
        (lambda: interact(blur_and_canny, None, low=3), ValueError, "'image' is None.*Was the file found"),
        (lambda: interact(blur_and_canny, 1, lov=(0, 9)), UnknownName, "No parameter 'lov'.*Did you mean 'low'"),
        (lambda: interact(blur_and_canny, 1), PayloadError, r"interact\(blur_and_canny, image, low=\(low, high\)\)"),
        (lambda: tune(blur_and_canny, low=3), PayloadError, r"'image'.*tune\(blur_and_canny, image=image\)"),
        (lambda: interact(blur_and_canny, 1, 2, low=3), PayloadError, "by position and by name"),
        (lambda: interact(blur_and_canny, 1, 2, 3, 4, 5, 6), PayloadError, "6 values .* image, low, high, sigma, side"),
        (lambda: interact([bright, above], 1, bright=3), HyperparameterError, "computed by the functions"),
        (lambda: interact(blur_and_canny, 1, low=(9, 3)), ValueError, "Hint of 'low'.*Exchange them"),
        (lambda: interact(blur_and_canny, 1, low=(3, 3)), ValueError, r"nothing to move.*fixed\(\(3, 3\)\)"),
        (lambda: interact(blur_and_canny, 1, low=ipywidgets.IntSlider()), TypeError, r"widget \(IntSlider\).*\(low, h"),
    ],
)  # fmt: skip
def test_what_can_not_work_is_refused_with_the_way_out(
    call: Callable[[], Any], error: type[Exception], text: str
) -> None:
    with pytest.raises(error, match=text):
        call()


def test_the_runner_of_a_panel_can_be_had(panel: Panel, runner: ep.CompGraphRunner) -> None:
    assert panel.runner is runner
