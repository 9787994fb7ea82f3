"""Several cameras at once, each read by a thread of its own, and their frames nearest to a time."""

from __future__ import annotations

import atexit
import contextlib
import logging
import threading
import time
import warnings
import weakref
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, Literal, Self

from epypes.acquisition.cameras import Camera, camera, has_twins
from epypes.acquisition.frames import Frame, Ring, next_frame
from epypes.errors import CameraUnavailable, InvalidValue, StillRunning

State = Literal["stopped", "running", "unavailable", "ended", "failed"]

# A camera that gives nothing is asked again after 10, 20, 40 ms ..., at last every second.
_FIRST_RETRY_S: Final = 0.01
_LAST_RETRY_S: Final = 1.0
# One missed frame is not reported, unless the camera is gone; this many in a row are.
_MISSES_REPORTED: Final = 5
# close() may come in the moment before a read begins, which opens the camera again; so it is repeated.
_CLOSE_AGAIN_S: Final = 0.05
_AT_EXIT_S: Final = 0.5

_log = logging.getLogger("epypes.acquisition")


@dataclass(frozen=True, slots=True)
class Counts:
    """Frames, missed reads and failures of one camera since it was given to an ImageAcquisition.

    Attributes
    ----------
    frames
        Frames that came.
    missed
        Reads that gave no frame, and were tried again.
    failed
        How often it ended with an exception.
    """

    frames: int
    missed: int
    failed: int


class ImageAcquisition:
    """Captures from several cameras, each on a thread of its own, and returns the frames nearest to a time.

    No camera waits for another one, or for a request: each fills a ring of recent frames.

    Parameters
    ----------
    *cameras
        Cameras, or what `camera` makes them of.
    size
        How many frames are kept of each.
    max_age_s
        How far from the time asked for, in seconds, a frame may be: a camera that has died must not answer with an old
        picture.
    on_error
        Called with a camera's index and an exception: when it has failed and ended, and once per outage when it is
        unplugged or gave no frame five times in a row, while it is tried again. On the camera's thread; logged without
        one.
    on_frame
        Called with a camera's index and each of its frames, on the camera's thread, which waits for it. What it raises
        ends the camera.

    Raises
    ------
    ValueError
        There is no camera, one camera is given twice, or a number can't be one.
    TypeError, ImageFileError, CameraUnavailable
        A camera can't be made of what was given.

    Notes
    -----
    Semeniuta and Falkman 2019, "Image acquisition". Start it, or use ``with``. Capture times are taken when ``read``
    returns, from the system's clock.

    Examples
    --------
    >>> import numpy as np, time
    >>> gray = np.zeros((4, 6), np.uint8)
    >>> with ImageAcquisition(gray, gray) as acquisition:
    ...     acquisition.wait_for_frames(5.0)
    ...     left, right = acquisition.nearest(time.time_ns())
    True
    >>> left.number, right.image.shape
    (1, (4, 6))
    """

    def __init__(
        self,
        *cameras: Any,
        size: int = 8,
        max_age_s: float = 1.0,
        on_error: Callable[[int, BaseException], object] | None = None,
        on_frame: Callable[[int, Frame], object] | None = None,
    ) -> None:
        if not cameras:
            raise InvalidValue("Give one camera or more, such as a path, a folder or the number of a device.")
        if has_twins(cameras):
            raise InvalidValue("One camera is given twice, but only one thread can read it. Give each its own.")
        if not max_age_s > 0:
            raise InvalidValue(f"max_age_s must be above 0, or math.inf, not {max_age_s!r:.40}.")
        self.max_age_s = max_age_s
        self._lock = threading.Lock()
        self._changed = threading.Condition()
        # The workers don't know this object, so that it can be collected while they run, and warn.
        self._workers = tuple(
            _CameraWorker(index, made, size, on_error, on_frame, self._changed)
            for index, made in enumerate(map(camera, cameras))
        )
        self._finalizer: weakref.finalize[Any, Any] | None = None

    @property
    def is_running(self) -> bool:
        """Whether it was started and not stopped; cameras may have ended or failed."""
        return self._finalizer is not None

    @property
    def rings(self) -> tuple[Ring, ...]:
        """The recent frames, by camera."""
        return tuple(worker.ring for worker in self._workers)

    @property
    def counts(self) -> tuple[Counts, ...]:
        """Frames, missed frames and failures, by camera."""
        return tuple(worker.counts for worker in self._workers)

    @property
    def states(self) -> tuple[State, ...]:
        """The state of each camera.

        ``"stopped"``, ``"running"``, ``"unavailable"`` (unplugged or without frames, and tried again), ``"ended"`` (no
        more frames) or ``"failed"`` (by an exception).
        """
        return tuple("unavailable" if worker.is_away else worker.state for worker in self._workers)

    def start(self) -> Self:
        """Start a thread per camera; nothing happens if it runs already.

        Raises
        ------
        StillRunning
            It was stopped, but a camera has not returned yet.
        """
        with self._lock:
            if self._finalizer is None:
                _require_ended([worker.name for worker in self._workers if worker.is_alive], 0.0)
                for worker in self._workers:
                    worker.start()
                _started.update(self._workers)
                self._finalizer = weakref.finalize(self, _abandon, self._workers)
        return self

    def stop(self, timeout_s: float = 5.0) -> None:
        """Stop after the frames under way and close the cameras; from any thread, as often as you like.

        Frames that were captured stay, as long as they are young enough.

        Raises
        ------
        StillRunning
            A camera did not return within ``timeout_s``; it is named.
        """
        deadline_s = time.monotonic() + timeout_s
        with self._lock:
            if self._finalizer is not None:
                self._finalizer.detach()
                self._finalizer = None
            endings = [(worker.name, worker.stop(deadline_s)) for worker in self._workers]
        _require_ended(_still_running(endings, deadline_s), timeout_s)

    def nearest(self, time_ns: int) -> tuple[Frame, ...]:
        """Return each camera's frame nearest to a time; never waits.

        Parameters
        ----------
        time_ns
            Unix time in ns, as from ``time.time_ns()``.

        Raises
        ------
        FrameUnavailable
            A camera has no frame yet, the time is before its oldest one, or none is within ``max_age_s`` of it.
        """
        return tuple(worker.ring.nearest(time_ns, self.max_age_s) for worker in self._workers)

    def wait_for_frames(self, timeout_s: float = 5.0) -> bool:
        """Return whether every camera has given a frame since the start, waiting up to ``timeout_s`` for it.

        False at once if one of them has ended or failed without any.
        """
        with self._changed:
            self._changed.wait_for(lambda: all(worker.is_settled for worker in self._workers), timeout_s)
            return all(worker.has_frame for worker in self._workers)

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    def __repr__(self) -> str:
        state = "running" if self.is_running else "stopped"
        frames = sum(counts.frames for counts in self.counts)
        return f"<ImageAcquisition {state}: {len(self._workers)} cameras, {frames} frames>"


