"""Cameras made of paths, arrays, devices, streams, videos, iterables and functions, and their frames per second."""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Callable, Iterable, Iterator
from functools import partial
from numbers import Integral, Real
from pathlib import Path
from time import monotonic
from typing import Any, Final, Protocol, TypeVar, cast, runtime_checkable

from epypes.acquisition.device import BACKENDS, DeviceCamera
from epypes.acquisition.device_owner import DeviceOwner
from epypes.acquisition.files import image_files, is_image_file, quiet_opencv, read_image
from epypes.acquisition.frames import Frame, frame_image, frame_of, frames_read, next_due_s
from epypes.acquisition.video import Video
from epypes.errors import CameraUnavailable, ImageFileError, InvalidType, InvalidValue
from epypes.optional import optional_import
from epypes.run.guard import is_array

# OpenCV takes the number of a device as a C int.
LAST_DEVICE: Final = 2**31 - 1
# Of sources that would give frames as fast as a processor can.
USUAL_FPS: Final = 10.0
# Reads in a row that give nothing, after which a device is opened again. That takes a second, so not after the first.
_MISSES: Final = 3


T = TypeVar("T")


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


class IterableCamera(Camera, Protocol):
    """A camera whose frames come in a loop, too: ``for frame in camera``."""

    def __iter__(self) -> Iterator[Frame]:
        """Yield frames with their numbers, from 0: those of a file or folder once, those of a device without end.

        A video's frames have their times; those that are damaged are left out. Nothing waits for the time of the next
        frame unless ``fps`` was given.
        """


def camera(source: Any, fps: float | None = None, *, loop: bool = True) -> IterableCamera:
    """Return a camera: any source of images, behind ``read`` and ``close``, and as an iterable of frames.

    Parameters
    ----------
    source
        - the path of an image, of a folder (its images by name, ``img2`` before ``img10``) or of a video, and what
          `epypes.video` returns;
        - an array (y, x) or (y, x, channels): a copy of it again and again;
        - the number of a device, or the URL of a stream;
        - the address of a camera with a node map, as ``epypes cameras`` lists them: ``"basler:SERIAL"`` by pylon,
          ``"genicam:SERIAL"`` for any of GigE Vision or USB3 Vision. It has ``settings``, ``trigger()`` and ``counts``:
          see `DeviceCamera`. A device belongs to the camera that opened it, until ``close()``; ``read()`` opens it
          again. A notebook's cell that is run again closes its former camera, unless something reads it;
        - an opened ``cv2.VideoCapture``, which is yours to release, or a function that returns one, which is called
          again when the device has failed: so you can set what you like on it;
        - an iterable of arrays, an iterator or a generator, or a function that returns one;
        - an object with ``read`` and ``close`` of its own (`Camera`), which is returned as it is if ``fps`` is None.
    fps
        Frames per second at most. None: 10 for an image, a folder and a list, as recorded for a video, and the source's
        own pace for all others. ``math.inf``: no waiting. Of a device, the frames in between are thrown away.
    loop
        Whether images, folders, videos, lists and what functions return begin anew after their last frame when they are
        read. A ``for`` over the camera has them once.

    Raises
    ------
    ImageFileError
        A file or folder can't be read.
    CameraUnavailable
        A device or stream can't be opened, or another camera of this process has the device.
    MissingPackage
        The library of such a camera is not installed.
    TypeError, ValueError
        The source, or ``fps``, can't be one.

    Examples
    --------
    >>> import numpy as np
    >>> left = camera(np.zeros((4, 6), np.uint8), fps=100)
    >>> left.read().shape
    (4, 6)
    >>> next(iter(left)).image.shape
    (4, 6)
    """
    if fps is not None and (isinstance(fps, bool) or not isinstance(fps, Real) or not fps > 0):
        raise InvalidValue(f"fps must be a number above 0, or None for the source's own pace, not {fps!r:.40}.")
    if isinstance(source, str) and source.startswith(tuple(f"{kind}:" for kind in BACKENDS)):
        return DeviceCamera(source, fps)
    if isinstance(source, str) and "://" in source:
        return _of_capture(source, fps, loop)
    if isinstance(source, str | Path):
        return _of_path(Path(source), fps, loop)
    if isinstance(source, Integral) and not isinstance(source, bool):
        if not 0 <= int(source) <= LAST_DEVICE:
            raise InvalidValue(f"No camera has the number {source}. They go from 0 to {LAST_DEVICE}.")
        return _of_capture(int(source), fps, loop)
    if is_array(source):
        return _still_camera(source, fps, loop)
    if _is_capture(source):
        return _of_capture(source, fps, loop)
    if _is_camera(source):
        return paced(source, fps)
    if isinstance(source, Iterable) and not isinstance(source, bytes | bytearray | memoryview | dict | set | frozenset):
        return _of_iterable(source, fps, loop)
    if callable(source):
        return _of_function(source, fps, loop)
    raise InvalidType(
        f"A camera can't be made of {type(source).__name__!r}. Give a path, an array, the number of a device, a "
        "cv2.VideoCapture, an iterable of arrays, or an object with read() and close()."
    )


