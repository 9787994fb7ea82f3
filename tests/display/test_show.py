from __future__ import annotations

import json
import queue
import re
import sys
import xml.etree.ElementTree as ET

import cv2
import numpy as np
import pytest
from PIL import Image

import epypes as ep
from epypes.display import mimebundle, to_svg, view
from epypes.display.layout import lay_out
from epypes.display.paint.svg import paint_svg
from epypes.display.previews.preview import Chart, Preview
from epypes.display.views.graphview import EdgeView, FunctionView, GraphView, StageView, TokenView, from_json, to_json
from epypes.errors import MissingPackage, UnknownName
from epypes.graph import Placeholder

SVG = "{http://www.w3.org/2000/svg}"


@pytest.fixture
def grouped_runner(edge_graph, photograph):
    runner = ep.CompGraphRunner(
        ep.group(edge_graph, "smooth", functions=["grayscale", "blur"]),
        {"blur_kernel": 11, "canny_lo": 70, "canny_hi": 200},
    )
    runner.run(image=photograph)
    return runner


def ids(svg):
    return {group.get("id") for group in ET.fromstring(svg).iter(f"{SVG}g")}


def test_a_figure_without_options_is_what_a_notebook_gets(grouped_runner):
    figure, bundle = ep.show(grouped_runner), mimebundle(grouped_runner)
    assert figure.svg == bundle["image/svg+xml"]
    assert figure.html == bundle["text/html"]
    assert figure._repr_mimebundle_()["text/html"] == bundle["text/html"]
    assert len(repr(figure)) < 100


@pytest.mark.parametrize("kind", ["graph", "runner", "run", "plan", "pipeline"])
def test_whatever_shows_itself_can_be_shown_in_another_way(grouped_runner, kind):
    shown = {
        "graph": grouped_runner.cg,
        "runner": grouped_runner,
        "run": grouped_runner.last,
        "plan": grouped_runner.plan(),
        "pipeline": ep.Pipeline("p", grouped_runner.cg, {"blur_kernel": 11, "canny_lo": 70, "canny_hi": 200}),
    }[kind]
    figure = ep.show(shown, direction="right", open="smooth")
    assert {"function-grayscale", "function-blur", "function-canny"} <= ids(figure.svg)
    assert figure.view.direction == "right"
    assert set(figure._repr_mimebundle_()) == {"text/plain", "text/html", "image/svg+xml"}
    assert ("<th" in figure.html.rpartition("</figure>")[2]) == (kind == "plan"), "the table of a plan"


def test_from_left_to_right_what_follows_stands_to_the_right(edge_runner, photograph):
    edge_runner.run(image=photograph)
    svg = ET.fromstring(ep.show(edge_runner, direction="right").svg)
    width, height = float(svg.get("width")), float(svg.get("height"))
    assert width > 3 * height
    at = {group.get("id"): float(group.find(f"{SVG}text").get("x")) for group in svg.iter(f"{SVG}g")}
    chain = ["token-image", "function-grayscale", "token-image_gray", "function-blur", "token-image_blurred"]
    assert [at[name] for name in chain] == sorted(at[name] for name in chain)
    assert at["token-blur_kernel"] < at["function-blur"]


def test_a_picture_may_be_shrunk_a_little_and_is_scrolled_otherwise(edge_runner):
    figure = ep.show(edge_runner, direction="right")
    width = float(ET.fromstring(figure.svg).get("width"))
    for text in (figure.svg, figure.html.partition("<figcaption")[0]):
        (least,) = re.findall(r"min-width:(\d+)px", re.sub(r"data:[^\"]*", "", text))
        assert float(least) == pytest.approx(0.75 * width, abs=1)
    assert 'style="overflow:auto"' in figure.html


@pytest.mark.parametrize("most", [0, 1, 3])
def test_thumbnails_are_as_many_as_asked_for(edge_runner, photograph, most):
    edge_runner.run(image=photograph)
    assert ep.show(edge_runner, thumbnails=most).svg.count("<image") == most


def test_the_last_thumbnail_that_is_kept_is_that_of_the_sink(edge_runner, photograph):
    edge_runner.run(image=photograph)
    (token,) = (token for token in view(edge_runner, thumbnails=1).tokens if token.preview and token.preview.picture)
    assert token.name == "edges"


def test_groups_can_be_drawn_open(grouped_runner):
    assert "function-smooth" in ids(ep.show(grouped_runner).svg)
    for options in ({"open": ["smooth"]}, {"open": "smooth"}, {"collapse": False}):
        figure = ep.show(grouped_runner, **options)
        assert "function-smooth" not in ids(figure.svg)
        assert "epypes-inside" not in figure.html.partition("<style")[0]


