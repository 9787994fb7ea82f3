"""How do devices, streams and video files give frames through OpenCV's VideoCapture?"""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import Any, Final

from epypes.acquisition.pace import next_due_s
from epypes.acquisition.quiet import quiet
from epypes.errors import CameraUnavailable, ImageFileError
from epypes.optional import optional_import

# Reads in a row that give nothing, after which a device is opened again. That takes a second, so not after the first.
_MISSES: Final = 3


class Handle:
    """A capture that is open while it is needed; it is read by one thread and closed from any.

    A capture of OpenCV must not be released while it is read, so whoever is done last does that.

    Parameters
    ----------
    capture
        A capture that is open.
    opening
        Returns such a capture again, after `close`. Without it, the capture belongs to somebody else and stays open.
    """

    def __init__(self, capture: Any, opening: Callable[[], Any] | None) -> None:
        self._capture, self._opening = capture, opening
        self._reading = threading.Lock()
        self.is_closed = False

    @property
    def is_ours(self) -> bool:
        """Whether it is released and opened again."""
        return self._opening is not None

    @contextmanager
    def reading(self) -> Iterator[Any]:
        """Hold the capture for a read; open it if it is closed."""
        try:
            with self._reading:
                self.is_closed = False
                if self._capture is None and self._opening is not None:
                    self._capture = self._opening()
                yield self._capture
        finally:
            if self.is_closed:
                self.close()

    def close(self) -> None:
        """Release the capture, at once or when the read under way returns."""
        self.is_closed = True
        if self.is_ours and self._reading.acquire(blocking=False):
            try:
                capture, self._capture = self._capture, None
                if capture is not None:
                    capture.release()
            finally:
                self._reading.release()


class Live:
    """The newest frames of a device or a stream.

    Parameters
    ----------
    handle
        Of the capture.
    name
        What errors call it.
    fps
        Frames per second at most. All are taken from the driver, so that none grows old there; those in between are
        not decoded. None: every frame.
    """

    def __init__(self, handle: Handle, name: str, fps: float | None = None) -> None:
        self._handle, self._name = handle, name
        self._period_s = 0.0 if fps is None else 1 / fps
        self._due_s = -math.inf
        self._misses = 0

    def read(self) -> Any:
        """Return the next frame; None if `close` was called meanwhile.

        Raises
        ------
        CameraUnavailable
            It gave none. A device that we have opened is opened again if that goes on.
        """
        with self._handle.reading() as capture:
            done, image = self._next(capture)
        if done or self._handle.is_closed:
            self._misses = 0
            return image
        self._misses += 1
        if self._misses % _MISSES == 0:
            self._handle.close()
        raise CameraUnavailable(self._name, f"{self._name} gave no frame.")

    def _next(self, capture: Any) -> tuple[bool, Any]:
        while capture.grab():
            if self._handle.is_closed:
                break
            if monotonic() >= self._due_s:
                self._due_s = next_due_s(self._due_s, self._period_s)
                done, image = capture.retrieve()
                return done, image if done else None
        return False, None

    def close(self) -> None:
        """Let go of the device; a read under way returns after its frame."""
        self._handle.close()

    def __repr__(self) -> str:
        return f"<Live: {self._name:.60}>"


class Video:
    """The frames of a video file, as fast as they are asked for.

    Parameters
    ----------
    handle
        Of the capture.
    name
        For its repr.
    loop
        Whether it begins anew after the last frame.
    """

    def __init__(self, handle: Handle, name: str, loop: bool = True) -> None:
        self._handle, self._name, self._loop = handle, name, loop

    def read(self) -> Any:
        """Return the next frame; None if there are no more."""
        with self._handle.reading() as capture:
            done, image = capture.read()
        if done or not self._loop or self._handle.is_closed:
            return image if done else None
        return self._again()

    def _again(self) -> Any:
        if self._handle.is_ours:
            # Not every format can be set back.
            self._handle.close()
        with self._handle.reading() as capture:
            if not self._handle.is_ours:
                capture.set(_position(), 0)
            done, image = capture.read()
        return image if done else None

    def close(self) -> None:
        """Let go of the file; the next `read` begins anew."""
        self._handle.close()

    def __repr__(self) -> str:
        return f"<Video: {self._name:.60}>"


def device(source: int | str, fps: float | None) -> Live:
    """Open the device of a number, or the stream of a URL.

    Raises
    ------
    CameraUnavailable
        It can't be opened.
    """
    # A URL may hold a password.
    name = "Camera " + (str(source) if isinstance(source, int) else re.sub(r"//[^/@]*@", "//", source))

    def opening() -> Any:
        capture = _open(source)
        if not capture.isOpened():
            text = f"{name} can't be opened. Check that it is connected and that no other program uses it."
            raise CameraUnavailable(name, text)
        return capture

    return Live(Handle(opening(), opening), name, fps)


def video_file(path: Path, loop: bool) -> tuple[Video, float]:
    """Open a video file; return it and its frames per second, 0 if it does not say.

    Raises
    ------
    ImageFileError
        It can't be read.
    """

    def opening() -> Any:
        capture = _open(str(path))
        if not capture.isOpened():
            text = f"{str(path)!r} is neither an image nor a video that OpenCV can read."
            raise ImageFileError(str(path), text)
        return capture

    capture = opening()
    return Video(Handle(capture, opening), path.name, loop), recorded_fps(capture)


def is_recorded(capture: Any) -> bool:
    """Whether a capture is of a file, which has an end and never runs ahead."""
    with optional_import():
        import cv2

    return bool(capture.get(cv2.CAP_PROP_FRAME_COUNT) > 0)


def require_open(capture: Any) -> None:
    """Raise CameraUnavailable unless a capture is open."""
    if not capture.isOpened():
        raise CameraUnavailable("The capture", "The capture that was given is not open. Check it with isOpened().")


def _open(source: int | str) -> Any:
    with optional_import():
        import cv2

    with quiet():
        return cv2.VideoCapture(source)


def recorded_fps(capture: Any) -> float:
    """Return the frames per second that a video file says; 0 if it says nothing sensible."""
    with optional_import():
        import cv2

    fps = float(capture.get(cv2.CAP_PROP_FPS))
    return fps if 0 < fps <= 1_000 else 0.0


def _position() -> int:
    with optional_import():
        import cv2

    return int(cv2.CAP_PROP_POS_FRAMES)
