"""Threads that take turns on one loop; no broker is needed for it."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from time import monotonic

import pytest

from epypes.transport.channels.turns import Turns, always, nothing
from epypes.transport.channels.waking import READ, Waiting

WAIT_S = 60.0


class Pipe:
    """A loop, as `turns.Loop`, that reads from a pipe: who has read what, and what was said to be written."""

    def __init__(self) -> None:
        self._read, self._write = os.pipe()
        self._waiting = Waiting()
        self._waiting.watch(self._read, READ)
        self.steps = self.flushed = self.closed = 0
        self.heard: list[str] = []
        self.strangers: set[int] = set()
        self.is_waiting = False
        self.before: Callable[[], object] = nothing

    def step(self, timeout_s: float, aside: AbstractContextManager[object]) -> None:
        self.before()
        with aside:
            ready = self._waiting.wait(timeout_s)
        self.steps += 1
        if ready:
            os.read(self._read, 1)
            self.heard.append(threading.current_thread().name)

    def flush(self) -> None:
        self.flushed += 1

    def tell(self) -> None:
        os.write(self._write, b"0")

    def wake(self) -> None:
        self._waiting.wake()

    def suits(self) -> bool:
        return threading.get_ident() not in self.strangers

    def close(self) -> None:
        self.closed += 1
        self._waiting.close()
        os.close(self._read)
        os.close(self._write)


@pytest.fixture
def troubles() -> list[Exception]:
    return []


@pytest.fixture
def pipe() -> Pipe:
    return Pipe()


@pytest.fixture
def turns(pipe: Pipe, troubles: list[Exception]) -> Iterator[Turns]:
    made = Turns(pipe, troubles.append, "the keeper")
    yield made
    made.end(WAIT_S)


def started(act: Callable[[], object], name: str = "another") -> threading.Thread:
    thread = threading.Thread(target=act, name=name)
    thread.start()
    return thread


def leading(turns: Turns, thread: threading.Thread) -> None:
    """Return when it is a thread's turn."""
    until_s = monotonic() + WAIT_S
    while turns._leader != thread.ident:
        assert monotonic() < until_s


def test_work_of_many_threads_is_done_once_each_and_never_two_at_a_time(turns):
    done: list[int] = []
    inside: list[int] = []

    def work(number: int) -> None:
        inside.append(number)
        assert inside == [number]
        done.append(inside.pop())

    def act(first: int) -> None:
        for number in range(first, first + 200):
            if number % 3:
                turns.run(lambda number=number: work(number), always, 0.0)
            else:
                assert turns.run(lambda number=number: work(number), lambda number=number: number in done, WAIT_S)

    threads = [started(lambda begin=begin: act(1000 * begin)) for begin in range(4)]
    for thread in threads:
        thread.join(WAIT_S)
    assert sorted(done) == [1000 * begin + number for begin in range(4) for number in range(200)]


def test_the_order_of_one_threads_work_is_kept_whoever_does_it(turns, pipe):
    done: list[int] = []
    waiting = started(lambda: turns.run(nothing, lambda: len(done) == 3000, WAIT_S))
    for number in range(3000):
        turns.run(lambda number=number: done.append(number), always, 0.0)
        if number % 7 == 0:
            pipe.tell()
    waiting.join(WAIT_S)
    assert done == list(range(3000))


def test_who_waits_does_the_work_that_others_wait_for(turns):
    did: list[str] = []
    waiting = started(lambda: turns.run(nothing, lambda: did, WAIT_S), "who waits")
    leading(turns, waiting)
    assert turns.run(lambda: did.append(threading.current_thread().name), lambda: did, WAIT_S)
    waiting.join(WAIT_S)
    assert did == ["who waits"]


def test_what_nobody_waits_for_is_done_by_who_asks_while_the_leader_only_waits(turns, pipe):
    did: list[str] = []

    def leave() -> None:
        turns.run(lambda: did.append(threading.current_thread().name), always, 0.0)

    def act() -> None:
        until_s = monotonic() + WAIT_S
        # Until it has come to wait: before, what is left is its.
        while (not did or did[-1] == "who waits") and monotonic() < until_s:
            leave()
        pipe.flushed, steps = 0, pipe.steps
        leave()
        flushed.append((pipe.flushed, pipe.steps - steps))

    flushed: list[tuple[int, int]] = []
    waiting = started(lambda: turns.run(nothing, lambda: pipe.heard, WAIT_S), "who waits")
    leading(turns, waiting)
    started(act, "who asks").join(WAIT_S)
    assert (did[-1], flushed) == ("who asks", [(1, 0)])
    pipe.tell()
    waiting.join(WAIT_S)
    assert pipe.heard == ["who waits"]


