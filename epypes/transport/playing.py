"""How is recorded traffic sent once more? By a Player, frame by frame as it came and at the same distances in time."""

from __future__ import annotations

import itertools
import math
import os
import queue as queues
import threading
import time
import warnings
import weakref
from collections import deque
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, Self

import zmq

from epypes.errors import RecordingError, StillRunning
from epypes.transport import io
from epypes.transport.guard import SUBSCRIPTION_OPTIONS
from epypes.transport.joining import Doorkeeper
from epypes.transport.keys import Keys, PublicKey
from epypes.transport.mcap import BrokenOff, Recorded, messages
from epypes.transport.security import Security, security
from epypes.transport.within import Within

# Small, since what is kept here when the last one has been handed over must still be sent before the process ends.
_HIGH_WATER_MARK = 64
# How often it is looked whether there is a subscriber, and whether a full subscriber has room again.
_LOOK_S, _RETRY_S = 0.025, 0.001
# Messages that are due are handed to the I/O thread together, so many at most.
_BATCH = 64


class _Asked(Exception):
    """The player was asked to stop."""


def _nothing() -> None:
    return


class Player(Within):
    """Publishes what a Recorder has written: the same frames, in the same order, at the same distances in time.

    Parameters
    ----------
    path
        The file.
    address
        ``"tcp://127.0.0.1:*"`` takes a free port, which `address` then names.
    bind
        False to connect to a subscriber that binds.
    speed
        2.0 plays twice as fast; 0 as fast as subscribers take it.
    loop
        How often it is played; 0 goes on until `stop`.
    wait
        Whether nothing is sent before there is a subscriber.
    insecure
        True to bind an address that other machines can reach, without keys.
    keys, allow
        As for `ZMQPublisher`.
    on_end
        Called on the player's thread when everything was sent, or it was stopped, or the file could not be read.

    Raises
    ------
    AddressError
        If ``bind`` is asked for an address that is not loopback, with neither keys nor ``insecure``.
    KeysError
        If keys can't be read, or it is not said which are allowed.
    ValueError
        If ``speed`` or ``loop`` is negative.

    Notes
    -----
    Start it, or use ``with``. Unlike a publisher it drops nothing: a file can wait for a subscriber that does not keep
    up, which then delays what comes after. Envelopes keep their ids, epochs, sequence numbers and times.
    """

    def __init__(
        self,
        path: str | Path,
        address: str = "tcp://127.0.0.1:*",
        bind: bool = True,
        *,
        speed: float = 1.0,
        loop: int = 1,
        wait: bool = True,
        insecure: bool = False,
        keys: Keys | str | Path | None = None,
        allow: PublicKey | Collection[PublicKey] | None = None,
        on_end: Callable[[], None] = _nothing,
    ) -> None:
        if not 0 <= speed < math.inf:
            raise ValueError(f"speed is {speed}; give 1.0, 0.5, 10 ..., or 0 for as fast as possible.")
        if loop < 0:
            raise ValueError(f"loop is {loop}; give how often, or 0 for without end.")
        self._security = security(address, bind, insecure, keys, allow)
        self.path = Path(path)
        self._given = address

        def make() -> _Playing:
            return _Playing(self.path, speed, loop, wait, on_end)

        self._make = make
        self._lock = threading.Lock()
        self._playing: _Playing | None = None
        self._finalizer: weakref.finalize[Any, Any] | None = None

    @property
    def address(self) -> str:
        """The endpoint that is bound, once it is started; before that, the address that was given."""
        playing = self._playing
        return self._given if playing is None else playing.address

    @property
    def sent(self) -> int:
        """How many messages were handed to ZeroMQ since the start."""
        playing = self._playing
        return 0 if playing is None else playing.sent

    def start(self) -> Self:
        """Open the file and the socket, and begin to play; nothing happens if it plays already.

        Raises
        ------
        RecordingError
            If the file can't be read, is no recording, or holds no message.
        AddressError
            If the address can't be bound or understood.
        """
        with self._lock:
            if self._playing is None or not self._playing.is_running():
                playing = self._make()
                playing.start(self._given, self._security)
                self._playing = playing
                self._finalizer = weakref.finalize(self, _abandon, playing, self._given)
        return self

    def stop(self, timeout_s: float = 5.0) -> None:
        """Stop where it is and close the socket; from any thread, as often as you like.

        Parameters
        ----------
        timeout_s
            Longest wait, in seconds.

        Raises
        ------
        RecordingError
            If the file was damaged or broke off. What was whole before that has been sent.
        StillRunning
            If reading a single message takes longer.
        """
        with self._lock:
            if self._finalizer is not None:
                self._finalizer.detach()
            playing = self._playing
        if playing is not None:
            playing.stop(timeout_s)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Return whether it has ended within ``timeout_s`` seconds: see ``on_end``."""
        playing = self._playing
        return playing is not None and playing.ended.wait(timeout_s)

    def wait_for_subscriber(self, timeout_s: float = 5.0) -> bool:
        """Return whether a subscriber, of any topic, is there within ``timeout_s`` seconds."""
        playing = self._playing
        return playing is not None and playing.doorkeeper.wait(timeout_s)

    def __repr__(self) -> str:
        running = self._playing is not None and self._playing.is_running()
        return f"<Player {str(self.path)[-40:]} {'running' if running else 'stopped'}: {self.sent} sent>"


class _Playing:
    """From a start to its stop: the socket and the thread that sends."""

    def __init__(self, path: Path, speed: float, loop: int, wait: bool, on_end: Callable[[], None]) -> None:
        self._path, self._speed, self._loop, self._wait, self._on_end = path, speed, loop, wait, on_end
        # Not an Event: the garbage collector stops it, in any thread, where a lock could be held already.
        self._asked: queues.SimpleQueue[None] = queues.SimpleQueue()
        self._process = os.getpid()
        self._failure: RecordingError | None = None
        self.doorkeeper = Doorkeeper()
        self.address = ""
        self.sent = 0
        self.ended = threading.Event()

    def start(self, address: str, security: Security) -> None:
        """Look into the file, then open the socket, then play."""
        whole = messages(self._path)
        first = next(whole, None)
        if first is None:
            raise RecordingError(self._path, f"{self._path} holds no message.")
        gate = security.gate()
        options = [
            (zmq.XPUB_MANUAL, 1),
            (zmq.XPUB_NODROP, 1),
            (zmq.SNDHWM, _HIGH_WATER_MARK),
            *SUBSCRIPTION_OPTIONS,
            *security.options(gate),
        ]

        def open_socket(thread: io.IOThread) -> tuple[io.Socket, str]:
            opened = thread.open(
                zmq.XPUB, address, security.bind, self.doorkeeper.read, options, gate=gate, max_message_bytes=0
            )
            self.doorkeeper.attach(opened, thread.watch_of(opened))
            return opened, thread.address_of(opened, address)

        self._socket, self.address = io.call(open_socket, start=True)
        begun = itertools.chain([first], whole)
        self._thread = threading.Thread(target=self._run, args=(begun,), name="epypes-player", daemon=True)
        self._thread.start()

    def is_running(self) -> bool:
        return self._process == os.getpid() and self._thread.is_alive()

    def ask_to_stop(self) -> None:
        self._asked.put(None)

    def stop(self, timeout_s: float) -> None:
        self.ask_to_stop()
        if self._process != os.getpid() or self._thread is threading.current_thread():
            return
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            raise StillRunning(f"Player {self._path}", ["read"], timeout_s)
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    def _run(self, begun: Iterator[Recorded]) -> None:
        try:
            while self._wait and not self.doorkeeper.wait(0.0):
                self._pause(_LOOK_S)
            self._play(begun)
            for _ in range(1, self._loop) if self._loop else itertools.count():
                self._play(messages(self._path))
        except _Asked:
            pass
        except RecordingError as error:
            self._failure = error
        except (zmq.ZMQError, TimeoutError) as error:
            self._failure = RecordingError(self._path, f"{self._path} could not be sent on: {error}.")
        finally:
            io.close(self._socket)
            self.ended.set()
            self._on_end()

    def _play(self, recorded: Iterator[Recorded]) -> None:
        begin, first_ns = time.monotonic(), None
        overdue: deque[Recorded] = deque()
        try:
            for message in recorded:
                first_ns = message.time_ns if first_ns is None else first_ns
                due = begin + (message.time_ns - first_ns) / 1e9 / self._speed if self._speed else begin
                wait_s = due - time.monotonic()
                if wait_s > 0:
                    self._send(overdue)
                    self._pause(wait_s)
                overdue.append(message)
                if wait_s > 0 or len(overdue) == _BATCH:
                    self._send(overdue)
        except BrokenOff as error:
            # What is whole may be played again all the same.
            self._failure = error
        self._send(overdue)

    def _send(self, overdue: deque[Recorded]) -> None:
        """Send all of these, as soon as there is room, with few visits to the I/O thread."""

        def send(thread: io.IOThread) -> bool:
            # Sending takes up what ZeroMQ has to say of subscriptions as well.
            thread.read_again(self._socket)
            while overdue:
                # Counted before: whoever has received it must find it counted.
                self.sent += 1
                try:
                    self._socket.send_multipart(overdue[0].frames, zmq.DONTWAIT, copy=False)
                except zmq.ZMQError as error:
                    self.sent -= 1
                    if isinstance(error, zmq.Again):
                        return False
                    raise
                overdue.popleft()
            return True

        self._pause(0.0)
        while not io.call(send):
            self._pause(_RETRY_S)

    def _pause(self, seconds: float) -> None:
        """Wait so long, but no longer than until it is asked to stop."""
        try:
            self._asked.get(timeout=min(max(0.0, seconds), threading.TIMEOUT_MAX))
        except queues.Empty:
            return
        raise _Asked


def _abandon(playing: _Playing, address: str) -> None:
    # By the garbage collector or at exit: so no waiting, no locks.
    if playing.is_running():
        playing.ask_to_stop()
        warnings.warn(f"Player {address} was left running. Call stop(), or use with.", ResourceWarning, stacklevel=2)
