"""What does the I/O thread do? It opens, reads and closes sockets, and sleeps in a poller between."""

from __future__ import annotations

import contextlib
import logging
import socket
import threading
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from time import monotonic
from typing import Any

import zmq
from zmq.backend import zmq_poll

from epypes.transport.addresses import address_error, check_port
from epypes.transport.gate import Gate, Gatekeeper
from epypes.transport.guard import HANDSHAKE_MS, Guard, Watch

Socket = zmq.Socket[bytes]
# Reads some of what has arrived, and says whether there is more.
Reader = Callable[[], bool]

log = logging.getLogger("epypes.transport")

# How long a socket that was closed, or the end of the process, may wait for a peer that does not read.
LINGER_MS = 1_000
_CLOSE_MS = 500
# A host that does not answer is dropped after 15 s, by TCP. ZeroMQ's own heartbeats end the whole process when one is
# due on a connection that broke while its messages waited: "Assertion failed: !_io_error", libzmq#4841 (4.3.5).
_OPTIONS: dict[int, int] = {
    zmq.TCP_KEEPALIVE: 1,
    zmq.TCP_KEEPALIVE_IDLE: 5,
    zmq.TCP_KEEPALIVE_INTVL: 5,
    zmq.TCP_KEEPALIVE_CNT: 2,
    zmq.HANDSHAKE_IVL: HANDSHAKE_MS,
    zmq.RECONNECT_IVL: 50,
    # A peer that has come back is met soon: what it sends before that is lost.
    zmq.RECONNECT_IVL_MAX: 200,
    zmq.IPV6: 0,
}


# As numbers: pyzmq looks an enum up at every call.
_FD, _POLLIN = int(zmq.FD), int(zmq.POLLIN)


def has_arrived(owned: Socket) -> bool:
    """Return whether a socket can be read.

    To be asked after whatever else was done with it: that may have used up the signal by which its file descriptor
    wakes the I/O thread.
    """
    # Not owned.get(EVENTS), which holds the interpreter's lock while libzmq takes in subscriptions: for 19 s if a peer
    # sends 20,000 of 1 kB.
    return bool(zmq_poll([(owned, _POLLIN)], 0))


@dataclass(slots=True, eq=False)
class _Owned:
    """What the I/O thread knows of a socket."""

    source: Socket | int
    reader: Reader
    lock: AbstractContextManager[Any]
    endpoint: str
    gate: Gate | None = None
    watch: Watch | None = None
    tick: Callable[[], None] | None = None
    every_s: float = 0.0
    due_s: float = float("inf")


