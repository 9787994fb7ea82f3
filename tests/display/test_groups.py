from __future__ import annotations

import json
import re
import xml.etree.ElementTree as ET
from urllib.parse import unquote

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import epypes as ep
from epypes.display import mimebundle, to_svg, view
from epypes.display.paint.svg import paint_svg
from epypes.display.views.graphview import EdgeView, FunctionView, GraphView, TokenView, from_json, to_json
from epypes.display.views.groups import collapsed, groups_of

SVG = "{http://www.w3.org/2000/svg}"
IMAGE = np.tile(np.arange(64, dtype=np.uint8), (64, 1))


def passed(x, *_):
    return x


def failing(x, *_):
    raise ValueError("too dark")


def two_branches(**other):
    """image -> blur -> canny -> edges (also: lo, kernel) and, of canny's input, corners -> points."""
    functions = dict.fromkeys(("blur", "canny", "corners", "join"), passed) | other
    io = {
        "blur": (("image", "kernel"), "blurred"),
        "canny": (("blurred", "lo"), "edges"),
        "corners": (("blurred", "kernel"), "points"),
        "join": (("edges", "points"), ("joined",)),
    }
    functions["join"] = lambda *xs: (xs[0],)
    return ep.CompGraph(functions, io)


@pytest.fixture
def cg():
    return ep.group(two_branches(), "edge detection", functions=["blur", "canny"])


@pytest.fixture
def runner(cg):
    return ep.CompGraphRunner(cg, {"kernel": 3, "lo": 70})


def box_of(shown, **options):
    (box,) = (function for function in view(shown, **options).functions if function.kind == "group")
    return box


def named(graph):
    return [function.name for function in graph.functions], [token.name for token in graph.tokens]


def edges_of(graph):
    return {(graph.functions[edge.function].name, graph.tokens[edge.token].name, edge.is_input) for edge in graph.edges}


def test_a_group_is_one_box_at_the_place_of_its_first_function(runner):
    graph = view(runner)
    assert named(graph)[0] == ["edge detection", "corners", "join"]
    assert box_of(runner).notes == ("2 functions", "1 hyperparameter inside")


def test_what_is_only_inside_disappears_and_what_others_see_stays(runner):
    graph = view(runner)
    assert named(graph)[1] == ["image", "kernel", "blurred", "edges", "points", "joined"], "lo is inside"
    assert ("edge detection", "blurred", True) not in edges_of(graph), "what a member gives a member is inside"
    assert {edge for edge in edges_of(graph) if edge[0] == "edge detection"} == {
        ("edge detection", "image", True),
        ("edge detection", "kernel", True),
        ("edge detection", "blurred", False),
        ("edge detection", "edges", False),
    }


def test_the_picture_is_told_with_the_number_of_all_functions(runner):
    assert "Computational graph of 4 functions: edge detection, corners, join." in to_svg(runner)
    assert repr(ep.show(runner)) == "<Figure: 4 functions, 1 closed group; down>"


def test_free_source_tokens_and_sinks_stay_outside():
    cg = ep.group(two_branches(), "all", functions=["blur", "canny", "corners", "join"])
    runner = ep.CompGraphRunner(cg, {"kernel": 3, "lo": 70})
    assert named(view(runner)) == (["all"], ["image", "joined"])
    assert box_of(runner).notes == ("4 functions", "2 hyperparameters inside")


def test_the_inside_of_a_group_is_a_graph_of_its_own(runner):
    (group,) = view(runner, direction="right").groups
    assert group.name == "edge detection"
    assert named(group.graph) == (["blur", "canny"], ["image", "kernel", "blurred", "lo", "edges"])
    assert edges_of(group.graph) <= edges_of(view(runner, collapse=False))
    assert len(group.graph.edges) == 6
    assert group.graph.direction == "right"
    assert not group.graph.groups


def test_a_thumbnail_is_carried_once(runner):
    graph = view(runner.run(image=IMAGE))
    (group,) = graph.groups
    outside = {token.name for token in graph.tokens if token.preview and token.preview.picture}
    inside = {token.name for token in group.graph.tokens if token.preview and token.preview.picture}
    assert outside == {"image", "blurred", "edges", "points", "joined"}
    assert not inside
    hidden = ep.group(two_branches(), "all", functions=["blur", "canny", "corners", "join"])
    (group,) = view(ep.CompGraphRunner(hidden, {"kernel": 3, "lo": 70}).run(image=IMAGE)).groups
    assert {token.name for token in group.graph.tokens if token.preview and token.preview.picture} == {
        "blurred",
        "edges",
        "points",
    }


