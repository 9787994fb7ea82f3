"""Cameras on OpenCV's VideoCapture: devices, streams and video files."""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import Any, Final

import cv2

from epypes.acquisition.files import quiet_opencv
from epypes.acquisition.pace import USUAL_FPS, Camera, next_due_s, paced
from epypes.errors import CameraUnavailable, ImageFileError

# Reads in a row that give nothing, after which a device is opened again. That takes a second, so not after the first.
_MISSES: Final = 3


class _CaptureCamera:
    """A capture that is open while it is needed; it is read by one thread and closed from any.

    OpenCV must not release a capture while it is read, so the thread that is done last releases it.

    Parameters
    ----------
    name
        Of the camera, for errors.
    capture
        A capture that is open.
    opening
        Returns such a capture again, after `close`. Without it, the capture belongs to the caller and stays open.
    """

    def __init__(self, name: str, capture: Any, opening: Callable[[], Any] | None) -> None:
        self._name, self._capture, self._opening = name, capture, opening
        self._lock = threading.Lock()
        self._is_closed = False

    @contextmanager
    def _reading(self) -> Iterator[Any]:
        """Hold the capture for a read; open it if it is closed."""
        try:
            with self._lock:
                self._is_closed = False
                if self._capture is None and self._opening is not None:
                    self._capture = self._opening()
                yield self._capture
        finally:
            if self._is_closed:
                self.close()

    def close(self) -> None:
        """Release the capture, at once or when the read under way returns."""
        self._is_closed = True
        if self._opening is not None and self._lock.acquire(blocking=False):
            try:
                capture, self._capture = self._capture, None
                if capture is not None:
                    capture.release()
            finally:
                self._lock.release()

    def __repr__(self) -> str:
        return f"<{type(self).__name__}: {self._name:.60}>"


class LiveCamera(_CaptureCamera):
    """The newest frames of a device or a stream.

    Parameters
    ----------
    name, capture, opening
        Of the capture.
    fps
        Frames per second at most. All are taken from the driver, so that none grows old there; those in between are
        not decoded. None: every frame.
    """

    def __init__(self, name: str, capture: Any, opening: Callable[[], Any] | None, fps: float | None) -> None:
        super().__init__(name, capture, opening)
        self._period_s = 0.0 if fps is None else 1 / fps
        self._due_s = -math.inf
        self._misses = 0

    def read(self) -> Any:
        """Return the next frame; None if `close` was called meanwhile.

        Raises
        ------
        CameraUnavailable
            It gave none. After three in a row, it is opened again, unless it is the caller's.
        """
        with self._reading() as capture:
            done, image = self._next(capture)
        if done or self._is_closed:
            self._misses = 0
            return image
        self._misses += 1
        if self._misses % _MISSES == 0:
            self.close()
        raise CameraUnavailable(self._name, f"{self._name} gave no frame.")

    def _next(self, capture: Any) -> tuple[bool, Any]:
        while capture.grab():
            if self._is_closed:
                break
            if monotonic() >= self._due_s:
                self._due_s = next_due_s(self._due_s, self._period_s)
                done, image = capture.retrieve()
                return done, image if done else None
        return False, None


class VideoCamera(_CaptureCamera):
    """The frames of a video file, as fast as they are asked for.

    Parameters
    ----------
    name, capture, opening
        Of the capture.
    loop
        Whether it begins anew after the last frame.
    """

    def __init__(self, name: str, capture: Any, opening: Callable[[], Any] | None, loop: bool) -> None:
        super().__init__(name, capture, opening)
        self._loop = loop

    def read(self) -> Any:
        """Return the next frame; None if there are no more."""
        with self._reading() as capture:
            done, image = capture.read()
        if not done and self._loop and not self._is_closed:
            if self._opening is not None:
                # Opened anew, since not every format can be set back.
                self.close()
            with self._reading() as capture:
                if self._opening is None:
                    capture.set(cv2.CAP_PROP_POS_FRAMES, 0)
                done, image = capture.read()
        return image if done else None


def device_camera(source: int | str, fps: float | None) -> Camera:
    """Open the device of a number, or the stream of a URL.

    Raises
    ------
    CameraUnavailable
        It can't be opened.
    """
    # A URL may hold a password.
    name = "Camera " + (str(source) if isinstance(source, int) else re.sub(r"//[^/@]*@", "//", source))
    text = f"{name} can't be opened. Check that it is connected and that no other program uses it."

    def opening() -> Any:
        return _opened(source, CameraUnavailable(name, text))

    return LiveCamera(name, opening(), opening, fps)


def video_camera(path: Path, fps: float | None, loop: bool) -> Camera:
    """Open a video file.

    Raises
    ------
    ImageFileError
        It can't be read.
    """
    text = f"{str(path)!r} is neither an image nor a video that OpenCV can read."

    def opening() -> Any:
        return _opened(str(path), ImageFileError(str(path), text))

    capture = opening()
    return paced(VideoCamera(path.name, capture, opening, loop), fps or _recorded_fps(capture))


def capture_camera(capture: Any, opening: Callable[[], Any] | None, fps: float | None, loop: bool) -> Camera:
    """Return the camera on a capture that the caller has opened.

    Raises
    ------
    CameraUnavailable
        It is not open.
    """
    if not capture.isOpened():
        raise CameraUnavailable("The capture", "The capture that was given is not open. Check it with isOpened().")
    # A file has an end, and never runs ahead.
    if capture.get(cv2.CAP_PROP_FRAME_COUNT) > 0:
        return paced(VideoCamera("a capture", capture, opening, loop), fps or _recorded_fps(capture))
    return LiveCamera("The capture", capture, opening, fps)


def _opened(source: int | str, error: Exception) -> Any:
    with quiet_opencv():
        capture = cv2.VideoCapture(source)
    if not capture.isOpened():
        raise error
    return capture


def _recorded_fps(capture: Any) -> float:
    """Return the frames per second of a video file; the usual ones if it has no sensible number."""
    fps = float(capture.get(cv2.CAP_PROP_FPS))
    return fps if 0 < fps <= 1_000 else USUAL_FPS