def test_what_the_main_thread_leaves_is_done_by_the_leader_since_a_signal_may_come_in_the_midst_of_it(turns, pipe):
    did: list[str] = []
    waiting = started(lambda: turns.run(nothing, lambda: len(did) == 50, WAIT_S), "who waits")
    leading(turns, waiting)
    for _ in range(50):
        turns.run(lambda: did.append(threading.current_thread().name), always, 0.0)
    waiting.join(WAIT_S)
    assert did == ["who waits"] * 50
    assert pipe.flushed == 0


def test_who_does_something_while_the_leader_waits_never_waits_for_himself(turns, pipe):
    found: list[bool] = []

    def work() -> None:
        # As a handler of a client's log does that sends.
        found.append(turns.run(nothing, lambda: False, WAIT_S))

    def act() -> None:
        until_s = monotonic() + WAIT_S
        while not pipe.flushed and monotonic() < until_s:
            turns.run(work, always, 0.0)

    begun_s = monotonic()
    waiting = started(lambda: turns.run(nothing, lambda: pipe.heard, WAIT_S))
    leading(turns, waiting)
    started(act).join(WAIT_S)
    pipe.tell()
    waiting.join(WAIT_S)
    assert pipe.flushed
    assert not any(found)
    assert monotonic() - begun_s < WAIT_S / 2


def test_a_leader_is_woken_when_what_another_did_is_what_it_waits_for(turns):
    did: list[int] = []
    begun_s = monotonic()
    waiting = started(lambda: turns.run(nothing, lambda: did, WAIT_S))
    leading(turns, waiting)
    turns.run(lambda: did.append(1), always, 0.0)
    waiting.join(WAIT_S)
    assert not waiting.is_alive()
    assert monotonic() - begun_s < WAIT_S / 2


def test_waiting_ends_when_its_time_is_over_also_for_who_has_no_turn(turns):
    begun_s = monotonic()
    results: list[bool] = []

    def wait() -> None:
        results.append(turns.run(nothing, lambda: False, 0.2))

    threads = [started(wait) for _ in range(3)]
    for thread in threads:
        thread.join(WAIT_S)
    assert results == [False] * 3
    assert 0.2 <= monotonic() - begun_s < WAIT_S / 2


@pytest.mark.slow
def test_when_nobody_waits_the_keeper_hears_what_comes_and_makes_way_for_who_does(turns, pipe):
    leading(turns, turns._keeper)
    pipe.tell()
    until_s = monotonic() + WAIT_S
    while not pipe.heard:
        assert monotonic() < until_s
    assert pipe.heard == ["the keeper"]
    while pipe.heard[-1] == "the keeper":
        # What came before it had made way it has heard itself.
        assert monotonic() < until_s
        count = len(pipe.heard) + 1
        assert turns.run(pipe.tell, lambda count=count: len(pipe.heard) == count, WAIT_S)
    assert pipe.heard[-1] == threading.current_thread().name


def test_a_thread_that_may_not_take_the_turn_has_the_keeper_do_it_and_waits(turns, pipe):
    pipe.strangers.add(threading.get_ident())
    for count in range(1, 4):
        assert turns.run(pipe.tell, lambda count=count: len(pipe.heard) == count, WAIT_S)
    assert set(pipe.heard) == {"the keeper"}
    assert not turns.run(nothing, lambda: False, 0.05)


def test_who_is_called_back_may_leave_work_and_never_waits_for_himself(turns):
    did: list[str] = []

    def nested() -> None:
        assert not turns.run(lambda: did.append("left"), lambda: False, WAIT_S)
        did.append("left it")

    begun_s = monotonic()
    assert turns.run(nested, lambda: "left" in did, WAIT_S)
    assert did == ["left it", "left"]
    assert monotonic() - begun_s < WAIT_S / 2


def test_what_goes_wrong_is_told_and_ends_nobody(turns, troubles):
    def fail() -> None:
        raise ValueError("no")

    assert turns.run(fail, lambda: troubles, WAIT_S)
    assert [str(trouble) for trouble in troubles] == ["no"]


