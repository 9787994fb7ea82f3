"""Threads that take turns on one loop; no broker is needed for it."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from time import monotonic

import pytest

pytest.importorskip("pika")

from epypes.transport.channels.amqp.turns import Turns, always, nothing

WAIT_S = 20.0


@pytest.fixture
def troubles() -> list[Exception]:
    return []


@pytest.fixture
def turns(troubles: list[Exception]) -> Iterator[Turns]:
    made = Turns(troubles.append)
    yield made
    made.end(WAIT_S)


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

    threads = [threading.Thread(target=act, args=(1000 * begin,)) for begin in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(WAIT_S)
    assert sorted(done) == [1000 * begin + number for begin in range(4) for number in range(200)]


def test_who_waits_does_the_work_that_others_leave(turns):
    did: list[str] = []

    def wait() -> None:
        assert turns.run(nothing, lambda: did, WAIT_S)

    waiting = threading.Thread(target=wait, name="who waits")
    waiting.start()
    while not turns._is_taken:
        assert waiting.is_alive()
    turns.run(lambda: did.append(threading.current_thread().name), always, 0.0)
    waiting.join(WAIT_S)
    assert did == ["who waits"]


def test_waiting_ends_when_its_time_is_over_also_for_who_has_no_turn(turns):
    begun_s = monotonic()
    results: list[bool] = []

    def wait() -> None:
        results.append(turns.run(nothing, lambda: False, 0.2))

    threads = [threading.Thread(target=wait) for _ in range(3)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(WAIT_S)
    assert results == [False] * 3
    assert 0.2 <= monotonic() - begun_s < WAIT_S / 2


def test_what_goes_wrong_is_told_and_ends_nobody(turns, troubles):
    def fail() -> None:
        raise ValueError("no")

    assert turns.run(fail, lambda: troubles, WAIT_S)
    assert [str(trouble) for trouble in troubles] == ["no"]


def test_after_the_end_nothing_is_done_and_nobody_waits(turns):
    did: list[int] = []
    turns.end(WAIT_S)
    assert not turns.run(lambda: did.append(1), lambda: did, WAIT_S)
    assert did == []
