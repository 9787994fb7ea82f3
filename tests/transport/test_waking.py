"""A wait for sockets that any thread may end."""

from __future__ import annotations

import gc
import os
import socket
import threading
from collections.abc import Iterator
from time import monotonic

import pytest

from epypes.transport.channels.waking import READ, WRITE, Waiting

WAIT_S = 60.0


@pytest.fixture
def waiting() -> Iterator[Waiting]:
    made = Waiting()
    yield made
    made.close()


@pytest.fixture
def ends() -> Iterator[tuple[socket.socket, socket.socket]]:
    one, other = socket.socketpair()
    with one, other:
        yield one, other


def test_what_is_ready_is_told_with_what_it_is_ready_for(waiting, ends):
    one, other = ends
    waiting.watch(one, READ)
    assert waiting.wait(0.0) == []
    other.send(b"0")
    assert waiting.wait(WAIT_S) == [(one, READ)]
    waiting.watch(one, READ | WRITE)
    assert waiting.wait(WAIT_S) == [(one, READ | WRITE)]
    waiting.watch(one, WRITE)
    assert waiting.wait(WAIT_S) == [(one, WRITE)]
    waiting.forget(one)
    assert waiting.wait(0.0) == []


def test_any_thread_ends_a_wait(waiting):
    begun_s = monotonic()
    timer = threading.Timer(0.05, waiting.wake)
    timer.start()
    assert waiting.wait(WAIT_S) == []
    assert monotonic() - begun_s < WAIT_S / 2
    timer.join(WAIT_S)


def test_who_was_woken_before_it_waits_does_not_wait_and_that_once(waiting):
    for _ in range(3):
        waiting.wake()
    begun_s = monotonic()
    assert waiting.wait(WAIT_S) == []
    assert monotonic() - begun_s < WAIT_S / 2
    begun_s = monotonic()
    assert waiting.wait(0.1) == []
    assert monotonic() - begun_s >= 0.1


def test_to_be_woken_more_often_than_anybody_can_count_blocks_nobody(waiting):
    for _ in range(10_000):
        waiting.wake()
    while waiting.wait(0.0):
        pass


def test_who_waits_hears_of_what_it_is_to_wait_for_from_now_on(waiting, ends):
    one, _ = ends
    waiting.watch(one, READ)
    heard: list[list[tuple[object, int]]] = []
    thread = threading.Thread(target=lambda: heard.append(waiting.wait(WAIT_S)))
    thread.start()
    waiting.watch(one, READ | WRITE)
    thread.join(WAIT_S)
    assert not thread.is_alive()
    assert waiting.wait(WAIT_S) == [(one, WRITE)]


def test_closed_there_is_nobody_to_be_woken():
    made = Waiting()
    made.close()
    made.wake()


@pytest.mark.slow
def test_a_forked_child_that_drops_its_copy_changes_nothing_here(waiting, ends):
    one, other = ends
    waiting.watch(one, READ)
    child = os.fork()
    if not child:
        waiting.forget(one)
        waiting.close()
        gc.collect()
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    other.send(b"0")
    assert waiting.wait(WAIT_S) == [(one, READ)]
    waiting.wake()
    one.recv(1)
    assert waiting.wait(WAIT_S) == []