def test_what_goes_wrong_beside_a_leader_is_told_and_the_leader_hears_of_it(turns, troubles):
    def fail() -> None:
        raise ValueError("no")

    waiting = started(lambda: turns.run(nothing, lambda: troubles, WAIT_S))
    leading(turns, waiting)
    turns.run(fail, always, 0.0)
    waiting.join(WAIT_S)
    assert not waiting.is_alive()
    assert [str(trouble) for trouble in troubles] == ["no"]


def test_after_an_interrupt_the_next_one_has_his_turn(turns, pipe):
    def interrupt() -> None:
        pipe.before = nothing
        raise KeyboardInterrupt

    pipe.before = interrupt
    with pytest.raises(KeyboardInterrupt):
        turns.run(nothing, lambda: False, WAIT_S)
    assert started(lambda: turns.run(pipe.tell, lambda: pipe.heard, WAIT_S)).join(WAIT_S) is None
    assert turns.run(pipe.tell, lambda: len(pipe.heard) == 2, WAIT_S)


def test_after_the_end_nothing_is_done_and_nobody_waits(turns, pipe):
    did: list[int] = []
    waiting = started(lambda: turns.run(nothing, lambda: False, WAIT_S))
    leading(turns, waiting)
    turns.end(WAIT_S)
    waiting.join(WAIT_S)
    assert not waiting.is_alive()
    assert not turns.run(lambda: did.append(1), lambda: did, WAIT_S)
    turns.end(WAIT_S)
    assert (did, pipe.closed) == ([], 1)
    assert not turns._keeper.is_alive()


def test_a_forked_child_leaves_the_connection_to_its_parent(turns, pipe):
    waiting = started(lambda: turns.run(nothing, lambda: pipe.heard, WAIT_S))
    leading(turns, waiting)
    child = os.fork()
    if not child:
        did: list[int] = []
        turns.run(lambda: did.append(1), always, 0.0)
        begun_s = monotonic()
        turns.run(lambda: did.append(2), lambda: did, WAIT_S)
        # Who led is not there.
        turns.end(WAIT_S)
        os._exit(len(did) + 2 * (monotonic() - begun_s > WAIT_S / 2))
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    pipe.tell()
    waiting.join(WAIT_S)
    assert len(pipe.heard) == 1


@pytest.mark.slow
def test_a_connection_that_is_over_keeps_nobody_busy(turns, pipe, troubles):
    def end() -> None:
        raise ConnectionError("over")

    begun_s, pipe.before = monotonic(), end
    looks = len(troubles)
    assert not turns.run(nothing, lambda: False, 0.0)
    until_s = monotonic() + WAIT_S
    while len(troubles) < looks + 3:
        assert monotonic() < until_s
    # Twice the keeper has looked, a quarter of a second after the other.
    assert monotonic() - begun_s > 0.4


@pytest.mark.parametrize("is_half_way", [True, False])
def test_only_what_was_interrupted_half_way_is_told_as_broken(turns, pipe, troubles, is_half_way):
    def interrupt() -> None:
        pipe.before = nothing
        pipe.is_waiting = not is_half_way
        raise KeyboardInterrupt

    pipe.before = interrupt
    with pytest.raises(KeyboardInterrupt):
        turns.run(nothing, lambda: False, WAIT_S)
    assert [str(trouble) for trouble in troubles] == ["a signal came in the midst of a message"] * is_half_way


def test_what_a_signals_handler_leaves_is_not_done_in_the_midst_of_what_it_has_come_between(turns, pipe):
    did: list[str] = []
    waiting = started(lambda: turns.run(nothing, lambda: pipe.heard, WAIT_S))
    leading(turns, waiting)

    def interrupted() -> None:
        did.append("begun")
        # As a handler does that is called just here.
        turns.run(lambda: did.append("the handler's"), always, 0.0)
        did.append("ended")

    turns.run(interrupted, always, 0.0)
    pipe.tell()
    waiting.join(WAIT_S)
    assert did == ["begun", "ended", "the handler's"]


def test_what_a_signals_handler_leaves_is_done_at_once_though_its_own_thread_waits(turns):
    did: list[float] = []
    begun_s = monotonic()

    def handle(*_: object) -> None:
        turns.run(lambda: did.append(monotonic()), always, 0.0)

    before = signal.signal(signal.SIGUSR1, handle)
    try:
        timer = threading.Timer(0.1, os.kill, (os.getpid(), signal.SIGUSR1))
        timer.start()
        assert turns.run(nothing, lambda: did, WAIT_S)
        timer.join(WAIT_S)
    finally:
        signal.signal(signal.SIGUSR1, before)
    assert did[0] - begun_s < WAIT_S / 2
