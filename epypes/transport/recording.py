"""How is traffic recorded? By a Recorder: the I/O thread receives, a thread of its own writes the file."""

from __future__ import annotations

import threading
import time
import weakref
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Self

from epypes.errors import RecordingError, StillRunning
from epypes.transport.backlog import Backlog
from epypes.transport.endpoint import Startable
from epypes.transport.mcapformat import Counts
from epypes.transport.mcapwriter import RecordingWriter
from epypes.transport.subscriber import ZMQSubscriber

# What may wait for the disk: some seconds of images, and more than the largest message.
BACKLOG_BYTES = 512 * 1024**2
# A recorder that is killed loses what came in this time.
_FLUSH_S = 1.0
# Part of the time for a stop in which the rest is written; then the file is finished without it.
_DRAIN_SHARE = 0.8


def _nothing() -> None:
    return


class Recorder(Startable):
    """Writes what is published into an MCAP file: every message as it came, with the time at which it did.

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
        True to replace the file if it is there.
    messages
        How many to record; None to go on until `stop`.
    backlog_bytes
        What may wait for the disk. A message that finds no room is dropped and counted.
    on_end
        Called on the recorder's thread when the file is closed: there are so many messages in it, or the disk failed,
        or it was stopped.
    **options
        For the `ZMQSubscriber`: ``insecure``, ``keys``, ``allow``, ``max_message_bytes``, ``high_water_mark``.

    Raises
    ------
    AddressError, MessageError
        As from `ZMQSubscriber`.

    Notes
    -----
    Start it, or use ``with``. Nothing is decoded. Times are Unix times, read once and counted on by a monotonic clock,
    so that a clock that is set meanwhile does no harm.
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

        about = {"address": address, "topic": topic}

        def make() -> tuple[ZMQSubscriber, _Recording]:
            recording = _Recording(self.path, about, force, Backlog(messages, backlog_bytes), on_end)
            return ZMQSubscriber(address, recording.backlog, topic, bind, undecoded=True, **options), recording

        self._make = make
        # At once, so that the constructor refuses what makes no sense. They are two, so that the recorder's thread does
        # not keep the socket of a recorder that was forgotten.
        self._subscriber, self._recording = make()
        self._lock = threading.Lock()
        self._finalizer: weakref.finalize[Any, Any] | None = None

    @property
    def address(self) -> str:
        """The endpoint that is bound, once it is started; otherwise the address that was given."""
        return self._subscriber.address

    @property
    def counts(self) -> Counts:
        """How many messages were received, written and dropped, by reason, since the start; a copy."""
        return self._recording.backlog.counts()

    def start(self) -> Self:
        """Open the socket, make the file and begin to record; nothing happens if it records already.

        Raises
        ------
        RecordingError
            If the file is there and ``force`` was not said, or can't be written.
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
            self._finalizer = weakref.finalize(self, self._recording.backlog.close)
        return self

    def stop(self, timeout_s: float = 5.0) -> None:
        """Receive no more, write what waits, finish the file; from any thread, as often as you like.

        Parameters
        ----------
        timeout_s
            Longest wait, in seconds. What the disk has not taken when most of it is over is dropped and counted.

        Raises
        ------
        RecordingError
            If the disk failed, now or before. What had been written can be played.
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
        """Return whether publishers have confirmed: what they send from then on is recorded. See `ZMQSubscriber`."""
        return self._subscriber.wait_joined(timeout_s, publishers)

    def __repr__(self) -> str:
        state = "running" if self._recording.is_running() else "stopped"
        return f"<Recorder {str(self.path)[-40:]} {state}: {self.counts}>"


class _Recording:
    """From a start to its stop: one file and the thread that writes it."""

    def __init__(
        self, path: Path, about: Mapping[str, str], force: bool, backlog: Backlog, on_end: Callable[[], None]
    ) -> None:
        self._path, self._about, self._force, self._on_end = path, about, force, on_end
        self._appended = 0
        self._deadline = float("inf")
        self._failure: RecordingError | None = None
        self._thread: threading.Thread | None = None
        self.backlog = backlog
        self.ended = threading.Event()

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
        self.backlog.close()
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
            writer.finish(self.backlog.counts())
        except Exception as error:
            text = f"{self._path} can't be written: {error!r}."
            self._failure = error if isinstance(error, RecordingError) else RecordingError(self._path, text)
            self.backlog.fail(writer.pending)
            self.backlog.wrote(self._appended - writer.pending)
        finally:
            writer.close()
            self.ended.set()
            self._on_end()

    def _write_all(self, writer: RecordingWriter) -> None:
        due = 0.0
        while not self.backlog.is_over():
            if time.monotonic() > self._deadline:
                self.backlog.give_up()
                break
            taken = self.backlog.take(max(0.0, due - time.monotonic()) if writer.pending else None)
            if taken is not None:
                due = due if writer.pending else time.monotonic() + _FLUSH_S
                # Counted before: if it fails in there, it is one of those that are pending.
                self._appended += 1
                writer.append(*taken)
            if time.monotonic() >= due:
                writer.flush()
            self.backlog.wrote(self._appended - writer.pending)
        writer.flush()
        self.backlog.wrote(self._appended)
