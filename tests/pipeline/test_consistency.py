"""Every answer belongs to its event, its hyperparameters and its own run, and every failure to its function."""

from __future__ import annotations

import queue
import threading
from dataclasses import dataclass
from typing import Annotated

import numpy as np
import pytest

import epypes as ep
from epypes.errors import HyperparameterError, PayloadError, UnknownName
from tests.transport.peers import wait_until

TIMEOUT_S = 60.0


@dataclass(frozen=True)
class Numbered:
    id: str
    value: object


def full(cg, f_out, f_in=lambda event: {"x": event.value}, hparams=None, **more) -> ep.FullPipeline:
    return ep.FullPipeline("p", cg, queue.SimpleQueue(), queue.SimpleQueue(), f_in, f_out, hparams, **more)


class Odd:
    """An event of which nothing can be asked."""

    def __eq__(self, other):
        raise RuntimeError("not comparable")

    def __bool__(self):
        raise RuntimeError("neither true nor false")

    def __getattr__(self, name):
        raise SystemExit(name)

    __hash__ = None


EVENTS = [
    np.zeros((4, 4)), np.zeros(0), np.array(3), np.array("stop"), b"", b"stop", "stop", None, False, 0, float("nan"),
    [], {}, (), object(), Odd(), type, queue.Empty, queue.Empty(), SystemExit(), ..., NotImplemented,
]  # fmt: skip


@pytest.mark.parametrize("kind", [queue.Queue, queue.SimpleQueue, lambda: ep.Mailbox("block", 99)])
def test_events_of_every_kind_are_answered_in_order_and_counted(kind):
    cg = ep.CompGraph({"f": lambda x: x}, {"f": ("x", "y")})
    pipe = ep.FullPipeline("p", cg, kind(), kind(), lambda event: {"x": 1}, lambda view: (view["y"], view.event))
    with pipe:
        for event in EVENTS:
            pipe.q_in.put(event)
        answers = [pipe.q_out.get(timeout=TIMEOUT_S) for _ in EVENTS]
    assert all(answer[1] is event for answer, event in zip(answers, EVENTS, strict=True))
    assert (pipe.loop.handled, pipe.run_count, pipe.failed) == (len(EVENTS), len(EVENTS), 0)


def test_events_of_the_wrong_kind_are_failures_that_are_counted_and_the_loop_lives():
    failures = []
    cg = ep.CompGraph({"f": lambda x: x + 1}, {"f": ("x", "y")})
    pipe = full(cg, lambda view: view["y"], lambda event: {"x": event["x"] + 0})
    pipe.on_error = failures.append
    wrong = [event for event in EVENTS if not isinstance(event, np.ndarray)]
    with pipe:
        for event in wrong:
            pipe.q_in.put(event)
        pipe.q_in.put({"x": 1})
        assert pipe.q_out.get(timeout=TIMEOUT_S) == 2
    assert len(failures) == pipe.failed == len(wrong)
    assert {failure.function for failure in failures} == {"f_in"}
    assert all(failure.inputs["event"] is event for failure, event in zip(failures, wrong, strict=True))


def test_an_event_whose_payload_misses_a_token_reaches_the_handler_and_the_loop_lives():
    failures = []
    cg = ep.CompGraph({"f": lambda x, z: x + z}, {"f": (("x", "z"), "y")})
    pipe = full(cg, lambda view: view["y"], dict)
    pipe.on_error = failures.append
    with pipe:
        for event in ({"x": 1}, {}, {"x": 1, "w": 2}, {"x": 1, "z": 2, "y": 3}, {"x": 1, "z": 2}):
            pipe.q_in.put(event)
        assert pipe.q_out.get(timeout=TIMEOUT_S) == 3
    assert {failure.function for failure in failures} == {"f_in"}
    assert [type(failure.exception) for failure in failures] == [PayloadError, PayloadError, UnknownName, PayloadError]
    assert pipe.failed == 4


@pytest.mark.parametrize(
    "kind", [RuntimeError, SystemExit, KeyboardInterrupt, GeneratorExit], ids=lambda kind: kind.__name__
)
def test_a_handler_that_raises_whatever_it_likes_does_not_end_the_thread(kind, caplog):
    def handler(failure):
        raise kind("handler")

    pipe = full(ep.CompGraph({"f": lambda x: 1 / x}, {"f": ("x", "y")}), lambda view: view["y"])
    pipe.on_error = handler
    with pipe:
        for value in (0, 0, 2):
            pipe.q_in.put(Numbered("", value))
        assert pipe.q_out.get(timeout=TIMEOUT_S) == 0.5
    assert pipe.failed == 2
    assert caplog.text.count("on_error itself failed") == 2


