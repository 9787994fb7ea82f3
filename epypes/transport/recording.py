"""Recorder and Player: published messages are written into a file, and published again at the same distances in time.

Both use a thread of their own for the file. It does not keep its Recorder or Player alive: one that is garbage ends.
"""

from __future__ import annotations

import itertools
import math
import queue as queues
import threading
import time
import weakref
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import Any, Final, Self

from epypes.errors import AddressError, BrokerError, InvalidValue, RecordingError, StillRunning
from epypes.transport.address import Address, open_channel, parse_address
from epypes.transport.channel import Delivery, Frames
from epypes.transport.endpoint import Startable, warn_left_running
from epypes.transport.mcap import BrokenOff, Recorded, RecordingCounts, RecordingWriter, messages
from epypes.transport.peers.channel import PeerChannel
from epypes.transport.subscriber import Subscriber
from epypes.transport.zeromq.channel import ZeroMQChannel
from epypes.transport.zeromq.curve import CurveOptions, Keys, PublicKey

# What may wait for the disk: some seconds of images, and more than the largest message.
BACKLOG_BYTES: Final = 512 * 1024**2
# The memory of a message beside its bytes: without it, millions of tiny ones would fill the memory.
_OVERHEAD_BYTES: Final = 1_024
# A recorder that is killed loses the messages of this time.
_FLUSH_S: Final = 1.0
# Share of the time for a stop in which waiting messages are written; then the file is finished without the rest.
_DRAIN_SHARE: Final = 0.8
_SLOW, _FAILED = "disk too slow", "disk failed"
# Few are kept for a subscriber: what is kept at the end must still be sent before the process ends.
_HIGH_WATER_MARK: Final = 64
# How often it is checked whether there is a subscriber, and whether the queue of a full one has room again.
_CHECK_S, _RETRY_S = 0.025, 0.001


class _Stopped(Exception):
    """The player is to stop."""


def _nothing() -> None:
    return


class _FileThread:
    """A thread that writes or reads a recording.

    Attributes
    ----------
    ended
        Set when the thread is done with the file.
    """

    def __init__(self, owner: str, verb: str, path: Path, on_end: Callable[[], None]) -> None:
        self._owner, self._verb, self._path, self._on_end = owner, verb, path, on_end
        self._thread: threading.Thread | None = None
        self._failure: RecordingError | None = None
        self.ended = threading.Event()

    @property
    def was_started(self) -> bool:
        return self._thread is not None

    def is_running(self) -> bool:
        return self._thread is not None and self._thread.is_alive()

    def _begin(self, work: Callable[[], None]) -> None:
        name = f"epypes-{self._owner.lower()}"
        self._thread = threading.Thread(target=self._run, args=(work,), name=name, daemon=True)
        self._thread.start()

    def _run(self, work: Callable[[], None]) -> None:
        try:
            work()
        except RecordingError as error:
            self._failure = error
        except Exception as error:
            self._failure = RecordingError(self._path, f"{self._owner} {self._path} failed: {error!r}.")
        finally:
            self.ended.set()
            self._on_end()

    def _join(self, timeout_s: float) -> None:
        """Wait for the end of the thread, but not in its own ``on_end``; raise StillRunning, or what it ended with."""
        thread = self._thread
        if thread is None or thread is threading.current_thread():
            return
        thread.join(timeout_s)
        if thread.is_alive():
            raise StillRunning(f"{self._owner} {self._path}", [self._verb], timeout_s)
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure


def _without_broker(address: str, why: str) -> Address:
    """Return a parsed address; AddressError, with the reason, if it is that of a broker."""
    parsed = parse_address(address)
    if parsed.is_broker:
        text = f"{parsed} is an address of a broker: {why}. Give one of ZeroMQ, DDS or Zenoh."
        raise AddressError(str(parsed), text)
    return parsed


