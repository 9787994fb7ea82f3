"""Hyperparameters of a pipeline in a graph: named after it, set through the graph, its runner's own."""

from __future__ import annotations

import queue
import threading
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import epypes as ep
from epypes.errors import HyperparameterError, InputMutated, PayloadError, UnknownName
from epypes.run import execute
from epypes.run.runner import branched

RUNS = 6  # enough that the later ones are compiled


class Counted:
    """Functions that count their calls."""

    def __init__(self):
        self.calls = []

    def __call__(self, name, function):
        def counted(*args):
            self.calls.append(name)
            return function(*args)

        return counted

    def taken(self):
        found, self.calls = self.calls, []
        return found


@pytest.fixture
def counted():
    return Counted()


@pytest.fixture
def geometry(counted):
    """points = x + 1; inliers = points * threshold; area = inliers + offset."""
    functions = {
        "find": counted("find", lambda x: x + 1),
        "ransac": counted("ransac", lambda points, threshold: points * threshold),
        "measure": counted("measure", lambda inliers, offset: inliers + offset),
    }
    io = {
        "find": ("x", "points"),
        "ransac": (("points", "threshold"), "inliers"),
        "measure": (("inliers", "offset"), "area"),
    }
    return ep.Pipeline("shapes", ep.CompGraph(functions, io), {"threshold": 2, "offset": 0})


def graph(geometry, counted):
    io = {"before": (("a", "gain"), "b"), "geometry": ("b", "c"), "after": ("c", "d")}
    before, after = counted("before", lambda a, gain: a * gain), counted("after", lambda c: -c)
    return ep.CompGraph({"before": before, "geometry": geometry, "after": after}, io)


@pytest.fixture
def runner(geometry, counted):
    return ep.CompGraphRunner(graph(geometry, counted), {"gain": 1})


@pytest.mark.parametrize("way", ["the loop", "compiled", "threads"])
def test_only_what_depends_on_it_runs_also_inside_the_pipeline(runner, counted, way, monkeypatch):
    monkeypatch.setattr(execute, "RUNS_BEFORE", 0 if way == "compiled" else 1_000)
    if way == "threads":
        monkeypatch.setattr(execute, "has_independent_steps", lambda program: True)
        monkeypatch.setattr(execute.Gain, "is_worth_it", lambda self: True)
        runner = ep.CompGraphRunner(runner.cg, runner.hyperparameters, workers=2)
    assert runner.run(a=1)["d"] == -4
    assert counted.taken() == ["before", "find", "ransac", "measure", "after"]
    for threshold in range(3, 3 + RUNS):
        assert runner.rerun(geometry__threshold=threshold)["d"] == -2 * threshold
        assert counted.taken() == ["ransac", "measure", "after"]
    runner.rerun(geometry__offset=1)
    assert counted.taken() == ["measure", "after"]
    runner.rerun(geometry__offset=1)
    assert counted.taken() == []
    runner.rerun(gain=2)
    assert counted.taken() == ["before", "find", "ransac", "measure", "after"]


def test_a_function_that_depends_on_another_input_of_the_pipeline_is_reused(counted):
    functions = {
        "left": counted("left", abs),
        "right": counted("right", abs),
        "both": counted("both", lambda a, b: a + b),
    }
    io = {"left": ("x", "a"), "right": ("y", "b"), "both": (("a", "b"), "c")}
    pipe = ep.Pipeline("pipe", ep.CompGraph(functions, io))
    runner = ep.CompGraphRunner(ep.CompGraph({"f": pipe}, {"f": (("p", "q"), "r")}), {"q": 1})
    runner.run(p=-3)
    counted.taken()
    assert runner.rerun(q=5)["r"] == 8
    assert counted.taken() == ["right", "both"]


def test_it_is_among_the_hyperparameters_of_the_runner_after_its_own(runner):
    assert dict(runner.hyperparameters) == {"gain": 1, "geometry__threshold": 2, "geometry__offset": 0}
    assert next(iter(runner.hyperparameters)) == "gain"
    runner["geometry__threshold"] = 5
    assert runner["geometry__threshold"] == 5
    assert runner.first_hyperparameters["geometry__threshold"] == 2
    assert runner.free_source_tokens == ("a",)
    assert "geometry__threshold" not in runner, "it is no token of this graph"


def test_the_runner_owns_the_value_and_the_pipeline_keeps_its_own(runner, geometry, counted):
    other = ep.CompGraphRunner(graph(geometry, counted), {"gain": 1})
    for each in (runner, other):
        each.run(a=1)
    assert runner.rerun(geometry__threshold=7)["d"] == -14
    assert geometry["threshold"] == 2
    assert geometry(1) == 4
    assert other.stale == ()
    assert other.rerun()["d"] == -4


