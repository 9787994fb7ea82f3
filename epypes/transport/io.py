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
import logging
import os
import socket
import threading
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from time import monotonic
from typing import Any, TypeVar

import zmq

from epypes.transport.addresses import address_error, check_port

T = TypeVar("T")
Socket = zmq.Socket[bytes]
# Reads some of what has arrived, and says whether there is more.
Reader = Callable[[], bool]

log = logging.getLogger("epypes.transport")

# How long a socket that was closed, or the end of the process, may wait for a peer that does not read.
LINGER_MS = 1_000
_CLOSE_MS = 500
# A silent peer is dropped after 15 s; seldom enough that an idle process stays idle.
_OPTIONS: dict[int, int] = {
    zmq.HEARTBEAT_IVL: 5_000,
    zmq.HEARTBEAT_TIMEOUT: 15_000,
    zmq.HEARTBEAT_TTL: 30_000,
    zmq.RECONNECT_IVL: 50,
    zmq.RECONNECT_IVL_MAX: 2_000,
    zmq.IPV6: 0,
}


# As numbers: pyzmq looks an enum up at every call.
_FD, _EVENTS, _POLLIN = int(zmq.FD), int(zmq.EVENTS), int(zmq.POLLIN)


def has_arrived(owned: Socket) -> bool:
    """Return whether a socket can be read. To be asked after whatever else was done with it: that may have used up
    the signal by which its file descriptor wakes the I/O thread.
    """
    return bool(int(owned.get(_EVENTS)) & _POLLIN)


@dataclass(slots=True, eq=False)
class _Owned:
    """What the I/O thread knows of a socket."""

    descriptor: int
    reader: Reader
    lock: AbstractContextManager[Any]
    endpoint: str
    tick: Callable[[], None] | None = None
    every_s: float = 0.0
    due_s: float = float("inf")


