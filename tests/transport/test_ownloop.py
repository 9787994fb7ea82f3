"""One event loop that several threads run in turn; no server is needed for it."""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import Callable, Iterator
from time import monotonic
from typing import Self

import pytest

from epypes.transport.channels.jetstream.loop import OwnLoop
from epypes.transport.channels.turns import Turns, always, nothing

WAIT_S = 60.0
MANY_BYTES = 8_000_000


@pytest.fixture
def loop() -> OwnLoop:
    return OwnLoop()


@pytest.fixture
def turns(loop: OwnLoop) -> Iterator[Turns]:
    raised: list[Exception] = []
    made = Turns(loop, raised.append, "the keeper")
    yield made
    made.end(WAIT_S)
    assert not raised


class Leader:
    """A thread that waits on a loop until it is told that it is over."""

    def __init__(self, turns: Turns, loop: OwnLoop) -> None:
        self._turns, self._loop = turns, loop
        self.is_over = False
        self.looks = 0
        self._thread = threading.Thread(target=self._wait)

    def _wait(self) -> None:
        self._turns.run(nothing, self._look, WAIT_S)

    def _look(self) -> bool:
        # Who leaves work looks too.
        self.looks += threading.get_ident() == self.ident
        return self.is_over

    @property
    def ident(self) -> int | None:
        return self._thread.ident

    def is_waiting(self) -> bool:
        return self._turns._leader == self.ident and self._loop._sparing.waits_until_s > 0.0

    def must_wait(self) -> None:
        """Return when it waits."""
        until_s = monotonic() + WAIT_S
        while not self.is_waiting():
            assert monotonic() < until_s

    def __enter__(self) -> Self:
        self._thread.start()
        self.must_wait()
        return self

    def __exit__(self, *_: object) -> None:
        self.is_over = True
        self._loop.wake()
        self._thread.join(WAIT_S)
        assert not self._thread.is_alive()


def leave(turns: Turns, *works: Callable[[], object]) -> int | None:
    """Leave work as a thread does that has not the main thread's signals; return which thread that was."""

    def act() -> None:
        for work in works:
            turns.run(work, always, 0.0)

    thread = threading.Thread(target=act)
    thread.start()
    thread.join(WAIT_S)
    assert not thread.is_alive()
    return thread.ident


@pytest.fixture
def leader(turns: Turns, loop: OwnLoop) -> Iterator[Leader]:
    with Leader(turns, loop) as made:
        yield made


def test_what_nobody_waits_for_is_done_by_who_leaves_it_while_the_leader_waits(turns, loop, leader):
    ran: list[int] = []

    async def work() -> None:
        await asyncio.sleep(0)
        ran.append(threading.get_ident())

    looks = leader.looks
    thread = leave(turns, *[lambda: loop.create_task(work())] * 50)
    assert ran == [thread] * 50
    assert leader.is_waiting()
    # It was not woken.
    assert leader.looks == looks


def test_a_timer_that_another_thread_sets_is_kept_by_who_waits(turns, loop, leader):
    rang = threading.Event()
    leave(turns, lambda: loop.call_later(0.05, rang.set))
    assert rang.wait(WAIT_S / 2)


def test_what_another_thread_could_not_write_at_once_is_written_by_who_waits(turns, loop, leader):
    ours, theirs = socket.socketpair()
    opened: list[asyncio.BaseTransport] = []

    async def connect() -> None:
        transport, _ = await loop.create_connection(asyncio.Protocol, sock=ours)
        opened.append(transport)
        # Who waits for it shall look.
        loop.stop()

    with theirs:
        assert turns.run(lambda: loop.create_task(connect()), lambda: opened, WAIT_S)
        leader.must_wait()
        leave(turns, lambda: opened[0].write(bytes(MANY_BYTES)))
        theirs.settimeout(WAIT_S / 2)
        read = 0
        while read < MANY_BYTES:
            read += len(theirs.recv(65_536))
        leader.must_wait()
        leave(turns, opened[0].close)
        assert theirs.recv(1) == b""


def test_a_thread_that_runs_a_loop_of_its_own_leaves_it_to_the_leader(turns, loop, leader):
    done = threading.Event()
    ran: list[int] = []

    def work() -> None:
        ran.append(threading.get_ident())
        done.set()

    async def cell() -> None:
        turns.run(work, always, 0.0)
        assert done.wait(WAIT_S)

    thread = threading.Thread(target=lambda: asyncio.run(cell()))
    thread.start()
    thread.join(WAIT_S)
    assert ran == [leader.ident]


def test_what_is_more_than_a_few_rounds_is_gone_on_with_by_who_waits(turns, loop, leader):
    done = threading.Event()

    async def work() -> None:
        for _ in range(100):
            # As what tells that something has changed does, it has the loop return.
            loop.stop()
            await asyncio.sleep(0)
        done.set()

    leave(turns, lambda: loop.create_task(work()))
    assert done.wait(WAIT_S)


def test_threads_that_leave_work_while_another_waits_lose_none(turns, loop, leader):
    ran: list[int] = []

    async def work(number: int) -> None:
        await asyncio.sleep(0.0001 * (number % 3))
        ran.append(number)
        loop.stop()

    def act(first: int) -> None:
        for number in range(first, first + 300):
            turns.run(lambda number=number: loop.create_task(work(number)), always, 0.0)

    threads = [threading.Thread(target=act, args=(1000 * begin,)) for begin in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(WAIT_S)
    assert turns.run(nothing, lambda: len(ran) == 1200, WAIT_S)
    assert sorted(ran) == [1000 * begin + number for begin in range(4) for number in range(300)]
