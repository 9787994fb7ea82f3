"""The defaults of a graph of functions are hyperparameters of its runner, from the functions to the answer."""

from __future__ import annotations

import queue
import xml.etree.ElementTree as ET

import pytest

import epypes as ep
from epypes.errors import GraphError, UnknownName


def gray(image):
    return image + 1


def edges(gray, threshold=70):
    return gray * threshold


@ep.outputs("low", "high")
def ends(edges, margin=1):
    return edges - margin, edges + margin


@ep.outputs()
def show(edges, seen=None):
    if seen is not None:
        seen.add(edges)


@pytest.fixture
def cg():
    return ep.CompGraph.from_functions(show, ends, edges, gray)


def texts(shown):
    root = ET.fromstring(shown._repr_mimebundle_()["image/svg+xml"])
    return {"".join(text.itertext()) for text in root.iter("{http://www.w3.org/2000/svg}text")}


def test_a_graph_of_functions_runs_with_its_defaults(cg, way):
    runner = way.runner(cg)
    assert runner.free_source_tokens == ("image",)
    assert dict(runner.hyperparameters) == {"threshold": 70, "margin": 1, "seen": None}
    for image in range(way.runs):
        run = runner.run(image=image)
        assert (run["low"], run["high"]) == (70 * (image + 1) - 1, 70 * (image + 1) + 1)
    for margin in range(2, 2 + way.runs):
        run = runner.rerun(margin=margin)
        assert (run["low"], run.report.ran) == (70 * way.runs - margin, ("ends",))
    assert dict(cg.defaults) == {"threshold": 70, "margin": 1, "seen": None}, "the graph stays as it is"


class Seen:
    def __init__(self):
        self.values = set()

    def add(self, value):
        self.values.add(value)


def test_what_is_given_goes_before_the_default(cg):
    seen = Seen()
    runner = ep.CompGraphRunner(cg, {"threshold": 2, "seen": seen})
    assert dict(runner.hyperparameters) == {"threshold": 2, "margin": 1, "seen": seen}
    assert runner.run(image=4)["high"] == 11
    assert seen.values == {10}
    assert ep.CompGraphRunner(cg).run(image=4)["high"] == 351, "another runner has the default"


def test_a_default_is_set_unfrozen_and_frozen_like_any_hyperparameter(cg):
    runner = ep.CompGraphRunner(cg)
    runner.run(image=4)
    runner["threshold"] = 3
    assert set(runner.stale) == {"edges", "ends", "show"}
    assert runner.rerun()["high"] == 16
    runner.unfreeze("threshold")
    assert runner.free_source_tokens == ("image", "threshold")
    assert runner.run(image=4, threshold=5)["high"] == 26
    with pytest.raises(UnknownName, match="Did you mean 'threshold'"):
        runner["treshold"] = 1


def test_a_default_shows_with_its_value(cg):
    runner = ep.CompGraphRunner(cg, {"margin": 4})
    assert {"threshold = 70", "margin = 4"} <= texts(runner)
    runner["threshold"] = 90
    assert "threshold = 90" in texts(runner)
    assert "threshold = 70" in texts(ep.Pipeline("p", cg))


def test_a_default_may_choose_the_branch_of_a_switch():
    def name(image, method="canny"):
        return method

    cg = ep.CompGraph.from_functions(name, gray) | ep.switch(
        "choose", {"canny": "gray", "sobel": "image"}, by="method", output="out"
    )
    runner = ep.CompGraphRunner(cg)
    assert runner.run(image=1)["out"] == 2
    assert runner.rerun(method="sobel")["out"] == 1
    with pytest.raises(UnknownName, match="No branch 'cany'"):
        ep.CompGraphRunner(cg, {"method": "cany"})


def test_defaults_hold_in_pipelines_of_every_kind_and_in_a_graph_of_pipelines(cg):
    q_in, q_out = queue.Queue(), queue.Queue()
    f_in, f_out = (lambda event: {"image": event}), (lambda view: (view["low"], view["high"]))
    assert ep.Pipeline("p", cg)(1) == (139, 141)
    assert ep.Pipeline("p", cg, {"threshold": 2})(1) == (3, 5)
    ep.SourcePipeline("p", cg, q_out, f_out, {"margin": 3}).run(image=1)
    assert q_out.get_nowait() == (137, 143)
    with ep.FullPipeline("p", cg, q_in, q_out, f_in, f_out, {"threshold": 1}):
        q_in.put(1)
        assert q_out.get(timeout=60) == (1, 3)
    with pytest.raises(GraphError, match="takes 1 input"):
        ep.CompGraph({"f": ep.Pipeline("p", cg)}, {"f": (("a", "b"), ("c", "d"))})
    outer = ep.CompGraph({"f": ep.Pipeline("p", cg)}, {"f": ("a", ("c", "d"))})
    assert dict(outer.defaults) == {}
    assert ep.CompGraphRunner(outer).run(a=1)["d"] == 141


def test_defaults_come_along_when_graphs_are_joined(cg):
    two = ep.union(cg, cg, suffixes=("_1", "_2"), keep=("threshold", "seen"))
    runner = ep.CompGraphRunner(two, {"margin_2": 0})
    assert runner.free_source_tokens == ("image_1", "image_2")
    run = runner.run(image_1=0, image_2=1)
    assert (run["high_1"], run["high_2"]) == (71, 140)
    assert set(runner.rerun(threshold=1).report.ran) == {
        f"{name}_{n}" for name in ("edges", "ends", "show") for n in (1, 2)
    }
