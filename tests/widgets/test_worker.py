"""Are values computed on another thread, the latest first and the last always?"""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping
from typing import Any

import pytest

from epypes.errors import StillRunning
from epypes_widgets.worker import Worker


class Slow:
    """A computation that waits until it is let go."""

    def __init__(self) -> None:
        self.seen: list[Mapping[str, Any]] = []
        self.started, self.go_on = threading.Event(), threading.Event()

    def __call__(self, values: Mapping[str, Any], changed_ns: int) -> None:
        self.seen.append(dict(values))
        self.started.set()
        assert self.go_on.wait(10)


def test_values_that_arrive_meanwhile_overwrite_each_other_and_the_last_is_computed() -> None:
    slow = Slow()
    worker = Worker(slow)
    worker.submit({"x": 0})
    assert slow.started.wait(10)
    for x in range(1, 120):
        worker.submit({"x": x})
    slow.go_on.set()
    worker.wait(10)
    assert slow.seen == [{"x": 0}, {"x": 119}]
    worker.close(10)


def test_values_of_several_hyperparameters_are_merged() -> None:
    slow = Slow()
    worker = Worker(slow)
    worker.submit({"x": 0})
    assert slow.started.wait(10)
    for values in ({"y": 1}, {"x": 2}, {"y": 3}):
        worker.submit(values)
    slow.go_on.set()
    worker.wait(10)
    assert slow.seen[1:] == [{"x": 2, "y": 3}]
    worker.close(10)


def test_values_may_come_from_any_thread() -> None:
    latest: dict[str, int] = {}
    worker = Worker(lambda values, _: latest.update(values))

    def submit(name: str) -> None:
        for x in range(200):
            worker.submit({name: x})

    threads = [threading.Thread(target=submit, args=(name,)) for name in "abcd"]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10)
    worker.wait(10)
    assert latest == dict.fromkeys("abcd", 199)
    worker.close(10)


@pytest.mark.parametrize("error", [ValueError("no"), SystemExit(1)])
def test_a_computation_that_raises_does_not_end_the_worker(
    error: BaseException, caplog: pytest.LogCaptureFixture
) -> None:
    seen: list[int] = []

    def compute(values: Mapping[str, Any], changed_ns: int) -> None:
        if values["x"] == 0:
            raise error
        seen.append(values["x"])

    worker = Worker(compute)
    with caplog.at_level(logging.CRITICAL + 1):
        worker.submit({"x": 0})
        worker.wait(10)
        worker.submit({"x": 1})
        worker.wait(10)
    assert seen == [1]
    worker.close(10)


def test_closing_is_bounded_and_may_come_twice_or_first() -> None:
    worker = Worker(lambda values, _: None)
    worker.close(1)
    worker.close(1)
    worker.submit({"x": 1})
    worker.wait(1)
    assert worker.idle


def test_a_function_that_does_not_return_is_reported_when_closing() -> None:
    slow = Slow()
    worker = Worker(slow)
    worker.submit({"x": 0})
    assert slow.started.wait(10)
    with pytest.raises(StillRunning):
        worker.close(0.05)
    with pytest.raises(TimeoutError, match="still computing"):
        worker.wait(0.01)
    slow.go_on.set()
    worker.close(10)
    assert worker.idle


def test_the_worker_does_not_wait_for_itself() -> None:
    caught: list[BaseException] = []

    def compute(values: Mapping[str, Any], changed_ns: int) -> None:
        try:
            worker.wait(10)
        except RuntimeError as error:
            caught.append(error)

    worker = Worker(compute)
    worker.submit({})
    worker.wait(10)
    assert len(caught) == 1
    worker.close(10)
