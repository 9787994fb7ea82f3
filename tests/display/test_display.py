from __future__ import annotations

import base64
import io
import re
import shutil
import sys
import xml.etree.ElementTree as ET
from dataclasses import FrozenInstanceError
from html import unescape
from urllib.parse import unquote

import cv2
import numpy as np
import pytest
from PIL import Image

import epypes as ep
from epypes.display import mimebundle, to_svg, view
from epypes.display.layout import lay_out
from epypes.display.text import KEPT_CHARACTERS, THUMBNAIL_CHARACTERS
from tests.colours import red_image, red_runner
from tests.pictures import assert_same_picture

SVG = "{http://www.w3.org/2000/svg}"


def vertices(svg: str) -> dict[str, ET.Element]:
    return {group.get("id"): group for group in ET.fromstring(svg).iter(f"{SVG}g")}


def texts(group: ET.Element) -> list[str]:
    return [text.text for text in group.iter(f"{SVG}text")]


@pytest.fixture
def fresh_layouts():
    """No layout is remembered, so that an engine is really asked."""
    lay_out.cache_clear()
    yield
    lay_out.cache_clear()


def test_a_graph_shows_every_function_and_token_once(edge_graph):
    found = vertices(to_svg(edge_graph))
    assert set(found) == {f"function-{name}" for name in edge_graph.functions} | {
        f"token-{name}" for name in edge_graph.tokens
    }
    assert found["function-blur"].find(f"{SVG}rect") is not None
    assert found["token-image"].find(f"{SVG}ellipse") is not None


def test_a_graph_shows_defaults_as_the_hyperparameters_that_they_will_be():
    def scale(image, factor=2):
        return factor * image

    found = vertices(to_svg(ep.CompGraph.from_functions(scale)))
    assert texts(found["token-factor"]) == ["factor = 2"]
    assert found["token-factor"].get("class") == "token hyperparameter fresh"
    assert found["token-image"].get("class") == "token payload static"


def test_a_runner_before_a_run_shows_the_values_of_its_hyperparameters(edge_runner):
    found = vertices(to_svg(edge_runner))
    assert texts(found["token-canny_lo"]) == ["canny_lo = 70"]
    assert found["token-canny_lo"].get("class") == "token hyperparameter fresh"
    assert found["token-canny_lo"].find(f"{SVG}polygon") is not None
    assert found["token-edges"].get("class") == "token payload not-computed"
    assert "<image" not in to_svg(edge_runner)


@pytest.mark.parametrize("shown", ["run", "runner"])
def test_after_a_run_thumbnails_values_and_times_show(edge_runner, photograph, shown):
    run = edge_runner.run(image=photograph)
    found = vertices(to_svg(run if shown == "run" else edge_runner))
    images = {name for name, group in found.items() if group.find(f"{SVG}image") is not None}
    assert images == {"token-image", "token-image_gray", "token-image_blurred", "token-edges"}
    assert texts(found["token-blur_kernel"]) == ["blur_kernel = 11"]
    assert re.fullmatch(r"[\d.]+ (ns|µs|ms), \d+%", texts(found["function-canny"])[1])


def test_the_thumbnail_shows_the_token_it_stands_on(edge_runner, photograph):
    edge_runner.run(image=photograph)
    href = vertices(to_svg(edge_runner))["token-image"].find(f"{SVG}image").get("href")
    picture = np.asarray(Image.open(io.BytesIO(base64.b64decode(href.partition(",")[2]))))
    assert max(picture.shape) <= 128
    expected = cv2.resize(photograph, (picture.shape[1], picture.shape[0]), interpolation=cv2.INTER_AREA)[..., ::-1]
    assert np.abs(picture.astype(int) - expected).mean() < 12, (
        "the picture is sampled and compressed, but shows the photograph"
    )


def test_stale_and_failed_functions_show_as_such(edge_runner, photograph):
    edge_runner.run(image=photograph)
    edge_runner["canny_lo"] = 90
    found = vertices(to_svg(edge_runner))
    assert found["function-canny"].get("class") == "function stale"
    assert found["token-edges"].get("class") == "token payload stale"
    with pytest.raises(cv2.error):
        edge_runner.rerun(blur_kernel=4)
    found = vertices(to_svg(edge_runner))
    assert found["function-blur"].get("class") == "function failed"
    assert "Assertion failed" in found["function-blur"].find(f"{SVG}title").text
    assert found["function-grayscale"].get("class") == "function reused"