def _of_iterable(source: Iterable[Any], fps: float | None, loop: bool) -> IterableCamera:
    if isinstance(source, Iterator):
        return paced(SequenceCamera(lambda: source, loop=False), fps)
    if isinstance(source, Video):
        return paced(SequenceCamera(source.frames, loop), fps, source.fps or USUAL_FPS)
    return paced(SequenceCamera(lambda: source, loop), fps, USUAL_FPS)


def has_twins(sources: Iterable[Any]) -> bool:
    """Whether a source that can be read by one thread only is there twice."""
    single = [
        id(source) for source in sources if _is_capture(source) or _is_camera(source) or isinstance(source, Iterator)
    ]
    return len(set(single)) < len(single)


def _of_capture(source: Any, fps: float | None, loop: bool, opening: Callable[[], Any] | None = None) -> IterableCamera:
    """Return the camera on a device, a stream, or a capture that the caller has opened.

    Parameters
    ----------
    source
        The number or path of a device or the URL of a stream, both as int or str; a capture.
    fps, loop
        As of `epypes.camera`.
    opening
        Returns such a capture again. Without it, a capture belongs to the caller and stays open.
    """
    with optional_import():
        import cv2

    if isinstance(source, int | str):
        # A URL may hold a password.
        name = "Camera " + re.sub(r"//[^/@]*@", "//", str(source))
        return LiveCamera(name, None, partial(_opened, source, name), fps, _device_of(source))
    if not source.isOpened():
        raise CameraUnavailable("The capture", "The capture that was given is not open. Check it with isOpened().")
    # A file has an end, and never runs ahead.
    if source.get(cv2.CAP_PROP_FRAME_COUNT) > 0:
        return _capture_camera(source, opening, fps, loop)
    return LiveCamera("The capture", source, opening, fps)


def _device_of(source: int | str) -> str:
    """Return the device file of a source that one camera has for itself; "" for a stream, which many may read."""
    if isinstance(source, int):
        return f"/dev/video{source}"
    return "" if "://" in source else str(Path(source).resolve())


def _opened(source: int | str, name: str) -> Any:
    import cv2

    with quiet_opencv():
        capture = cv2.VideoCapture(source)
    if not capture.isOpened():
        text = f"{name} can't be opened. Check that it is connected and that no other program uses it."
        raise CameraUnavailable(name, text)
    return capture


def _of_path(path: Path, fps: float | None, loop: bool) -> IterableCamera:
    try:
        is_device, is_folder = path.is_char_device(), path.is_dir()
    except OSError as error:  # of a name that is too long
        text = f"Image '{path!s:.80}' can't be read: {error.strerror}. Check the path."
        raise ImageFileError(str(path), text) from error
    if is_device or (path.parts[:2] == ("/", "dev") and not path.exists()):
        return _of_capture(str(path), fps, loop)
    if is_folder:
        files = image_files(path)
        if not files:
            text = f"There are no images in folder {str(path)!r}. Put PNG, JPEG or TIFF into it."
            raise ImageFileError(str(path), text)
        return paced(SequenceCamera(lambda: map(read_image, files), loop), fps, USUAL_FPS)
    if not path.exists() and not path.suffix:
        text = f"There is no file or folder {str(path)!r}, and no such camera. Write "
        text += f"{', '.join(f'{kind}:SERIAL' for kind in BACKENDS)}, /dev/video0, or the URL of a stream; "
        raise ImageFileError(str(path), f"{text}`epypes cameras` lists what is there.")
    if not path.is_file() or is_image_file(path):
        return _still_camera(read_image(path), fps, loop)
    video = Video(path)
    # Opened anew for each round: the file may be another one by then.
    opened = _again(video, lambda: Video(path))
    return paced(SequenceCamera(lambda: opened().frames(), loop), fps, video.fps or USUAL_FPS)


