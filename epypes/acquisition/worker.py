"""The thread of one camera, which reads its frames into a ring."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Final, Literal

from epypes.acquisition.frames import Frame, Ring, take_image
from epypes.acquisition.pace import Alarm, Camera
from epypes.errors import CameraUnavailable

State = Literal["stopped", "running", "ended", "failed"]

# A camera that gives nothing is asked again after 10, 20, 40 ms ..., at last every second.
_FIRST_RETRY_S: Final = 0.01
_LAST_RETRY_S: Final = 1.0
# One missed frame is not reported; this many in a row are.
_MISSES_REPORTED: Final = 5
# close() may come in the moment before a read begins, which opens the camera again; so it is repeated.
_CLOSE_AGAIN_S: Final = 0.05

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


@dataclass(frozen=True, slots=True)
class Ending:
    """The threads of one camera that was asked to stop."""

    name: str
    reading: threading.Thread
    closing: threading.Thread

    def join(self, deadline_s: float) -> bool:
        """Wait for the threads; return whether the camera has ended, or it is its own thread that asks."""
        threads = (self.reading, self.closing)
        if threading.current_thread() in threads:
            return True
        for thread in threads:
            thread.join(max(0.0, deadline_s - time.monotonic()))
        return not self.reading.is_alive()


class CameraWorker:
    """One camera, its ring, and its thread, which waits for the camera alone.

    Parameters
    ----------
    index
        Of the camera.
    camera
        Is read on the thread.
    size
        Of the ring.
    on_error
        Called on the thread with the index and the exception.
    on_change
        Called on the thread with the first frame and at the end.
    """

    def __init__(
        self,
        index: int,
        camera: Camera,
        size: int,
        on_error: Callable[[int, BaseException], object] | None,
        on_change: Callable[[], None],
    ) -> None:
        self.index, self.camera, self.name = index, camera, f"camera {index}"
        self.ring = Ring(size, name=f"Camera {index}")
        self.state: State = "stopped"
        self.has_frame = False
        self._on_error, self._on_change = on_error, on_change
        self._image: Any = None
        self._frames = self._missed = self._failed = self._missed_in_a_row = 0
        self._stop = Alarm()
        self._thread: threading.Thread | None = None

    @property
    def counts(self) -> Counts:
        """Frames, missed reads and failures so far."""
        return Counts(self._frames, self._missed, self._failed)

    @property
    def is_alive(self) -> bool:
        """Whether the thread has not ended."""
        return self._thread is not None and self._thread.is_alive()

    def start(self) -> None:
        """Start the thread, of which there must be none."""
        self._stop = Alarm()
        self.has_frame, self.state, self._missed_in_a_row = False, "running", 0
        self._thread = threading.Thread(target=self._run, args=(self._stop,), name=f"epypes {self.name}", daemon=True)
        self._thread.start()

    def ask_to_stop(self) -> None:
        """Have the thread end after the read under way."""
        self._stop.ring()

    def end_read(self, deadline_s: float) -> Ending | None:
        """Close the camera until its thread has ended; return how to wait for that, unless it has ended already."""
        thread = self._thread
        if thread is None or not thread.is_alive():
            return None
        # On a thread of its own, since a user's close() might wait for a lock that the read holds.
        closing = threading.Thread(
            target=self._close_again, args=(thread, deadline_s), name=f"epypes close {self.name}", daemon=True
        )
        closing.start()
        return Ending(self.name, thread, closing)

    def _close_again(self, thread: threading.Thread, deadline_s: float) -> None:
        while thread.is_alive():
            self._close()
            thread.join(_CLOSE_AGAIN_S)
            if time.monotonic() >= deadline_s:
                return

    def _run(self, stop: Alarm) -> None:
        try:
            self._capture(stop)
            self._end("stopped" if stop.has_rung else "ended")
        except BaseException as exception:  # a generator's SystemExit must not end the thread in silence
            # A read that was ended by close() may raise anything: that is no failure.
            if stop.has_rung:
                self._end("stopped")
            else:
                self._failed += 1
                self._end("failed")
                self._report(exception)
        self._close()

    def _capture(self, stop: Alarm) -> None:
        """Read frames until the camera is stopped, or has no more."""
        while not stop.has_rung:
            try:
                given = [self.camera.read()]
            except CameraUnavailable as error:
                stop.wait(self._miss(error))
                continue
            captured_ns = time.time_ns()
            if given[0] is None:
                return
            self._keep(given, captured_ns)

    def _end(self, state: State) -> None:
        self.state = state
        self._on_change()

    def _keep(self, given: list[Any], captured_ns: int) -> None:
        self._missed_in_a_row = 0
        # An image that lies still was looked at when it came first.
        is_known = given[0] is self._image and not self._image.flags.writeable
        image = self._image if is_known else take_image(given)
        self._image = image
        frame = Frame(image, captured_ns, self._frames + 1)
        # Counted before, so that a caller that has a frame finds it counted.
        self._frames += 1
        self.ring.append(frame)
        if not self.has_frame:
            self.has_frame = True
            self._on_change()

    def _miss(self, error: CameraUnavailable) -> float:
        """Count a read that gave no frame; return after how many seconds to try again."""
        self._missed += 1
        self._missed_in_a_row += 1
        if self._missed_in_a_row == _MISSES_REPORTED:
            self._report(error)
        return float(min(_LAST_RETRY_S, _FIRST_RETRY_S * 2 ** min(self._missed_in_a_row - 1, 10)))

    def _close(self) -> None:
        try:
            self.camera.close()
        except BaseException as exception:
            self._report(exception)

    def _report(self, exception: BaseException) -> None:
        if self._on_error is None:
            _log.error("%s: %s", self.name, exception, exc_info=exception)
            return
        try:
            self._on_error(self.index, exception)
        except BaseException:
            _log.exception("%s: on_error itself failed", self.name)
