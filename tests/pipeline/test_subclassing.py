"""The paper's custom components: what each class says may be overridden is called, and everything else still holds."""

from __future__ import annotations

import queue

import numpy as np
import pytest

import epypes as ep
from epypes.errors import GraphError, StaleToken

TIMEOUT_S = 60.0


def add_graph(function=lambda x, n: x + n) -> ep.CompGraph:
    return ep.CompGraph({"add": function}, {"add": (("x", "n"), "y")})


class Doubled(ep.Node):
    """Does something around its function."""

    def __init__(self, name, func, factor=2):
        super().__init__(name, func)
        self.factor = factor

    def compute(self, *args):
        return self.factor * super().compute(*args)


class Clock(ep.Node):
    """Does something instead of a function."""

    def __init__(self):
        super().__init__("clock", lambda x: None)
        self.ticks = 0

    def compute(self, x):
        self.ticks += 1
        return self.ticks


def test_a_node_that_overrides_compute_is_measured_counted_and_checked():
    node = Doubled("f", lambda x, n: x + n, factor=3)
    assert (node(1, 2), node.run_count) == (9, 1)
    assert node.time > 0
    with pytest.raises(ZeroDivisionError):
        Doubled("g", lambda x: 1 / x)(0)
    with pytest.raises(GraphError, match="takes 2 inputs"):
        ep.CompGraph({"f": node}, {"f": ("x", "y")})


def test_a_node_of_ones_own_runs_in_graphs_compiled_too_and_is_kept_by_pipelines():
    node, clock = Doubled("f", lambda x: x + 1), Clock()
    cg = ep.CompGraph({"f": node, "clock": clock}, {"f": ("x", "y"), "clock": ("y", "t")})
    runner = ep.CompGraphRunner(cg)
    for x in range(6):
        run = runner.run(x=x)
        assert (run["y"], run["t"]) == (2 * (x + 1), x + 1)
    assert (node.run_count, clock.ticks) == (6, 6)
    pipe = ep.Pipeline("p", cg)
    assert pipe.network.nodes["f"] is node
    assert pipe(0) == 7
    assert [name for name, _ in pipe.traverse_time()[2]] == ["f", "clock"]


def test_arrays_are_guarded_for_a_node_of_ones_own_too():
    class Draws(ep.Node):
        def compute(self, image):
            image[0] = 1

    runner = ep.CompGraphRunner(ep.CompGraph({"draw": Draws("draw", lambda image: None)}, {"draw": ("image", None)}))
    for _ in range(6):
        with pytest.raises(ValueError, match="read-only") as error:
            runner.run(image=np.zeros(3))
    assert "'draw' can't change 'image'" in error.value.__notes__[0]


class Timed(ep.Pipeline):
    """Looks at every payload and every run."""

    def compute(self, payload):
        run = super().compute({**payload, "x": payload["x"] + 100})
        self.attributes["seen"] = (payload["x"], run["y"])
        return run


def test_a_pipeline_that_overrides_compute_does_so_however_it_is_run():
    pipe = Timed("timed", add_graph(), {"n": 1})
    assert pipe(2) == 103
    assert pipe.run(x=3)["y"] == 104
    assert (pipe.attributes, pipe.run_count) == ({"seen": (3, 104)}, 2)
    assert (pipe["y"], pipe["n"]) == (104, 1)
    assert 0 < pipe.compute_overhead() < pipe.time


def test_a_pipeline_of_ones_own_is_a_function_of_another_graph_and_makes_it_stale():
    pipe = Timed("timed", add_graph(), {"n": 1})
    outer = ep.CompGraphRunner(ep.CompGraph({"inner": pipe}, {"inner": ("a", "b")}))
    assert outer.run(a=2)["b"] == 103
    pipe["n"] = 5
    with pytest.raises(StaleToken):
        outer["b"]
    assert outer.rerun()["b"] == 107
    assert ep.Pipeline("outer", outer.cg).traverse_time()[2][0][0] == "timed"


