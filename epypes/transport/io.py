"""Who touches the sockets of this process? One I/O thread, and nobody else without a socket's lock.

ZeroMQ's sockets must not be used by two threads at once, and a thread per socket wakes up for nothing. So one daemon
thread opens, reads and closes them all: it sleeps in a poller until a socket can be read, something is due, or
another thread hands it a command through a wake-up socket. It starts with the first command and ends when it has no
socket left.

Sending alone is done where the message is, since to wake another thread for it takes longer than to send it (35 us
of 60). A socket that is sent on has a lock, and whoever touches it holds that.
"""

from __future__ import annotations

import atexit
import contextlib
import os
import threading
from collections.abc import Callable
from concurrent.futures import Future
from typing import TypeVar

import zmq

from epypes.transport.iothread import LINGER_MS, IOThread, Socket, has_arrived

__all__ = ["IOThread", "Socket", "call", "close", "close_soon", "has_arrived", "on_io_thread", "soon"]

T = TypeVar("T")


class _State:
    """The I/O thread of this process, made anew after a fork, since threads and sockets don't survive one."""

    def __init__(self) -> None:
        # Re-entrant, since the garbage collector may close a forgotten socket while it is held.
        self.lock = threading.RLock()
        self.current: IOThread | None = None
        self.inherited: list[IOThread | None] = []

    def forget(self) -> None:
        # Kept alive: collecting a ZeroMQ context of the parent would close what the parent still uses.
        self.inherited.append(self.current)
        self.lock = threading.RLock()
        self.current = None


_state = _State()
os.register_at_fork(after_in_child=_state.forget)


def call(command: Callable[[IOThread], T], timeout_s: float = 10.0, *, start: bool = False) -> T:
    """Run a command on the I/O thread of this process and return its result, or raise what it raised.

    Parameters
    ----------
    command
        Called with the `IOThread`, on its thread; must not block.
    timeout_s
        Longest wait, in seconds.
    start
        True for the command that opens a socket: the thread is started if none runs.

    Raises
    ------
    TimeoutError
        If the I/O thread was busy for so long; the command may still run later.
    zmq.ZMQError
        Of errno ``ENOTSOCK`` if no thread runs, so that no socket is open.
    """
    with _state.lock:
        current = _state.current
        if current is None:
            current = _started(start)
        if current.thread is not threading.current_thread():
            future: Future[T] = Future()
            current.submit(command, future)
    if current.thread is threading.current_thread():
        return command(current)
    return future.result(timeout_s)


def on_io_thread() -> bool:
    """Return whether the caller runs on the I/O thread, as a user's queue does that is put into."""
    current = _state.current
    return current is not None and current.thread is threading.current_thread()


def _started(start: bool) -> IOThread:
    if not start:
        raise zmq.ZMQError(zmq.ENOTSOCK)
    new = IOThread(lambda: _retire(new))
    _state.current = new
    new.thread.start()
    return new


def _retire(thread: IOThread) -> None:
    """Have a thread end, unless it has just got something to do."""
    with _state.lock:
        if thread.is_idle():
            thread.has_retired = True
            if _state.current is thread:
                _state.current = None


def close(owned: Socket, timeout_s: float = 10.0) -> None:
    """Close a socket of the I/O thread, and wait until what it had is sent if it was the last.

    Parameters
    ----------
    owned
        From `IOThread.open`; closing it twice is allowed.
    timeout_s
        Longest wait, in seconds. Sending what is left goes on in the background, `LINGER_MS` at most.
    """

    def command(io: IOThread) -> threading.Thread | None:
        return io.thread if io.close(owned) else None

    try:
        ending = call(command, timeout_s)
    except zmq.ZMQError:
        # No thread, so it is closed.
        return
    if ending is not None and ending is not threading.current_thread():
        ending.join(min(timeout_s, LINGER_MS / 1000 + 0.5))


def soon(command: Callable[[IOThread], object]) -> None:
    """Have a command run without waiting; the garbage collector may call this in any thread, anywhere."""
    current = _state.current
    if current is not None:
        current.submit(command, Future())


def close_soon(owned: Socket) -> None:
    """Have a socket closed without waiting; the garbage collector may call this in any thread, anywhere."""
    soon(lambda io: io.close(owned))


def _close_at_exit() -> None:
    # Without this, what was handed to ZeroMQ just before the script's end would be lost.
    current = _state.current
    if current is None or not current.thread.is_alive():
        return
    with contextlib.suppress(TimeoutError, zmq.ZMQError):
        call(IOThread.close_all, timeout_s=1.0)
    current.thread.join(LINGER_MS / 1000 + 0.5)


atexit.register(_close_at_exit)
