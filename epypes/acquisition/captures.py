"""Cameras on OpenCV's VideoCapture: devices, streams and video files."""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from time import monotonic
from typing import Any, Final

import cv2

from epypes.acquisition.cameras import USUAL_FPS, Camera, SequenceCamera, next_due_s, paced
from epypes.acquisition.files import quiet_opencv
from epypes.errors import CameraUnavailable, ImageFileError

# Reads in a row that give nothing, after which a device is opened again. That takes a second, so not after the first.
_MISSES: Final = 3


def capture_camera(source: Any, fps: float | None, loop: bool, opening: Callable[[], Any] | None = None) -> Camera:
    """Return the camera on a device, a stream, a video file, or a capture that the caller has opened.

    Parameters
    ----------
    source
        The number or path of a device or the URL of a stream, both as int or str; the Path of a video file; a capture.
    fps, loop
        As of `epypes.camera`.
    opening
        Returns such a capture again. Without it, a capture belongs to the caller and stays open.

    Raises
    ------
    CameraUnavailable
        A device, a stream or a capture is not open.
    ImageFileError
        A file can't be read.
    """
    if isinstance(source, int | str):
        # A URL may hold a password.
        name = "Camera " + re.sub(r"//[^/@]*@", "//", str(source))
        text = f"{name} can't be opened. Check that it is connected and that no other program uses it."
        opening = partial(_opened, source, CameraUnavailable, name, text)
        return LiveCamera(name, opening(), opening, fps)
    if isinstance(source, Path):
        path = str(source)
        text = f"{path!r} is neither an image nor a video that OpenCV can read."
        opening = partial(_opened, path, ImageFileError, path, text)
        return _video_camera(opening(), opening, fps, loop)
    if not source.isOpened():
        raise CameraUnavailable("The capture", "The capture that was given is not open. Check it with isOpened().")
    # A file has an end, and never runs ahead.
    if source.get(cv2.CAP_PROP_FRAME_COUNT) > 0:
        return _video_camera(source, opening, fps, loop)
    return LiveCamera("The capture", source, opening, fps)


def _opened(source: int | str, kind: Callable[[str, str], Exception], name: str, text: str) -> Any:
    with quiet_opencv():
        capture = cv2.VideoCapture(source)
    if not capture.isOpened():
        raise kind(name, text)
    return capture


class LiveCamera:
    """The newest frames of a device or a stream; one thread reads it, and any closes it.

    OpenCV must not release a capture while it is read, so the thread that is done last releases it.

    Parameters
    ----------
    name
        Of the camera, for errors.
    capture
        A capture that is open.
    opening
        Returns such a capture again, after `close`. Without it, the capture belongs to the caller and stays open.
    fps
        Frames per second at most. All are taken from the driver, so that none grows old there; those in between are
        not decoded. None: every frame.
    """

    def __init__(self, name: str, capture: Any, opening: Callable[[], Any] | None, fps: float | None) -> None:
        self._name, self._capture, self._opening = name, capture, opening
        self._period_s = 0.0 if fps is None else 1 / fps
        self._due_s = -math.inf
        self._misses = 0
        self._lock = threading.Lock()
        self._is_closed = False

    def read(self) -> Any:
        """Return the next frame; None if `close` was called meanwhile.

        Raises
        ------
        CameraUnavailable
            It gave none. After three in a row, it is opened again, unless it is the caller's.
        """
        with self._lock:
            self._is_closed = False
            if self._capture is None and self._opening is not None:
                self._capture = self._opening()
            image = self._next(self._capture)
        is_closed = self._is_closed
        self._misses = 0 if is_closed or image is not None else self._misses + 1
        if is_closed or (self._misses and self._misses % _MISSES == 0):
            self.close()
        if self._misses:
            raise CameraUnavailable(self._name, f"{self._name} gave no frame.")
        return image

    def _next(self, capture: Any) -> Any:
        while capture.grab() and not self._is_closed:
            if monotonic() >= self._due_s:
                self._due_s = next_due_s(self._due_s, self._period_s)
                done, image = capture.retrieve()
                return image if done else None
        return None

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


def _video_camera(capture: Any, opening: Callable[[], Any] | None, fps: float | None, loop: bool) -> Camera:
    unread = [capture]

    def start() -> Iterator[Any]:
        if opening is None:
            return _frames(capture, is_own=False, loop=loop)
        # Opened anew for each round, since not every format can be set back.
        return _frames(unread.pop() if unread else opening(), is_own=True, loop=loop)

    recorded_fps = float(capture.get(cv2.CAP_PROP_FPS))
    usual_fps = recorded_fps if 0 < recorded_fps <= 1_000 else USUAL_FPS
    return paced(SequenceCamera(start, loop), fps or usual_fps)


def _frames(capture: Any, *, is_own: bool, loop: bool) -> Iterator[Any]:
    """Yield the frames of a video; a capture of our own is released when the last frame or the reader is gone."""
    try:
        while (found := capture.read())[0]:
            yield found[1]
        if loop and not is_own:
            capture.set(cv2.CAP_PROP_POS_FRAMES, 0)
    finally:
        if is_own:
            capture.release()