class Recorder(Startable):
    """Writes published messages into an MCAP file, each as it arrived, with the time of its arrival.

    Foxglove shows the images of v1 messages in it, on topics called TOPIC/PART.

    Parameters
    ----------
    address
        Where the publisher is: ``"tcp://127.0.0.1:5555"``; or of DDS or Zenoh, but not of a broker.
    path
        The file, usually ``something.mcap``.
    topic
        As for `Subscriber`; ``""`` records everything.
    bind
        True to bind, for publishers that connect.
    force
        True to replace an existing file.
    messages
        The recording ends after this number of messages; None to go on until `stop`.
    backlog_bytes
        Most bytes that may wait for the disk. A message that finds no room is dropped and counted.
    on_end
        Called on the recorder's thread when the file is closed: it has that number of messages, or the disk failed,
        or the recorder was stopped.
    **options
        For the `Subscriber`: ``insecure``, ``keys``, ``allow``, ``max_message_bytes``, ``high_water_mark``.

    Raises
    ------
    AddressError, MessageError
        As from `Subscriber`.

    Notes
    -----
    Start it, or use ``with``. Nothing is decoded. Times are Unix times, read once and continued by a monotonic clock,
    so that setting the clock meanwhile does no harm.
    """

    def __init__(
        self,
        address: str,
        path: str | Path,
        topic: str = "",
        bind: bool = False,
        *,
        force: bool = False,
        messages: int | None = None,
        backlog_bytes: int = BACKLOG_BYTES,
        on_end: Callable[[], None] = _nothing,
        **options: Any,
    ) -> None:
        self.path = Path(path)
        parsed = _without_broker(address, "a recording would take its messages from other consumers")
        about = {"address": parsed.endpoint, "topic": topic}

        def make() -> tuple[Subscriber, _Recording]:
            recording = _Recording(self.path, about, force, messages, backlog_bytes, on_end)
            return Subscriber(parsed, recording, topic, bind, undecoded=True, **options), recording

        self._make = make
        # Made at once, so that the constructor refuses wrong arguments. They are two objects, so that the recorder's
        # thread does not keep the socket of a recorder that is garbage.
        self._subscriber, self._recording = make()
        self._lock = threading.Lock()
        self._finalizer: weakref.finalize[Any, Any] | None = None

    @property
    def address(self) -> str:
        """The bound endpoint once it is started; otherwise the address that was given."""
        return self._subscriber.address

    @property
    def counts(self) -> RecordingCounts:
        """Numbers of messages received, written and dropped, by reason, since the start; a copy."""
        return self._recording.counts()

    def start(self) -> Self:
        """Open the socket, make the file and begin to record; nothing happens if it records already.

        Raises
        ------
        RecordingError
            If the file exists and ``force`` is False, or can't be written.
        AddressError
            If the address can't be bound or understood.
        """
        with self._lock:
            if self._recording.is_running():
                return self
            if self._recording.was_started:
                self._subscriber, self._recording = self._make()
            # First the socket: an address that is refused must not cost the file that is to be replaced.
            self._subscriber.start()
            try:
                self._recording.start()
            except BaseException:
                self._subscriber.stop()
                raise
            _detach(self._finalizer)
            self._finalizer = weakref.finalize(self, self._recording.close)
        return self

    def stop(self, timeout_s: float = 5.0) -> None:
        """Receive no more, write the waiting messages, finish the file; from any thread, any number of times.

        Parameters
        ----------
        timeout_s
            Longest wait, in seconds. Messages that the disk has not taken when most of it is over are dropped and
            counted.

        Raises
        ------
        RecordingError
            If the disk failed, now or before. The messages written until then can be played.
        StillRunning
            If a single write takes longer.
        """
        with self._lock:
            subscriber, recording = self._subscriber, self._recording
            _detach(self._finalizer)
        try:
            subscriber.stop(timeout_s)
        finally:
            recording.stop(timeout_s)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Return whether the file is closed within ``timeout_s`` seconds: see ``on_end``."""
        return self._recording.ended.wait(timeout_s)

    def wait_joined(self, timeout_s: float = 5.0, publishers: int = 1) -> bool:
        """Return whether publishers have confirmed: all they send from then on is recorded. See `Subscriber`."""
        return self._subscriber.wait_joined(timeout_s, publishers)

    def __repr__(self) -> str:
        state = "running" if self._recording.is_running() else "stopped"
        return f"<Recorder {str(self.path)[-40:]} {state}: {self.counts}>"


class _Recording(_FileThread):
    """One recording from its start to its stop: the messages that wait for the disk, and the thread that writes them.

    The subscriber puts messages; the thread takes them. A message that finds no room is dropped and counted.
    """

    def __init__(
        self,
        path: Path,
        about: Mapping[str, str],
        force: bool,
        messages: int | None,
        backlog_bytes: int,
        on_end: Callable[[], None],
    ) -> None:
        super().__init__("Recorder", "write", path, on_end)
        self._about, self._force = about, force
        self._remaining, self._backlog_bytes = messages, backlog_bytes
        self._waiting: deque[tuple[int, Frames, int]] = deque()
        self._waiting_bytes = 0
        self._counts = RecordingCounts()
        self._is_closed = self._has_failed = False
        # A Condition has a re-entrant lock: the finalizer closes in any thread, even in one that holds it.
        self._changed = threading.Condition()
        self._deadline = float("inf")
        # The clocks are read together once: later times differ as those of the monotonic one.
        self._offset_ns = time.time_ns() - time.perf_counter_ns()

    def put(self, delivery: Delivery, *, block: bool) -> None:
        """Accept the frames of a message, or count them as dropped; called by the subscriber."""
        now_ns = self._offset_ns + time.perf_counter_ns()
        frames = delivery.frames
        size = sum(map(len, frames)) + _OVERHEAD_BYTES
        with self._changed:
            if self._is_closed and not self._has_failed:
                return
            self._counts.received += 1
            if self._has_failed:
                self._counts.dropped[_FAILED] += 1
            elif self._waiting and self._waiting_bytes + size > self._backlog_bytes:
                self._counts.dropped[_SLOW] += 1
            else:
                self._waiting.append((now_ns, frames, size))
                self._waiting_bytes += size
                if self._remaining is not None:
                    self._remaining -= 1
                    self._is_closed = self._remaining <= 0
                self._changed.notify_all()

    def counts(self) -> RecordingCounts:
        with self._changed:
            return RecordingCounts(self._counts.received, self._counts.written, Counter(self._counts.dropped))

    def close(self) -> None:
        """Accept no more messages; the thread writes those that wait, and ends."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()

    def start(self) -> None:
        writer = RecordingWriter(self._path, self._about, self._force)
        self._begin(lambda: self._record(writer))

    def stop(self, timeout_s: float) -> None:
        if not self.was_started:
            return
        self._deadline = time.monotonic() + timeout_s * _DRAIN_SHARE
        self.close()
        self._join(timeout_s)

    def _record(self, writer: RecordingWriter) -> None:
        try:
            self._write_all(writer)
            writer.finish(self.counts())
        except BaseException:
            with self._changed:
                self._has_failed = True
                self._drop(_FAILED, writer.pending)
                self._counts.written = writer.written
            raise
        finally:
            writer.close()

    def _write_all(self, writer: RecordingWriter) -> None:
        flush_at, is_over = float("inf"), False
        while not is_over:
            with self._changed:
                wait_s = max(0.0, flush_at - time.monotonic()) if writer.pending else None
                self._changed.wait_for(lambda: self._waiting or self._is_closed, wait_s)
                if time.monotonic() > self._deadline:
                    self._drop(_SLOW)
                message = self._waiting.popleft() if self._waiting else None
                self._waiting_bytes -= message[2] if message else 0
                is_over = self._is_closed and message is None
            if message is not None:
                flush_at = flush_at if writer.pending else time.monotonic() + _FLUSH_S
                writer.append(message[0], message[1])
            if is_over or time.monotonic() >= flush_at:
                writer.flush()
            with self._changed:
                self._counts.written = writer.written

    def _drop(self, reason: str, more: int = 0) -> None:
        lost = len(self._waiting) + more
        if lost:
            self._counts.dropped[reason] += lost
        self._waiting.clear()
        self._waiting_bytes = 0


