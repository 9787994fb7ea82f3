"""The paper's classes in the forms that Semeniuta and Falkman 2019 give them."""

from __future__ import annotations

import copy
import queue
from collections.abc import Mapping

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.errors import HyperparameterError, NotComputed, StaleToken, UnknownName

TIMEOUT_S = 60
HPARAMS = {"blur_kernel": 11, "canny_lo": 70, "canny_hi": 200}


def to_gray(im):
    return cv2.cvtColor(im, cv2.COLOR_BGR2GRAY)


def gaussian_blur(img, kernel_size):
    return cv2.GaussianBlur(img, (kernel_size, kernel_size), 0)


@pytest.fixture
def image():
    return np.random.default_rng(0).integers(0, 255, (32, 32, 3), np.uint8)


@pytest.fixture
def cg():
    """Return the graph of Figure 4."""
    return ep.CompGraph(
        {"grayscale": to_gray, "canny": cv2.Canny, "blur": gaussian_blur},
        {
            "grayscale": ("image", "image_gray"),
            "blur": (("image_gray", "blur_kernel"), "image_blurred"),
            "canny": (("image_blurred", "canny_lo", "canny_hi"), "edges"),
        },
    )


def number_graph():
    """Return f: x -> y; g: (y, k) -> z."""
    return ep.CompGraph({"f": lambda x: x + 1, "g": lambda y, k: y * k}, {"f": ("x", "y"), "g": (("y", "k"), "z")})


def runner_of_figure_4(cg):
    return ep.CompGraphRunner(cg, HPARAMS)


def pipeline_of_figure_4(cg):
    return ep.Pipeline("edges", cg, HPARAMS)


@pytest.fixture(params=[runner_of_figure_4, pipeline_of_figure_4])
def namespace(request, cg):
    """Return a runner, and a pipeline, of the graph of Figure 4."""
    return request.param(cg)


class TestMapping:
    """Runner and pipeline have the interface of a dictionary ("Computational graphs", Figure 4)."""

    def test_before_a_run_it_has_its_hyperparameters(self, namespace):
        assert isinstance(namespace, Mapping)
        assert dict(namespace) == HPARAMS
        assert len(namespace) == 3
        assert "edges" not in namespace
        assert namespace.get("edges") is None
        assert namespace.get("no such token", 3) == 3

    def test_after_a_run_it_has_every_token_in_graph_order(self, namespace, cg, image):
        namespace.run(image=image)
        assert "edges" in namespace
        assert tuple(namespace) == tuple(namespace.keys()) == cg.tokens
        assert len(namespace) == len(cg.tokens)
        for (token, item), value in zip(namespace.items(), namespace.values(), strict=True):
            np.testing.assert_array_equal(item, namespace[token])
            np.testing.assert_array_equal(value, namespace[token])
        np.testing.assert_array_equal(dict(namespace)["edges"], namespace.get("edges"))

    def test_what_is_stale_is_not_in_it(self, namespace, image):
        namespace.run(image=image)
        namespace["canny_lo"] = 90
        assert namespace["canny_lo"] == namespace.get("canny_lo") == 90
        assert "edges" not in namespace
        assert namespace.get("edges", "stale") == "stale"
        assert "edges" not in dict(namespace)
        with pytest.raises(StaleToken):
            namespace["edges"]
        assert "image_blurred" in namespace

    def test_hyperparameters_alone_are_set(self, namespace):
        with pytest.raises(HyperparameterError):
            namespace["edges"] = 1
        with pytest.raises(UnknownName, match="Did you mean 'canny_lo'"):
            namespace["cannylo"] = 1

    def test_after_a_failed_run_it_has_what_was_computed(self):
        cg = ep.CompGraph({"f": lambda x: x + 1, "g": lambda y: 1 / y}, {"f": ("x", "y"), "g": ("y", "z")})
        for namespace in (ep.CompGraphRunner(cg), ep.Pipeline("p", cg)):
            with pytest.raises(ZeroDivisionError):
                namespace.run(x=-1)
            assert dict(namespace) == {"x": -1, "y": 0}

    def test_it_is_told_apart_by_identity_and_a_pipeline_is_always_true(self, cg):
        runner, pipe = ep.CompGraphRunner(cg), ep.Pipeline("edges", cg)
        assert (len(runner), len(pipe), bool(pipe)) == (0, 0, True)
        assert runner != ep.CompGraphRunner(cg)
        assert pipe != ep.Pipeline("edges", cg)
        assert {runner: 1, pipe: 2} == {pipe: 2, runner: 1}