class IOThread:
    """The thread; its methods other than `submit` are for commands, which run on it."""

    def __init__(self) -> None:
        self._commands: deque[tuple[Callable[[IOThread], Any], Future[Any]]] = deque()
        self._owned: dict[Socket, _Owned] = {}
        # By file descriptor, and those among them that may have more than they were asked for.
        self._readers: dict[int, Reader] = {}
        self._unfinished: set[int] = set()
        self._next_due_s = float("inf")
        self._context = zmq.Context(io_threads=1)
        self._poller = zmq.Poller()
        self._wake_in, self._wake_out = socket.socketpair()
        self._wake_in.setblocking(False)
        self._wake_out.setblocking(False)
        self._poller.register(self._wake_out.fileno(), zmq.POLLIN)
        self._readers[self._wake_out.fileno()] = self._run_commands
        self.thread = threading.Thread(target=self._run, name="epypes-io", daemon=True)

    def submit(self, command: Callable[[IOThread], Any], future: Future[Any]) -> None:
        """Hand over a command; callable from any thread, under the module's lock."""
        self._commands.append((command, future))
        # Blocking would mean that the pipe is full of wake-ups already.
        with contextlib.suppress(BlockingIOError):
            self._wake_in.send(b"\0")

    def open(
        self,
        kind: int,
        address: str,
        bind: bool,
        reader: Reader,
        options: Sequence[tuple[int, int | bytes]],
        lock: AbstractContextManager[Any] | None = None,
    ) -> Socket:
        """Return a new socket, bound or connected, whose ``reader`` is called when it can be read.

        Parameters
        ----------
        kind
            ``zmq.XPUB`` or the like.
        address
            Where it is bound or connected.
        bind
            Whether it is bound.
        reader
            Reads a part of what has arrived; returns whether there is more.
        options
            Of ZeroMQ, by number, in this order.
        lock
            Is held by whoever else touches the socket.

        Raises
        ------
        AddressError
            If ZeroMQ refuses the address.
        """
        check_port(address)
        new: Socket = self._context.socket(kind)
        try:
            # Options count only for what is bound or connected after them.
            for option, value in [*_OPTIONS.items(), (zmq.LINGER, LINGER_MS), *options]:
                new.setsockopt(option, value)
            if bind:
                new.bind(address)
            else:
                new.connect(address)
        except (zmq.ZMQError, UnicodeError, ValueError, TypeError) as error:
            new.close(linger=0)
            number = getattr(error, "errno", None) or 0
            raise address_error(address, "bound" if bind else "connected", number, str(error)) from error
        endpoint = new.getsockopt_string(zmq.LAST_ENDPOINT) if bind else ""
        descriptor = int(new.get(_FD))
        self._owned[new] = _Owned(descriptor, reader, lock or nullcontext(), endpoint)
        self._readers[descriptor] = reader
        self._poller.register(descriptor, zmq.POLLIN)
        self._unfinished.add(descriptor)
        return new

    def address_of(self, owned: Socket, address: str) -> str:
        """Return the endpoint that a socket is really bound to, or the address it was connected to."""
        known = self._owned.get(owned)
        return known.endpoint or address if known is not None else address

    def read_again(self, owned: Socket) -> None:
        """Have a socket read though it gives no signal, since something else has been done with it."""
        known = self._owned.get(owned)
        if known is not None:
            self._unfinished.add(known.descriptor)

    def every(self, interval_s: float, owned: Socket, tick: Callable[[], None]) -> None:
        """Call something again and again while a socket is open; it may use the socket."""
        known = self._owned[owned]
        known.tick, known.every_s, known.due_s = tick, interval_s, monotonic() + interval_s
        self._next_due_s = min(self._next_due_s, known.due_s)

    def close(self, owned: Socket) -> bool:
        """Close a socket, twice if you like; return whether it was the last one, so that the thread ends."""
        known = self._owned.pop(owned, None)
        if known is not None:
            self._poller.unregister(known.descriptor)
            self._readers.pop(known.descriptor, None)
            self._unfinished.discard(known.descriptor)
            with known.lock:
                _close(owned, known.endpoint)
        return not self._owned

    def close_all(self) -> bool:
        """Close every socket; the thread ends then."""
        for owned in list(self._owned):
            self.close(owned)
        return True

    def _run(self) -> None:
        try:
            while not self._ended():
                # What comes between the poller and a reader is paid for by every message.
                for descriptor, _ in self._poller.poll(self._wait_ms()):
                    self._read(descriptor)
                self._catch_up()
        finally:
            self._context.term()
            self._wake_in.close()
            self._wake_out.close()

    def _wait_ms(self) -> float | None:
        if self._unfinished:
            return 0
        if self._next_due_s == float("inf"):
            return None
        # One more, since it is cut to whole milliseconds: otherwise it would wake up too early, and again at once.
        return max(self._next_due_s - monotonic(), 0.0) * 1000 + 1

    def _read(self, descriptor: Any) -> None:
        """Read a part of what a socket has, so that none waits for another to be empty."""
        # A command or another reader may have closed it.
        reader = self._readers.get(descriptor)
        try:
            if reader is not None and reader():
                self._unfinished.add(descriptor)
        except Exception:
            # A reader counts what it can't read; this is a bug of ours, and must not stop the others.
            log.exception("a reader failed")

    def _catch_up(self) -> None:
        if monotonic() >= self._next_due_s:
            self._tick()
        if self._unfinished:
            unfinished, self._unfinished = self._unfinished, set()
            for descriptor in unfinished:
                self._read(descriptor)

    def _tick(self) -> None:
        now_s = monotonic()
        for known in list(self._owned.values()):
            if known.tick is not None and known.due_s <= now_s:
                known.due_s = now_s + known.every_s
                try:
                    known.tick()
                except Exception:
                    log.exception("what was due failed")
                self._unfinished.add(known.descriptor)
        self._next_due_s = min((known.due_s for known in self._owned.values()), default=float("inf"))

    def _ended(self) -> bool:
        if self._owned or self._commands:
            return False
        with _state.lock:
            if self._owned or self._commands:
                return False
            if _state.current is self:
                _state.current = None
            return True

    def _run_commands(self) -> bool:
        with contextlib.suppress(BlockingIOError):
            self._wake_out.recv(4096)
        while self._commands:
            command, future = self._commands.popleft()
            try:
                future.set_result(command(self))
            except Exception as error:
                # It belongs to the thread that asked, with its traceback.
                future.set_exception(error)
        return False


def _close(owned: Socket, endpoint: str) -> None:
    if not endpoint.startswith(("tcp:", "ipc:")):
        owned.close()
        return
    # Sockets close in the background: without this wait the same port could not be bound again at once. Not unbind(),
    # which would throw away what is still to be sent (measured: 32 of 50 messages arrived).
    monitor = owned.get_monitor_socket(zmq.EVENT_CLOSED | zmq.EVENT_CLOSE_FAILED)
    owned.close()
    monitor.poll(_CLOSE_MS)
    monitor.close(linger=0)


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
    new = _state.current = IOThread()
    new.thread.start()
    return new


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