@pytest.mark.parametrize(
    ("options", "error", "said"),
    [
        ({"direction": "up"}, ValueError, 'direction must be "down" or "right", not \'up\''),
        ({"open": ["smoth"]}, UnknownName, "No group 'smoth' in this picture. Did you mean 'smooth'"),
        ({"open": 3}, TypeError, "open must be a name or an iterable of names"),
        ({"thumbnails": -1}, ValueError, "thumbnails must be 0 or more, not -1"),
        ({"thumbnails": None}, TypeError, "thumbnails must be a number"),
    ],
)
def test_bad_arguments_are_refused_with_a_sentence(grouped_runner, options, error, said):
    with pytest.raises(error, match=said):
        ep.show(grouped_runner, **options)


@pytest.mark.parametrize("shown", [None, 3, "graph", np.zeros(3), ep.CompGraph, ep.Pipeline])
def test_what_can_not_be_shown_is_refused_with_what_can(shown):
    with pytest.raises(TypeError, match="draws a CompGraph, a CompGraphRunner, a Run, a Plan or a Pipeline"):
        ep.show(shown)


def test_a_sweep_shows_itself_and_is_no_pipeline(edge_runner, photograph):
    edge_runner.run(image=photograph)
    swept = ep.sweep(edge_runner, {"canny_lo": [50]}, progress=False)
    with pytest.raises(TypeError, match="a Plan or a Pipeline, not 'SweepResult'"):
        ep.show(swept)


def test_a_figure_stays_as_it_was_when_it_was_shown(edge_runner, photograph):
    edge_runner.run(image=photograph)
    figure = ep.show(edge_runner)
    before = figure.svg
    edge_runner.rerun(canny_lo=90)
    assert figure.svg == before != to_svg(edge_runner)


def test_without_an_engine_a_figure_is_text(edge_graph, monkeypatch):
    monkeypatch.setitem(sys.modules, "graphviz", None)
    lay_out.cache_clear()
    bundle = ep.show(edge_graph, direction="right")._repr_mimebundle_()
    assert set(bundle) == {"text/plain"}
    assert "canny(image_blurred, canny_lo, canny_hi) -> edges" in bundle["text/plain"]


# -- files ------------------------------------------------------------------------------------------------------------


def test_a_figure_is_saved_as_a_picture_a_page_or_json(grouped_runner, tmp_path):
    figure = ep.show(grouped_runner)
    assert figure.save(tmp_path / "a.svg").read_text(encoding="utf-8") == figure.svg
    page = figure.save(str(tmp_path / "a.html")).read_text(encoding="utf-8")
    assert page.startswith("<!doctype html>")
    assert figure.html in page
    written = json.loads(figure.save(tmp_path / "a.json").read_text(encoding="utf-8"))
    assert from_json(written) == figure.view


def test_a_figure_is_saved_as_png_with_its_thumbnails_and_states(tmp_path):
    def colours(image):
        return image, np.full((64, 64, 3), (10, 200, 20), np.uint8)

    cg = ep.CompGraph(
        {"colours": colours, "wide$name": len}, {"colours": ("image", ("same", "made")), "wide$name": ("same", "n")}
    )
    runner = ep.CompGraphRunner(cg)
    runner.run(image=np.full((64, 64, 3), (10, 20, 200), np.uint8))
    path = ep.show(runner).save(tmp_path / "a.png")
    with Image.open(path) as picture:
        svg = ET.fromstring(ep.show(runner).svg)
        assert picture.size == (2 * int(svg.get("width")), 2 * int(svg.get("height")))
        pixels = np.asarray(picture.convert("RGB")).astype(int)

    def count(*colour):
        return int((np.abs(pixels - colour).max(axis=-1) < 12).sum())

    thumbnail = (2 * 96) ** 2  # pixels of a square thumbnail
    assert count(200, 20, 10) == pytest.approx(2 * thumbnail, rel=0.05), "BGR as it is shown"
    assert count(20, 200, 10) == pytest.approx(thumbnail, rel=0.05)
    assert count(0x17, 0x69, 0xC2) > 500, "the borders of functions"
    assert (pixels[0, 0] == 255).all(), "on white"