class TestTokenManager:
    """The runner delegates storage to a TokenManager (the class diagram in "Computational graphs")."""

    def test_one_of_a_graph_alone_has_no_values(self, cg):
        tokens = ep.TokenManager(cg)
        assert list(tokens) == []
        assert "edges" not in tokens
        assert not tokens.is_computed("edges")
        with pytest.raises(NotComputed, match=r"'image' has not been computed. Pass it: run\(image=...\)"):
            tokens["image"]
        with pytest.raises(UnknownName, match="Did you mean 'edges'"):
            tokens["edge"]

    def test_it_has_the_values_that_it_is_given(self, cg, image):
        tokens = ep.TokenManager(cg, {"image": image, "blur_kernel": None})
        assert list(tokens) == ["image", "blur_kernel"]
        assert tokens["blur_kernel"] is None
        assert not tokens["image"].flags.writeable
        assert image.flags.writeable
        with pytest.raises(UnknownName, match="Did you mean 'image'"):
            ep.TokenManager(cg, {"imag": image})

    def test_that_of_a_run_has_the_values_of_the_run(self, cg, image):
        run = ep.CompGraphRunner(cg, HPARAMS).run(image=image)
        assert isinstance(run.tokens, ep.TokenManager)
        assert tuple(run.tokens) == cg.tokens
        np.testing.assert_array_equal(run.tokens["edges"], run["edges"])


class TestNodeBasedCompGraph:
    """The network of Nodes of a graph is a graph (the class diagram in "Nodes and pipelines")."""

    def test_it_is_the_graph_with_nodes_as_functions(self, cg):
        network = ep.NodeBasedCompGraph(cg)
        assert isinstance(network, ep.CompGraph)
        assert (dict(network.func_io), network.tokens) == (dict(cg.func_io), cg.tokens)
        assert all(isinstance(node, ep.Node) for node in network.functions.values())
        assert network.nodes == network.functions
        assert repr(network) == "<NodeBasedCompGraph: 3 nodes>"
        with pytest.raises(TypeError, match="made of a CompGraph, not 'CompGraphRunner'"):
            ep.NodeBasedCompGraph(ep.CompGraphRunner(cg))

    def test_it_runs_and_its_nodes_measure_their_time(self, cg, image):
        network = ep.NodeBasedCompGraph(cg)
        edges = ep.CompGraphRunner(network, HPARAMS).run(image=image)["edges"]
        np.testing.assert_array_equal(edges, ep.CompGraphRunner(cg, HPARAMS).run(image=image)["edges"])
        assert [(name, seconds > 0) for name, seconds in network.traverse_time()] == [
            ("grayscale", True), ("blur", True), ("canny", True),
        ]  # fmt: skip
        assert all(node.run_count == 1 for node in network.nodes.values())

    def test_it_is_drawn_like_its_graph(self, cg):
        network = ep.NodeBasedCompGraph(cg)
        assert set(network.to_networkx()) == set(cg.to_networkx())
        view, network_view = ep.show(cg).view, ep.show(network).view
        assert [each.name for each in network_view.functions] == [each.name for each in view.functions]
        bundle = network._repr_mimebundle_()
        assert bundle["text/plain"] == repr(network)
        assert "image_blurred" in bundle["image/svg+xml"]

    def test_it_joins_other_graphs(self, cg):
        network = ep.NodeBasedCompGraph(cg)
        other = ep.CompGraph({"count": np.count_nonzero}, {"count": ("edges", "number")})
        whole = network | other
        assert whole.sink_tokens == ("number",)
        assert whole.functions["blur"] is network.nodes["blur"]
        two = ep.union(network, network, suffixes=("_1", "_2"), keep=("blur_kernel", "canny_lo", "canny_hi"))
        assert len(two.functions) == 6
        assert list(ep.subgraph(network, "image_gray").functions) == ["grayscale"]

    def test_nodes_are_kept_and_groups_and_defaults_go_along(self):
        def f(x, k=3):
            return x + k

        node = ep.Node("f", f)
        network = ep.NodeBasedCompGraph(ep.group(ep.CompGraph.from_functions(node), "all", functions="f"))
        assert network.nodes["f"] is node
        assert (dict(network.groups), dict(network.defaults)) == ({"all": ("f",)}, {"k": 3})
        assert ep.NodeBasedCompGraph(network).nodes == network.nodes
        assert isinstance(ep.NodeBasedCompGraph.from_functions(f).nodes["f"], ep.Node)

    def test_it_can_be_copied(self, cg):
        network = ep.NodeBasedCompGraph(cg)
        assert copy.deepcopy(network) is network
        assert copy.copy(network).nodes == network.nodes