def test_one_pipeline_twice_in_a_graph_has_two_values(geometry):
    cg = ep.CompGraph({"left": geometry, "right": geometry}, {"left": ("a", "b"), "right": ("a", "c")})
    run = ep.CompGraphRunner(cg, {"left__threshold": 10, "right__threshold": 100}).run(a=1)
    assert (run["b"], run["c"]) == (20, 200)


def test_what_was_set_last_counts(runner, geometry):
    runner.run(a=1)
    runner.rerun(geometry__threshold=7)
    geometry["threshold"] = 3
    assert runner.stale == ("geometry", "after")
    assert runner["geometry__threshold"] == 3
    assert runner.rerun()["d"] == -6
    runner["geometry__threshold"] = 7
    geometry["offset"] = 1
    assert runner.rerun()["d"] == -15
    runner.unfreeze("geometry__threshold")
    assert runner["geometry__threshold"] == 3, "unfrozen, it is the pipeline's again"


def test_a_runner_is_made_with_values_of_pipelines(geometry, counted):
    runner = ep.CompGraphRunner(graph(geometry, counted), {"gain": 1, "geometry__threshold": 9})
    assert runner.run(a=1)["d"] == -18
    assert runner.first_hyperparameters["geometry__threshold"] == 9


@pytest.mark.parametrize("depth", [2, 3])
def test_pipelines_in_pipelines_are_named_one_after_the_other(geometry, counted, depth):
    pipe = geometry
    for level in range(1, depth):
        pipe = ep.Pipeline(f"level{level}", ep.CompGraph({f"p{level}": pipe}, {f"p{level}": ("x", "y")}))
    runner = ep.CompGraphRunner(ep.CompGraph({"f": pipe}, {"f": ("a", "b")}))
    name = "__".join(["f", *(f"p{level}" for level in reversed(range(1, depth))), "threshold"])
    assert runner.run(a=1)["b"] == 4
    counted.taken()
    assert runner.rerun(**{name: 5})["b"] == 10
    assert counted.taken() == ["ransac", "measure"]
    assert geometry["threshold"] == 2


# -- errors -----------------------------------------------------------------------------------------------------------


def test_a_misspelt_name_is_suggested(runner):
    runner.run(a=1)
    with pytest.raises(UnknownName, match="Did you mean 'geometry__threshold'"):
        runner.rerun(geometry__treshold=3)
    with pytest.raises(UnknownName, match="'geometry__threshold'"):
        runner.set(gain=5, geometry__treshold=3)
    assert runner["gain"] == 1, "all or none"


def test_payload_and_free_tokens_say_the_way_out(runner, geometry):
    with pytest.raises(PayloadError, match=r"'geometry__threshold' is a hyperparameter"):
        runner.run(a=1, geometry__threshold=3)
    geometry.runner.unfreeze("offset")
    with pytest.raises(HyperparameterError, match="free in its pipeline"):
        runner["geometry__offset"] = 3


def test_a_branch_that_a_switch_inside_does_not_have_is_refused():
    cg = ep.CompGraph({"f": abs, "g": abs}, {"f": ("x", "a"), "g": ("x", "b")})
    cg |= ep.switch("pick", {"first": "a", "second": "b"}, by="method", output="y")
    outer = ep.CompGraphRunner(ep.CompGraph({"p": ep.Pipeline("p", cg, {"method": "first"})}, {"p": ("x", "y")}))
    outer.run(x=-2)
    with pytest.raises(UnknownName, match="'second'"):
        outer.rerun(p__method="secnd")
    assert outer.rerun(p__method="second")["y"] == 2
    assert outer.last.nested["p"].report.ran == ("g", "pick")


def test_a_token_of_the_graph_is_not_hidden_by_a_name_inside(geometry):
    io = {"use": (("a", "geometry__threshold"), "b"), "geometry": ("b", "c")}
    runner = ep.CompGraphRunner(ep.CompGraph({"use": max, "geometry": geometry}, io), {"geometry__threshold": 50})
    assert runner.run(a=1)["c"] == 102
    geometry["threshold"] = 3
    assert runner.rerun()["c"] == 153


# -- runs -------------------------------------------------------------------------------------------------------------


def test_a_run_remembers_what_was_inside(runner, geometry):
    run = runner.run(a=1)
    later = runner.rerun(geometry__threshold=9)
    geometry["offset"] = 100
    runner.rerun()
    assert run.hyperparameters["geometry__threshold"] == 2
    assert run.nested["geometry"]["inliers"] == 4
    assert later.nested["geometry"]["inliers"] == 18
    assert later.nested["geometry"].report.ran == ("ransac", "measure")
    assert later.nested["geometry"].hyperparameters["offset"] == 0
    for name in ("inliers", "geometry__inliers"):
        with pytest.raises(UnknownName, match=r"run\.nested\['geometry'\]\['inliers'\]"):
            run[name]


