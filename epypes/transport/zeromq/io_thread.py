"""The one thread that opens, reads and closes the ZeroMQ sockets of a process.

ZeroMQ's sockets must not be used by two threads at once, and a thread per socket wakes up for nothing. So one daemon
thread sleeps in a poller until a socket can be read, something is due, or another thread hands it a command through
a wake-up socket. It starts with the first socket and ends with the last.

Only sending is done on the caller's thread, since waking another thread takes longer than sending (35 us of 60). A
socket that other threads send on has a lock, and every thread that touches the socket holds it.
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
from typing import Any, Final, TypeVar

import zmq

from epypes.transport.address import address_error, check_port
from epypes.transport.zeromq.connection_guard import CHECK_S, HANDSHAKE_MS, ConnectionGuard
from epypes.transport.zeromq.curve import CurveOptions, ZapHandler

Socket = zmq.Socket[bytes]
# Reads some of what has arrived, and returns whether there is more.
Reader = Callable[[], bool]
T = TypeVar("T")

log = logging.getLogger("epypes.transport")

# How long a closed socket, or the end of the process, may wait for a peer that does not read.
LINGER_MS: Final = 1_000
_CLOSE_MS: Final = 500
# TCP drops a host that does not answer after 15 s. ZeroMQ's own heartbeats end the whole process when one is due on a
# connection that broke while its messages waited: "Assertion failed: !_io_error", libzmq#4841 (4.3.5).
_OPTIONS: Final[dict[int, int]] = {
    zmq.TCP_KEEPALIVE: 1,
    zmq.TCP_KEEPALIVE_IDLE: 5,
    zmq.TCP_KEEPALIVE_INTVL: 5,
    zmq.TCP_KEEPALIVE_CNT: 2,
    zmq.HANDSHAKE_IVL: HANDSHAKE_MS,
    zmq.RECONNECT_IVL: 50,
    # What a peer that is back sends before the reconnect is lost.
    zmq.RECONNECT_IVL_MAX: 200,
    zmq.IPV6: 0,
    zmq.LINGER: LINGER_MS,
}
# As numbers: pyzmq looks an enum up at every call.
_FD, _POLLIN = int(zmq.FD), int(zmq.POLLIN)


@dataclass(slots=True, eq=False)
class OwnedSocket:
    """A socket of the I/O thread.

    Attributes
    ----------
    socket
        The socket itself.
    endpoint
        Where it is bound; the given address if it is connected.
    guard
        What bounds its connections; None unless it is bound to a port or a file.
    companion
        A socket that is closed with it.
    """

    socket: Socket
    endpoint: str
    reader: Reader
    lock: AbstractContextManager[Any]
    # What the poller watches: the socket, or the file descriptor of one that other threads send on, which the poller
    # must not touch. Such a descriptor gives one signal for all that has arrived, so unfinished reads are kept in mind.
    source: Socket | int
    security: CurveOptions
    guard: ConnectionGuard | None = None
    tick: Callable[[], None] | None = None
    tick_s: float = float("inf")
    due_s: float = float("inf")
    companion: Socket | None = None


class IOThread:
    """The thread; its methods other than `submit` are for commands, which run on it."""

    def __init__(self) -> None:
        self._commands: deque[tuple[Callable[[IOThread], Any], Future[Any]]] = deque()
        self._owned: dict[Socket, OwnedSocket] = {}
        # By source.
        self._readers: dict[Any, Reader] = {}
        self._unfinished: set[Any] = set()
        self._next_due_s = float("inf")
        self._zap: ZapHandler | None = None
        self._is_over = threading.Event()
        self._guarding: threading.Thread | None = None
        self._context = zmq.Context(io_threads=1)
        self._poller = zmq.Poller()
        self._wake_in, self._wake_out = socket.socketpair()
        self._wake_in.setblocking(False)
        self._wake_out.setblocking(False)
        self._watch(self._wake_out.fileno(), self._run_commands)
        self.thread = threading.Thread(target=self._run, name="epypes-io", daemon=True)

    def submit(self, command: Callable[[IOThread], Any], future: Future[Any] | None = None) -> None:
        """Hand over a command, from any thread; the future gets its result."""
        self._commands.append((command, future or Future()))
        # If the pipe is full, enough wake-ups are on their way.
        with contextlib.suppress(BlockingIOError):
            self._wake_in.send(b"\0")

    def open(
        self,
        kind: int,
        address: str,
        security: CurveOptions,
        reader: Reader,
        options: Sequence[tuple[int, int | bytes]],
        *,
        prepare: Callable[[Socket], Socket | None] | None = None,
        lock: AbstractContextManager[Any] | None = None,
        max_message_bytes: int = 0,
        tick: Callable[[], None] | None = None,
        tick_s: float = float("inf"),
    ) -> OwnedSocket:
        """Open a socket, bound or connected, whose ``reader`` is called when it can be read.

        Parameters
        ----------
        kind
            ``zmq.XPUB`` or the like.
        options
            Of ZeroMQ, by number, in this order.
        prepare
            Called with the socket that has its options, before it is bound or connected; may return a companion.
        lock
            Held by every thread that touches the socket; None if only the I/O thread does.
        max_message_bytes
            Size limit of one message with all its parts, 0 if only subscriptions come; see `connection_guard`.
        tick
            Called every ``tick_s`` seconds.

        Raises
        ------
        AddressError
            ZeroMQ refuses the address.
        """
        check_port(address)
        if security.is_guarded:
            self._require_keys(security)
        new: Socket = self._context.socket(kind)
        guard: ConnectionGuard | None = None
        companion: Socket | None = None
        try:
            # Options count only for what is bound or connected after them.
            for option, value in [*_OPTIONS.items(), *security.socket_options(), *options]:
                new.setsockopt(option, value)
            if prepare is not None:
                companion = prepare(new)
            if security.bind and not address.startswith("inproc:"):
                # Before it is bound, so that no connection is missed.
                guard = ConnectionGuard(new, max_message_bytes, self.submit)
            (new.bind if security.bind else new.connect)(address)
        except (zmq.ZMQError, UnicodeError, ValueError, TypeError) as error:
            if guard is not None:
                guard.close()
            if companion is not None:
                companion.close(linger=0)
            new.close(linger=0)
            number = getattr(error, "errno", None) or 0
            raise address_error(address, "bound" if security.bind else "connected", number, str(error)) from error
        endpoint = new.getsockopt_string(zmq.LAST_ENDPOINT) if security.bind else address
        source = new if lock is None else int(new.get(_FD))
        due_s = monotonic() + tick_s
        owned = OwnedSocket(
            new, endpoint, reader, lock or nullcontext(), source, security, guard, tick, tick_s, due_s, companion
        )
        self._next_due_s = min(self._next_due_s, due_s)
        self._owned[new] = owned
        if guard is not None:
            guard.endpoint = endpoint
            self._watch(guard.descriptor, guard.update)
            if endpoint.startswith("tcp:") and self._guarding is None:
                self._guarding = threading.Thread(target=self._check_guards, name="epypes-guard", daemon=True)
                self._guarding.start()
        self._watch(source, reader)
        self._unfinished.add(source)
        return owned

    def read_again(self, owned: OwnedSocket) -> None:
        """Have a socket read though it gives no signal."""
        if owned.socket in self._owned:
            self._unfinished.add(owned.source)

    def close(self, owned: OwnedSocket) -> bool:
        """Close a socket, as often as you like; return whether none is left, so that the thread ends."""
        if self._owned.pop(owned.socket, None) is not None:
            self._unwatch(owned.source)
            if owned.guard is not None:
                self._unwatch(owned.guard.descriptor)
                owned.guard.close()
            with owned.lock:
                _close(owned)
            if self._zap is not None:
                self._zap.guarded.pop(owned.security.domain, None)
        return not self._owned

    def close_all(self) -> None:
        """Close every socket; the thread ends then."""
        for owned in list(self._owned.values()):
            self.close(owned)

    def _watch(self, source: Any, reader: Reader) -> None:
        self._readers[source] = reader
        self._poller.register(source, zmq.POLLIN)

    def _unwatch(self, source: Any) -> None:
        self._poller.unregister(source)
        self._readers.pop(source, None)
        self._unfinished.discard(source)

    def _require_keys(self, security: CurveOptions) -> None:
        # The handler stays until the thread ends: its address may not be free at once, and a socket that is guarded
        # meanwhile would have no handler.
        if self._zap is None:
            self._zap = ZapHandler(self._context)
            self._watch(self._zap.socket, self._zap.read)
        self._zap.guarded[security.domain] = security

    def _check_guards(self) -> None:
        """Bound what connections may cost, on a thread that needs no socket's lock; see `connection_guard`."""
        checked_s = monotonic()
        while not self._is_over.wait(CHECK_S):
            now_s = monotonic()
            for owned in list(self._owned.values()):
                if owned.guard is not None:
                    owned.guard.check(now_s - checked_s)
            checked_s = now_s

    def _run(self) -> None:
        try:
            while self._owned or self._commands or not self._may_end():
                for source, _ in self._poller.poll(self._wait_ms()):
                    self._read(source)
                if self._unfinished or self._next_due_s <= monotonic():
                    self._catch_up()
        finally:
            self._is_over.set()
            if self._guarding is not None:
                self._guarding.join()
            if self._zap is not None:
                self._zap.socket.close()
            self._context.term()
            self._wake_in.close()
            self._wake_out.close()

    def _may_end(self) -> bool:
        """Return whether it has no commands; from then on it takes no more."""
        with _process.lock:
            may_end = not self._commands
            if may_end and _process.current is self:
                _process.current = None
        return may_end

    def _wait_ms(self) -> int | None:
        if self._unfinished:
            return 0
        if self._next_due_s == float("inf"):
            return None
        # Rounded up: rounded down it would wake up too early, and again at once.
        return int(max(self._next_due_s - monotonic(), 0.0) * 1000) + 1

    def _read(self, source: Any) -> None:
        """Read a part of what a socket has, so that none waits for another to be empty."""
        # A command or another reader may have closed it.
        reader = self._readers.get(source)
        try:
            if reader is not None and reader():
                self._unfinished.add(source)
        except BaseException:
            # A reader counts what it can't read; this is a bug of ours, and must not stop the other sockets.
            log.exception("a reader failed")

    def _catch_up(self) -> None:
        now_s = monotonic()
        if now_s >= self._next_due_s:
            for owned in list(self._owned.values()):
                if owned.tick is not None and owned.due_s <= now_s:
                    owned.due_s = now_s + owned.tick_s
                    owned.tick()
                    self._unfinished.add(owned.source)
            self._next_due_s = min((owned.due_s for owned in self._owned.values()), default=float("inf"))
        unfinished, self._unfinished = self._unfinished, set()
        for source in unfinished:
            self._read(source)

    def _run_commands(self) -> bool:
        with contextlib.suppress(BlockingIOError):
            self._wake_out.recv(4096)
        while self._commands:
            command, future = self._commands.popleft()
            try:
                future.set_result(command(self))
            except BaseException as error:
                # It belongs to the thread that asked, with its traceback.
                future.set_exception(error)
        # A command that used a socket may have used up its signal as well.
        self._unfinished.update(owned.source for owned in self._owned.values())
        return False


