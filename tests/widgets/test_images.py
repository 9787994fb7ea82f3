"""Which payloads does a panel take?"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import epypes as ep
from epypes.errors import PayloadError, UnknownName
from epypes_widgets.picture.images import payloads
from tests.colours import red_image, red_runner


def single() -> ep.CompGraphRunner:
    cg = ep.CompGraph({"add": lambda image, n: image + n}, {"add": (("image", "n"), "sum")})
    return ep.CompGraphRunner(cg, {"n": 1})


def double() -> ep.CompGraphRunner:
    cg = ep.CompGraph({"add": lambda left, right, n: left + right + n}, {"add": (("left", "right", "n"), "sum")})
    return ep.CompGraphRunner(cg, {"n": 1})


def gray(level: int = 90) -> Any:
    return np.full((48, 64), level, np.uint8)


def test_images_are_values_of_the_one_free_source_token() -> None:
    runner, images = single(), [gray(1), gray(2)]
    found = payloads(runner, images)
    assert [payload.title for payload in found] == ["image 1", "image 2"]
    assert [payload.values["image"] for payload in found] == images
    assert int(runner.run(**found[1].values)["sum"].max()) == 3


def test_mappings_give_a_value_for_each_free_source_token() -> None:
    (found,) = payloads(double(), [{"right": gray(2), "left": gray(1)}])
    assert list(found.values) == ["left", "right"]
    assert int(double().run(**found.values)["sum"].max()) == 4
    (found,) = payloads(single(), [{"image": gray(5)}])
    assert int(found.values["image"].max()) == 5


def test_a_generator_is_read_as_a_list() -> None:
    assert len(payloads(single(), (gray(level) for level in range(3)))) == 3


def test_files_are_called_by_their_names() -> None:
    cg = ep.CompGraph({"read": lambda path: None}, {"read": ("path", "image")})
    found = payloads(ep.CompGraphRunner(cg), ["/images/coins.png", Path("far") / "moon.png", 3])
    assert [payload.title for payload in found] == ["coins.png", "moon.png", "path 3"]
    assert {payload.thumbnail for payload in found} == {b""}


@pytest.mark.parametrize(
    "image",
    [
        np.random.default_rng(0).integers(0, 255, (300, 400, 3), np.uint8),
        np.random.default_rng(0).integers(0, 255, (300, 400, 4), np.uint8),
        np.eye(200) > 0,
        np.full((300, 40), np.nan),
        np.arange(90_000, dtype=np.int32).reshape(300, 300) // 20_000,
        gray(),
    ],
)
def test_a_thumbnail_is_a_small_picture_whatever_the_image_is(image: Any) -> None:
    (found,) = payloads(single(), [image])
    picture = Image.open(io.BytesIO(found.thumbnail))
    assert picture.format in ("JPEG", "PNG")
    assert max(picture.size) <= 96
    assert len(found.thumbnail) <= 5_000


def test_a_thumbnail_has_its_tokens_colours() -> None:
    (found,) = payloads(red_runner(), [red_image()])
    red, green, blue = Image.open(io.BytesIO(found.thumbnail)).convert("RGB").getpixel((20, 20))
    assert red > 150 > 60 > max(green, blue)


@pytest.mark.parametrize("images", [gray(), "coins.png", b"", Path("coins.png"), {"image": gray()}, 3, None])
def test_what_is_no_list_is_refused_with_the_way_out(images: Any) -> None:
    with pytest.raises(TypeError, match=r"images=\[...\]"):
        payloads(single(), images)


@pytest.mark.parametrize("images", [[], iter([])])
def test_an_empty_list_is_refused(images: Any) -> None:
    with pytest.raises(ValueError, match="empty"):
        payloads(single(), images)


def test_an_image_alone_does_not_tell_which_of_two_tokens_it_is() -> None:
    with pytest.raises(PayloadError, match="'left', 'right'") as caught:
        payloads(double(), [{"left": gray(), "right": gray()}, gray()])
    assert caught.value.tokens == ("left", "right")
    assert "images[1]" in str(caught.value)


def test_names_that_are_no_free_source_tokens_are_refused() -> None:
    with pytest.raises(UnknownName, match="Did you mean 'image'"):
        payloads(single(), [{"imgae": gray()}])
    with pytest.raises(PayloadError, match="'n', which is not a free source token"):
        payloads(single(), [{"image": gray(), "n": 3}])


def test_a_token_without_value_is_named() -> None:
    with pytest.raises(PayloadError, match="no value for 'right'") as caught:
        payloads(double(), [{"left": gray()}])
    assert caught.value.tokens == ("right",)


def test_a_graph_that_takes_nothing_takes_no_images() -> None:
    cg = ep.CompGraph({"add": lambda n: n + 1}, {"add": ("n", "sum")})
    with pytest.raises(PayloadError, match="no free source token"):
        payloads(ep.CompGraphRunner(cg, {"n": 1}), [gray()])
