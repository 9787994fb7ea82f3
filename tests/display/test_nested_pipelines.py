"""What is inside a pipeline of a graph is drawn in a frame, or opens below the picture."""

from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from urllib.parse import unquote

import numpy as np
import pytest

import epypes as ep
from epypes.display import mimebundle, to_svg, view
from epypes.display.paint.svg import paint_svg
from epypes.display.views.graphview import from_json, to_json
from epypes.errors import UnknownName
from tests.display.test_display import SVG, texts, vertices

IMAGE = np.random.default_rng(0).integers(0, 255, (60, 80), dtype=np.uint8)


def threshold(image, level):
    if level > 250:
        raise ValueError("nothing is so bright")
    return np.where(image > level, 255, 0).astype(np.uint8)


def invert(mask):
    return 255 - mask


def smooth(image, size):
    return image // size * size


def runner_of(depth=1, **options):
    io = {"threshold": (("image", "level"), "mask"), "invert": ("mask", "background")}
    pipe = ep.Pipeline("binary", ep.CompGraph({"threshold": threshold, "invert": invert}, io), {"level": 100})
    for _ in range(depth - 1):
        pipe = ep.Pipeline("outer", ep.CompGraph({"binary": pipe}, {"binary": ("photo", "found")}))
    io = {"smooth": (("image", "size"), "smoothed"), "cut": ("smoothed", "parts"), "area": ("parts", "size_of_parts")}
    cg = ep.CompGraph({"smooth": smooth, "cut": pipe, "area": np.count_nonzero}, io)
    return ep.CompGraphRunner(cg, {"size": 2}, **options)


def named(graph):
    return [function.name for function in graph.functions], {token.name for token in graph.tokens}


def function(graph, name):
    return next(function for function in graph.functions if function.name == name)


def token(graph, name):
    return next(token for token in graph.tokens if token.name == name)


OPEN = ["smooth", "cut__threshold", "cut__invert", "area"]


@pytest.mark.parametrize("how", [{"depth": 1}, {"open": ["cut"]}, {"open": "cut"}])
def test_an_open_pipeline_is_drawn_in_its_place(how):
    graph = view(runner_of().run(image=IMAGE), **how)
    functions, tokens = named(graph)
    assert functions == OPEN
    assert tokens == {"image", "size", "smoothed", "parts", "size_of_parts", "cut__level", "cut__mask"}
    assert graph.io()[1:3] == [(["smoothed", "cut__level"], ["cut__mask"]), (["cut__mask"], ["parts"])]
    assert [function.state for function in graph.functions] == ["ran"] * 4
    assert token(graph, "cut__level").preview.text == "100"
    assert token(graph, "cut__mask").preview.picture is not None
    assert not graph.groups


def test_the_frame_has_the_name_and_holds_what_is_inside_and_nothing_else():
    svg = to_svg_of(runner_of().run(image=IMAGE), depth=1)
    root, found = ET.fromstring(svg), vertices(svg)
    (frame,) = (rect for rect in root.iter(f"{SVG}rect") if rect.get("class") == "frame")
    (label,) = (group for group in root.iter(f"{SVG}g") if group.get("class") == "label")
    assert texts(label) == ["cut"]
    left, top = float(frame.get("x")), float(frame.get("y"))
    right, bottom = left + float(frame.get("width")), top + float(frame.get("height"))
    for name in ("function-cut__threshold", "function-cut__invert", "token-cut__mask", "token-cut__level"):
        x, y = centre(found[name])
        assert left < x < right
        assert top < y < bottom
    for name in ("function-smooth", "function-area", "token-image", "token-parts"):
        x, y = centre(found[name])
        assert not (left < x < right and top < y < bottom), name
    assert texts(found["function-cut__threshold"])[0] == "threshold", (
        "without the pipeline's name, which is on the frame"
    )
    assert texts(found["token-cut__level"]) == ["level = 100"]


def to_svg_of(shown, **options):
    return paint_svg(view(shown, **options))


def centre(group):
    text = group.find(f"{SVG}text")
    return float(text.get("x")), float(text.get("y"))


def test_pipelines_in_pipelines_open_level_by_level():
    run = runner_of(depth=2).run(image=IMAGE)
    assert named(view(run))[0] == ["smooth", "cut", "area"]
    assert named(view(run, depth=1))[0] == ["smooth", "cut__binary", "area"]
    for how in ({"depth": 2}, {"open": "cut__binary"}):
        graph = view(run, **how)
        assert named(graph)[0] == ["smooth", "cut__binary__threshold", "cut__binary__invert", "area"]
        assert graph.io()[1] == (["smoothed", "cut__binary__level"], ["cut__binary__mask"])
        assert [frame.name for frame in graph.frames] == ["cut", "cut__binary"]
        assert (
            len([rect for rect in ET.fromstring(paint_svg(graph)).iter(f"{SVG}rect") if rect.get("class") == "frame"])
            == 2
        )


def test_a_closed_pipeline_opens_below_the_picture():
    bundle = mimebundle(runner_of().run(image=IMAGE))
    html = bundle["text/html"]
    assert "function-cut__threshold" not in bundle["image/svg+xml"]
    (_, rest) = html.split('<details class="epypes-inside" data-group="cut">')
    inside = ET.fromstring(unquote(re.search(r'<img src="data:image/svg\+xml,([^"]*)"', rest)[1]))
    assert {group.get("id") for group in inside.iter(f"{SVG}g")} >= {"function-threshold", "token-mask", "token-level"}
    data = json.loads(re.search(r'class="epypes-data">([^<]*)<', html)[1])
    assert data["groups"] == {"1": "cut"}


