"""What does a tooltip say of a hyperparameter?"""

from __future__ import annotations

from functools import partial
from typing import Any

import cv2
import pytest
from skimage import filters

import epypes as ep
from epypes_widgets.controls.ranges import ranges
from epypes_widgets.controls.tooltips import tooltip


def documented(image: Any, side: int, low: int, high: int, other: int) -> Any:
    """Blur the image.

    Much could be said here.

    Parameters
    ----------
    image : array
        The photograph.
    side : int, optional
        side of the window,
        in pixels

        This is a paragraph of its own.
    low, high
        Both ends.

    Returns
    -------
    other
        Not a parameter.
    """
    return image


def said(function: Any, token: str = "x", param: Any = None, **more: Any) -> str:
    inputs = ("image", token, *more)
    cg = ep.CompGraph({"f": function}, {"f": (inputs, "out")})
    return tooltip(cg, token, param)


def all_said(token: str, param: Any = None) -> str:
    cg = ep.CompGraph({"f": documented}, {"f": (("im", "s", "l", "h", "o"), "out")})
    return tooltip(cg, token, param)


def test_the_docstring_of_the_function_says_what_a_parameter_is() -> None:
    assert all_said("s") == "Side of the window, in pixels."
    assert all_said("l") == all_said("h") == "Both ends."
    assert all_said("o") == "Blur the image."


@pytest.mark.parametrize(
    "text",
    [
        "Blur.\n\nArgs:\n    x (int): the side\n        of it.\n\n        More.\n    y: Other.",
        "Blur.\n\n:param x: the side\n    of it.\n:type x: int\n:param y: Other.",
        "Blur.\n\n@param x: the side\n    of it.\n@param y: Other.",
    ],
    ids=["Google", "Sphinx", "Epydoc"],
)
def test_docstrings_of_other_styles_are_read(text: str) -> None:
    def blur(image: Any, x: int) -> Any:
        return image

    blur.__doc__ = text
    assert said(blur) == "The side of it."


def test_the_hint_says_it_where_the_docstring_does_not() -> None:
    assert all_said("o", ep.Param(about="one of many", choices=("a", "b"))) == "One of many. One of 'a', 'b'."
    assert all_said("s", ep.Param(about="one of many")) == "Side of the window, in pixels."


@pytest.mark.parametrize(
    ("param", "facts"),
    [
        (ep.Param(1, 31, odd=True, unit="px"), "Odd 1 to 31 px."),
        (ep.Param(0, soft=(0, 10), unit="px"), "From 0, usually 0 to 10 px."),
        (ep.Param(soft=(0, 10)), "Usually 0 to 10."),
        (ep.Param(0, 10, soft=(0, 10)), "0 to 10."),
        (ep.Roi(), "X, y, width, height in pixels."),
        (None, ""),
    ],
)
def test_unit_and_range_are_told_in_words(param: Any, facts: str) -> None:
    assert said(lambda image, x: image, param=param) == facts


def test_what_the_libraries_say_is_read_too() -> None:
    assert said(cv2.medianBlur, "k").startswith("Aperture linear size; it must be odd and greater than 1")
    assert said(filters.gaussian, "s").startswith("Standard deviation for Gaussian kernel.")
    assert said(partial(documented, low=1, high=2, other=3), "s").startswith("Side of the window")


def test_a_tip_is_one_short_line_of_text() -> None:
    def long(image, x):
        pass

    long.__doc__ = "A <b>word</b>\t" + "and another " * 100
    text = said(long, param=ep.Param(1, 31, odd=True, unit="px"))
    assert len(text) == 300
    assert "\n" not in text
    assert text.endswith("… Odd 1 to 31 px.")
    assert len(said(long, param=ep.Param(choices=tuple(range(1000))))) <= 300


def test_odd_functions_have_tips_too() -> None:
    class Callable:
        __doc__ = 3  # type: ignore[assignment]

        def __call__(self, image: Any, x: int) -> Any:
            return image

    def odd(image: Any, x: int) -> Any:
        return image

    assert said(Callable()) == ""
    odd.__doc__ = ": :\n:type x"  # the parser of docstrings raises IndexError
    assert said(odd) == ""
    assert said(cv2.Canny, "p", None, q=1, edges=2, sizes=3).startswith("First threshold")
    cg = ep.CompGraph({"f": lambda x: x}, {"f": ("x", "y")})
    assert tooltip(cg, "x", ranges(ep.CompGraphRunner(cg, {"x": 70}), {})["x"]) == "Usually 0 to 210."