class Stamped(ep.SourcePipeline):
    """Says of everything that it puts on its queue how it came about."""

    def compute(self, payload):
        run = super().compute(payload)
        self.attributes["stamp"] = self.run_count + 1
        return run


def test_a_source_pipeline_of_ones_own_puts_what_its_hook_has_prepared():
    q_out = queue.Queue()
    pipe = Stamped("source", add_graph(), q_out, lambda view: (view["y"], view.attributes), {"n": 1})
    pipe.run(x=1)
    assert pipe(2) == 3, "a call is a run too"
    assert [q_out.get_nowait() for _ in range(2)] == [(2, {"stamp": 1}), (3, {"stamp": 2})]
    assert q_out.empty()


class Choosy(ep.SinkPipeline):
    """Passes some events over, and keeps what it computed of the others."""

    def __init__(self, *args, **kwargs):
        super().__init__(*args, **kwargs)
        self.kept = queue.Queue()

    def handle(self, event):
        if event != "not mine":
            super().handle(event)

    def emit(self, event, run):
        if event == "no":
            raise RuntimeError("emit")
        self.kept.put((event, run["y"]))


def test_a_sink_pipeline_of_ones_own_handles_and_emits_as_it_likes_and_its_failures_are_reported():
    failures, q_in = queue.Queue(), queue.Queue()
    pipe = Choosy("sink", add_graph(), q_in, lambda event: {"x": 1 if event == "no" else event}, {"n": 1})
    pipe.on_error = failures.put
    with pipe:
        for event in ("not mine", 4, "no", "x", 5):
            q_in.put(event)
        assert [pipe.kept.get(timeout=TIMEOUT_S) for _ in range(2)] == [(4, 5), (5, 6)]
    assert [failures.get_nowait().function for _ in range(2)] == ["emit", "add"]
    assert (pipe.failed, pipe.run_count) == (2, 4)
    assert failures.empty()


class Tuned(ep.FullPipeline):
    """Answers twice, and follows the events with a hyperparameter."""

    def handle(self, event):
        self["n"] = event * 10
        super().handle(event)

    def compute(self, payload):
        return super().compute({"x": -payload["x"]})

    def emit(self, event, run):
        super().emit(event, run)
        self.q_out.put(("again", event))


def test_a_full_pipeline_of_ones_own_has_every_hook_of_those_that_it_is_made_of():
    q_in, q_out = queue.Queue(), queue.Queue()
    f_out = lambda view: (view["y"], view.run.hyperparameters["n"], view.event)  # noqa: E731
    with Tuned("full", add_graph(), q_in, q_out, lambda event: {"x": event}, f_out, {"n": 0}) as pipe:
        assert type(pipe) is Tuned
        for event in (1, 2):
            q_in.put(event)
        answers = [q_out.get(timeout=TIMEOUT_S) for _ in range(4)]
    assert answers == [(9, 10, 1), ("again", 1), (18, 20, 2), ("again", 2)]
    assert not pipe.loop.is_running


def full(kind=ep.FullPipeline, f_out=lambda view: view["y"]):
    return kind("full", add_graph(), queue.Queue(), queue.Queue(), lambda event: {"x": event}, f_out, {"n": 1})


def test_an_emit_or_a_put_that_is_set_on_the_object_is_called():
    pipe, emitted = full(), []
    pipe.emit = lambda event, run: emitted.append((event, run["y"]))
    pipe.handle(2)
    assert (emitted, pipe.q_out.empty(), pipe.failed) == ([(2, 3)], True, 0)
    del pipe.emit
    pipe.put = lambda answer, view: emitted.append(answer)
    pipe.handle(3)
    assert emitted == [(2, 3), 4]


class EmitsLate(ep.FullPipeline):
    """Fails after it has answered."""

    def emit(self, event, run):
        super().emit(event, run)
        raise RuntimeError("late")


class EmitsEarly(ep.FullPipeline):
    """Fails before it answers."""

    def emit(self, event, run):
        raise RuntimeError("early")