def test_a_failure_inside_is_found_and_gone_on_from(counted):
    def check(points, limit):
        counted.calls.append("check")
        if points > limit:
            raise ValueError("too many points")
        return points

    cg = ep.CompGraph(
        {"find": counted("find", abs), "check": check}, {"find": ("x", "points"), "check": (("points", "limit"), "y")}
    )
    runner = ep.CompGraphRunner(ep.CompGraph({"f": ep.Pipeline("p", cg, {"limit": 10})}, {"f": ("a", "b")}))
    runner.run(a=5)
    counted.taken()
    with pytest.raises(ValueError, match="too many points"):
        runner.rerun(f__limit=3)
    inner = runner.last.nested["f"]
    assert (runner.last.failure.function, inner.failure.function, inner["points"]) == ("f", "check", 5)
    assert runner.rerun(f__limit=7)["b"] == 5
    assert counted.taken() == ["check", "check"], "what was computed before the failure is reused"


def test_a_trial_changes_nothing_until_it_is_adopted(runner, geometry):
    runner.run(a=1)
    for threshold in range(10, 10 + RUNS):
        tried = runner.trial({"geometry__threshold": threshold})
        assert tried["d"] == -2 * threshold
    assert runner["d"] == -4
    assert runner["geometry__threshold"] == 2
    assert runner.adopt(tried)
    assert runner["d"] == tried["d"]
    assert runner["geometry__threshold"] == 15


def test_an_array_counts_as_new_when_it_is_set_and_only_then(counted):
    cg = ep.CompGraph(
        {"f": counted("f", abs), "g": counted("g", lambda y, k: y * k.sum())}, {"f": ("x", "y"), "g": (("y", "k"), "z")}
    )
    pipe = ep.Pipeline("p", cg, {"k": np.ones(3)})
    runner = ep.CompGraphRunner(ep.CompGraph({"p": pipe}, {"p": (("a"), "b")}), {})
    runner.run(a=-1)
    camera = np.full(3, 2.0)
    assert runner.rerun(p__k=camera)["b"] == 6
    counted.taken()
    camera[:] = 0
    assert runner.rerun()["b"] == 6, "the runner has a copy"
    assert counted.taken() == []
    assert runner.rerun(p__k=camera)["b"] == 0
    assert counted.taken() == ["g"]
    assert not runner["p__k"].flags.writeable


def test_runs_in_threads_and_branches_have_their_own_values(geometry, counted):
    runner = ep.CompGraphRunner(graph(geometry, counted), {"gain": 1})
    runner.run(a=1)
    barrier = threading.Barrier(4)

    def work(threshold):
        own = branched(runner)
        barrier.wait(60)
        return [own.rerun(geometry__threshold=threshold * n)["d"] for n in range(1, 30)]

    with ThreadPoolExecutor(4) as pool:
        for threshold, found in zip((1, 10, 100, 1000), pool.map(work, (1, 10, 100, 1000)), strict=True):
            assert found == [-2 * threshold * n for n in range(1, 30)]
    assert runner["geometry__threshold"] == 2


def test_state_inside_is_that_of_the_run_that_is_repeated():
    cg = ep.CompGraph({"mean": lambda x, old, k: k * x + old}, {"mean": (("x", "old", "k"), "y")})
    pipe = ep.Pipeline("mean", ep.delay(cg, "y", "old", initial=0), {"k": 1})
    runner = ep.CompGraphRunner(ep.CompGraph({"f": pipe}, {"f": ("a", "b")}))
    assert [runner.run(a=1)["b"] for _ in range(3)] == [1, 2, 3]
    assert runner.rerun(f__k=10)["b"] == 12
    assert runner.rerun(f__k=20)["b"] == 22
    assert runner.run(a=1)["b"] == 42


@pytest.mark.parametrize("options", [{"guard": False}, {"check_mutation": True}])
def test_without_guard_and_checked_it_is_the_same(geometry, counted, options):
    runner = ep.CompGraphRunner(graph(geometry, counted), {"gain": 1}, **options)
    for n in range(1, RUNS):
        assert runner.run(a=n)["d"] == -2 * (n + 1)
        assert runner.rerun(geometry__threshold=5)["d"] == -5 * (n + 1)
        assert runner.rerun(geometry__threshold=2)["d"] == -2 * (n + 1)


class Noisy(ep.Pipeline):
    """Gives its graph something else than it was called with."""

    count = 0

    def compute(self, payload):
        self.count += 1
        return super().compute({"x": payload["x"] + 10 * self.count})