@pytest.mark.parametrize("kind", ["run", "runner"])
def test_thumbnails_that_are_seen_at_once_are_kept_before_those_inside(kind):
    io = {"f": ("a", "b"), "g": ("b", "c"), "h": ("c", "d")}
    cg = ep.group(ep.CompGraph(dict.fromkeys(io, passed), io), "first", functions=["f", "g"])
    runner = ep.CompGraphRunner(cg)
    run = runner.run(a=IMAGE)
    graph = view(run if kind == "run" else runner, thumbnails=3)
    assert [token.name for token in graph.tokens if token.preview.picture] == ["a", "c", "d"]
    assert not any(token.preview.picture for token in graph.groups[0].graph.tokens)


def test_an_edge_of_a_box_is_live_if_it_is_so_for_one_of_its_functions():
    functions = (FunctionView("f", "ran"), FunctionView("g", "left out"), FunctionView("h", "ran"))
    for lives in ((True, False), (False, True), (False, False)):
        edges = tuple(EdgeView(place, 0, True, is_live) for place, is_live in enumerate(lives))
        graph = GraphView(functions, (TokenView("t", "payload", "fresh"),), edges)
        (edge,) = collapsed(graph, {"both": ["f", "g"]}).edges
        assert edge.is_live == any(lives)


# -- states -----------------------------------------------------------------------------------------------------------


def test_times_and_shares_of_a_group_are_summed(runner):
    run = runner.run(image=IMAGE)
    box, durations = box_of(run), run.report.durations_ns
    assert box.state == "ran"
    assert box.duration_ns == durations["blur"] + durations["canny"]
    assert 0 < box.share <= 1


def test_a_group_is_stale_as_soon_as_one_of_its_functions_is(runner):
    runner.run(image=IMAGE)
    runner["lo"] = 90
    assert (box_of(runner).state, box_of(runner).message) == ("stale", "1 of 2 functions")
    assert (box_of(runner.plan()).state, box_of(runner.plan()).message) == ("planned", "1 of 2 functions")
    runner["kernel"] = 5
    assert (box_of(runner).state, box_of(runner).message) == ("stale", "")


def test_a_group_says_which_of_its_functions_failed():
    cg = ep.group(two_branches(canny=failing), "edge detection", functions=["blur", "canny"])
    runner = ep.CompGraphRunner(cg, {"kernel": 3, "lo": 70})
    with pytest.raises(ValueError, match="too dark"):
        runner.run(image=IMAGE)
    box = box_of(runner)
    assert box.state == "failed"
    assert box.message.startswith("canny: ")
    assert "too dark" in box.message
    found = {group.get("id"): group for group in ET.fromstring(to_svg(runner)).iter(f"{SVG}g")}
    assert found["function-edge:20:detection"].get("class") == "function group failed"


def test_a_group_with_a_placeholder_says_so():
    cg = ep.group(two_branches(canny=ep.Placeholder()), "edge detection", functions=["blur", "canny"])
    assert "1 to be written" in box_of(cg).notes
    assert box_of(ep.CompGraphRunner(cg, {"kernel": 3, "lo": 70}).plan()).state == "missing"


def test_a_group_is_left_out_only_if_all_of_it_is(runner):
    runner.run(image=IMAGE)
    part = runner.plan("blurred")
    assert box_of(part).state == "reused"
    assert box_of(
        ep.CompGraphRunner(ep.group(two_branches(), "end", functions=["corners", "join"])).plan("edges")
    ).state == ("left out")


def test_a_group_of_a_function_that_was_redefined_is_marked():
    graph = GraphView((FunctionView("f", "ran", is_redefined=True), FunctionView("g", "ran")), (), ())
    (box,) = collapsed(graph, {"both": ["f", "g"]}).functions
    assert box.is_redefined
    assert box.notes == ("2 functions", "redefined inside: build again")