def fails(view):
    raise RuntimeError("no answer")


class Answers(ep.FullPipeline):
    def emit(self, event, run):
        super().emit(event, run)


@pytest.mark.parametrize(
    ("make", "function"),
    [
        (lambda: full(EmitsLate), "emit"),
        (lambda: full(EmitsEarly), "emit"),
        (lambda: full(Answers, fails), "f_out"),
        (lambda: full(f_out=fails), "f_out"),
    ],
    ids=["after the answer", "before the answer", "f_out of an emit of one's own", "f_out"],
)
def test_a_failure_after_the_graph_names_the_hook_or_f_out(make, function):
    failures, pipe = [], make()
    pipe.on_error = failures.append
    pipe.handle(1)
    assert [failure.function for failure in failures] == [function]
    (stage, _) = pipe.stages.after
    assert stage.state == "failed"
    assert stage.notes[-1].startswith("emit: RuntimeError: " if function == "emit" else "RuntimeError: ")


def test_a_source_pipeline_shows_that_f_out_failed_until_the_next_answer():
    pipe = ep.SourcePipeline("source", add_graph(), queue.Queue(), lambda view: 1 // view["y"], {"n": 1})
    with pytest.raises(ZeroDivisionError):
        pipe.run(x=-1)
    assert (pipe.stages.after[0].state, pipe.stages.after[0].notes[-1][:18]) == ("failed", "ZeroDivisionError:")
    pipe.run(x=1)
    assert pipe.stages.after[0].state == "static"


@pytest.mark.parametrize("is_heard", [False, True])
def test_a_handle_of_ones_own_that_raises_is_counted_and_reported(is_heard, caplog):
    class Refusing(ep.SinkPipeline):
        def handle(self, event):
            if event == "no":
                raise ValueError("not this one")
            super().handle(event)
            done.put(event)

    done, failures = queue.Queue(), []
    pipe = Refusing("sink", add_graph(), queue.Queue(), lambda event: {"x": event}, {"n": 1})
    pipe.on_error = failures.append if is_heard else None
    with pipe:
        for event in ("no", 1):
            pipe.q_in.put(event)
        assert done.get(timeout=TIMEOUT_S) == 1
    assert pipe.failed == 1
    assert [str(failure) for failure in failures] == ["handle: ValueError: not this one"] * is_heard
    assert ("an event failed in handle: ValueError: not this one" in caplog.text) != is_heard


class Disturbed(ep.FullPipeline):
    """Is run by somebody else between an event's run and its answer."""

    def emit(self, event, run):
        self.run(x=1000)
        super().emit(event, run)


def test_another_run_of_the_pipeline_does_not_disturb_the_view_of_an_event():
    q_in, q_out = queue.Queue(), queue.Queue()

    def f_out(view):
        pipe.run(x=2000)
        pipe.attributes["late"] = True
        return view["x"], view["y"], dict(view), dict(view.attributes)

    pipe = Disturbed("p", add_graph(), q_in, q_out, lambda event: {"x": event}, f_out, {"n": 1})
    with pipe:
        q_in.put(5)
        assert q_out.get(timeout=TIMEOUT_S) == (5, 6, {"x": 5, "n": 1, "y": 6}, {})
    assert pipe["y"] == 2001


def test_a_pipelines_own_method_may_be_a_function_of_its_graph():
    class Scaled(ep.Pipeline):
        by = 2

        def __init__(self):
            super().__init__("p", ep.CompGraph({"f": self._f}, {"f": (("x", "k"), "y")}), {"k": 1})

        def _f(self, x, k):
            return self.by * x + k

    pipeline = Scaled()
    outer = ep.CompGraphRunner(ep.CompGraph({"p": pipeline}, {"p": ("x", "y")}))
    assert (pipeline(3), outer.run(x=3)["y"]) == (7, 7)
    pipeline.runner.rerun(k=2)
    assert outer.rerun()["y"] == 8
