"""Is everything computed on another thread, once after any number of wishes, and the last always?"""

from __future__ import annotations

import threading
from collections.abc import Callable
from time import monotonic

import pytest

from epypes.errors import StillRunning
from epypes_widgets.worker import Worker


def unexpected(exception: BaseException) -> None:
    raise AssertionError from exception


def worker_of(compute: Callable[[int], None]) -> Worker:
    return Worker(compute, unexpected)


class Slow:
    """A computation that waits until it is let go."""

    def __init__(self) -> None:
        self.count = 0
        self.started, self.go_on = threading.Event(), threading.Event()

    def __call__(self, asked_ns: int) -> None:
        self.count += 1
        self.started.set()
        assert self.go_on.wait(60)


def test_wishes_that_arrive_meanwhile_are_one() -> None:
    slow = Slow()
    worker = worker_of(slow)
    worker.ask()
    assert slow.started.wait(60)
    for _ in range(120):
        worker.ask()
    slow.go_on.set()
    worker.wait(60)
    assert slow.count == 2
    worker.close(10)


def test_what_was_wanted_before_asking_is_always_computed() -> None:
    """Of four threads that each want and then ask, nobody's last wish is missed."""
    wanted: dict[str, int] = {}
    computed: dict[str, int] = {}
    worker = worker_of(lambda _: computed.update(wanted))

    def want(name: str) -> None:
        for x in range(200):
            wanted[name] = x
            worker.ask()

    threads = [threading.Thread(target=want, args=(name,)) for name in "abcd"]
    wanted.update(dict.fromkeys("abcd", -1))
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    worker.wait(60)
    assert computed == dict.fromkeys("abcd", 199)
    worker.close(10)


@pytest.mark.parametrize("error", [ValueError("no"), SystemExit(1)])
def test_a_computation_that_raises_is_told_and_does_not_end_the_worker(error: BaseException) -> None:
    told: list[BaseException] = []
    rest = [error]

    def compute(asked_ns: int) -> None:
        if rest:
            raise rest.pop()

    worker = Worker(compute, told.append)
    for _ in range(2):
        worker.ask()
        worker.wait(60)
    assert told == [error]
    worker.close(10)


def test_work_that_is_put_off_is_done_when_nothing_is_computed_and_waited_for() -> None:
    order: list[str] = []
    slow = Slow()
    worker = worker_of(lambda asked_ns: (slow(asked_ns), order.append("computed"))[1])
    worker.ask()
    assert slow.started.wait(60)
    worker.later("commit", 0.0, lambda: order.append("early"), is_work=True)
    worker.later("commit", 0.02, lambda: order.append("commit"), is_work=True)
    worker.later("never", 3600.0, lambda: order.append("never"))
    slow.go_on.set()
    worker.wait(60)
    assert order == ["computed", "commit"]
    worker.close(10)


def test_what_is_due_first_is_done_first_whenever_it_was_put_off() -> None:
    done: list[str] = []
    both = threading.Event()
    worker = worker_of(lambda _: None)
    start_s = monotonic()
    worker.later("second", 0.06, lambda: (done.append("second"), both.set())[0])
    worker.later("first", 0.02, lambda: done.append("first"))
    assert both.wait(60)
    assert done == ["first", "second"]
    assert monotonic() - start_s >= 0.06
    worker.close(10)


def test_closing_is_bounded_and_may_come_twice_or_first() -> None:
    worker = worker_of(lambda _: None)
    worker.close(1)
    worker.close(1)
    worker.ask()
    worker.later("a", 0.0, lambda: None, is_work=True)
    worker.wait(1)
    assert worker.idle


def test_a_function_that_does_not_return_is_reported_when_closing() -> None:
    slow = Slow()
    worker = worker_of(slow)
    worker.ask()
    assert slow.started.wait(60)
    with pytest.raises(StillRunning):
        worker.close(0.05)
    with pytest.raises(TimeoutError, match="still computing"):
        worker.wait(0.01)
    slow.go_on.set()
    worker.close(10)
    assert worker.idle


def test_the_worker_does_not_wait_for_itself() -> None:
    caught: list[BaseException] = []

    def compute(asked_ns: int) -> None:
        try:
            worker.wait(60)
        except RuntimeError as error:
            caught.append(error)

    worker = worker_of(compute)
    worker.ask()
    worker.wait(60)
    assert len(caught) == 1
    worker.close(10)
