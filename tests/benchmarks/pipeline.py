"""How many events a second go through a pipeline?"""

from __future__ import annotations

import queue
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from time import perf_counter_ns
from typing import Any

import epypes as ep
from tests.benchmarks.row import OURS, Goal, Row, row
from tests.benchmarks.timing import Effort, Times
from tests.benchmarks.work import add_one

RAW = "a thread between two queues"
_ROUNDS = 15
_EVENTS = 20_000
_TIMEOUT_S = 60.0

Queues = tuple["queue.SimpleQueue[Any]", "queue.SimpleQueue[Any]"]


def rows(effort: Effort) -> list[Row]:
    rounds, count = (3, 200) if effort.quick else (_ROUNDS, _EVENTS)
    times = Times({RAW: {}, OURS: {}})
    with _raw() as raw, _pipeline() as ours:
        for queues in (raw, ours):
            _taken_ns(queues, count)
        for index in range(rounds):
            for name, queues in ((RAW, raw), (OURS, ours)):
                times.durations_ns[name][index] = _taken_ns(queues, count)
    rate = count / times.medians_ns[OURS] * 1e9
    note = f"{count:,} events, from the first put to the last answer taken: {rate:,.0f} a second"
    return [row("events through a trivial FullPipeline", times, goal=Goal("ratio", 12), limit=RAW, note=note)]


def _taken_ns(queues: Queues, count: int) -> int:
    q_in, q_out = queues
    start_ns = perf_counter_ns()
    for event in range(count):
        q_in.put(event)
    answers = [q_out.get(timeout=_TIMEOUT_S) for _ in range(count)]
    taken_ns = perf_counter_ns() - start_ns
    if answers != list(range(1, count + 1)):
        raise AssertionError("The answers are not those of the events, in their order.")
    return taken_ns


@contextmanager
def _raw() -> Iterator[Queues]:
    q_in: Any = queue.SimpleQueue()
    q_out: Any = queue.SimpleQueue()

    def work() -> None:
        while (event := q_in.get()) is not None:
            q_out.put(add_one(event))

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    yield q_in, q_out
    q_in.put(None)
    thread.join(_TIMEOUT_S)


@contextmanager
def _pipeline() -> Iterator[Queues]:
    q_in: Any = queue.SimpleQueue()
    q_out: Any = queue.SimpleQueue()
    cg = ep.CompGraph({"f": add_one}, {"f": ("x", "y")})
    with ep.FullPipeline("trivial", cg, q_in, q_out, lambda event: {"x": event}, lambda view: view["y"]):
        yield q_in, q_out