class Player(Startable):
    """Publishes what a Recorder has written: the same frames, in the same order, at the same distances in time.

    Parameters
    ----------
    path
        The file.
    address
        ``"tcp://127.0.0.1:*"`` takes a free port, which `address` then names; or of DDS or Zenoh.
    bind
        False to connect to a ZeroMQ subscriber that binds.
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
    Start it, or use ``with``. Unlike a publisher it drops nothing over ZeroMQ, nor over Zenoh with `congestion=block`:
    a file can wait for a subscriber that does not keep up, which delays the messages behind it. Envelopes keep their
    ids, epochs, sequence numbers and times.
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
            raise InvalidValue(f"speed is {speed}; give 1.0, 0.5, 10 ..., or 0 for as fast as possible.")
        if loop < 0:
            raise InvalidValue(f"loop is {loop}; give how often, or 0 for without end.")
        parsed = _without_broker(address, "no recording is played to it")
        self._given = parsed.endpoint
        self.path = Path(path)
        if parsed.is_zeromq:
            binds = bind if parsed.binds is None else parsed.binds
            security = CurveOptions.checked(self._given, binds, insecure, keys, allow)

        def make() -> _Playback:
            channel: ZeroMQChannel | PeerChannel
            if parsed.is_zeromq:
                channel = ZeroMQChannel(self._given, security, high_water_mark=_HIGH_WATER_MARK)
            else:
                channel = open_channel(parsed)  # type: ignore[assignment]  # that of a peer, as checked above
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
        """How many messages were handed over since the start."""
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
                _detach(self._finalizer)
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
            playing = self._playing
        if playing is not None:
            playing.stop(timeout_s)
            _detach(self._finalizer)

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


class _Playback(_FileThread):
    """One playing from its start to its stop: the channel, and the thread that sends."""

    def __init__(
        self,
        path: Path,
        channel: ZeroMQChannel | PeerChannel,
        speed: float,
        loop: int,
        wait: bool,
        on_end: Callable[[], None],
    ) -> None:
        super().__init__("Player", "read", path, on_end)
        self.channel = channel
        self._speed, self._loop, self._wait = speed, loop, wait
        # Not an Event: the garbage collector puts into it, in any thread, where a lock could be held already.
        self._stops: queues.SimpleQueue[None] = queues.SimpleQueue()
        self.sent = 0

    def start(self) -> None:
        """Read the first message, then open the socket, then play."""
        whole = messages(self._path)
        first = next(whole, None)
        if first is None:
            raise RecordingError(self._path, f"{self._path} holds no message.")
        self.channel.open(None)
        begun = itertools.chain([first], whole)
        self._begin(lambda: self._play_all(begun))

    def stop_soon(self) -> None:
        self._stops.put(None)

    def stop(self, timeout_s: float) -> None:
        self.stop_soon()
        self._join(timeout_s)

    def _play_all(self, begun: Iterator[Recorded]) -> None:
        try:
            while self._wait and not self.channel.subscriptions.wait(0.0):
                self._pause(_CHECK_S)
            self._play(begun)
            for _ in range(1, self._loop) if self._loop else itertools.count():
                self._play(messages(self._path))
        except _Stopped:
            pass
        except BrokerError as error:
            raise RecordingError(self._path, f"{self._path} could not be sent on: {error}") from error
        finally:
            self.channel.close()

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


def _detach(finalizer: weakref.finalize[Any, Any] | None) -> None:
    """Have the garbage collector do nothing for a start that is over."""
    if finalizer is not None:
        finalizer.detach()


def _abandon(playing: _Playback, address: str) -> None:
    # By the garbage collector or at exit: so no waiting, no locks.
    if playing.is_running():
        playing.stop_soon()
        warn_left_running(f"Player {address}")