# -- which groups there are -------------------------------------------------------------------------------------------


def names(prefix, count):
    return [f"{prefix}{index}" for index in range(count)]


def test_in_a_large_graph_functions_of_one_prefix_are_a_group():
    many = [*names("left.", 3), *names("right.", 2), *names("f", 20)]
    assert groups_of(many, {}) == {"left": ("left.0", "left.1", "left.2")}
    assert groups_of(many[:24], {}) == {}, "few functions are drawn one by one"


def test_a_prefix_is_no_group_where_its_name_is_taken():
    many = [*names("left.", 30), "left"]
    assert groups_of(many, {}) == {}
    many = names("left.", 30)
    assert groups_of(many, {"left": ["left.0"]}) == {"left": ("left.0",)}
    assert groups_of([*many, ".hidden", ".too", ".three"], {"first": many[:28]}) == {"first": tuple(many[:28])}


def camera_graph(count):
    functions, io = {}, {}
    for side in ("left", "right"):
        for index in range(count):
            functions[f"{side}.{index}"] = passed
            io[f"{side}.{index}"] = ((f"{side}{index}", f"{side}.k{index}"), f"{side}{index + 1}")
    functions["join"] = passed
    io["join"] = ((f"left{count}", f"right{count}"), "joined")
    return ep.CompGraph(functions, io)


def test_two_cameras_are_two_boxes_and_open_on_request():
    runner = ep.CompGraphRunner(camera_graph(15), {f"{side}.k{k}": 1 for side in ("left", "right") for k in range(15)})
    assert named(view(runner)) == (["left", "right", "join"], ["left0", "left15", "right0", "right15", "joined"])
    opened = view(runner, open="left")
    assert len(opened.functions) == 15 + 2
    assert [group.name for group in opened.groups] == ["right"]
    assert view(runner, open=["left", "right"]).functions == view(runner, collapse=False).functions
    assert not view(runner, collapse=False).groups


# -- on the page ------------------------------------------------------------------------------------------------------


def test_a_page_has_the_inside_of_each_group_to_be_opened(runner):
    bundle = mimebundle(runner.run(image=IMAGE))
    html = bundle["text/html"]
    assert html.count("<details") == 1
    (start, rest) = html.split('<details class="epypes-inside" data-group="edge detection">')
    assert re.search("<summary[^>]*>edge detection: 2 functions</summary>", rest)
    inside = ET.fromstring(unquote(re.search(r'<img src="data:image/svg\+xml,([^"]*)"', rest)[1]))
    assert {group.get("id") for group in inside.iter(f"{SVG}g")} >= {"function-blur", "function-canny", "token-lo"}
    assert "function-blur" not in bundle["image/svg+xml"], "the file has the closed picture only"
    assert "function-blur" not in unquote(start)


@pytest.mark.parametrize("direction", ["down", "right"])
def test_the_box_of_a_group_is_a_stack_and_holds_its_text_and_its_bar(runner, direction):
    svg = ET.fromstring(paint_svg(view(runner.run(image=IMAGE), direction=direction)))
    found = {group.get("id"): group for group in svg.iter(f"{SVG}g")}
    boxes = {
        name: [rect for rect in group.iter(f"{SVG}rect") if rect.get("class").startswith("shape")]
        for name, group in found.items()
    }
    assert len(boxes["function-corners"]) == 1
    (*behind, front) = boxes["function-edge:20:detection"]
    assert len(behind) == 2
    top, bottom = float(front.get("y")), float(front.get("y")) + float(front.get("height"))
    rows = [float(text.get("y")) for text in found["function-edge:20:detection"].iter(f"{SVG}text")]
    assert all(top < row < bottom for row in rows)
    (bar,) = (rect for rect in found["function-edge:20:detection"].iter(f"{SVG}rect") if rect.get("class") == "bar")
    assert max(rows) < float(bar.get("y")) < float(bar.get("y")) + float(bar.get("height")) < bottom


