"""Events that come faster than they are worked off: their age, and the memory that they take."""

from __future__ import annotations

import gc
import os
import queue
import threading
import time
import weakref
from collections import Counter

import numpy as np
import psutil
import pytest

import epypes as ep

TIMEOUT_S = 60.0
FRAMES_OF_A_MINUTE = 30 * 60
FRAME_BYTES = 1_000_000
# A tenth of what the queue would hold if nothing were dropped.
MOST_GROWTH_BYTES = FRAMES_OF_A_MINUTE * FRAME_BYTES // 10


def resident_bytes() -> int:
    return psutil.Process(os.getpid()).memory_info().rss


@pytest.mark.slow
def test_a_camera_of_30_fps_before_a_graph_of_10_fps_is_answered_from_frames_less_than_two_periods_old():
    period_s, frames, waiting = 1 / 30, 120, threading.Event()
    ages_s = []

    def compute(captured_s):
        ages_s.append(time.monotonic() - captured_s)
        waiting.wait(0.1)

    mailbox = ep.Mailbox("latest")
    cg = ep.CompGraph({"compute": compute}, {"compute": ("captured_s", None)})
    with ep.SinkPipeline("late", cg, mailbox, lambda event: {"captured_s": event}) as pipe:
        begin_s = time.monotonic()
        for number in range(frames):
            waiting.wait(max(0.0, begin_s + number * period_s - time.monotonic()))
            mailbox.put(time.monotonic())
        assert pipe.loop.drain(TIMEOUT_S)
    assert mailbox.dropped["superseded"] + pipe.loop.handled == frames
    assert mailbox.dropped["superseded"] > frames / 2, "or it was no overload"
    assert np.percentile(ages_s, 95) < 2 * period_s


@pytest.mark.parametrize(("policy", "size", "reason"), [("latest", 1, "superseded"), ("drop_oldest", 8, "oldest")])
def test_what_was_dropped_and_what_was_worked_off_is_what_came(policy, size, reason):
    gate, inside, worked_off = threading.Event(), threading.Event(), []

    def compute(x):
        worked_off.append(x)
        inside.set()
        assert gate.wait(TIMEOUT_S)

    told: Counter[int] = Counter()
    mailbox = ep.Mailbox(policy, size, on_drop=lambda event: told.update([event]))
    pipe = ep.SinkPipeline("p", ep.CompGraph({"f": compute}, {"f": ("x", None)}), mailbox, lambda event: {"x": event})
    pipe.listen()
    mailbox.put(0)
    assert inside.wait(TIMEOUT_S)
    for event in range(1, 1_000):
        mailbox.put(event)
    gate.set()
    assert pipe.loop.drain(TIMEOUT_S)
    assert worked_off == [0, *range(1_000 - size, 1_000)], "the newest ones, in their order"
    assert mailbox.dropped == {reason: 999 - size}
    assert told == Counter(range(1, 1_000 - size)), "each one that was dropped is told, once"


def overload(mailbox: ep.Mailbox, function, frames: int) -> ep.SinkPipeline:
    """Put frames as fast as they can be made; return the pipeline, which has had to leave most of them out."""
    cg = ep.CompGraph({"f": function, "g": lambda y: y + 1}, {"f": ("x", "y"), "g": ("y", "z")})
    pipe = ep.SinkPipeline("p", cg, mailbox, lambda event: {"x": event})
    pipe.on_error = lambda failure: None
    with pipe:
        for number in range(frames):
            mailbox.put(np.full(FRAME_BYTES, number % 251, np.uint8))
        assert pipe.loop.drain(TIMEOUT_S)
    return pipe


def slow(x):
    """Take longer than it takes to make a frame."""
    for _ in range(20):
        y = x + 1
    return y


def fails_often(x):
    if x[0] % 2:
        raise ValueError(int(x[0]))
    return slow(x)


@pytest.mark.slow
@pytest.mark.parametrize(
    "function",
    [pytest.param(slow, marks=pytest.mark.soak), fails_often],
    ids=["good frames", "bad frames too"],
)
@pytest.mark.parametrize(("policy", "size"), [("latest", 1), ("drop_oldest", 8), ("block", 8)])
def test_memory_stays_flat_over_as_many_frames_as_a_minute_of_overload_has(policy, size, function):
    overload(ep.Mailbox(policy, size), function, 100)
    before = resident_bytes()
    mailbox = ep.Mailbox(policy, size)
    pipe = overload(mailbox, function, FRAMES_OF_A_MINUTE)
    assert resident_bytes() - before < MOST_GROWTH_BYTES
    assert mailbox.dropped.total() + pipe.loop.handled == FRAMES_OF_A_MINUTE
    assert (pipe.failed > 0) == (function is fails_often)


@pytest.mark.slow
def test_a_kept_failure_keeps_its_own_event_alive_and_no_other():
    class Frame:
        pass

    def f(x):
        raise ValueError("bad frame")

    cg = ep.CompGraph({"f": f}, {"f": ("x", "y")})
    pipe = ep.SinkPipeline("p", cg, queue.SimpleQueue(), lambda event: {"x": event})
    failures = []
    pipe.on_error = failures.append
    frames = weakref.WeakSet()
    for _ in range(50):
        frame = Frame()
        frames.add(frame)
        pipe.handle(frame)
    del frame
    assert len(failures) == len(frames) == 50
    last = failures.pop()
    failures.clear()
    gc.collect()
    assert list(frames) == [last.inputs["x"]]


@pytest.mark.parametrize("timeout", [float("nan"), -1.0, -0.001], ids=str)
@pytest.mark.parametrize("policy", ["block", "latest"])
def test_a_mailbox_refuses_to_wait_for_a_time_that_is_none(policy, timeout):
    mailbox = ep.Mailbox(policy)
    with pytest.raises(ValueError, match="seconds to wait"):
        mailbox.put(1, timeout=timeout)
    assert mailbox.empty()
    with pytest.raises(ValueError, match="seconds to wait"):
        mailbox.get(timeout=timeout)
    mailbox.put(1, block=False, timeout=timeout)
    assert mailbox.get(block=False, timeout=timeout) == 1, "it waits for nothing then"


@pytest.mark.slow
def test_an_idle_pipeline_takes_next_to_nothing_of_a_core():
    cg = ep.CompGraph({"f": lambda x: x}, {"f": ("x", None)})
    with ep.SinkPipeline("idle", cg, queue.SimpleQueue(), lambda event: {"x": event}) as pipe:
        clock = time.pthread_getcpuclockid(pipe.loop._thread.ident)
        before_s = time.clock_gettime(clock)
        pipe.loop._thread.join(3.0)
        spent_s = time.clock_gettime(clock) - before_s
    assert spent_s < 3.0 * 0.02, "busy polling would take it all"