def test_a_pipeline_that_changes_its_payload_is_run_whole(geometry, counted):
    noisy = Noisy("noisy", geometry.source_cg, {"threshold": 2, "offset": 0})
    runner = ep.CompGraphRunner(ep.CompGraph({"f": noisy}, {"f": ("a", "b")}))
    assert runner.run(a=0)["b"] == 22
    assert runner.rerun(f__offset=1)["b"] == 43
    assert counted.taken() == ["find", "ransac", "measure"] * 2
    assert not runner.last.nested


def test_a_plan_names_what_changed_inside(runner):
    runner.run(a=1)
    runner["geometry__threshold"] = 8
    assert runner.plan().why == {"geometry": "'geometry__threshold' changed", "after": "takes 'c', made anew"}


def test_mutation_inside_is_still_refused():
    def spoil(x, k):
        k.append([1])
        k[0].append(2)
        return x

    pipe = ep.Pipeline("p", ep.CompGraph({"f": spoil}, {"f": (("x", "k"), "y")}), {"k": [[1]]})
    pipe.runner = ep.CompGraphRunner(pipe.network, {"k": [[1]]}, check_mutation=True)
    runner = ep.CompGraphRunner(ep.CompGraph({"p": pipe}, {"p": ("a", "b")}))
    with pytest.raises(InputMutated):
        runner.run(a=1)


def test_a_pipeline_around_a_pipeline_takes_the_values_too(geometry, counted):
    pipe = ep.Pipeline("whole", graph(geometry, counted), {"gain": 1, "geometry__threshold": 4})
    assert pipe(1) == -8
    pipe["geometry__threshold"] = 5
    pipe.set(geometry__offset=1, gain=2)
    assert pipe(1) == -16


@pytest.mark.parametrize("kind", ["source", "sink", "full"])
def test_a_reactive_pipeline_takes_them_too(geometry, counted, kind):
    cg, hparams = geometry.source_cg, {"threshold": 2, "offset": 0}
    q_in, q_out = queue.Queue(), queue.Queue()
    pipe = {
        "source": lambda: ep.SourcePipeline("p", cg, q_out, lambda view: view["area"], hparams),
        "sink": lambda: ep.SinkPipeline("p", cg, q_in, lambda event: {"x": event}, hparams),
        "full": lambda: ep.FullPipeline("p", cg, q_in, q_out, lambda event: {"x": event}, None, hparams),
    }[kind]()
    runner = ep.CompGraphRunner(ep.CompGraph({"f": pipe}, {"f": ("a", "b")}))
    assert runner.run(a=1)["b"] == 4
    counted.taken()
    assert runner.rerun(f__threshold=5)["b"] == 10
    assert counted.taken() == ["ransac", "measure"]


def test_an_input_that_was_a_hyperparameter_in_the_pipeline_is_new():
    cg = ep.CompGraph({"f": lambda x, k: (x, k)}, {"f": (("x", "k"), "y")})
    pipe = ep.Pipeline("p", cg, {"k": 2})
    runner = ep.CompGraphRunner(ep.CompGraph({"p": pipe}, {"p": ("a", "b")}))
    assert runner.run(a=1)["b"] == (1, 2)
    pipe.runner.freeze(x=10)
    pipe.runner.unfreeze("k")
    assert runner.rerun()["b"] == (10, 1)


def test_a_trial_is_adopted_only_if_the_pipeline_has_not_changed_since(runner, geometry):
    runner.run(a=1)
    tried = runner.trial({"geometry__threshold": 7})
    geometry["threshold"] = 3
    assert not runner.adopt(tried)
    assert runner.adopt(runner.trial({"geometry__threshold": 8})), "what had changed before it does not matter"
    assert runner["geometry__threshold"] == 8
    assert runner["d"] == -16


def test_the_runner_of_a_pipeline_may_be_replaced(runner, geometry):
    runner.run(a=1)
    geometry.runner = ep.CompGraphRunner(geometry.network, {"threshold": 5, "offset": 0})
    assert runner.rerun()["d"] == -10
    assert runner.rerun(geometry__threshold=9)["d"] == -18
    assert runner.last.nested["geometry"]["inliers"] == 18


def test_an_array_that_is_filled_again_is_new_inside_where_nothing_is_guarded_around(counted):
    buffer = np.zeros(2)

    def camera(a):
        buffer[:] = a
        return buffer

    pipe = ep.Pipeline("p", ep.CompGraph({"f": lambda x, k: x.sum() + k}, {"f": (("x", "k"), "y")}), {"k": 0})
    cg = ep.CompGraph({"camera": camera, "p": pipe}, {"camera": ("a", "image"), "p": ("image", "b")})
    runner = ep.CompGraphRunner(cg, {"a": 1}, guard=False)
    assert runner.run()["b"] == 2
    assert [runner.rerun(a=n)["b"] for n in range(2, RUNS)] == [2 * n for n in range(2, RUNS)]
