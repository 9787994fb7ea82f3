"""What does a saved notebook show without a kernel, and is it small and safe?"""

from __future__ import annotations

import base64
import re
from html.parser import HTMLParser
from typing import Any

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes_widgets.picture.frames import thumbnail
from epypes_widgets.picture.static import static_html
from tests.colours import red_image, red_runner


def shown(value: Any, values: dict[str, Any] | None = None, defaults: dict[str, Any] | None = None, **rest: Any) -> str:
    run = ep.CompGraphRunner(ep.CompGraph({"f": lambda x: x}, {"f": ("x", "y")})).run(x=value)
    return static_html(run, "y", values or {}, defaults or {}, **rest)


def picture(html: str) -> Any:
    found = re.search(r'src="data:image/\w+;base64,([^"]+)"', html)
    assert found is not None
    return cv2.imdecode(np.frombuffer(base64.b64decode(found[1]), np.uint8), cv2.IMREAD_COLOR)


def test_the_last_picture_and_the_values_are_there(runner: ep.CompGraphRunner) -> None:
    run = runner.rerun(gain=3)
    html = static_html(
        run, "mask", run.hyperparameters, run.first_hyperparameters, image="ramp", code="runner.rerun(gain=3)"
    )
    assert html.startswith('<figure class="epypes-static"')
    assert html.endswith("</figure>")
    assert 'alt="mask of ramp: uint8 48 x 64' in html
    np.testing.assert_array_equal(picture(html)[:, :, 0], run["mask"])
    assert re.sub("<[^>]+>", " ", html).split()[-12:] == [
        "since", "the", "start", "gain", "3", "●", "changed", "from", "2", "threshold", "100", "runner.rerun(gain=3)",
    ]  # fmt: skip


def test_colours_are_those_of_the_token() -> None:
    run = red_runner().run(image=red_image())
    blue, green, red = picture(static_html(run, "red", {}, {}))[30, 30].tolist()
    assert red > 150 > 50 > max(blue, green)
    photo = np.full((64, 64, 3), (200, 20, 10), np.uint8)
    blue, green, red = picture(shown(photo))[30, 30].tolist()
    assert blue > 150 > 50 > max(red, green)


def test_an_array_that_was_moved_to_one_of_the_same_shape_is_marked() -> None:
    html = shown(1, {"kernel": np.zeros(3)}, {"kernel": np.ones(3)})
    assert "● changed<" in html


@pytest.mark.slow
@pytest.mark.parametrize(
    "make",
    [lambda noise: noise, lambda noise: noise[:, :, 0] > 127, lambda noise: noise[:, :, 0].astype(np.float64) / 7,
     lambda noise: np.dstack([noise, noise[:, :, 0]]), lambda noise: noise[:, :, 0].astype(np.int32) % 60,
     lambda noise: noise[:9], lambda noise: noise[:, :, 0].astype(np.uint16) * 250],
    ids=["colours", "mask", "float", "alpha", "labels", "strip", "16 bit"],
)  # fmt: skip
def test_the_worst_picture_and_many_values_stay_small(make: Any) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (1500, 2200, 3), dtype=np.uint8)
    values = {"&<>\"'é" * 20 + str(place): "<" * 500 for place in range(300)}
    html = shown(make(noise), values, dict.fromkeys(values, "&" * 500), image="&" * 900, code="<" * 9_000)
    assert len(html.encode()) < 120_000
    assert "<img" in html
    assert "and 260 more" in html


def test_of_many_values_those_that_were_moved_are_listed() -> None:
    values = {f"k{place}": 0 for place in range(100)}
    html = shown(1, {**values, "k99": 5}, values)
    assert "k99" in html
    assert "● changed from 0" in html


@pytest.mark.parametrize("value", [3, None, "text", [1, 2], np.zeros(4), {"a": 1}, object(), np.zeros((3, 3))])
def test_what_is_no_image_is_a_text(value: Any) -> None:
    html = shown(value)
    assert "<img" not in html
    assert "<figcaption" in html
    assert " at 0x" not in html


def test_a_token_that_was_not_computed_says_so_and_none_is_no_picture(runner: ep.CompGraphRunner, image: Any) -> None:
    fresh = ep.CompGraphRunner(runner.cg, runner.hyperparameters)
    run = fresh.run("image_bright", image=image)
    assert "has not been computed" in static_html(run, "mask", run.hyperparameters, {})
    assert "<img" not in static_html(run, None, run.hyperparameters, {})


class Tags(HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.found: list[tuple[str, dict[str, str | None]]] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.found.append((tag, dict(attrs)))


def test_nothing_of_the_users_becomes_markup() -> None:
    evil = '"><script>alert(1)</script><img src=x onerror=alert(1)>'
    run = ep.CompGraphRunner(ep.CompGraph({"f": lambda x: x}, {"f": ("x", evil)})).run(x=np.zeros((9, 9), np.uint8))
    html = static_html(run, evil, {evil: evil}, {evil: 1}, image=evil, code=evil)
    tags = Tags()
    tags.feed(html)
    assert {tag for tag, _ in tags.found} == {"figure", "img", "figcaption", "table", "tr", "th", "td", "pre"}
    assert all(set(attributes) <= {"class", "style", "src", "alt", "width"} for _, attributes in tags.found)
    assert not re.search(r"style=\"[^\"]*(#[0-9a-f]{3}|rgb|background|[^-]color:)", html), "no colours of its own"


def test_the_same_gives_the_same_bytes(runner: ep.CompGraphRunner, image: Any) -> None:
    again = ep.CompGraphRunner(runner.cg, runner.hyperparameters)
    one, two = (each.run(image=image) for each in (runner, again))
    assert static_html(one, "image", {"k": object()}, {}) == static_html(two, "image", {"k": object()}, {})


def test_a_thumbnail_is_small_and_only_of_images_that_are_up_to_date(runner: ep.CompGraphRunner, image: Any) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (900, 1200), dtype=np.uint8)
    small = thumbnail(runner.run(image=noise), "image")
    assert small is not None
    assert (max(small.width, small.height), len(small.data) < 5_000) == (96, True)
    fresh = ep.CompGraphRunner(runner.cg, runner.hyperparameters)
    partial = fresh.run("image_bright", image=image)
    assert [thumbnail(partial, token) for token in ("mask", "gain", None)] == [None, None, None]
    assert thumbnail(partial, "image_bright") is not None


def test_a_code_line_is_whole_or_not_there() -> None:
    assert "<pre" not in shown(1, code="runner.rerun(k='" + "x" * 5_000 + "')")
    assert "rerun(k='a  b')</pre>" in shown(1, code="runner.rerun(k='a  b')")