def test_the_same_object_renders_to_the_same_bytes(edge_runner, photograph):
    edge_runner.run(image=photograph)
    assert to_svg(edge_runner) == to_svg(edge_runner)


def test_other_values_do_not_ask_for_another_layout(edge_runner, photograph, fresh_layouts):
    edge_runner.run(image=photograph)
    to_svg(edge_runner)
    edge_runner.rerun(canny_lo=71)
    edge_runner.run(image=photograph)
    to_svg(edge_runner)
    assert lay_out.cache_info().misses == 1


def test_a_view_is_frozen(edge_graph):
    with pytest.raises(FrozenInstanceError):
        view(edge_graph).caption = "other"


def test_a_notebook_gets_text_html_and_svg(edge_runner, photograph):
    run = edge_runner.run(image=photograph)
    pipe = ep.Pipeline("edges", edge_runner.cg, edge_runner.hyperparameters)
    for shown in (edge_runner.cg, edge_runner, run, pipe):
        bundle = shown._repr_mimebundle_()
        assert set(bundle) == {"text/plain", "text/html", "image/svg+xml"}
        assert len(bundle["text/plain"]) < 100
        ET.fromstring(bundle["image/svg+xml"])
        source = re.search(r'<img src="data:image/svg\+xml,([^"]*)"', bundle["text/html"])[1]
        assert_same_picture(unquote(unescape(source)), bundle["image/svg+xml"])
        assert "<table" in bundle["text/html"], "the twin for screen readers"
    assert "graph overhead" in run.report._repr_mimebundle_()["text/html"]


def test_without_the_wheel_dot_on_the_path_lays_out(edge_graph, monkeypatch, fresh_layouts, tmp_path):
    monkeypatch.setitem(sys.modules, "pygraphviz", None)
    monkeypatch.setenv("PATH", str(tmp_path))
    fake = tmp_path / "dot"
    code = (
        f"#!{sys.executable}\nimport sys, json\nsource = sys.stdin.read()\n"
        "names = sorted({w for l in source.splitlines() if '->' in l for w in l.split()[:3:2]}, "
        "key=lambda n: int(n[1:]))\n"
        "print(json.dumps({'bb': '0,0,100,100', 'objects': [{'_gvid': i, 'name': n, 'pos': '5,5'} for i, n in "
        "enumerate(names)], 'edges': [{'tail': names.index(a), 'head': names.index(b), 'pos': "
        "'e,1,1 2,2 3,3 4,4 5,5'} for l in source.splitlines() if '->' in l for a, b in [l.split()[:3:2]]]}))\n"
    )
    fake.write_text(code)
    fake.chmod(0o755)
    assert shutil.which("dot") == str(fake)
    assert "function-canny" in to_svg(edge_graph)


def test_without_any_engine_the_text_form_shows_with_a_way_out(
    edge_runner, photograph, monkeypatch, fresh_layouts, tmp_path
):
    monkeypatch.setitem(sys.modules, "pygraphviz", None)
    monkeypatch.setenv("PATH", str(tmp_path))
    edge_runner.run(image=photograph)
    bundle = mimebundle(edge_runner)
    assert set(bundle) == {"text/plain"}
    assert "canny(image_blurred, canny_lo, canny_hi) -> edges" in bundle["text/plain"]
    assert "canny_lo = 70" in bundle["text/plain"]
    assert "pip install 'epypes[graphviz]'" in bundle["text/plain"]


def test_a_pipeline_inside_a_graph_shows_that_it_is_one():
    inner = ep.Pipeline("inner", ep.CompGraph({"f": abs, "g": abs}, {"f": ("x", "y"), "g": ("y", "z")}))
    small = ep.Pipeline("small", ep.CompGraph({"f": abs}, {"f": ("x", "y")}))
    functions = {"both": inner, "one": small, "plain": abs}
    cg = ep.CompGraph(functions, {"both": ("a", "b"), "one": ("b", "c"), "plain": ("c", "d")})
    runner = ep.CompGraphRunner(cg)
    runner.run(a=-1)
    for shown in (cg, runner, runner.plan(), ep.Pipeline("outer", cg).runner):
        found = vertices(to_svg(shown))
        assert texts(found["function-both"])[1] == "pipeline of 2 functions"
        assert texts(found["function-one"])[1] == "pipeline of 1 function"
        borders = [len(found[f"function-{name}"].findall(f"{SVG}rect[@class]")) for name in ("both", "one", "plain")]
        bars = [len(found[f"function-{name}"].findall(f"{SVG}rect[@class='bar']")) for name in ("both", "one", "plain")]
        assert [border - bar for border, bar in zip(borders, bars, strict=True)] == [2, 2, 1]
        assert found["function-both"].find(f"{SVG}title").text.startswith("pipeline both: ")