@pytest.mark.parametrize("direction", ["down", "right"])
def test_a_figure_is_saved_as_pdf_with_its_thumbnails_and_its_text(grouped_runner, tmp_path, direction):
    figure = ep.show(grouped_runner, direction=direction)
    written = figure.save(tmp_path / "a.pdf").read_bytes()
    assert written.startswith(b"%PDF-")
    masks = written.count(b"/SMask")
    assert written.count(b"/Subtype /Image") - masks == figure.svg.count("<image ") > 0
    assert b"/BaseFont" in written, "text is text"
    assert written == figure.save(tmp_path / "b.pdf").read_bytes(), "the same picture is the same file"


@pytest.mark.parametrize("ending", ["png", "pdf"])
def test_pictures_of_all_kinds_of_vertices_can_be_saved_on_paper(photograph, tmp_path, ending):
    def failing(image):
        raise ValueError("no $x^2$ \u4e2d here")

    either = ep.switch("either", {"a": "first", "b": "second"}, by="which", output="chosen")
    cg = either | ep.CompGraph(
        {"first": cv2.split, "later": Placeholder(), "histogram": lambda image: np.histogram(image, 64)[0], "fail": failing},
        {"first": ("image", ("first", "second", "third")), "later": ("third", "more"), "histogram": ("image", "counts"),
         "fail": ("counts", "nothing")},
    )  # fmt: skip
    pipeline = ep.FullPipeline("p", cg, queue.Queue(), queue.Queue(), lambda e: e, lambda v: v, {"which": "a"})
    for target in ("chosen", "counts"):
        pipeline.runner.run(target, image=photograph)
    with pytest.raises(ValueError, match="here"):
        pipeline.runner.run("nothing", image=photograph)
    path = ep.show(pipeline).save(tmp_path / f"a.{ending}")
    assert path.stat().st_size > 10_000


def test_a_png_without_matplotlib_names_what_to_install(edge_graph, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(MissingPackage, match=r"'matplotlib' is missing. Run: pip install 'epypes\[vision\]'"):
        ep.show(edge_graph).save(tmp_path / "a.png")


@pytest.mark.parametrize("name", ["a.gif", "a.tiff", "a"])
def test_other_files_are_refused_with_those_that_can_be_written(edge_graph, tmp_path, name):
    with pytest.raises(ValueError, match=r"writes \.svg, \.html, \.png, \.pdf and \.json, not '" + name):
        ep.show(edge_graph).save(tmp_path / name)
    assert not list(tmp_path.iterdir())


# -- JSON -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["graph", "runner", "run", "failed", "plan", "right"])
def test_what_is_painted_from_json_is_the_same_picture(grouped_runner, kind):
    graph = view(grouped_runner)
    if kind == "graph":
        graph = view(grouped_runner.cg)
    elif kind == "run":
        graph = view(grouped_runner.last)
    elif kind == "failed":
        with pytest.raises(Exception, match="ksize"):
            grouped_runner.rerun(blur_kernel=4)
        graph = view(grouped_runner)
    elif kind == "plan":
        graph = view(grouped_runner.plan())
    elif kind == "right":
        graph = view(grouped_runner, direction="right")
    again = from_json(json.loads(json.dumps(to_json(graph), allow_nan=False)))
    assert again == graph
    assert paint_svg(again) == paint_svg(graph)
    assert [paint_svg(group.graph) for group in again.groups] == [paint_svg(group.graph) for group in graph.groups]


def test_stages_charts_and_rows_survive_json():
    chart = Chart("points", (((0.0, 0.5), (1.0, 0.25)), ()))
    graph = GraphView(
        (FunctionView("f", "running", 12, 0.5, "m", notes=("a", "b"), is_redefined=True),),
        (TokenView("t", "payload", "fresh", Preview("x", "y", None, chart, ("1", "2")), "rgb", "3"),),
        (EdgeView(0, 0, False, False),),
        before=(StageView("queue", "q_in", "running", ("2 wait",)),),
        direction="right",
    )
    assert from_json(json.loads(json.dumps(to_json(graph)))) == graph


def test_pictures_are_data_uris_in_json(edge_runner, photograph):
    written = to_json(view(edge_runner.run(image=photograph)))
    (image,) = (token for token in written["tokens"] if token["name"] == "image")
    assert image["preview"]["picture"]["uri"].startswith("data:image/jpeg;base64,")


def test_fields_that_are_missing_in_json_have_their_defaults(edge_graph):
    written = to_json(view(edge_graph))
    del written["direction"], written["groups"]
    assert from_json({**written, "of a later version": 1}) == view(edge_graph)


@pytest.mark.parametrize("written", [[], None, "x"])
def test_what_is_no_view_is_refused(written):
    with pytest.raises(TypeError, match="A view in JSON is an object"):
        from_json(written)
