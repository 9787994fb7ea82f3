"""The times of an event, and the failures of one."""

from __future__ import annotations

import queue
import time
from types import SimpleNamespace

import pytest

import epypes as ep
from epypes.wire import failure_event

TIMEOUT_S = 60.0


def graph(function=lambda x: x + 1) -> ep.CompGraph:
    return ep.CompGraph({"f": function}, {"f": ("x", "y")})


class Stamping(ep.FullPipeline):
    """Says in each answer when f_out was done with it."""

    def put(self, answer, view):
        answer["t_fout_end"] = view.stamps.f_out_end_ns
        answer["t_pub"] = view.stamps.now_ns()
        super().put(answer, view)


def test_the_stamps_of_an_event_are_unix_times_in_the_order_of_what_happened():
    before_ns = time.time_ns()
    pipe = Stamping("p", graph(), queue.Queue(), queue.Queue(), lambda event: {"x": event}, f_out=stamps_of)
    with pipe:
        pipe.q_in.put(1)
        answer = pipe.q_out.get(timeout=TIMEOUT_S)
    moments = [answer[name] for name in ("react", "f_in_start", "f_in_end", "f_out_start", "t_fout_end", "t_pub")]
    assert moments == sorted(moments)
    assert abs(moments[0] - before_ns) < TIMEOUT_S * 1e9
    assert answer["f_out_end"] == 0, "not known in f_out"


def stamps_of(view) -> dict[str, int]:
    names = ("react", "f_in_start", "f_in_end", "f_out_start", "f_out_end")
    return {name: getattr(view.stamps, f"{name}_ns") for name in names}


def test_each_event_has_stamps_of_its_own():
    pipe = ep.FullPipeline(
        "p", graph(), queue.Queue(), queue.Queue(), lambda event: {"x": event}, lambda view: view.stamps
    )
    with pipe:
        for event in (1, 2):
            pipe.q_in.put(event)
        first, second = (pipe.q_out.get(timeout=TIMEOUT_S) for _ in range(2))
    assert first is not second
    assert first.f_out_end_ns <= second.react_ns


def test_a_source_pipeline_has_no_stamps_of_f_in():
    class Source(ep.SourcePipeline):
        def put(self, answer, view):
            super().put((answer, stamps_of(view)), view)

    pipe = Source("p", graph(), queue.Queue(), lambda view: view["y"])
    pipe.run(x=1)
    answer, stamps = pipe.q_out.get_nowait()
    assert answer == 2
    assert stamps["f_in_start"] == stamps["f_in_end"] == 0
    assert stamps["react"] <= stamps["f_out_start"] <= stamps["f_out_end"]


def test_a_put_of_ones_own_that_raises_is_no_failure_of_f_out():
    class Broken(ep.FullPipeline):
        def put(self, answer, view):
            raise OSError("no room")

    failures = queue.Queue()
    pipe = Broken("p", graph(), queue.Queue(), queue.Queue(), lambda event: {"x": event}, lambda view: view["y"])
    pipe.on_error = failures.put
    pipe.handle(1)
    assert str(failures.get_nowait()) == "put: OSError: no room"


def test_a_queue_that_takes_no_answer_is_a_failure_of_f_out():
    class Full:
        def put(self, item):
            raise OSError("no room")

    failures = queue.Queue()
    pipe = ep.FullPipeline("p", graph(), queue.Queue(), Full(), lambda event: {"x": event}, lambda view: view["y"])
    pipe.on_error = failures.put
    pipe.handle(1)
    assert str(failures.get_nowait()) == "f_out: OSError: no room"


def test_failures_of_one_event_are_counted_by_its_id_and_say_whose_they_are():
    failures = []
    pipe = ep.SinkPipeline("station 4", graph(), queue.Queue(), lambda event: {"x": event.x})
    pipe.on_error = failures.append
    for event_id in ("a", "b", "a", "", "", "a", None):
        pipe.handle(SimpleNamespace(id=event_id, x="not a number"))
    assert [(failure.event_id, failure.attempt) for failure in failures] == [
        ("a", 1), ("b", 1), ("a", 2), ("", 1), ("", 1), ("a", 3), ("", 1),
    ]  # fmt: skip
    assert {failure.source for failure in failures} == {"station 4"}
    sent = failure_event(failures[2])
    assert (sent.source, sent.correlation_id, sent.failure.attempt) == ("station 4", "a", 2)
    assert (sent.failure.function, sent.failure.tokens, sent.failure.exception) == ("f", ("x", "y"), "TypeError")


@pytest.mark.slow
def test_the_ids_of_failed_events_are_not_kept_for_ever():
    attempts = []
    pipe = ep.SinkPipeline("p", graph(), queue.Queue(), lambda event: {})
    pipe.on_error = lambda failure: attempts.append(failure.attempt)
    for number in range(5_000):
        pipe.handle(SimpleNamespace(id=str(number)))
    pipe.handle(SimpleNamespace(id="0"))
    pipe.handle(SimpleNamespace(id="4999"))
    assert attempts[-2:] == [1, 2]


def test_what_no_message_can_hold_does_not_keep_a_failure_from_being_told():
    from epypes.wire import decode, encode

    pipe = ep.SinkPipeline("p\ud800", graph(), queue.Queue(), lambda event: {"\ud801": 1})
    failures = []
    pipe.on_error = failures.append
    pipe.handle(SimpleNamespace(id="\ud802" * 3_000))
    told = decode([bytes(frame) for frame in encode(failure_event(failures[0]))])
    assert told.failure.function == "f_in"
    assert told.source == "p?"
