"""The protocol of a camera, and cameras that are kept to a number of frames per second."""

from __future__ import annotations

import contextlib
import math
import threading
from numbers import Real
from time import monotonic
from typing import Any, Final, Protocol, runtime_checkable

# Of sources that would give frames as fast as a processor can.
USUAL_FPS: Final = 10.0


@runtime_checkable
class Camera(Protocol):
    """A source of frames, one after the other: any object with these two methods."""

    def read(self) -> Any:
        """Return the next frame, (y, x) or (y, x, channels), when there is one; None: there are no more.

        Called on the camera's own thread. It may fill one buffer again and again: a frame is copied where other
        code could write to it. ``errors.CameraUnavailable`` means: no frame just now, try again later. Any other
        exception ends this camera.
        """

    def close(self) -> None:
        """Let go of what was opened, and end a `read` under way if that is possible.

        Called from any thread, as often as it takes; `read` may be called again afterwards, and goes on.
        """


class Alarm:
    """A wait that any thread can end, and a finalizer too.

    It holds no lock while it waits, as `threading.Event` does for a moment: a finalizer that rings, called by the
    garbage collector in that moment, would wait for itself. It also costs a third less.
    """

    def __init__(self) -> None:
        self.has_rung = False
        # Held, but for the moment in which it rings.
        self._asleep = threading.Lock()
        self._asleep.acquire()

    def ring(self) -> None:
        """End the wait, and those to come."""
        self.has_rung = True
        with contextlib.suppress(RuntimeError):
            self._asleep.release()

    def reset(self) -> None:
        """Let the next wait last again."""
        self.has_rung = False
        self._asleep.acquire(blocking=False)

    def wait(self, wait_s: float) -> bool:
        """Wait, on one thread at a time; return whether it has rung."""
        if wait_s > 0 and not self.has_rung:
            self._asleep.acquire(timeout=min(wait_s, threading.TIMEOUT_MAX))
        return self.has_rung


class Paced:
    """A camera that gives its first frame at once, and each further one when it is due.

    Parameters
    ----------
    camera
        Gives the frames.
    fps
        Frames per second. If the reader comes late, the next frame is due one period later: nothing is caught up.
    """

    def __init__(self, camera: Camera, fps: float) -> None:
        self._camera, self._period_s = camera, 1 / require_fps(fps)
        self._due_s = -math.inf
        self._closing = Alarm()

    def read(self) -> Any:
        """Return the next frame when it is due; None if `close` was called meanwhile."""
        self._closing.reset()
        if self._closing.wait(self._due_s - monotonic()):
            return None
        self._due_s = next_due_s(self._due_s, self._period_s)
        return self._camera.read()

    def close(self) -> None:
        """End the wait, and close the camera."""
        self._closing.ring()
        self._camera.close()

    def __repr__(self) -> str:
        return f"<{1 / self._period_s:g} fps of {self._camera!r}>"


def next_due_s(due_s: float, period_s: float) -> float:
    """Return when the frame after one that was due at ``due_s`` is due; a period from now, if that has passed."""
    now_s = monotonic()
    return due_s + period_s if now_s - due_s < period_s else now_s + period_s


def paced(camera: Camera, fps: float | None) -> Camera:
    """Return a camera that is kept to ``fps`` frames per second; the camera as it is for None and infinity."""
    return camera if fps is None or require_fps(fps) == math.inf else Paced(camera, fps)


def require_fps(fps: float) -> float:
    """Return a number of frames per second, or raise ValueError if it can't be one."""
    if isinstance(fps, bool) or not isinstance(fps, Real) or not fps > 0:
        raise ValueError(f"fps must be a number above 0, or None for the source's own pace, not {fps!r:.40}.")
    return float(fps)