@pytest.mark.parametrize("workers", [1, 2])
def test_of_alternating_good_and_bad_frames_each_answer_and_each_failure_has_the_id_of_its_own(workers):
    def first(x):
        if x % 4 == 1:
            raise ValueError(x)
        return x + 1000

    def second(y):
        if (y - 1000) % 4 == 3:
            raise LookupError(y)
        return 2 * y

    cg = ep.CompGraph(
        {"first": first, "beside": lambda x: -x, "second": second},
        {"first": ("x", "y"), "beside": ("x", "w"), "second": ("y", "z")},
    )
    pipe = full(cg, lambda view: (view.event.id, view["x"], view["w"], view["y"], view["z"]), workers=workers)
    failures = []
    pipe.on_error = failures.append
    with pipe:
        for number in range(400):
            pipe.q_in.put(Numbered(str(number), number))
        answers = [pipe.q_out.get(timeout=TIMEOUT_S) for _ in range(200)]
        wait_until(lambda: len(failures) == 200)
    assert answers == [(str(n), n, -n, n + 1000, 2 * (n + 1000)) for n in range(0, 400, 2)]
    told = [(int(failure.event_id), failure.function, dict(failure.inputs)) for failure in failures]
    assert told == [(n, "first", {"x": n}) if n % 4 == 1 else (n, "second", {"y": n + 1000}) for n in range(1, 400, 2)]
    assert pipe.q_out.empty()


def test_no_answer_is_put_that_stems_from_another_event_when_f_out_catches_what_it_reads():
    def f_out(view):
        try:
            return view.event.id, view["y"]
        except Exception as error:
            return view.event.id, error

    pipe = full(ep.CompGraph({"f": lambda x: 1 / x}, {"f": ("x", "y")}), f_out)
    pipe.on_error = lambda failure: None
    with pipe:
        for number in range(40):
            pipe.q_in.put(Numbered(str(number), number % 2))
        assert [pipe.q_out.get(timeout=TIMEOUT_S) for _ in range(20)] == [(str(n), 1.0) for n in range(1, 40, 2)]
    assert pipe.q_out.empty()


def test_a_failure_of_an_event_is_that_of_its_run_whatever_other_threads_run():
    stop, failures = threading.Event(), []

    def f(x):
        raise ValueError(x)

    pipe = full(ep.CompGraph({"f": lambda x: x if x < 0 else f(x)}, {"f": ("x", "y")}), lambda view: view["y"])
    pipe.on_error = failures.append

    def run_beside():
        while not stop.is_set():
            pipe.run(x=-1)

    beside = threading.Thread(target=run_beside)
    beside.start()
    for number in range(300):
        pipe.handle(Numbered(str(number), number))
    stop.set()
    beside.join(TIMEOUT_S)
    assert [(failure.function, failure.inputs) for failure in failures] == [("f", {"x": n}) for n in range(300)]


def states(pipe) -> dict[str, str]:
    return {stage.name: stage.state for stage in (*pipe.stages.before, *pipe.stages.after)}


def test_an_error_that_f_in_raises_again_is_f_ins_though_a_function_raised_it_first():
    error, failures = ValueError("the same object"), []

    def throw(*args):
        raise error

    pipe = full(ep.CompGraph({"f": throw}, {"f": ("x", "y")}), lambda view: view["y"])
    pipe.on_error = failures.append
    pipe.handle(Numbered("1", 1))
    pipe.f_in = throw
    pipe.handle(Numbered("2", 2))
    assert [failure.function for failure in failures] == ["f", "f_in"]
    assert list(failures[1].inputs) == ["event"]
    assert states(pipe)["f_in"] == "failed"


@pytest.mark.parametrize("name", ["f_in", "f_out"])
def test_a_function_of_the_graph_that_is_called_like_a_stage_does_not_mark_the_stage(name):
    pipe = full(ep.CompGraph({name: lambda x: 1 / x}, {name: ("x", "y")}), lambda view: view["y"])
    failures = []
    pipe.on_error = failures.append
    pipe.handle(Numbered("", 0))
    assert [(failure.function, failure.tokens) for failure in failures] == [(name, ("x", "y"))]
    assert set(states(pipe).values()) == {"static", "stopped"}


def test_what_a_compute_of_ones_own_raises_is_neither_f_ins_nor_a_functions():
    class Own(ep.FullPipeline):
        def compute(self, payload):
            raise OSError("the licence has expired")

    pipe = Own("p", ep.CompGraph({"f": abs}, {"f": ("x", "y")}), None, None, lambda event: {"x": 1}, lambda view: 1)
    failures = []
    pipe.on_error = failures.append
    pipe.handle(1)
    assert str(failures[0]) == "compute: OSError: the licence has expired"
    assert states(pipe)["f_in"] == "static"