def _still_camera(image: Any, fps: float | None, loop: bool) -> IterableCamera:
    frame = frame_image([image])
    return paced(SequenceCamera(lambda: (frame,), loop), fps, USUAL_FPS)


def _of_function(source: Callable[[], Any], fps: float | None, loop: bool) -> IterableCamera:
    made = source()
    if _is_capture(made):
        return _of_capture(made, fps, loop, source)
    if not isinstance(made, Iterable) or is_array(made):
        name = getattr(source, "__qualname__", "The function")
        raise InvalidType(
            f"{name} returned {type(made).__name__!r}, which a camera can't be made of. "
            "Return an iterator of arrays or a cv2.VideoCapture; a generator function does the former."
        )
    return paced(SequenceCamera(_again(made, source), loop), fps)


def _again(made: T, make: Callable[[], T]) -> Callable[[], T]:
    """Return a function that gives what is made already, and makes it again from its second call on."""
    first = [made]
    return lambda: first.pop() if first else make()


def _is_capture(source: Any) -> bool:
    return _has_methods(source, "grab", "retrieve", "release")


def _is_camera(source: Any) -> bool:
    return _has_methods(source, "read", "close")


def _has_methods(source: Any, *names: str) -> bool:
    return not isinstance(source, type) and all(callable(getattr(source, name, None)) for name in names)


class SequenceCamera:
    """The items of an iterable, one after the other, and from the beginning again.

    Parameters
    ----------
    start
        Returns an iterable; called when the first frame is wanted, and for each further round.
    loop
        Whether there is another round.
    """

    def __init__(self, start: Callable[[], Iterable[Any]], loop: bool = True) -> None:
        self._start, self._loop = start, loop
        self._items: Iterator[Any] | None = None

    def read(self) -> Any:
        """Return the next item; None if there are no more."""
        items = self._items
        if items is not None:
            for item in items:
                return _image(item)
            if not self._loop:
                return None
        self._items = items = iter(self._start())
        # A round without any item would be followed by others for ever.
        for item in items:
            return _image(item)
        return None

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames of one round."""
        for number, item in enumerate(self._start()):
            yield item if isinstance(item, Frame) else frame_of([_image(item)], number)

    def close(self) -> None:
        """Begin anew with the next `read`; an iterator, which can't, goes on where it was."""
        self._items = None


def _image(item: Any) -> Any:
    if item is None:
        raise InvalidType("The iterator gave None, which is no image. Let it end, or wait inside it for the next one.")
    return item.image if isinstance(item, Frame) else item


# -- frames per second ------------------------------------------------------------------------------------------------


class PacedCamera:
    """A camera that gives its first frame at once, and each further one when it is due.

    Parameters
    ----------
    camera
        Gives the frames.
    fps
        Frames per second. If the reader comes late, the next frame is due one period later: nothing is caught up.
    is_asked
        Whether the caller has asked for this pace, so that a ``for`` keeps to it.
    """

    def __init__(self, camera: Camera, fps: float, *, is_asked: bool = True) -> None:
        self._camera, self._period_s, self._is_asked = camera, 1 / fps, is_asked
        self._due_s = -math.inf
        self._closing = threading.Event()

    def read(self) -> Any:
        """Return the next frame when it is due; None if `close` was called meanwhile."""
        self._closing.clear()
        if self._closing.wait(min(self._due_s - monotonic(), threading.TIMEOUT_MAX)):
            return None
        self._due_s = next_due_s(self._due_s, self._period_s)
        return self._camera.read()

    def __iter__(self) -> Iterator[Frame]:
        """Yield the frames of the camera, when they are due if that was asked for; `close` ends the wait."""
        self._closing.clear()
        due_s = -math.inf
        # A user's own camera may have no loop.
        for frame in self._camera if isinstance(self._camera, Iterable) else frames_read(self._camera):
            if self._is_asked and self._closing.wait(min(due_s - monotonic(), threading.TIMEOUT_MAX)):
                return
            due_s = next_due_s(due_s, self._period_s)
            yield frame

    def close(self) -> None:
        """End the wait, and close the camera."""
        self._closing.set()
        self._camera.close()