def test_one_is_not_many():
    runner = ep.CompGraphRunner(ep.CompGraph({"f": abs}, {"f": ("x", "y")}), {"x": 1})
    assert repr(runner) == "<CompGraphRunner: 1 function, 1 hyperparameter; not run yet>"
    assert repr(runner.plan()) == "<Plan: 1 function to run, 0 reused>"
    assert "1 function to run, 0 reused" in mimebundle(runner.plan())["text/html"]
    runner.run()
    runner["x"] = 2
    assert repr(runner) == "<CompGraphRunner: 1 function, 1 hyperparameter; 1 function stale>"


def test_names_and_values_are_escaped():
    evil = "<script>alert(1)</script>"
    cg = ep.CompGraph({evil: lambda x: x}, {evil: ('a"b&<c', "y")})
    runner = ep.CompGraphRunner(cg, {'a"b&<c': evil})
    runner.run()
    bundle = mimebundle(runner)
    assert "<script" not in bundle["image/svg+xml"]
    scripts = re.findall(r"<script[^>]*>(.*?)</script>", bundle["text/html"], re.DOTALL)
    assert bundle["text/html"].count("<script") == len(scripts) == 2, "our own: the data and what explores them"
    assert not any("alert(1)" in script for script in scripts)
    ET.fromstring(bundle["image/svg+xml"])


def test_ids_differ_where_names_do():
    cg = ep.CompGraph(
        dict.fromkeys(["a b", "a_b", "a-b"], lambda: 1), {"a b": ((), "x y"), "a_b": ((), "x_y"), "a-b": ((), "x.y")}
    )
    assert len(vertices(to_svg(cg))) == 6


def test_a_function_and_a_token_of_one_name_are_two_vertices():
    cg = ep.CompGraph({"edges": abs, "image": abs}, {"image": ("image", "gray"), "edges": ("gray", "edges")})
    found = vertices(to_svg(cg))
    assert set(found) == {"function-edges", "function-image", "token-image", "token-gray", "token-edges"}
    found = vertices(to_svg(ep.CompGraphRunner(cg).run(image=-3)))
    assert found["token-edges"].find(f"{SVG}title").text == "token edges: int 3, fresh"
    assert found["function-edges"].find(f"{SVG}title").text.startswith("function edges")
    assert ("function" in found["function-edges"].get("class"), "token" in found["token-edges"].get("class")) == (
        True,
        True,
    )


def test_long_names_that_differ_at_their_ends_differ_in_the_picture():
    names = [f"detect_and_describe_the_features_of_image_{side}" for side in ("left", "right")]
    cg = ep.CompGraph(dict.fromkeys(names, abs), {name: ("x", f"{name}_out") for name in names})
    labels = [texts(group)[0] for group in vertices(to_svg(cg)).values()]
    assert len(set(labels)) == len(labels) == 5
    assert all(len(label) <= 32 for label in labels)


def test_pictures_stay_small_and_say_what_was_left_out(photograph):
    count = 60
    noise = np.random.default_rng(0).integers(0, 255, (128, 128, 3)).astype(np.uint8)
    functions = {f"f{index}": lambda x: x.copy() for index in range(count)}
    cg = ep.CompGraph(functions, {f"f{index}": (f"t{index}", f"t{index + 1}") for index in range(count)})
    run = ep.CompGraphRunner(cg).run(t0=noise)
    bundle = mimebundle(run)
    limit = 30_000 + 600 * (2 * count + 1) + THUMBNAIL_CHARACTERS
    assert len(bundle["image/svg+xml"]) <= limit
    assert len(bundle["text/html"]) <= limit + KEPT_CHARACTERS
    assert "thumbnails left out" in bundle["text/html"]
    assert vertices(bundle["image/svg+xml"])[f"token-t{count}"].find(f"{SVG}image") is not None, "sinks come first"


def test_looking_computes_nothing(edge_graph, photograph):
    calls = []
    cg = ep.CompGraph({"f": lambda x: calls.append(x)}, {"f": ("x", None)})
    mimebundle(ep.CompGraphRunner(cg, {"x": 1}))
    assert calls == []


