"""A node stays itself, whatever it stands for, and its times are those of the call."""

from __future__ import annotations

import gc

import numpy as np
import pytest

import epypes as ep


class Camera:
    """A callable with attributes that are called like a node's own."""

    def __init__(self):
        self.name, self.time, self.func = "the camera", -1.0, None
        self.compute = self.traverse_time = lambda *args: "the camera's"

    def __call__(self, exposure):
        return exposure


def test_a_node_around_a_callable_object_keeps_its_own_name_and_methods():
    node = ep.Node("shot", Camera())
    assert node(3) == 3
    assert (node.name, node.run_count) == ("shot", 1)
    assert node.traverse_time() == ("shot", node.time)
    assert node.time > 0


def test_a_node_around_a_node_calls_it_and_both_count():
    inner = ep.Node("inner", lambda x: x + 1)
    outer = ep.Node("outer", inner)
    assert outer(1) == 2
    inner(1)
    assert (outer.name, outer.run_count, inner.name, inner.run_count) == ("outer", 1, "inner", 2)
    assert outer.time > 0


def test_a_node_around_a_pipeline_runs_it():
    pipe = ep.Pipeline("pipe", ep.CompGraph({"f": abs}, {"f": ("x", "y")}))
    node = ep.Node("node", pipe)
    assert node(-2) == 2
    assert (node.name, node.run_count, pipe.run_count) == ("node", 1, 1)


def test_marks_of_a_function_count_for_its_node():
    seen = []

    @ep.unguarded
    @ep.outputs("flag")
    def look(image):
        seen.append(image.flags.writeable)

    cg = ep.CompGraph.from_functions(ep.Node("look", look))
    assert cg.sink_tokens == ("flag",)
    ep.CompGraphRunner(cg).run(image=np.zeros(2))
    assert seen == [True]


def test_the_repr_of_a_node_stays_short_whatever_its_class_is_called():
    node = type("A" * 90, (ep.Node,), {})("n" * 90, abs)
    assert len(repr(node)) < 100


def branching():
    """Make a pipeline of two branches whose times are set, not measured."""
    chosen = ep.switch("choose", {"slow": "a", "fast": "b"}, by="method", output="y")
    cg = ep.CompGraph({"slow": abs, "fast": abs}, {"slow": ("x", "a"), "fast": ("x", "b")}) | chosen
    return ep.Pipeline("p", cg, {"method": "slow"})


def test_the_overhead_of_a_pipeline_leaves_out_the_branch_that_was_not_run():
    pipe = branching()
    assert pipe.compute_overhead() == 0.0, "nothing was called"
    pipe(1)
    pipe.network.nodes["slow"].count_call(3_600_000_000_000)
    pipe["method"] = "fast"
    pipe(1)
    nodes = pipe.network.nodes
    assert pipe.compute_overhead() == pytest.approx(pipe.time - nodes["fast"].time - nodes["choose"].time)
    assert 0 < pipe.compute_overhead() < pipe.time


def test_the_overhead_after_a_failure_leaves_out_what_did_not_run():
    def fail_at_2(x):
        if x == 2:
            raise ValueError(x)
        return x

    cg = ep.CompGraph({"check": fail_at_2, "after": abs}, {"check": ("x", "y"), "after": ("y", "z")})
    pipe = ep.Pipeline("p", cg)
    pipe(1)
    pipe.network.nodes["after"].count_call(3_600_000_000_000)
    with pytest.raises(ValueError, match="2"):
        pipe(2)
    assert 0 < pipe.compute_overhead() < pipe.time


def test_a_rerun_counts_as_no_call_and_the_overhead_is_still_that_of_the_call():
    cg = ep.CompGraph({"f": abs, "g": lambda y, k: y + k}, {"f": ("x", "y"), "g": (("y", "k"), "z")})
    pipe = ep.Pipeline("p", cg, {"k": 1})
    pipe(1)
    pipe.runner.rerun(k=2)
    assert pipe.compute_overhead() == pytest.approx(pipe.time - sum(node.time for node in pipe.network.nodes.values()))


def test_nodes_count_the_calls_of_a_runner_that_is_gone():
    network = ep.NodeBasedCompGraph(ep.CompGraph({"double": lambda x: 2 * x}, {"double": ("x", "y")}))
    runner = ep.CompGraphRunner(network)
    for x in range(10):
        runner.run(x=x)
    del runner
    gc.collect()
    assert network.nodes["double"].run_count == 10
