"""Several cameras at once, and their frames nearest to a time."""

from __future__ import annotations

import atexit
import contextlib
import threading
import time
import warnings
import weakref
from collections.abc import Callable, Sequence
from types import TracebackType
from typing import Any, Self

from epypes.acquisition.cameras import camera, has_twins
from epypes.acquisition.frames import Frame, Ring
from epypes.acquisition.worker import CameraWorker, Counts, Ending, State
from epypes.errors import StillRunning

_AT_EXIT_S = 0.5

_started: weakref.WeakSet[CameraWorker] = weakref.WeakSet()


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
        Called with a camera's index and an exception: when it has failed and ended, and once per outage when it gave
        no frame five times in a row, while it is tried again. On the camera's thread; logged without one.

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
    ) -> None:
        if not cameras:
            raise ValueError("Give one camera or more, such as a path, a folder or the number of a device.")
        if has_twins(cameras):
            raise ValueError("One camera is given twice, but only one thread can read it. Give each its own.")
        if not max_age_s > 0:
            raise ValueError(f"max_age_s must be above 0, or math.inf, not {max_age_s!r:.40}.")
        self.max_age_s = max_age_s
        self._lock = threading.Lock()
        self._changed = changed = threading.Condition()

        def on_change() -> None:
            with changed:
                changed.notify_all()

        # The workers don't know this object, so that it can be collected while they run, and warn.
        self._workers = tuple(
            CameraWorker(index, made, size, on_error, on_change) for index, made in enumerate(map(camera, cameras))
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
        """``"stopped"``, ``"running"``, ``"ended"`` (no more frames) or ``"failed"`` (by an exception), by camera."""
        return tuple(worker.state for worker in self._workers)

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
                    _started.add(worker)
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
            endings = _end(self._workers, deadline_s)
        _require_ended([ending.name for ending in endings if not ending.join(deadline_s)], timeout_s)

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
            self._changed.wait_for(lambda: all(map(_is_settled, self._workers)), timeout_s)
            return all(worker.has_frame for worker in self._workers)

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    def __repr__(self) -> str:
        state = "running" if self.is_running else "stopped"
        frames = sum(counts.frames for counts in self.counts)
        return f"<ImageAcquisition {state}: {len(self._workers)} cameras, {frames} frames>"


def _is_settled(worker: CameraWorker) -> bool:
    return worker.has_frame or worker.state in ("ended", "failed")


def _require_ended(busy: Sequence[str], timeout_s: float) -> None:
    if busy:
        raise StillRunning("ImageAcquisition", busy, timeout_s)


def _end(workers: Sequence[CameraWorker], deadline_s: float) -> list[Ending]:
    for worker in workers:
        worker.ask_to_stop()
    return [ending for worker in workers if (ending := worker.end_read(deadline_s)) is not None]


def _abandon(workers: Sequence[CameraWorker]) -> None:
    # By the garbage collector or at exit: so no waiting, no locks.
    for worker in workers:
        worker.ask_to_stop()
    text = f"An ImageAcquisition of {len(workers)} was left running. Call stop(), or use it in a with statement."
    warnings.warn(text, ResourceWarning, stacklevel=2)


@atexit.register
def _end_threads() -> None:
    # A thread that comes back from OpenCV while the interpreter goes down aborts the process: its destructors may not
    # be left by Python's way of ending threads. Cameras that wait for the next frame's time come back at once.
    deadline_s = time.monotonic() + _AT_EXIT_S
    # Some interpreters start no thread any more by now.
    with contextlib.suppress(RuntimeError):
        for ending in _end(list(_started), deadline_s):
            ending.join(deadline_s)