class IOThread:
    """The thread; its methods other than `submit` are for commands, which run on it."""

    def __init__(self, retire: Callable[[], None]) -> None:
        """Prepare; ``retire`` is called, on the thread, when it has no socket and no command left."""
        self._retire, self.has_retired = retire, False
        self._commands: deque[tuple[Callable[[IOThread], Any], Future[Any]]] = deque()
        self._owned: dict[Socket, _Owned] = {}
        # By what the poller names: the socket, or the file descriptor of one that other threads send on, which it must
        # not ask for more than that. Such a descriptor gives a signal once: who has more to read is kept in mind.
        self._readers: dict[Any, Reader] = {}
        self._unfinished: set[Any] = set()
        self._next_due_s = float("inf")
        self._gatekeeper: Gatekeeper | None = None
        self._guards = Guard()
        self._context = zmq.Context(io_threads=1)
        self._poller = zmq.Poller()
        self._wake_in, self._wake_out = socket.socketpair()
        self._wake_in.setblocking(False)
        self._wake_out.setblocking(False)
        self._poller.register(self._wake_out.fileno(), zmq.POLLIN)
        self._readers[self._wake_out.fileno()] = self._run_commands
        self.thread = threading.Thread(target=self._run, name="epypes-io", daemon=True)

    def is_idle(self) -> bool:
        """Return whether it has neither sockets nor commands."""
        return not self._owned and not self._commands

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
        gate: Gate | None = None,
        max_message_bytes: int | None = None,
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
        gate
            Who may connect, if it is bound with keys.
        max_message_bytes
            What one connection may send in one message with all its parts, 0 if only subscriptions come; see `guard`.
            It is heeded where a TCP port is bound.

        Raises
        ------
        AddressError
            If ZeroMQ refuses the address.
        """
        check_port(address)
        if gate is not None:
            self._guard(gate)
        new: Socket = self._context.socket(kind)
        watch: Watch | None = None
        try:
            # Options count only for what is bound or connected after them.
            for option, value in [*_OPTIONS.items(), (zmq.LINGER, LINGER_MS), *options]:
                new.setsockopt(option, value)
            if bind:
                if not address.startswith("inproc:"):
                    # Before it is bound, so that no connection is missed.
                    watch = self._watch(new, max_message_bytes)
                new.bind(address)
            else:
                new.connect(address)
        except (zmq.ZMQError, UnicodeError, ValueError, TypeError) as error:
            if watch is not None:
                watch.end()
            new.close(linger=0)
            self._unguard(gate)
            number = getattr(error, "errno", None) or 0
            raise address_error(address, "bound" if bind else "connected", number, str(error)) from error
        endpoint = new.getsockopt_string(zmq.LAST_ENDPOINT) if bind else ""
        source = new if lock is None else int(new.get(_FD))
        self._owned[new] = _Owned(source, reader, lock or nullcontext(), endpoint, gate, watch)
        if watch is not None:
            watch.endpoint = endpoint
            self._readers[watch.descriptor] = watch.follow
            self._poller.register(watch.descriptor, zmq.POLLIN)
            if max_message_bytes is not None and endpoint.startswith("tcp:"):
                self._guards.add(watch)
        self._readers[source] = reader
        self._poller.register(source, zmq.POLLIN)
        self._unfinished.add(source)
        return new

    def address_of(self, owned: Socket, address: str) -> str:
        """Return the endpoint that a socket is really bound to, or the address it was connected to."""
        known = self._owned.get(owned)
        return known.endpoint or address if known is not None else address

    def read_again(self, owned: Socket) -> None:
        """Have a socket read though it gives no signal, since something else has been done with it."""
        known = self._owned.get(owned)
        if known is not None:
            self._unfinished.add(known.source)

    def every(self, interval_s: float, owned: Socket, tick: Callable[[], None]) -> None:
        """Call something again and again while a socket is open; it may use the socket."""
        known = self._owned[owned]
        known.tick, known.every_s, known.due_s = tick, interval_s, monotonic() + interval_s
        self._next_due_s = min(self._next_due_s, known.due_s)

    def watch_of(self, owned: Socket) -> Watch | None:
        """Return what bounds the connections to a socket; None if it is not bound, or has no connections."""
        return self._owned[owned].watch

    def _watch(self, new: Socket, max_message_bytes: int | None) -> Watch:
        def ask(then: Callable[[bool], None]) -> None:
            def look(thread: IOThread) -> None:
                if new in self._owned:
                    then(not has_arrived(new))

            self.submit(look, Future())

        return Watch(new, max_message_bytes, ask)

    def close(self, owned: Socket) -> bool:
        """Close a socket, twice if you like; return whether it was the last one, so that the thread ends."""
        known = self._owned.pop(owned, None)
        if known is not None:
            self._poller.unregister(known.source)
            self._readers.pop(known.source, None)
            self._unfinished.discard(known.source)
            if known.watch is not None:
                self._poller.unregister(known.watch.descriptor)
                self._readers.pop(known.watch.descriptor, None)
                self._guards.remove(known.watch)
                known.watch.end()
            with known.lock:
                _close(owned, known.endpoint)
            self._unguard(known.gate)
        return not self._owned

    def _guard(self, gate: Gate) -> None:
        if self._gatekeeper is None:
            self._gatekeeper = Gatekeeper(self._context)
            self._readers[self._gatekeeper.descriptor] = self._gatekeeper.read
            self._poller.register(self._gatekeeper.descriptor, zmq.POLLIN)
        self._gatekeeper.gates[gate.domain] = gate

    def _unguard(self, gate: Gate | None) -> None:
        # The gatekeeper stays: its address may not be free at once, and who is guarded next would have none.
        if self._gatekeeper is not None and gate is not None:
            self._gatekeeper.gates.pop(gate.domain, None)

    def close_all(self) -> bool:
        """Close every socket; the thread ends then."""
        for owned in list(self._owned):
            self.close(owned)
        return True

    def _run(self) -> None:
        try:
            while not self._ended():
                for source, _ in self._poller.poll(self._wait_ms()):
                    self._read(source)
                if self._unfinished or self._next_due_s <= monotonic():
                    self._catch_up()
        finally:
            self._guards.join()
            if self._gatekeeper is not None:
                self._gatekeeper.close()
            self._context.term()
            self._wake_in.close()
            self._wake_out.close()

    def _wait_ms(self) -> int | None:
        if self._unfinished:
            return 0
        if self._next_due_s == float("inf"):
            return None
        # One more for what is cut off, or it would wake up too early, and again at once.
        return int(max(self._next_due_s - monotonic(), 0.0) * 1000) + 1

    def _read(self, source: Any) -> None:
        """Read a part of what a socket has, so that none waits for another to be empty."""
        # A command or another reader may have closed it.
        reader = self._readers.get(source)
        try:
            if reader is not None and reader():
                self._unfinished.add(source)
        except BaseException as error:
            # A reader counts what it can't read; this is a bug of ours, and must not stop the others.
            _complain("a reader failed", error)

    def _catch_up(self) -> None:
        if monotonic() >= self._next_due_s:
            self._tick()
        if self._unfinished:
            unfinished, self._unfinished = self._unfinished, set()
            for source in unfinished:
                self._read(source)

    def _tick(self) -> None:
        now_s = monotonic()
        for known in list(self._owned.values()):
            if known.tick is not None and known.due_s <= now_s:
                known.due_s = now_s + known.every_s
                try:
                    known.tick()
                except BaseException as error:
                    _complain("what was due failed", error)
                self._unfinished.add(known.source)
        self._next_due_s = min((known.due_s for known in self._owned.values()), default=float("inf"))

    def _ended(self) -> bool:
        if self.is_idle():
            self._retire()
        return self.has_retired

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
        self._unfinished.update(known.source for known in self._owned.values())
        return False


def _complain(text: str, error: BaseException) -> None:
    # A handler of the user's may raise anything as well.
    with contextlib.suppress(BaseException):
        log.error(text, exc_info=error)


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
