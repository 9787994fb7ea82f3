"""The Recorder: published messages into a file, received by the I/O thread and written by a thread of its own."""

from __future__ import annotations

import threading
import time
import weakref
from collections import Counter, deque
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, Self

from epypes.errors import RecordingError, StillRunning
from epypes.transport.address import parse_address
from epypes.transport.channel import Delivery, Frames
from epypes.transport.endpoint import Startable
from epypes.transport.mcap import RecordingCounts, RecordingWriter
from epypes.transport.subscriber import ZMQSubscriber

# What may wait for the disk: some seconds of images, and more than the largest message.
BACKLOG_BYTES: Final = 512 * 1024**2
# The memory of a message beside its bytes: without it, millions of tiny ones would fill the memory.
_OVERHEAD_BYTES: Final = 1_024
# A recorder that is killed loses the messages of this time.
_FLUSH_S: Final = 1.0
# Share of the time for a stop in which waiting messages are written; then the file is finished without the rest.
_DRAIN_SHARE: Final = 0.8
_SLOW, _FAILED = "disk too slow", "disk failed"


def _nothing() -> None:
    return


class Recorder(Startable):
    """Writes published messages into an MCAP file, each as it arrived, with the time of its arrival.

    Parameters
    ----------
    address
        Where the publisher is: ``"tcp://127.0.0.1:5555"``.
    path
        The file, usually ``something.mcap``.
    topic
        As for `ZMQSubscriber`; ``""`` records everything.
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
        For the `ZMQSubscriber`: ``insecure``, ``keys``, ``allow``, ``max_message_bytes``, ``high_water_mark``.

    Raises
    ------
    AddressError, MessageError
        As from `ZMQSubscriber`.

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
        about = {"address": parse_address(address).endpoint, "topic": topic}

        def make() -> tuple[ZMQSubscriber, _Recording]:
            recording = _Recording(self.path, about, force, messages, backlog_bytes, on_end)
            return ZMQSubscriber(address, recording, topic, bind, undecoded=True, **options), recording

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
            if self._recording.was_started():
                self._subscriber, self._recording = self._make()
            # First the socket: an address that is refused must not cost the file that is to be replaced.
            self._subscriber.start()
            try:
                self._recording.start()
            except BaseException:
                self._subscriber.stop()
                raise
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
            if self._finalizer is not None:
                self._finalizer.detach()
            subscriber, recording = self._subscriber, self._recording
        subscriber.stop(timeout_s)
        recording.stop(timeout_s)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Return whether the file is closed within ``timeout_s`` seconds: see ``on_end``."""
        return self._recording.ended.wait(timeout_s)

    def wait_joined(self, timeout_s: float = 5.0, publishers: int = 1) -> bool:
        """Return whether publishers have confirmed: all they send from then on is recorded. See `ZMQSubscriber`."""
        return self._subscriber.wait_joined(timeout_s, publishers)

    def __repr__(self) -> str:
        state = "running" if self._recording.is_running() else "stopped"
        return f"<Recorder {str(self.path)[-40:]} {state}: {self.counts}>"


class _Recording:
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
        self._path, self._about, self._force, self._on_end = path, about, force, on_end
        self._remaining, self._backlog_bytes = messages, backlog_bytes
        self._waiting: deque[tuple[int, Frames, int]] = deque()
        self._waiting_bytes = 0
        self._counts = RecordingCounts()
        self._is_closed = self._has_failed = False
        self._failure: RecordingError | None = None
        # A Condition has a re-entrant lock: the finalizer closes in any thread, even in one that holds it.
        self._changed = threading.Condition()
        self._deadline = float("inf")
        self._thread: threading.Thread | None = None
        # The clocks are read together once: later times differ as those of the monotonic one.
        self._offset_ns = time.time_ns() - time.perf_counter_ns()
        self.ended = threading.Event()

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
        self._thread = threading.Thread(target=self._run, args=(writer,), name="epypes-recorder", daemon=True)
        self._thread.start()

    def was_started(self) -> bool:
        return self._thread is not None

    def is_running(self) -> bool:
        return self._thread is not None and self._thread.is_alive()

    def stop(self, timeout_s: float) -> None:
        if self._thread is None:
            return
        self._deadline = time.monotonic() + timeout_s * _DRAIN_SHARE
        self.close()
        if self._thread is threading.current_thread():
            # In on_end: the file is closed already.
            return
        self._thread.join(timeout_s)
        if self._thread.is_alive():
            raise StillRunning(f"Recorder {self._path}", ["write"], timeout_s)
        failure, self._failure = self._failure, None
        if failure is not None:
            raise failure

    def _run(self, writer: RecordingWriter) -> None:
        try:
            self._write_all(writer)
            writer.finish(self.counts())
        except Exception as error:
            text = f"{self._path} can't be written: {error!r}."
            self._failure = error if isinstance(error, RecordingError) else RecordingError(self._path, text)
            with self._changed:
                self._has_failed = True
                self._drop(_FAILED, writer.pending)
                self._counts.written = writer.written
        finally:
            writer.close()
            self.ended.set()
            self._on_end()

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
