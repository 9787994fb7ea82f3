"""A parameter's usual values are found by the function, by what a function does with it, and by its name."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, wraps
from typing import Any

import cv2
import cv2 as cv
import numpy as np
import pytest
import skimage
from cv2 import GaussianBlur as soften
from skimage import filters
from skimage.feature import canny as find_edges

from epypes.catalog import CatalogEntry, entry_of, parameter_names, table, uses, usual

BLUR = "GaussianBlur"


def entry(function: str, parameter: str) -> CatalogEntry:
    return next(entry for entry in table() if (entry.function, entry.parameter) == (function, parameter))


@pytest.mark.parametrize(
    ("function", "parameter", "found"),
    [
        (cv2.Canny, "threshold1", "Canny"),
        (cv2.ORB_create, "nlevels", "ORB_create"),
        (cv2.ORB.create, "nlevels", "ORB_create"),
        (cv2.BFMatcher, "crossCheck", "BFMatcher_create"),
        (partial(cv2.Canny), "threshold1", "Canny"),
        (skimage.filters.gaussian, "sigma", "filters.gaussian"),
        (find_edges, "sigma", "feature.canny"),
        (skimage.feature.ORB, "n_keypoints", "feature.ORB"),
    ],
)
def test_a_function_is_known_by_object(function: Any, parameter: str, found: str) -> None:
    assert entry_of(function, parameter) is entry(found, parameter)


def gaussian(image: Any, sigma: float) -> Any:
    return image


@pytest.mark.parametrize("function", [gaussian, len, np.sort, object(), "Canny", None, lambda sigma: sigma])
def test_another_function_of_the_same_name_is_not_known(function: Any) -> None:
    assert entry_of(function, "sigma") is None


class Hostile:
    @property
    def __signature__(self) -> Any:
        raise RuntimeError

    def __call__(self, image: Any) -> Any:
        return image


def by_module(image: Any, k: int) -> Any:
    return cv.GaussianBlur(image, (k, k), 0)


def by_name(image: Any, k: int) -> Any:
    return soften(image, ksize=(int(k), 1), sigmaX=0)


def by_list(image: Any, k: int) -> Any:
    return soften(image, [k, k], 0)


def imported_inside(image: Any, k: int) -> Any:
    import cv2 as vision
    from cv2 import GaussianBlur as also

    return also(image, (k, k), 0) + vision.blur(image, (3, 3))


def converted(image: Any, k: float) -> Any:
    k = int(k)
    return cv2.GaussianBlur(image, (k, k), 0)


def through_another(picture: Any, side: int) -> Any:
    return by_module(picture, side)


def enclosed() -> Callable[..., Any]:
    blur, mask = cv2.GaussianBlur, np.ones((3, 3))
    return lambda image, k: blur(image, (k, k), 0) * mask


@wraps(by_module)
def decorated(*args: Any) -> Any:
    return by_module(*args)


class Blurs:
    def method(self, image: Any, k: int) -> Any:
        return cv2.GaussianBlur(image, (k, k), 0)


in_a_table = {"a": lambda image, size: image, "b": lambda image, k: cv2.GaussianBlur(image, (k, k), 0)}


@pytest.mark.parametrize(
    "function",
    [
        by_module,
        by_name,
        by_list,
        imported_inside,
        converted,
        enclosed(),
        decorated,
        Blurs().method,
        partial(by_module, k=3),
        in_a_table["b"],
    ],
)
def test_what_a_function_hands_on_is_found_however_it_was_imported(function: Callable[..., Any]) -> None:
    assert [use.entry for use in uses(function, "k")] == [entry(BLUR, "ksize")]


def test_what_a_function_hands_to_another_of_the_user_is_found() -> None:
    assert [use.entry for use in uses(through_another, "side")] == [entry(BLUR, "ksize")]


@pytest.mark.parametrize(
    ("function", "names"),
    [
        (cv2.medianBlur, ("src", "ksize", "dst")),
        (cv2.BFMatcher, ("normType", "crossCheck")),
        (gaussian, ("image", "sigma")),
        (partial(gaussian, 1), ("sigma",)),
        (filters.unsharp_mask, ("image", "radius", "amount", "preserve_range")),
        (Blurs().method, ("image", "k")),
        (decorated, ("image", "k")),
        (object(), ()),
        (Hostile(), ()),
    ],
)
def test_the_parameters_of_c_functions_are_known_too(function: Any, names: tuple[str, ...]) -> None:
    assert parameter_names(function) == names


def changed(image: Any, k: int) -> Any:
    k = 2 * k + 1
    return cv2.GaussianBlur(image, (k, k), 0)


def computed(image: Any, k: int) -> Any:
    return cv2.GaussianBlur(image, (2 * k + 1, 2 * k + 1), 0)


def around_itself(image: Any, k: int) -> Any:
    return around_itself(image, k) if k else image


def behind_a_star(image: Any, k: int) -> Any:
    rest = ((3, 3), 0)
    return cv2.GaussianBlur(image, *rest, k)


made_elsewhere: dict[str, Any] = {}
exec("def f(image, k):\n    return cv2.GaussianBlur(image, (k, k), 0)", {"cv2": cv2}, made_elsewhere)


@pytest.mark.parametrize(
    "function", [changed, computed, around_itself, behind_a_star, made_elsewhere["f"], cv2.Canny, object(), None]
)
def test_what_a_function_computes_first_says_nothing(function: Any) -> None:
    assert uses(function, "k") == ()


def above(image: Any, bright: int) -> Any:
    return image > bright


def cut(picture: Any, t: int) -> Any:
    return cv2.threshold(picture, t, 255, cv2.THRESH_BINARY)[1]


def test_a_threshold_tells_what_it_cuts() -> None:
    assert [(use.entry, use.cuts) for use in uses(above, "bright")] == [(None, "image")]
    assert [(use.entry, use.cuts) for use in uses(cut, "t")] == [(entry("threshold", "thresh"), "picture")]


@pytest.mark.parametrize(
    ("name", "value", "soft"),
    [
        ("ksize", 11, (1, 31)),
        ("blur_kernel", 11, (1, 31)),
        ("blockSize_1", 5, (1, 101)),
        ("sigma", 1.5, (0.0, 10.0)),
        ("sigma", 2, (0, 10)),
        ("canny_sigma", 2.0, (0.0, 10.0)),
        ("threshold", 100, (0, 255)),
        ("threshold", 0.4, (0.0, 1.0)),
        ("threshold", 1, (0, 255)),
        ("nfeatures", 500, (0, 5000)),
        ("n_features", 500, (0, 5000)),
        ("clip_limit", 0.02, (0.0, 0.1)),
        ("clipLimit", 3.0, (0.0, 40.0)),
    ],
)
def test_a_name_says_what_is_usual(name: str, value: Any, soft: Any) -> None:
    found = usual(name, value)
    assert (found and found.soft) == soft


@pytest.mark.parametrize(
    ("name", "value"),
    [("ksize", 10), ("ksize", 3.0), ("sigma", -1), ("k", 3), ("type", 1), ("n", 3), ("h", 5), ("anything", 3), ("", 1)],
)
def test_a_name_that_does_not_fit_or_means_several_things_says_nothing(name: str, value: Any) -> None:
    assert usual(name, value) is None


def test_choices_are_found_by_name_where_all_functions_agree() -> None:
    assert usual("connectivity", 8).choices == (4, 8)
    assert usual("connectivity", 1).choices == (1, 2)
    assert usual("crossCheck", True).choices == (False, True)
    assert usual("crossCheck", 1) is None
    assert usual("normType", cv2.NORM_HAMMING).labels[2] == "NORM_HAMMING"