def paced(camera: Camera, fps: float | None, usual_fps: float = math.inf) -> IterableCamera:
    """Return a camera that is kept to ``fps`` frames per second, of which None are the usual ones.

    With infinity it is the camera as it is.
    """
    kept_fps = usual_fps if fps is None else float(fps)
    if kept_fps == math.inf:
        return cast(IterableCamera, camera)
    return PacedCamera(camera, kept_fps, is_asked=fps is not None)


# -- on OpenCV's VideoCapture -----------------------------------------------------------------------------------------


class LiveCamera(DeviceOwner):
    """The newest frames of a device or a stream; one thread reads it, and any closes it.

    OpenCV must not release a capture while it is read, so the thread that is done last releases it.

    Parameters
    ----------
    name
        Of the camera, for errors.
    capture
        A capture that is open; None to open it now.
    opening
        Returns such a capture again, after `close`. Without it, the capture belongs to the caller and stays open.
    fps
        Frames per second at most. All are taken from the driver, so that none grows old there; those in between are
        not decoded. None: every frame.
    device
        What no other camera of this process opens meanwhile; "" for none.
    """

    def __init__(
        self, name: str, capture: Any, opening: Callable[[], Any] | None, fps: float | None, device: str = ""
    ) -> None:
        super().__init__()
        self._name, self._opening, self._device = name, opening, device
        self._period_s = 0.0 if fps is None else 1 / fps
        self._due_s = -math.inf
        self._misses = 0
        self._lock = threading.Lock()
        self._is_closed = False
        self._capture = self._open() if capture is None else capture

    def read(self) -> Any:
        """Return the next frame; None if `close` was called meanwhile.

        Raises
        ------
        CameraUnavailable
            It gave none. After three in a row, it is opened again, unless it is the caller's.
        """
        self._last_reader = threading.current_thread()
        with self._lock:
            self._is_closed = False
            if self._capture is None:
                self._capture = self._open()
            image = self._next(self._capture)
        is_closed = self._is_closed
        self._misses = 0 if is_closed or image is not None else self._misses + 1
        if is_closed or (self._misses and self._misses % _MISSES == 0):
            self.close()
        if self._misses:
            raise CameraUnavailable(self._name, f"{self._name} gave no frame.")
        return image

    def _open(self) -> Any:
        if self._device:
            self._own(self._device)
        try:
            return self._opening() if self._opening is not None else None
        except BaseException:
            self._disown()
            raise

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
                self._disown()
                self._lock.release()


def _capture_camera(capture: Any, opening: Callable[[], Any] | None, fps: float | None, loop: bool) -> IterableCamera:
    import cv2

    # A capture of ours is opened anew for each round, since not every format can be set back.
    opened = _again(capture, opening or (lambda: capture))

    def start() -> Iterator[Any]:
        return _frames(opened(), is_own=opening is not None, loop=loop)

    recorded_fps = float(capture.get(cv2.CAP_PROP_FPS))
    usual_fps = recorded_fps if 0 < recorded_fps <= 1_000 else USUAL_FPS
    return paced(SequenceCamera(start, loop), fps, usual_fps)


def _frames(capture: Any, *, is_own: bool, loop: bool) -> Iterator[Any]:
    """Yield the frames of a video; a capture of our own is released when the last frame or the reader is gone."""
    import cv2

    try:
        while (found := capture.read())[0]:
            yield found[1]
        if loop and not is_own:
            capture.set(cv2.CAP_PROP_POS_FRAMES, 0)
    finally:
        if is_own:
            capture.release()
