"""Players: recorded messages are published once more, frame by frame as they came, at the same distances in time."""

from __future__ import annotations

import itertools
import math
import os
import queue as queues
import threading
import time
import weakref
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from typing import Any, Self

from epypes.errors import BrokerError, RecordingError, StillRunning
from epypes.transport.address import parse_address
from epypes.transport.endpoint import Startable, warn_left_running
from epypes.transport.mcap import BrokenOff, Recorded, messages
from epypes.transport.zeromq.channel import ZeroMQChannel
from epypes.transport.zeromq.curve import CurveOptions, Keys, PublicKey

_HIGH_WATER_MARK = 64
# How often it is checked whether there is a subscriber, and whether the queue of a full one has room again.
_CHECK_S, _RETRY_S = 0.025, 0.001


class _Stopped(Exception):
    """The player is to stop."""


def _nothing() -> None:
    return


class Player(Startable):
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
        Keys can't be read, or there is no list of allowed keys.
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
        place = parse_address(address)
        self._given = place.endpoint
        binds = bind if place.binds is None else place.binds
        self._security = CurveOptions.checked(self._given, binds, insecure, keys, allow)
        self.path = Path(path)

        def make() -> _Playback:
            # Few are kept for a subscriber: what is kept at the end must still be sent before the process ends.
            channel = ZeroMQChannel(self._given, self._security, high_water_mark=_HIGH_WATER_MARK)
            return _Playback(self.path, channel, speed, loop, wait, on_end)

        self._make = make
        self._lock = threading.Lock()
        self._playing: _Playback | None = None
        self._finalizer: weakref.finalize[Any, Any] | None = None

    @property
    def address(self) -> str:
        """The endpoint that is bound, once it is started; before that, the address that was given."""
        playing = self._playing
        return self._given if playing is None else playing.channel.address

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
                playing.start()
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
        return playing is not None and playing.channel.subscriptions.wait(timeout_s)

    def __repr__(self) -> str:
        running = self._playing is not None and self._playing.is_running()
        return f"<Player {str(self.path)[-40:]} {'running' if running else 'stopped'}: {self.sent} sent>"


class _Playback:
    """From a start to its stop: the channel and the thread that sends."""

    def __init__(
        self, path: Path, channel: ZeroMQChannel, speed: float, loop: int, wait: bool, on_end: Callable[[], None]
    ) -> None:
        self._path, self.channel = path, channel
        self._speed, self._loop, self._wait, self._on_end = speed, loop, wait, on_end
        # Not an Event: the garbage collector puts into it, in any thread, where a lock could be held already.
        self._stops: queues.SimpleQueue[None] = queues.SimpleQueue()
        self._process = os.getpid()
        self._failure: RecordingError | None = None
        self.sent = 0
        self.ended = threading.Event()

    def start(self) -> None:
        """Read the first message, then open the socket, then play."""
        whole = messages(self._path)
        first = next(whole, None)
        if first is None:
            raise RecordingError(self._path, f"{self._path} holds no message.")
        self.channel.open(None)
        begun = itertools.chain([first], whole)
        self._thread = threading.Thread(target=self._run, args=(begun,), name="epypes-player", daemon=True)
        self._thread.start()

    def is_running(self) -> bool:
        return self._process == os.getpid() and self._thread.is_alive()

    def stop_soon(self) -> None:
        self._stops.put(None)

    def stop(self, timeout_s: float) -> None:
        self.stop_soon()
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
            while self._wait and not self.channel.subscriptions.wait(0.0):
                self._pause(_CHECK_S)
            self._play(begun)
            for _ in range(1, self._loop) if self._loop else itertools.count():
                self._play(messages(self._path))
        except _Stopped:
            pass
        except RecordingError as error:
            self._failure = error
        except BrokerError as error:
            self._failure = RecordingError(self._path, f"{self._path} could not be sent on: {error}")
        finally:
            self.channel.close()
            self.ended.set()
            self._on_end()

    def _play(self, recorded: Iterator[Recorded]) -> None:
        begin_s, first_ns = time.monotonic(), None
        try:
            for message in recorded:
                first_ns = message.time_ns if first_ns is None else first_ns
                due_s = begin_s + (message.time_ns - first_ns) / 1e9 / self._speed if self._speed else begin_s
                self._pause(due_s - time.monotonic())
                # Counted before: a thread that has received it must find it counted.
                self.sent += 1
                try:
                    while not self.channel.send_if_room(message.frames):
                        self._pause(_RETRY_S)
                except BaseException:
                    self.sent -= 1
                    raise
        except BrokenOff as error:
            # What is whole may be played again all the same.
            self._failure = error

    def _pause(self, seconds: float) -> None:
        """Wait so long, but no longer than until the player is to stop."""
        try:
            self._stops.get(timeout=min(max(0.0, seconds), threading.TIMEOUT_MAX))
        except queues.Empty:
            return
        raise _Stopped


def _abandon(playing: _Playback, address: str) -> None:
    # By the garbage collector or at exit: so no waiting, no locks.
    if playing.is_running():
        playing.stop_soon()
        warn_left_running(f"Player {address}")
