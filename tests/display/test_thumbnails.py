"""The tokens that get a thumbnail, how they are painted, and the size of their vertices."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from typing import Any

import numpy as np
import pytest

import epypes as ep
from epypes.display import to_svg, view
from epypes.display.layout import lay_out
from epypes.display.text import KEPT_CHARACTERS, THUMBNAIL_CHARACTERS

SVG = "{http://www.w3.org/2000/svg}"


def vertex(svg: str, token: str) -> ET.Element:
    return next(group for group in ET.fromstring(svg).iter(f"{SVG}g") if group.get("id") == f"token-{token}")


def made(value: Any) -> ep.CompGraphRunner:
    """Return a runner that has made this value of a token ``y``."""
    runner = ep.CompGraphRunner(ep.CompGraph({"f": lambda: value}, {"f": ((), "y")}))
    runner.run()
    return runner


def noise(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (200, 200, 3)).astype(np.uint8)


def with_thumbnail(run: ep.Run) -> set[str]:
    tokens = view(run, collapse=False).tokens
    return {token.name for token in tokens if token.preview and (token.preview.picture or token.preview.chart)}


def chain(count: int) -> ep.CompGraph:
    """Return a graph that takes an image ``t0`` and changes it so many times."""
    return ep.CompGraph(
        {f"f{index}": lambda image: image + np.uint8(1) for index in range(count)},
        {f"f{index}": (f"t{index}", f"t{index + 1}") for index in range(count)},
    )


def test_twenty_four_thumbnails_are_shown_and_the_others_keep_their_words():
    run = ep.CompGraphRunner(chain(60)).run(t0=noise())
    assert with_thumbnail(run) == {"t60", *(f"t{index}" for index in range(23))}
    graph = view(run, collapse=False)
    assert "37 thumbnails left out" in graph.caption
    assert all(token.preview.text == "uint8 200 x 200 x 3 bgr" for token in graph.tokens)


def test_what_has_no_thumbnail_still_tells_its_range():
    run = ep.CompGraphRunner(chain(60)).run(t0=noise())
    left_out = next(token.preview for token in view(run, collapse=False).tokens if token.name == "t50")
    assert left_out.picture is None
    assert re.match(r"uint8 200 x 200 x 3 bgr, \d+ to \d+ of a sample, mean ", left_out.detail)


def test_so_many_can_be_asked_for():
    run = ep.CompGraphRunner(chain(60)).run(t0=noise())
    for asked, expected in ((0, 0), (3, 3), (1000, 37)):
        graph = view(run, thumbnails=asked, collapse=False)
        assert sum(token.preview.picture is not None for token in graph.tokens) == expected
        assert f"; {61 - expected} thumbnails left out" in graph.caption


@pytest.mark.slow
def test_all_chosen_thumbnails_together_stay_within_their_part_of_the_picture():
    for count in (5, 23, 60):
        run = ep.CompGraphRunner(chain(count)).run(t0=noise())
        figure = ep.show(run, collapse=False)
        spent = sum(len(data) for data in re.findall(r'href="data:[^"]*"', figure.svg))
        assert 20_000 < spent <= THUMBNAIL_CHARACTERS
        assert len(with_thumbnail(run)) == min(count + 1, 24)
        limit = 30_000 + 600 * (2 * count + 1) + THUMBNAIL_CHARACTERS
        assert len(figure.svg) <= limit
        assert len(figure.html) <= limit + KEPT_CHARACTERS


def test_sinks_come_first_then_source_images_then_what_ran_last():
    side = {f"g{index}": lambda image: image + np.uint8(2) for index in range(30)}
    io = {f"g{index}": ("image", f"early{index}") for index in range(30)}
    late = {"h": lambda image, k: image + np.uint8(k), "last": lambda *images: images[0]}
    io |= {"h": (("image", "k"), "late"), "last": (("late", *(f"early{index}" for index in range(30))), "sink")}
    runner = ep.CompGraphRunner(ep.CompGraph(side | late, io), {"k": 1})
    runner.run(image=noise())
    assert "late" not in with_thumbnail(runner.last), "of those that ran it is the last"
    run = runner.rerun(k=2)
    assert {"sink", "image", "late"} <= with_thumbnail(run)
    assert len(with_thumbnail(run)) == 24


def test_hyperparameters_before_a_run_stay_within_the_limit_too():
    io = {"f": (tuple(f"k{index}" for index in range(60)), "y")}
    runner = ep.CompGraphRunner(
        ep.CompGraph({"f": lambda *images: 1}, io), {f"k{index}": noise(index) for index in range(60)}
    )
    for shown in (runner, runner.plan()):
        assert to_svg(shown).count("<image") == 24


# Painting


@pytest.mark.parametrize(
    ("value", "element"),
    [(np.sin(np.arange(100)), "polyline"), (np.histogram(np.arange(50), 10), "path"), (np.eye(9)[:, :2] * 3, "path")],
    ids=["line", "bars", "points"],
)
def test_charts_are_painted_within_their_frame(value, element):
    group = vertex(to_svg(made(value)), "y")
    chart = next(part for part in group.iter(f"{SVG}g") if part.get("class") == "chart")
    frame, drawn = chart.find(f"{SVG}rect"), chart.find(f"{SVG}{element}")
    left, top, width, height = (float(frame.get(key)) for key in ("x", "y", "width", "height"))
    assert (width, height) == (128, 96)
    numbers = [
        float(number) for number in re.findall(r"-?\d+\.?\d*", re.sub("h0", "", drawn.get("d") or drawn.get("points")))
    ]
    assert len(numbers) >= 9
    if element == "polyline":
        assert all(left <= x <= left + width for x in numbers[::2])
        assert all(top <= y <= top + height for y in numbers[1::2])


def test_rows_are_painted_cut_and_escaped():
    group = vertex(to_svg(made({"<b>": "&" * 100, "k": 1, "l": 2, "m": 3, "n": 4})), "y")
    rows = [text.text for text in group.iter(f"{SVG}text") if text.get("class") == "row"]
    assert rows[0].startswith("<b>: '")
    assert len(rows[0]) <= 26
    assert rows[1:] == ["k: 1", "l: 2", "... 2 more"]


def test_long_values_are_cut_on_the_vertex_and_whole_in_its_title():
    group = vertex(to_svg(made("a text of some length, which goes on")), "y")
    texts = [text.text for text in group.iter(f"{SVG}text")]
    assert texts == ["y", "'a text of some l…"]
    assert "which goes on" in group.find(f"{SVG}title").text


def test_floats_have_four_digits_on_the_vertex():
    runner = ep.CompGraphRunner(ep.CompGraph({"f": abs}, {"f": ("sigma", "y")}), {"sigma": 1 / 3})
    assert [text.text for text in vertex(to_svg(runner), "sigma").iter(f"{SVG}text")] == ["sigma = 0.3333"]


# Sizes


@pytest.fixture
def fresh_layouts():
    """No layout is remembered."""
    lay_out.cache_clear()
    yield
    lay_out.cache_clear()


def functions_of_a_number() -> dict[str, Any]:
    return {
        "integer": lambda n: n * n,
        "real": lambda n: n / 7,
        "items": lambda n: list(range(n)),
        "table": lambda n: {f"k{index}": index for index in range(n)},
        "signal": lambda n: np.arange(10.0 + n),
        "points": lambda n: np.random.default_rng(n).random((6 + n, 2)),
        "image": lambda n: np.full((20 + n, 30), n * 5, np.uint8),
        "rows": lambda n: np.zeros((2, 3)) + n,
        "descriptors": lambda n: np.zeros((91 + n, 9), np.uint8),
        "odd": lambda n: np.zeros((n + 1, 2, 3, 4)),
        "text": lambda n: "a word"[: 1 + n % 4],
    }


@pytest.mark.slow
def test_fifty_runs_with_other_values_ask_for_one_layout(fresh_layouts):
    functions = functions_of_a_number()
    io = {name: (("n", "sigma"), f"{name}_made") for name in functions}
    wrapped = {name: lambda n, sigma, function=function: function(n) for name, function in functions.items()}
    runner = ep.CompGraphRunner(ep.CompGraph(wrapped, io), {"n": 0, "sigma": 0.5})
    runner.run()
    for n in range(50):
        runner.rerun(n=n, sigma=n / 13)
        to_svg(runner)
    assert lay_out.cache_info().misses == 1


def test_thresholds_of_two_to_four_digits_stand_in_the_same_place(fresh_layouts):
    runner = ep.CompGraphRunner(ep.CompGraph({"f": abs}, {"f": ("canny_lo", "y")}), {"canny_lo": 70})
    for value in (70, 71, 100, 1000, -5):
        runner["canny_lo"] = value
        to_svg(runner)
    assert lay_out.cache_info().misses == 1


def test_a_box_with_a_thumbnail_has_one_size(photograph):
    for value in (photograph, photograph[:100], photograph > 100, np.arange(100.0), np.zeros((3000, 2000), np.float32)):
        shape = next(iter(vertex(to_svg(made(value)), "y").iter(f"{SVG}rect")))
        assert (shape.get("width"), shape.get("height")) == ("140", "144")
