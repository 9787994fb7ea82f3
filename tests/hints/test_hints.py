from __future__ import annotations

import enum
import functools
from typing import Annotated, Literal

import annotated_types
import pytest

import epypes as ep
from epypes import Param, Roi
from epypes.graph import annotated_params
from epypes.hints import as_param, param_from_value


class Method(enum.Enum):
    CANNY = 1
    SOBEL = 2


def annotated_param(function, position, count=None):
    """The range of the token at a position of a function's io."""
    tokens = tuple(f"token_{place}" for place in range(count or position + 1))
    return next(annotated_params(ep.CompGraph({"f": function}, {"f": (tokens, "out")}), tokens[position]), None)


def annotated(
    a: Annotated[int, Param(1, 31, odd=True)],
    b: Annotated[float, annotated_types.Interval(ge=0, le=1)],
    c: Annotated[int, annotated_types.Ge(2), annotated_types.Le(8), annotated_types.MultipleOf(2)],
    d: Literal["x", "y"],
    e: Method,
    f: bool,
    g: int,
    h=3,
): ...


@pytest.mark.parametrize(
    ("position", "expected"),
    [
        (0, Param(1, 31, odd=True)),
        (1, Param(0, 1)),
        (2, Param(2, 8, 2)),
        (3, Param(choices=("x", "y"))),
        (4, Param(choices=(Method.CANNY, Method.SOBEL))),
        (5, Param(choices=(False, True))),
        (6, None),
        (7, None),
    ],
)
def test_annotations_say_the_range(position, expected):
    assert annotated_param(annotated, position, 8) == expected


@pytest.mark.parametrize("function", [len, print, int, lambda x: x])
def test_functions_without_annotations_say_nothing(function):
    assert annotated_param(function, 0) is None


@pytest.mark.parametrize(
    ("value", "low", "high"),
    [(70, 0, 210), (0, 0, 10), (-5, -15, 0), (0.5, 0.0, 1.5), (0.0, 0.0, 1.0), (-2.0, -6.0, 0.0)],
)
def test_a_value_that_is_not_negative_never_gets_a_negative_range(value, low, high):
    param = param_from_value(value)
    assert (param.low, param.high) == (low, high)
    assert param.allows(value)


@pytest.mark.parametrize("value", ["text", None, (1, 2), [1], float("inf"), float("nan"), object()])
def test_some_values_say_nothing(value):
    assert param_from_value(value) is None


def test_tuples_are_ranges_and_lists_are_choices():
    assert as_param((0, 255)) == Param(0, 255)
    assert as_param((0.0, 1.0, 0.1)) == Param(0.0, 1.0, 0.1)
    assert as_param(["a", "b"]) == Param(choices=("a", "b"))
    assert as_param("abc") is None
    assert as_param((1, 2, 3, 4)) is None


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"low": 3, "high": 1}, "Exchange them"),
        ({"choices": ()}, "There are no choices"),
        ({"step": 0}, "step must be positive"),
        ({"low": 0, "high": 1, "log": True}, "positive low"),
        ({"low": 2, "high": 2, "odd": True}, "no odd value"),
        ({"labels": ("A",)}, "Give choices too"),
        ({"choices": (1, 2), "labels": ("A",)}, "Name each choice once"),
        ({"choices": (1, 2), "below": "hi"}, "below is for a range"),
        ({"choices": (1, 2), "cuts": "image"}, "cuts is for a range"),
        ({"soft": (3, 1)}, "Exchange them"),
        ({"low": 0, "high": 9, "soft": (0, 10)}, "Narrow it"),
    ],
)
def test_a_hint_that_allows_nothing_is_refused(settings, words):
    with pytest.raises(ValueError, match=words):
        Param(**settings)


def test_a_hint_says_what_it_allows():
    assert Param(1, 31, odd=True).allows(11)
    assert not Param(1, 31, odd=True).allows(12)
    assert not Param(1, 31).allows(0)
    assert not Param(1, 31).allows(32)
    assert Param(choices=("a",)).allows("a")
    assert not Param(choices=("a",)).allows("b")


def test_a_rectangle_is_four_integers_none_of_them_negative():
    assert Roi().allows((0, 0, 10, 20))
    assert Roi("image").allows([1, 2, 3, 4])
    for value in ((1, 2, 3), (1, 2, -3, 4), (1.0, 2, 3, 4), (True, 2, 3, 4), "1234", None, 7):
        assert not Roi().allows(value)
    assert as_param(Roi("image")) == Roi("image")


def test_an_annotation_may_be_a_rectangle():
    def cut(image, part: Annotated[tuple, Roi("image")]): ...

    assert annotated_param(cut, 1) == Roi("image")


def test_a_method_a_cached_function_and_a_node_say_the_range_of_what_they_call():
    class Filter:
        def blur(self, image, k: Annotated[int, Param(1, 31, odd=True)]): ...

    for function in (Filter().blur, functools.lru_cache(Filter().blur), ep.Node("blur", Filter().blur)):
        assert annotated_param(function, 1) == Param(1, 31, odd=True)
        assert annotated_param(function, 0, 2) is None
