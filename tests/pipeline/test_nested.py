"""A pipeline as a function of another graph: what changes inside it is seen outside."""

from __future__ import annotations

import functools
import threading

import pytest

import epypes as ep
from epypes.errors import GraphError, NotComputed, OutputArityError, PayloadError, StaleToken
from epypes.run import execute

RUNS = 6  # enough that the later ones are compiled


class Level:
    """``depth`` pipelines, each inside the next: x + n, then a function of each level, then the runner of the outermost."""

    def __init__(self, depth, **more):
        self.calls = dict.fromkeys(["before", "after"], 0)
        self.inner = ep.Pipeline("add", ep.CompGraph({"add": lambda x, n: x + n}, {"add": (("x", "n"), "y")}), {"n": 1})
        function = self.inner
        for level in range(depth - 1):
            cg = ep.CompGraph({f"level{level}": function}, {f"level{level}": ("x", "y")})
            function = ep.Pipeline(f"level{level}", cg)
        cg = ep.CompGraph(
            {"before": self.counted("before"), "nested": function, "after": self.counted("after")},
            {"before": ("a", "b"), "nested": ("b", "c"), "after": ("c", "d")},
        )
        self.runner = ep.CompGraphRunner(cg, **more)

    def counted(self, name):
        def function(value):
            self.calls[name] += 1
            return value

        return function


@pytest.mark.parametrize("depth", [1, 2, 3])
def test_a_hyperparameter_inside_makes_what_depends_on_it_stale_outside(depth):
    nest = Level(depth)
    run = nest.runner.run(a=10)
    assert nest.runner.stale == ()
    nest.inner["n"] = 5
    assert nest.runner.stale == ("nested", "after")
    assert nest.runner.plan().reused == ("before",)
    path = "__".join(["nested", *(f"level{level}" for level in reversed(range(depth - 1))), "n"])
    assert nest.runner.plan().why["nested"] == f"{path!r} changed"
    assert tuple(nest.runner) == ("a", "b")
    with pytest.raises(StaleToken, match=r"'d' is stale.*Call rerun\(\)"):
        nest.runner["d"]
    assert run["d"] == 11, "a Run does not change"
    assert nest.runner.rerun()["d"] == 15
    assert nest.calls == {"before": 1, "after": 2}
    assert nest.runner.stale == ()


@pytest.mark.parametrize("depth", [1, 2])
def test_an_equal_value_inside_makes_nothing_stale(depth):
    nest = Level(depth)
    nest.runner.run(a=10)
    nest.inner["n"] = 1
    assert nest.runner.stale == ()
    assert nest.runner.rerun().report.ran == ()


@pytest.mark.parametrize("depth", [1, 2])
@pytest.mark.parametrize("workers", [1, 2])
def test_a_change_inside_is_seen_when_the_runs_are_compiled(depth, workers, monkeypatch):
    monkeypatch.setattr(execute, "has_independent_steps", lambda program: True)
    monkeypatch.setattr(execute.Gain, "is_worth_it", lambda self: workers > 1)
    nest = Level(depth, workers=workers)
    for n in range(RUNS):
        nest.inner["n"] = n
        assert nest.runner.run(a=10)["d"] == 10 + n
        assert nest.runner.stale == ()
    for n in range(RUNS, 2 * RUNS):
        nest.inner["n"] = n
        assert nest.runner.stale == ("nested", "after")
        assert nest.runner.rerun()["d"] == 10 + n
        assert nest.runner.rerun().report.ran == ()
    assert nest.calls == {"before": RUNS, "after": 2 * RUNS}


def test_a_hyperparameter_outside_and_one_inside_are_both_seen_by_one_rerun():
    inner = ep.Pipeline("inner", ep.CompGraph({"add": lambda x, n: x + n}, {"add": (("x", "n"), "y")}), {"n": 1})
    cg = ep.CompGraph({"inner": inner, "times": lambda y, k: y * k}, {"inner": ("x", "y"), "times": (("y", "k"), "z")})
    runner = ep.CompGraphRunner(cg, {"k": 2})
    runner.run(x=1)
    for step in range(1, RUNS):
        assert runner.rerun(k=step)["z"] == (inner["n"] + 1) * step
        inner["n"] = 10 * step
        assert runner.rerun(k=-step)["z"] == (1 + 10 * step) * -step