@pytest.mark.parametrize("direction", ["down", "right"])
def test_a_switch_is_narrower_where_the_data_leaves_it(direction):
    choice = ep.switch("pick", {"a": "x", "b": "y"}, by="way", output="z")
    runner = ep.CompGraphRunner(choice, {"way": "a"})
    svg = ET.fromstring(paint_svg(view(runner, direction=direction)))
    (shape,) = (group.find(f"{SVG}polygon") for group in svg.iter(f"{SVG}g") if group.get("id") == "function-pick")
    points = [tuple(map(float, point.split(","))) for point in shape.get("points").split()]
    axis = 0 if direction == "down" else 1
    first, last = (
        [point[axis] for point in points if point[1 - axis] == end]
        for end in (min(point[1 - axis] for point in points), max(point[1 - axis] for point in points))
    )
    assert max(last) - min(last) < max(first) - min(first)


def test_the_table_of_a_plan_has_the_functions_inside_groups(runner):
    table = mimebundle(runner.plan())["text/html"].rpartition("<table>")[2]
    assert all(name in table for name in ("blur", "canny", "corners", "join"))


def test_names_of_groups_are_only_text():
    evil = '"><script>alert(1)</script>'
    cg = ep.group(two_branches(), evil, functions=["blur", "canny"])
    html = mimebundle(cg)["text/html"]
    assert "<script>alert" not in html
    assert "<script>alert" not in unquote(html)


def test_a_page_with_many_groups_stays_within_its_size_and_says_what_is_missing():
    count = 120
    functions = {f"f{index}": passed for index in range(count)}
    cg = ep.CompGraph(functions, {f"f{index}": (f"t{index}", f"t{index + 1}") for index in range(count)})
    for index in range(count):
        cg = ep.group(cg, f"group{index}", functions=[f"f{index}"])
    html = mimebundle(ep.CompGraphRunner(cg).run(t0=IMAGE))["text/html"]
    assert len(html) <= 30_000 + 600 * (count + len(cg.tokens)) + 80_000 + 150_000
    assert html.count("<details") < count
    assert re.search(r"Not shown here: the inside of group\d+, group\d+", html)


# -- any grouping -----------------------------------------------------------------------------------------------------


@st.composite
def grouped_graphs(draw):
    """A random graph, and a random way to group its functions; groups may lead to each other in rings."""
    count = draw(st.integers(1, 9))
    known, io = ["s", "h"], {}
    for index in range(count):
        inputs = tuple(draw(st.lists(st.sampled_from(known), min_size=1, max_size=3, unique=True)))
        io[f"f{index}"] = (inputs, f"t{index}")
        known.append(f"t{index}")
    cg = ep.CompGraph(dict.fromkeys(io, passed), io)
    places = [draw(st.sampled_from(["a", "b", None])) for _ in io]
    for name in ("a", "b"):
        inside = [function for function, place in zip(io, places, strict=True) if place == name]
        cg = ep.group(cg, name, functions=inside) if inside else cg
    return cg


@pytest.mark.slow
@pytest.mark.fuzz
@given(grouped_graphs(), st.sampled_from(["down", "right"]))
def test_any_grouping_keeps_every_function_and_edge_and_can_be_painted(cg, direction):
    hparams = {"h": 3} if "h" in cg.tokens else {}
    runner = ep.CompGraphRunner(cg, hparams)
    graph, whole = view(runner, direction=direction), view(runner, collapse=False)
    parts = [graph, *(group.graph for group in graph.groups)]
    shown = [name for part in parts for name in named(part)[0] if name not in cg.groups]
    assert sorted(shown) == sorted(cg.functions)
    assert {name for part in parts for name in named(part)[1]} == set(cg.tokens)
    inside = {name: group for group, names in cg.groups.items() for name in names}
    outer = {(inside.get(name, name), token, is_input) for name, token, is_input in edges_of(whole)}
    assert edges_of(graph) <= outer
    assert len(graph.edges) == len(edges_of(graph)), "each edge once"
    assert set().union(*(edges_of(group.graph) for group in graph.groups), set()) | {
        edge for edge in edges_of(graph) if edge[0] not in cg.groups
    } == edges_of(whole)
    for part in parts:
        svg = paint_svg(part)
        assert {group.get("id").partition("-")[2] for group in ET.fromstring(svg).iter(f"{SVG}g")} == {
            *named(part)[0],
            *named(part)[1],
        }
    again = from_json(json.loads(json.dumps(to_json(graph))))
    assert again == graph
    assert paint_svg(again) == paint_svg(graph)