# -- hyperparameters that belong together -----------------------------------------------------------------------------


def test_two_linked_hyperparameters_flipped_a_thousand_times_under_load_are_never_seen_half_way():
    def between(x, lo, hi):
        return lo, hi

    cg = ep.CompGraph(
        {"first": lambda x, lo: lo, "second": between},
        {"first": (("x", "lo"), "a"), "second": (("x", "lo", "hi"), "b")},
    )
    pipe = full(
        cg, lambda view: (view.run.revision, view["a"], view["b"]), lambda event: {"x": event}, {"lo": 0, "hi": 10}
    )
    pairs = {pipe.runner.revision: (0, 10)}
    with pipe:
        for number in range(1, 1_001):
            pipe.q_in.put(number)
            pair = (number, number + 10) if number % 2 else (-number, -number + 10)
            pipe.set(lo=pair[0], hi=pair[1])
            pairs[pipe.runner.revision] = pair
        answers = [pipe.q_out.get(timeout=TIMEOUT_S) for _ in range(1_000)]
    assert len(pairs) == 1_001, "one revision for each pair"
    assert all(pair == pairs[revision] and a == pair[0] for revision, a, pair in answers)
    assert [revision for revision, _, _ in answers] == sorted(revision for revision, _, _ in answers)


def thresholds(x, lo: Annotated[int, ep.Param(0, 255)], k: Annotated[int, ep.Param(1, 31, odd=True)], hi):
    return lo, k, hi


BAD = {
    "an unknown name": ({"lo": 1, "low": 2}, UnknownName, "No token 'low'"),
    "made by a function": ({"lo": 1, "y": 2}, HyperparameterError, "made by function 'f'"),
    "a free source token": ({"lo": 1, "x": 2}, HyperparameterError, "free source token"),
    "out of range": ({"hi": 1, "lo": 300}, HyperparameterError, "lo=300 is not what its annotation allows"),
    "even": ({"hi": 1, "k": 4}, HyperparameterError, "k=4"),
    "no number": ({"hi": 1, "lo": "dark"}, HyperparameterError, "lo='dark'"),
    "an array": ({"hi": 1, "lo": np.zeros(3)}, HyperparameterError, "lo="),
    "no such branch": ({"lo": 1, "by": "sobol"}, UnknownName, "sobel"),
}


@pytest.mark.parametrize("bad", BAD)
def test_a_bad_value_is_refused_with_a_reason_nothing_is_set_and_no_frame_is_lost(bad):
    values, kind, reason = BAD[bad]
    cg = ep.CompGraph({"f": thresholds, "g": lambda y: y}, {"f": (("x", "lo", "k", "hi"), "y"), "g": ("y", "z")})
    cg = cg | ep.switch("choose", {"canny": "y", "sobel": "z"}, by="by", output="end")
    hparams = {"lo": 70, "k": 3, "hi": 200, "by": "canny"}
    pipe = full(cg, lambda view: (view["x"], view["end"], view.run.revision), lambda event: {"x": event}, hparams)
    revision = pipe.runner.revision
    with pipe:
        for event in range(50):
            pipe.q_in.put(event)
            with pytest.raises(kind, match=reason):
                pipe.set(**values)
        answers = [pipe.q_out.get(timeout=TIMEOUT_S) for _ in range(50)]
    assert answers == [(event, (70, 3, 200), revision) for event in range(50)]
    assert (dict(pipe.runner.hyperparameters), pipe.runner.revision, pipe.failed) == (hparams, revision, 0)
    pipe.set(lo=80, hi=210)
    assert (pipe["lo"], pipe["hi"], pipe.runner.revision) == (80, 210, revision + 1)


def test_a_value_that_no_annotation_forbids_and_a_function_refuses_costs_only_its_own_frames():
    failures = []
    pipe = full(
        ep.CompGraph({"f": lambda x, k: x // k}, {"f": (("x", "k"), "y")}),
        lambda view: (view["y"], view.run.revision),
        lambda event: {"x": event},
        {"k": 1},
    )
    pipe.on_error = failures.append
    revision = pipe.runner.revision
    for event, k in enumerate([1, 0, 2]):
        pipe.set(k=k)
        pipe.handle(event)
    assert [pipe.q_out.get_nowait() for _ in range(2)] == [(0, revision), (1, revision + 2)]
    assert [(failure.function, failure.inputs) for failure in failures] == [("f", {"x": 1, "k": 0})]