def test_a_rerun_of_what_does_not_need_the_pipeline_leaves_it_stale():
    nest = Level(1)
    nest.runner.run(a=10)
    nest.inner["n"] = 5
    assert nest.runner.rerun("b").report.ran == ()
    assert nest.runner.stale == ("nested", "after")
    assert nest.runner.rerun()["d"] == 15


def test_a_failure_inside_keeps_its_type_and_names_both_functions():
    def fail_at_3(x, n):
        if n == 3:
            raise ZeroDivisionError("three")
        return x + n

    inner = ep.Pipeline("inner", ep.CompGraph({"check": fail_at_3}, {"check": (("x", "n"), "y")}), {"n": 1})
    cg = ep.CompGraph({"nested": inner, "after": abs}, {"nested": ("b", "c"), "after": ("c", "d")})
    runner = ep.CompGraphRunner(cg)
    for _ in range(RUNS):
        runner.run(b=1)
    inner["n"] = 3
    with pytest.raises(ZeroDivisionError, match="three") as error:
        runner.rerun()
    assert error.value.__notes__ == ["In function 'check': (x=1, n=3) -> (y)", "In function 'nested': (b=1) -> (c)"]
    assert runner.last.failure.function == "nested"
    for token in ("c", "d"):
        with pytest.raises(NotComputed):
            runner[token]
    inner["n"] = 4
    assert runner.rerun()["d"] == 5


def test_times_nest_as_deep_as_the_pipelines():
    nest = Level(3)
    pipe = ep.Pipeline("whole", nest.runner.cg)
    assert pipe(10) == 11
    name, total, nodes = pipe.traverse_time()
    assert name == "whole"
    assert [node[0] for node in nodes] == ["before", "level1", "after"]
    outer = total
    for expected in ("level1", "level0", "add"):
        (found,) = (node for node in nodes if node[0] == expected)
        name, seconds, nodes = found
        assert 0 < seconds < outer, "what is inside takes less time than what is around it"
        outer = seconds
    assert [node[0] for node in nodes] == ["add"]
    assert pipe.compute_overhead() == pytest.approx(total - sum(node[1] for node in pipe.traverse_time()[2]))


def test_the_number_of_inputs_of_a_pipeline_is_checked_when_the_graph_is_made():
    add = ep.CompGraph({"add": lambda x, n: x + n}, {"add": (("x", "n"), "y")})
    open_pipe, frozen_pipe = ep.Pipeline("open", add), ep.Pipeline("frozen", add, {"n": 1})
    ep.CompGraph({"f": open_pipe}, {"f": (("a", "b"), "c")})
    with pytest.raises(GraphError, match="Function 'f' takes 2 inputs"):
        ep.CompGraph({"f": open_pipe}, {"f": ("a", "c")})
    ep.CompGraph({"f": frozen_pipe}, {"f": ("a", "c")})
    with pytest.raises(GraphError, match="Function 'f' takes 1 input"):
        ep.CompGraph({"f": frozen_pipe}, {"f": (("a", "b"), "c")})


def test_a_pipeline_that_loses_a_hyperparameter_later_says_what_it_takes():
    nest = Level(1)
    nest.runner.run(a=10)
    nest.inner.runner.unfreeze("n")
    assert nest.runner.stale == ("nested", "after")
    with pytest.raises(PayloadError, match=r"'add' takes 2 inputs \(x, n\), not 1"):
        nest.runner.rerun()
    nest.inner.runner.freeze(n=2)
    assert nest.runner.rerun()["d"] == 12


