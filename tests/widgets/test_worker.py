"""Is everything run on another thread, once for any number of requests, and the last always?"""

from __future__ import annotations

import math
import threading
from time import monotonic

import pytest

from epypes.errors import StillRunning
from epypes_widgets.worker import Worker


def unexpected(exception: BaseException) -> None:
    raise AssertionError from exception


@pytest.fixture
def worker() -> Worker:
    return Worker(failed=unexpected)


class Slow:
    """A computation that waits until it is let go."""

    def __init__(self) -> None:
        self.count = 0
        self.started, self.go_on = threading.Event(), threading.Event()

    def __call__(self) -> None:
        self.count += 1
        self.started.set()
        assert self.go_on.wait(60)


def test_requests_of_one_key_that_arrive_meanwhile_are_one(worker: Worker) -> None:
    slow = Slow()
    worker.post("compute", slow)
    assert slow.started.wait(60)
    assert worker.is_pending("compute")
    for _ in range(120):
        worker.post("compute", slow)
    slow.go_on.set()
    worker.wait(60)
    assert slow.count == 2
    assert not worker.is_pending("compute")
    worker.close(10)


def test_what_was_wanted_before_a_request_is_always_computed(worker: Worker) -> None:
    """Of four threads that each want and then request, the last wish of none is missed."""
    wanted: dict[str, int] = dict.fromkeys("abcd", -1)
    computed: dict[str, int] = {}

    def want(name: str) -> None:
        for x in range(200):
            wanted[name] = x
            worker.post("compute", lambda: computed.update(wanted))

    threads = [threading.Thread(target=want, args=(name,)) for name in "abcd"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    worker.wait(60)
    assert computed == dict.fromkeys("abcd", 199)
    worker.close(10)


@pytest.mark.parametrize("error", [ValueError("no"), SystemExit(1)])
def test_a_request_that_raises_is_reported_and_does_not_end_the_worker(error: BaseException) -> None:
    reported: list[BaseException] = []
    worker = Worker(failed=reported.append)

    def fail() -> None:
        raise error

    worker.post("compute", fail)
    worker.wait(60)
    worker.post("compute", lambda: None)
    worker.wait(60)
    assert reported == [error]
    worker.close(10)


def test_a_delayed_request_runs_after_those_without_a_delay_and_is_waited_for_if_it_is_work(worker: Worker) -> None:
    order: list[str] = []
    slow = Slow()
    worker.post("first", slow)
    assert slow.started.wait(60)
    worker.post("commit", lambda: order.append("early"), 0.001)
    worker.post("commit", lambda: order.append("commit"), 0.02)
    worker.post("compute", lambda: order.append("computed"))
    worker.post("never", lambda: order.append("never"), 3600.0, is_work=False)
    slow.go_on.set()
    worker.wait(60)
    assert order == ["computed", "commit"]
    worker.close(10)


def test_what_is_due_first_is_run_first_whenever_it_was_requested(worker: Worker) -> None:
    done: list[str] = []
    start_s = monotonic()
    worker.post("second", lambda: done.append("second"), 0.06)
    worker.post("first", lambda: done.append("first"), 0.02)
    worker.wait(60)
    assert done == ["first", "second"]
    assert monotonic() - start_s >= 0.06
    worker.close(10)


def test_what_has_no_end_of_its_delay_is_run_when_it_is_hastened(worker: Worker) -> None:
    order: list[str] = []
    assert not worker.hasten("frame")
    worker.post("frame", lambda: order.append("older"), math.inf, is_work=False)
    worker.post("frame", lambda: order.append("frame"), math.inf, is_work=False)
    worker.post("compute", lambda: order.append("computed"))
    worker.wait(60)
    assert order == ["computed"]
    done = threading.Event()
    worker.post("late", done.set, math.inf)
    assert worker.hasten("frame")
    assert worker.hasten("late")
    assert done.wait(60)
    worker.wait(60)
    assert order == ["computed", "frame"]
    worker.close(10)


def test_closing_is_bounded_and_may_come_twice_or_first(worker: Worker) -> None:
    worker.close(1)
    worker.close(1)
    worker.post("compute", lambda: unexpected(ValueError()))
    worker.wait(1)
    assert not worker.is_pending("compute")


def test_a_function_that_does_not_return_is_reported_when_closing(worker: Worker) -> None:
    slow = Slow()
    worker.post("compute", slow)
    assert slow.started.wait(60)
    with pytest.raises(StillRunning):
        worker.close(0.05)
    with pytest.raises(TimeoutError, match="still computing"):
        worker.wait(0.01)
    slow.go_on.set()
    worker.close(10)
    assert not worker.is_pending("compute")


def test_the_worker_does_not_wait_for_itself(worker: Worker) -> None:
    caught: list[BaseException] = []

    def compute() -> None:
        try:
            worker.wait(60)
        except RuntimeError as error:
            caught.append(error)

    worker.post("compute", compute)
    worker.wait(60)
    assert len(caught) == 1
    worker.close(10)
