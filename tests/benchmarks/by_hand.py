"""How would somebody write the same work without any library?"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from time import perf_counter_ns
from typing import Any

from tests.benchmarks.work import Work, add_one


def straight_chain(count: int) -> Callable[[], int]:
    def straight() -> int:
        x = 0
        for _ in range(count):
            x = add_one(x)
        return x

    return straight


def timed_chain(count: int) -> Callable[[], int]:
    def timed() -> int:
        x, durations_ns = 0, []
        for _ in range(count):
            start_ns = perf_counter_ns()
            x = add_one(x)
            durations_ns.append(perf_counter_ns() - start_ns)
        return x

    return timed


def straight_fan(count: int, gather: Callable[..., int]) -> Callable[[], int]:
    def straight() -> int:
        a = add_one(0)
        return gather(*[add_one(a) for _ in range(count)])

    return straight


def timed_fan(count: int, gather: Callable[..., int]) -> Callable[[], int]:
    def timed() -> int:
        start_ns = perf_counter_ns()
        a = add_one(0)
        durations_ns, outputs = [perf_counter_ns() - start_ns], []
        for _ in range(count):
            start_ns = perf_counter_ns()
            outputs.append(add_one(a))
            durations_ns.append(perf_counter_ns() - start_ns)
        start_ns = perf_counter_ns()
        y = gather(*outputs)
        durations_ns.append(perf_counter_ns() - start_ns)
        return y

    return timed


def first_result(work: Work) -> Any:
    """Order the functions (Kahn) and call them by dictionaries."""
    values = {**work.payload, **work.hparams}
    for name in _in_run_order(work.io):
        inputs, output = work.io[name]
        values[output] = work.functions[name](*[values[token] for token in inputs])
    return values[work.target]


def _in_run_order(io: Mapping[str, tuple[tuple[str, ...], str]]) -> list[str]:
    producer = {output: name for name, (_, output) in io.items()}
    waits_for: dict[str, int] = {}
    followers: dict[str, list[str]] = {name: [] for name in io}
    for name, (inputs, _) in io.items():
        above = [producer[token] for token in inputs if token in producer]
        waits_for[name] = len(above)
        for other in above:
            followers[other].append(name)
    ready, order = deque(name for name, count in waits_for.items() if not count), []
    while ready:
        name = ready.popleft()
        order.append(name)
        for follower in followers[name]:
            waits_for[follower] -= 1
            if not waits_for[follower]:
                ready.append(follower)
    return order