@pytest.mark.parametrize("outputs", [("low", "high"), "both"])
def test_several_sink_tokens_are_a_tuple_in_graph_order(outputs):
    cg = ep.CompGraph({"f": lambda x: -x, "g": lambda x: x}, {"f": ("x", "low"), "g": ("x", "high")})
    runner = ep.CompGraphRunner(ep.CompGraph({"ends": ep.Pipeline("ends", cg)}, {"ends": ("a", outputs)}))
    run = runner.run(a=3)
    assert ((run["low"], run["high"]) if len(outputs) == 2 else run["both"]) == (-3, 3)
    wrong = ep.CompGraph({"ends": ep.Pipeline("ends", cg)}, {"ends": ("a", ("p", "q", "r"))})
    with pytest.raises(OutputArityError, match="3 values"):
        ep.CompGraphRunner(wrong).run(a=3)


def test_a_graph_of_functions_joins_a_pipeline_by_its_name_and_the_names_of_its_inputs():
    def show(edges):
        return f"<{edges}>"

    pipe = ep.Pipeline("edges", ep.CompGraph({"f": lambda x, k: x + k}, {"f": (("image", "k"), "y")}), {"k": 2})
    cg = ep.CompGraph.from_functions(pipe, show)
    assert dict(cg.func_io) == {"edges": (("image",), "edges"), "show": (("edges",), "show")}
    assert ep.CompGraphRunner(cg).run(image=1)["show"] == "<3>"
    odd = ep.Pipeline("odd", ep.CompGraph({"f": lambda *xs: sum(xs)}, {"f": (("the image", "class"), "y")}))
    assert ep.CompGraph.from_functions(odd).source_tokens == ("input_0", "input_1")


def test_a_pipeline_with_workers_runs_independent_functions_at_once(monkeypatch):
    monkeypatch.setattr(execute.Gain, "is_worth_it", lambda self: True)
    barrier = threading.Barrier(2)

    def meet(x):
        barrier.wait(60)  # passes only if two are in it at once
        return x

    cg = ep.CompGraph({"f": meet, "g": meet}, {"f": ("x", "a"), "g": ("x", "b")})
    pipe = ep.Pipeline("pipe", cg, workers=2)
    outer = ep.Pipeline("outer", ep.CompGraph({"pipe": pipe}, {"pipe": ("x", ("a", "b"))}))
    assert outer(3) == (3, 3)
    report = pipe.runner.last.report
    assert report.side_by_side
    assert pipe.compute_overhead() == report.overhead_ns / 1e9
    assert [node[0] for node in pipe.traverse_time()[2]] == ["f", "g"]
    assert all(node.run_count == 1 for node in pipe.network.nodes.values())


def test_workers_reach_the_runner_of_every_pipeline():
    cg = ep.CompGraph({"f": abs}, {"f": ("x", "y")})
    pipes = [
        ep.Pipeline("p", cg, workers=2),
        ep.SourcePipeline("p", cg, None, None, workers=2),
        ep.SinkPipeline("p", cg, None, None, workers=2),
        ep.FullPipeline("p", cg, None, None, None, None, workers=2),
    ]
    assert [pipe.runner.workers for pipe in pipes] == [2] * 4


def test_a_value_that_changes_inside_while_the_graph_runs_is_stale_afterwards():
    inner = ep.Pipeline("inner", ep.CompGraph({"f": lambda x, n: x + n}, {"f": (("x", "n"), "y")}), {"n": 1})
    given = iter(range(2, 100))

    def turn(b):
        inner["n"] = next(given)
        return b

    io = {"inner": ("a", "b"), "turn": ("b", "c")}
    runner = ep.CompGraphRunner(ep.CompGraph({"inner": inner, "turn": turn}, io))
    for _ in range(RUNS):
        before = inner["n"]
        assert runner.run(a=1)["b"] == 1 + before, "of the run, whatever came after"
        assert runner.stale == ("inner", "turn")
        with pytest.raises(StaleToken):
            runner["b"]