@pytest.mark.parametrize("name", ["\ud800", "a\0b", "a\x1b[31mb", "two\nlines", "x" * 100_000, "数え", " "], ids=ascii)
def test_any_name_can_be_shown(name):
    cg = ep.CompGraph({name: lambda x: x}, {name: ("x", name)})
    runner = ep.CompGraphRunner(cg)
    runner.run(x=1)
    for shown in (cg, runner, runner.last):
        bundle = mimebundle(shown)
        ET.fromstring(bundle["image/svg+xml"])
        bundle["text/html"].encode()
        assert len(bundle["text/html"]) < 40_000
        assert "\n" not in bundle["text/plain"]
        assert len(bundle["text/plain"]) < 100


@pytest.mark.parametrize(("functions", "inputs"), [(30, 16), (60, 16), (200, 4)])
def test_dense_graphs_are_drawn_within_the_limits(functions, inputs):
    tokens, io = [f"s{index}" for index in range(inputs)], {}
    for index in range(functions):
        # A stride that is prime to the number of tokens spreads the inputs.
        io[f"f{index}"] = (tuple(tokens[(7 * index + 5 * place) % len(tokens)] for place in range(inputs)), f"t{index}")
        tokens.append(f"t{index}")
    cg = ep.CompGraph(dict.fromkeys(io, lambda *xs: 1), io)
    bundle = mimebundle(ep.show(cg, collapse=False))
    limit = 30_000 + 600 * (functions + len(cg.tokens))
    assert 0 < len(bundle["image/svg+xml"]) <= limit
    assert 0 < len(bundle["text/html"]) <= limit


def test_a_value_whose_class_lies_can_be_run_and_shown():
    class Lies:
        @property
        def __class__(self):
            raise RuntimeError("no class")

    runner = ep.CompGraphRunner(ep.CompGraph({"f": lambda x: x}, {"f": ("x", "y")}))
    runner.run(x=Lies())
    assert "image/svg+xml" in mimebundle(runner)


def test_graphviz_is_not_asked_for_what_would_take_it_minutes(monkeypatch):
    monkeypatch.setattr("epypes.display.layout._dot_source", lambda *graph: pytest.fail("asked"))
    sources = tuple(f"s{index}" for index in range(100))
    io = {f"f{index}": (sources, f"t{index}") for index in range(100)}
    svg = ep.show(ep.CompGraph(dict.fromkeys(io, lambda *xs: 1), io), collapse=False).svg
    assert len(vertices(svg)) == 300
    assert len(svg) <= 30_000 + 600 * 300 + THUMBNAIL_CHARACTERS


def colour_of(data: bytes) -> str:
    """Return which channel of an encoded picture is the strongest."""
    pixel = np.asarray(Image.open(io.BytesIO(data)).convert("RGB")).reshape(-1, 3).mean(axis=0)
    return ("red", "green", "blue")[int(pixel.argmax())]


@pytest.mark.parametrize("wrapped", [False, True], ids=["functions", "nodes"])
def test_a_token_that_is_marked_rgb_shows_its_colours_and_any_other_is_bgr(wrapped):
    runner = red_runner()
    shown = ep.Pipeline("red", runner.cg).runner if wrapped else runner
    tokens = {token.name: token for token in view(shown.run(image=red_image())).tokens}
    colours = {name: colour_of(token.preview.picture.data) for name, token in tokens.items()}
    assert colours == {"image": "red", "red": "red", "unsaid": "blue"}
    assert tokens["red"].preview.detail.startswith("uint8 64 x 64 x 3 rgb, 0 to 200, ")
    assert tokens["unsaid"].preview.detail.startswith("uint8 64 x 64 x 3 bgr, 0 to 200, ")
    found = vertices(to_svg(shown))
    links = [found[f"token-{name}"].find(f"{SVG}image").get("href") for name in ("image", "unsaid")]
    assert [colour_of(base64.b64decode(link.partition(",")[2])) for link in links] == ["red", "blue"]


def test_a_hyperparameter_that_is_an_image_shows_its_colours():
    runner = ep.CompGraphRunner(red_runner().cg, {"image": red_image()})
    for shown in (runner, runner.run()):
        image = next(token for token in view(shown).tokens if token.name == "image")
        assert (image.role, colour_of(image.preview.picture.data)) == ("hyperparameter", "red")