class _CameraWorker:
    """One camera, its ring, and its thread, which waits for the camera alone.

    Parameters
    ----------
    index
        Of the camera.
    camera
        Is read on the thread.
    size
        Of the ring.
    on_error, on_frame
        Called on the thread with the index and the exception, or the frame.
    changed
        Notified of the first frame and of the end.
    """

    def __init__(
        self,
        index: int,
        camera: Camera,
        size: int,
        on_error: Callable[[int, BaseException], object] | None,
        on_frame: Callable[[int, Frame], object] | None,
        changed: threading.Condition,
    ) -> None:
        self.name = f"camera {index}"
        self.ring = Ring(size, name=f"Camera {index}")
        self.state: State = "stopped"
        self.has_frame = False
        # Set by a finalizer, which must not wait for the lock of an Event: the thread that holds it may have called it.
        self.is_abandoned = False
        self._index, self._camera = index, camera
        self._on_error, self._on_frame, self._changed = on_error, on_frame, changed
        self._frames = self._missed = self._failed = self._missed_in_a_row = 0
        # Whether an outage was reported that lasts.
        self._is_reported = False
        self._stop = threading.Event()
        self._thread: threading.Thread | None = None

    @property
    def counts(self) -> Counts:
        return Counts(self._frames, self._missed, self._failed)

    @property
    def is_away(self) -> bool:
        return self._is_reported and self.state == "running"

    @property
    def is_settled(self) -> bool:
        return self.has_frame or self.state in ("ended", "failed")

    @property
    def is_alive(self) -> bool:
        return self._thread is not None and self._thread.is_alive()

    def start(self) -> None:
        """Start the thread, of which there must be none."""
        self._stop.clear()
        self.has_frame, self.state, self._missed_in_a_row, self._is_reported = False, "running", 0, False
        self._thread = threading.Thread(target=self._run, name=f"epypes {self.name}", daemon=True)
        self._thread.start()

    def stop(self, deadline_s: float) -> list[threading.Thread]:
        """Have the thread end after the read under way; return the threads to wait for, that of the camera first."""
        self._stop.set()
        thread = self._thread
        if thread is None or not thread.is_alive():
            return []
        # On a thread of its own, since a user's close() might wait for a lock that the read holds.
        closing = threading.Thread(
            target=self._close_again, args=(thread, deadline_s), name=f"epypes close {self.name}", daemon=True
        )
        closing.start()
        return [thread, closing]

    def _close_again(self, thread: threading.Thread, deadline_s: float) -> None:
        while thread.is_alive():
            self._close()
            thread.join(_CLOSE_AGAIN_S)
            if time.monotonic() >= deadline_s:
                return

    def _run(self) -> None:
        state: State = "ended"
        failure = None
        try:
            self._capture()
        except BaseException as exception:  # a generator's SystemExit must not end the thread in silence
            state, failure = "failed", exception
        # A read that was ended by close() may return or raise anything: that is no failure.
        if self._is_stopping():
            state, failure = "stopped", None
        self._failed += failure is not None
        self.state = state
        self._notify()
        if failure is not None:
            self._report(failure)
        self._close()

    def _is_stopping(self) -> bool:
        return self.is_abandoned or self._stop.is_set()

    def _capture(self) -> None:
        """Read frames until the camera is stopped, or has no more."""
        while not self._is_stopping():
            try:
                frame = next_frame(self._camera, self._frames + 1)
            except CameraUnavailable as error:
                self._stop.wait(self._miss(error))
                continue
            if frame is None:
                return
            self._missed_in_a_row, self._is_reported = 0, False
            # Counted before, so that a caller that has a frame finds it counted.
            self._frames += 1
            self.ring.append(frame)
            if self._on_frame is not None:
                self._on_frame(self._index, frame)
            if not self.has_frame:
                self.has_frame = True
                self._notify()

    def _notify(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _miss(self, error: CameraUnavailable) -> float:
        """Count a read that gave no frame; return after how many seconds to try again."""
        self._missed += 1
        self._missed_in_a_row += 1
        if not self._is_reported and (error.is_gone or self._missed_in_a_row >= _MISSES_REPORTED):
            self._is_reported = True
            self._report(error)
        return float(min(_LAST_RETRY_S, _FIRST_RETRY_S * 2 ** min(self._missed_in_a_row - 1, 10)))

    def _close(self) -> None:
        try:
            self._camera.close()
        except BaseException as exception:
            self._report(exception)

    def _report(self, exception: BaseException) -> None:
        if self._on_error is None:
            _log.error("%s: %s", self.name, exception, exc_info=exception)
            return
        try:
            self._on_error(self._index, exception)
        except BaseException:
            _log.exception("%s: on_error itself failed", self.name)


_started: weakref.WeakSet[_CameraWorker] = weakref.WeakSet()


def _require_ended(busy: Sequence[str], timeout_s: float) -> None:
    if busy:
        raise StillRunning("ImageAcquisition", busy, timeout_s)


def _still_running(endings: Iterable[tuple[str, Sequence[threading.Thread]]], deadline_s: float) -> list[str]:
    """Wait for the threads of cameras that were stopped; return the names of those whose first one has not ended."""
    busy = []
    for name, threads in endings:
        if threading.current_thread() in threads:
            continue
        for thread in threads:
            thread.join(max(0.0, deadline_s - time.monotonic()))
        if threads and threads[0].is_alive():
            busy.append(name)
    return busy


def _abandon(workers: Sequence[_CameraWorker]) -> None:
    # By the garbage collector or at exit: so no waiting, no locks.
    for worker in workers:
        worker.is_abandoned = True
    text = f"An ImageAcquisition of {len(workers)} was left running. Call stop(), or use it in a with statement."
    warnings.warn(text, ResourceWarning, stacklevel=2)


@atexit.register
def _end_threads() -> None:
    # A thread that comes back from OpenCV while the interpreter goes down aborts the process: its destructors may not
    # be left by Python's way of ending threads. Cameras that wait for the next frame's time come back at once.
    deadline_s = time.monotonic() + _AT_EXIT_S
    # Some interpreters start no thread any more by now.
    with contextlib.suppress(RuntimeError):
        _still_running([(worker.name, worker.stop(deadline_s)) for worker in list(_started)], deadline_s)