def test_a_node_around_a_pipeline_shows_its_changes():
    inner = ep.Pipeline("inner", ep.CompGraph({"f": lambda x, n: x + n}, {"f": (("x", "n"), "y")}), {"n": 1})
    runner = ep.CompGraphRunner(ep.CompGraph({"node": ep.Node("node", inner)}, {"node": ("a", "b")}))
    assert runner.run(a=1)["b"] == 2
    inner["n"] = 5
    assert runner.stale == ("node",)
    assert runner.rerun()["b"] == 6


class Stage:
    def __init__(self, function):
        self.function = function

    def __call__(self, x):
        return self.function(x)

    def compute(self, x):
        return self.function(x)


def wrapped(pipe):
    @functools.wraps(pipe)
    def inner(*args):
        return pipe(*args)

    return inner


def named(pipe, code="lambda a: p(a)"):
    names = {"p": pipe, "helper": None}
    exec("helper = lambda a: p(a)", names)
    return eval(code, names)


WRAPPERS = {
    "partial": functools.partial,
    "partial of a function": lambda pipe: functools.partial(lambda p, a: p(a), pipe),
    "wraps": wrapped,
    "lambda": lambda pipe: lambda a: pipe(a),
    "default": lambda pipe: lambda a, p=pipe: p(a),
    "call": lambda pipe: pipe.__call__,
    "object": Stage,
    "method": lambda pipe: Stage(pipe).compute,
    "global": named,
    "global in a comprehension": lambda pipe: named(pipe, "lambda a: [p(x) for x in (a,)][0]"),
    "global in a helper": lambda pipe: named(pipe, "lambda a: helper(a)"),
    "lambda around partial": lambda pipe: (lambda f: lambda a: f(a))(functools.partial(pipe)),
}


@pytest.mark.parametrize("how", WRAPPERS)
def test_a_pipeline_behind_any_wrapper_shows_its_changes(how):
    inner = ep.Pipeline("inner", ep.CompGraph({"f": lambda x, n: x + n}, {"f": (("x", "n"), "y")}), {"n": 1})
    cg = ep.CompGraph({"before": abs, "f": WRAPPERS[how](inner)}, {"before": ("x", "a"), "f": (("a",), "b")})
    whole = ep.Pipeline("whole", cg)
    outer = ep.CompGraphRunner(ep.CompGraph({"whole": whole}, {"whole": ("a", "b")}))
    for runner, function in ((ep.CompGraphRunner(cg), "f"), (outer, "whole")):
        (token,) = runner.free_source_tokens
        for n in range(RUNS):
            inner["n"] = n
            assert runner.run(**{token: 1})["b"] == 1 + n
        for n in range(10, 10 + RUNS):
            inner["n"] = n
            assert runner.stale == (function,)
            assert runner.rerun()["b"] == 1 + n


def test_the_times_of_what_a_switch_left_out_are_not_those_of_an_earlier_call():
    cg = ep.CompGraph({"slow": abs, "fast": abs}, {"slow": ("x", "a"), "fast": ("x", "b")})
    cg |= ep.switch("which", {"slow": "a", "fast": "b"}, by="method", output="y")
    pipe = ep.Pipeline("pipe", cg, {"method": "slow"})
    pipe.run(x=1)
    pipe["method"] = "fast"
    pipe.run(x=1)
    times = dict(pipe.traverse_time()[2])
    assert times["slow"] == 0
    assert times["fast"] > 0


@pytest.mark.parametrize("wrong", [{"x": 1}, None, abs])
def test_a_pipeline_of_no_graph_and_a_node_of_no_function_are_refused(wrong):
    with pytest.raises(TypeError, match=r"A pipeline runs a CompGraph, not .* Pipeline\(name, cg\)"):
        ep.Pipeline("p", wrong)
    if not callable(wrong):
        with pytest.raises(TypeError, match="Node 'n' needs a function to call"):
            ep.Node("n", wrong)
    with pytest.raises(TypeError, match="Give its graph: .cg"):
        ep.Pipeline("p", ep.CompGraphRunner(ep.CompGraph({"f": abs}, {"f": ("x", "y")})))