class TestEventLoop:
    """An EventLoop takes q_in, a pipeline and f_in (the figures of "Reactive pipelines", Figure 12)."""

    def test_it_runs_a_pipeline_on_what_f_in_makes_of_each_event(self):
        q_in, done = queue.Queue(), queue.Queue()
        cg = ep.extend(number_graph(), {"put": done.put}, {"put": ("z", None)})
        pipe = ep.Pipeline("numbers", cg, {"k": 10})
        loop = ep.EventLoop(q_in, pipe, lambda event: {"x": event["number"]})
        assert loop.name == "numbers"
        loop.start()
        q_in.put({"number": 1})
        q_in.put({"number": 4})
        assert [done.get(timeout=TIMEOUT_S) for _ in range(2)] == [20, 50]
        loop.stop(TIMEOUT_S)
        assert (pipe["x"], pipe.run_count) == (4, 2)

    def test_a_failed_run_is_reported_and_the_loop_goes_on(self):
        q_in, failed = queue.Queue(), queue.Queue()
        pipe = ep.Pipeline("inverse", ep.CompGraph({"f": lambda x: 1 / x}, {"f": ("x", "y")}))
        loop = ep.EventLoop(
            q_in, pipe, lambda event: {"x": event}, on_error=lambda event, error: failed.put((event, type(error)))
        )
        loop.start()
        for event in (0, 2, 0):
            q_in.put(event)
        assert [failed.get(timeout=TIMEOUT_S) for _ in range(2)] == [(0, ZeroDivisionError)] * 2
        loop.stop(TIMEOUT_S)
        assert pipe.run_count == 3

    def test_without_f_in_the_event_is_the_only_input(self):
        q_in, done = queue.Queue(), queue.Queue()
        pipe = ep.Pipeline("put", ep.CompGraph({"put": done.put}, {"put": ("x", None)}))
        loop = ep.EventLoop(q_in, pipe)
        loop.start()
        q_in.put(3)
        assert done.get(timeout=TIMEOUT_S) == 3
        loop.stop(TIMEOUT_S)

    def test_a_full_pipeline_answers_and_reports_as_when_it_listens(self):
        q_in, q_out, other_in, failed = (queue.Queue() for _ in range(4))
        pipe = ep.FullPipeline(
            "numbers", number_graph(), other_in, q_out, lambda event: {"x": event}, lambda view: view["z"], {"k": 10}
        )
        pipe.on_error = failed.put
        loops = [
            ep.EventLoop(q_in, pipe, lambda event: {"x": -event}),
            ep.EventLoop(q_in, pipe, pipe.f_in),
            ep.EventLoop(q_in, pipe),
        ]
        for loop, expected in zip(loops, (-40, 60, 60), strict=True):
            loop.start()
            q_in.put(5)
            assert q_out.get(timeout=TIMEOUT_S) == expected
            q_in.put("five")
            assert failed.get(timeout=TIMEOUT_S).function == ("f_in" if loop is loops[0] else "f")
            loop.stop(TIMEOUT_S)
        assert (pipe.failed, pipe.run_count) == (3, 5)

    def test_an_event_is_acknowledged_once_whichever_loop_takes_it(self):
        words = []

        class Event:
            id = "1"

            def ack(self):
                words.append("ack")

            def reject(self, reason):
                words.append("reject")

        q_in, done = queue.Queue(), queue.Queue()
        graph = ep.CompGraph({"put": done.put}, {"put": ("x", None)})
        own = ep.SinkPipeline("sink", graph, queue.Queue(), lambda event: {"x": event})
        for pipe in (ep.Pipeline("plain", graph), own):
            loop = ep.EventLoop(q_in, pipe, lambda event: {"x": event.id})
            loop.start()
            q_in.put(Event())
            done.get(timeout=TIMEOUT_S)
            loop.stop(TIMEOUT_S)
        assert words == ["ack", "ack"]

    def test_a_function_still_works(self):
        q_in, done = queue.Queue(), queue.Queue()
        loop = ep.EventLoop(q_in, lambda value: done.put(value), lambda event: {"value": event})
        loop.start()
        q_in.put(7)
        assert done.get(timeout=TIMEOUT_S) == 7
        loop.stop(TIMEOUT_S)

    def test_a_pipeline_listens_by_such_a_loop(self):
        pipe = ep.SinkPipeline("sink", number_graph(), queue.Queue(), lambda event: {"x": event}, {"k": 1})
        assert isinstance(pipe.loop, ep.EventLoop)
        assert pipe.loop.callback is pipe