class _Process:
    """The I/O thread of this process; a forked child begins anew, since threads and sockets don't survive a fork."""

    def __init__(self) -> None:
        # Re-entrant, since the garbage collector may close a forgotten socket while it is held.
        self.lock = threading.RLock()
        self.current: IOThread | None = None
        self._inherited: list[IOThread | None] = []

    def forget(self) -> None:
        # Kept alive: collecting a ZeroMQ context of the parent would close what the parent still uses.
        self._inherited.append(self.current)
        self.lock = threading.RLock()
        self.current = None


_process: Final = _Process()
os.register_at_fork(after_in_child=_process.forget)


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
        The I/O thread was busy for so long; the command may still run later.
    zmq.ZMQError
        Of errno ``ENOTSOCK`` if no thread runs, so that no socket is open.
    """
    with _process.lock:
        current = _process.current
        if current is None:
            if not start:
                raise zmq.ZMQError(zmq.ENOTSOCK)
            _process.current = current = IOThread()
            current.thread.start()
        is_own = current.thread is threading.current_thread()
        future: Future[T] = Future()
        if not is_own:
            current.submit(command, future)
    return command(current) if is_own else future.result(timeout_s)


def close(owned: OwnedSocket, timeout_s: float = 10.0) -> None:
    """Close a socket, and wait until what it had is sent if it was the last.

    Sending what is left goes on in the background, `LINGER_MS` at most.

    Raises
    ------
    TimeoutError
        The I/O thread was busy for so long; it closes the socket later.
    """

    def command(thread: IOThread) -> threading.Thread | None:
        return thread.thread if thread.close(owned) else None

    try:
        ending = call(command, timeout_s)
    except zmq.ZMQError:
        # No thread runs, so it is closed.
        return
    if ending is not None and ending is not threading.current_thread():
        ending.join(min(timeout_s, LINGER_MS / 1000 + 0.5))


def soon(command: Callable[[IOThread], object]) -> None:
    """Have a command run without waiting; the garbage collector may call this in any thread, anywhere."""
    current = _process.current
    if current is not None:
        current.submit(command)


def _close_at_exit() -> None:
    # Without this, what was handed to ZeroMQ just before the end of the script would be lost.
    current = _process.current
    if current is None or not current.thread.is_alive():
        return
    with contextlib.suppress(TimeoutError, zmq.ZMQError):
        call(IOThread.close_all, timeout_s=1.0)
    current.thread.join(LINGER_MS / 1000 + 0.5)


atexit.register(_close_at_exit)


def _close(owned: OwnedSocket) -> None:
    if owned.companion is not None:
        owned.companion.close(linger=0)
    if owned.guard is None:
        owned.socket.close()
        return
    # Sockets close in the background: without this wait the same port could not be bound again at once. Not unbind(),
    # which would throw away what is still to be sent (measured: 32 of 50 messages arrived).
    monitor = owned.socket.get_monitor_socket(zmq.EVENT_CLOSED | zmq.EVENT_CLOSE_FAILED)
    owned.socket.close()
    monitor.poll(_CLOSE_MS)
    monitor.close(linger=0)