def test_only_what_is_stale_inside_is_faded():
    runner = runner_of()
    runner.run(image=IMAGE)
    runner["cut__level"] = 50
    graph = view(runner, depth=1)
    assert [function.state for function in graph.functions] == ["ran", "stale", "stale", "stale"]
    assert token(graph, "cut__level").first == "100"
    runner.rerun(cut__level=60)
    graph = view(runner.rerun(size=3), depth=1)
    assert [function.state for function in graph.functions] == ["ran"] * 4
    runner["size"] = 4
    assert [function.state for function in view(runner, depth=1).functions] == ["stale"] * 4


def test_a_run_that_is_shown_later_shows_what_it_computed():
    runner = runner_of()
    run = runner.run(image=IMAGE)
    before = to_svg_of(run, depth=1)
    runner.rerun(cut__level=200)
    assert to_svg_of(run, depth=1) == before


def test_a_failure_inside_is_marked_at_the_inner_function():
    runner = runner_of()
    runner.run(image=IMAGE)
    with pytest.raises(ValueError, match="so bright"):
        runner.rerun(cut__level=255)
    graph = view(runner, depth=1)
    assert [function.state for function in graph.functions] == ["reused", "failed", "not run", "not run"]
    assert function(graph, "cut__threshold").message == "nothing is so bright"
    closed = view(runner)
    assert function(closed, "cut").message == "threshold: nothing is so bright"
    assert [each.state for each in closed.groups[0].graph.functions] == ["failed", "not run"]


@pytest.mark.parametrize("kind", ["graph", "runner", "plan", "pipeline"])
def test_it_opens_whatever_is_shown(kind):
    runner = runner_of()
    shown = {
        "graph": runner.cg,
        "runner": runner,
        "plan": runner.plan(),
        "pipeline": ep.Pipeline("whole", runner.cg, {"size": 2}),
    }[kind]
    graph = view(shown, depth=1)
    assert named(graph)[0] == OPEN
    assert token(graph, "cut__level").preview.text == "100"
    assert "image/svg+xml" in mimebundle(ep.show(shown, depth=1))
    assert 'data-group="cut"' in mimebundle(ep.show(shown))["text/html"]


def test_what_returns_several_sinks_as_one_token_stays_closed():
    pipe = ep.Pipeline("p", ep.CompGraph({"f": abs, "g": abs}, {"f": ("x", "a"), "g": ("x", "b")}))
    run = ep.CompGraphRunner(ep.CompGraph({"p": pipe}, {"p": ("x", "both")})).run(x=1)
    graph = view(run, depth=1)
    assert named(graph) == (["p"], {"x", "both"})
    assert [group.name for group in graph.groups] == ["p"]


def test_wrong_names_and_depths_are_refused():
    runner = runner_of()
    with pytest.raises(UnknownName, match=r"No group or pipeline 'cutt'.*Did you mean 'cut'"):
        view(runner, open="cutt")
    with pytest.raises(ValueError, match="depth is how many levels"):
        view(runner, depth=-1)


@pytest.mark.parametrize("how", [{}, {"depth": 1}])
def test_a_view_is_the_same_after_json_and_stays_small(how):
    graph = view(runner_of().run(image=IMAGE), **how)
    assert from_json(json.loads(json.dumps(to_json(graph)))) == graph
    html = mimebundle(ep.show(runner_of().run(image=IMAGE), **how))["text/html"]
    assert len(html.encode()) <= 30_000 + 600 * 13 + 80_000 + 150_000


def test_thumbnails_of_both_share_the_room():
    noise = np.random.default_rng(1).integers(0, 255, (400, 400, 3), dtype=np.uint8)
    io = {f"f{index}": (f"t{index}", f"t{index + 1}") for index in range(20)}
    pipe = ep.Pipeline("long", ep.CompGraph(dict.fromkeys(io, lambda image: 255 - image), io))
    runner = ep.CompGraphRunner(ep.CompGraph({"p": pipe, "g": lambda x: 255 - x}, {"p": ("a", "b"), "g": ("b", "c")}))
    run = runner.run(a=noise)
    for how in ({}, {"depth": 1}):
        html = mimebundle(ep.show(run, **how))["text/html"]
        assert len(html.encode()) <= 30_000 + 600 * (22 + 24) + 80_000 + 150_000


def test_the_open_picture_is_labelled_to_the_right_too():
    svg = to_svg(runner_of())
    assert "frame" not in re.findall('class="([a-z]*)"', svg)
    right = ep.show(runner_of().run(image=IMAGE), depth=1, direction="right").svg
    root = ET.fromstring(right)
    x0, y0, width, height = map(float, root.get("viewBox").split())
    (frame,) = (rect for rect in root.iter(f"{SVG}rect") if rect.get("class") == "frame")
    assert x0 < float(frame.get("x")) < float(frame.get("x")) + float(frame.get("width")) < x0 + width
    assert y0 < float(frame.get("y")) < float(frame.get("y")) + float(frame.get("height")) < y0 + height
