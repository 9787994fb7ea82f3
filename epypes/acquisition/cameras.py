"""Which source of images becomes which camera?"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from numbers import Integral
from pathlib import Path
from typing import Any, Final

from epypes.acquisition import captures
from epypes.acquisition.files import read_image
from epypes.acquisition.pace import Camera, paced, require_fps
from epypes.acquisition.pictures import Sequence, Still, folder
from epypes.acquisition.quiet import quiet
from epypes.errors import ImageFileError
from epypes.optional import optional_import
from epypes.run.guard import is_array

# Of sources that would give frames as fast as a processor can.
USUAL_FPS: Final = 10.0
# OpenCV takes the number of a device as a C int.
LAST_DEVICE: Final = 2**31 - 1


def camera(source: Any, fps: float | None = None, *, loop: bool = True) -> Camera:
    """Return a camera: whatever gives images, behind ``read`` and ``close``.

    Parameters
    ----------
    source
        - the path of an image, of a folder (its images by name, ``img2`` before ``img10``) or of a video;
        - an array (y, x) or (y, x, channels): a copy of it again and again;
        - the number of a device, or the URL of a stream;
        - an opened ``cv2.VideoCapture``, which is yours to release, or a function that returns one, which is called
          again when the device has failed: so you can set what you like on it;
        - an iterable of arrays, an iterator or a generator, or a function that returns one;
        - an object with ``read`` and ``close`` of its own (`Camera`).
    fps
        Frames per second at most. None: 10 for an image, a folder and a list, as recorded for a video, and the source's
        own pace for all others. ``math.inf``: no waiting. Of a device, the frames in between are thrown away.
    loop
        Whether images, folders, videos, lists and what functions return begin anew after their last frame.

    Raises
    ------
    ImageFileError
        A file or folder can't be read.
    CameraUnavailable
        A device or stream can't be opened.
    TypeError, ValueError
        The source, or ``fps``, can't be one.

    Examples
    --------
    >>> import numpy as np
    >>> left = camera(np.zeros((4, 6), np.uint8), fps=100)
    >>> left.read().shape
    (4, 6)
    """
    if fps is not None:
        fps = require_fps(fps)
    if isinstance(source, str | Path):
        return _of_text(source, fps, loop)
    if isinstance(source, Integral) and not isinstance(source, bool):
        return _of_number(int(source), fps)
    if is_array(source):
        return paced(Still(source, loop), fps or USUAL_FPS)
    if _is_capture(source):
        return _of_capture(source, None, fps, loop)
    if _has_methods(source, "read", "close"):
        return paced(source, fps)
    return _of_many(source, fps, loop)


def has_twins(sources: Iterable[Any]) -> bool:
    """Whether a source that can be read by one thread only is there twice."""
    single = [
        id(source)
        for source in sources
        if _is_capture(source) or _has_methods(source, "read", "close") or isinstance(source, Iterator)
    ]
    return len(set(single)) < len(single)


def _of_text(source: str | Path, fps: float | None, loop: bool) -> Camera:
    if isinstance(source, str) and "://" in source:
        return captures.device(source, fps)
    path = Path(source)
    try:
        is_device, is_folder = path.is_char_device(), path.is_dir()
    except OSError as error:  # of a name that is too long
        text = f"Image '{source!s:.80}' can't be read: {error.strerror}. Check the path."
        raise ImageFileError(str(path), text) from error
    if is_device:
        return captures.device(str(path), fps)
    if is_folder:
        return paced(folder(path, loop), fps or USUAL_FPS)
    if not path.is_file() or _is_image(path):
        return paced(Still(read_image(path), loop), fps or USUAL_FPS)
    video, recorded_fps = captures.video_file(path, loop)
    return paced(video, fps or recorded_fps or USUAL_FPS)


def _is_image(path: Path) -> bool:
    with optional_import():
        import cv2

    # By its first bytes: reading the whole file as an image would load a film into the memory. What only is called like
    # an image would open as a film without a frame.
    with quiet():
        return bool(cv2.haveImageReader(str(path)) or (path.suffix and cv2.haveImageWriter(str(path))))


def _of_number(number: int, fps: float | None) -> Camera:
    if not 0 <= number <= LAST_DEVICE:
        raise ValueError(f"No camera has the number {number}. They go from 0 to {LAST_DEVICE}.")
    return captures.device(number, fps)


def _of_capture(capture: Any, opening: Callable[[], Any] | None, fps: float | None, loop: bool) -> Camera:
    captures.require_open(capture)
    handle = captures.Handle(capture, opening)
    if captures.is_recorded(capture):
        return paced(captures.Video(handle, "a capture", loop), fps or captures.recorded_fps(capture) or USUAL_FPS)
    return captures.Live(handle, "The capture", fps)


def _of_many(source: Any, fps: float | None, loop: bool) -> Camera:
    if isinstance(source, Iterator):
        return paced(Sequence(lambda: source, loop=False), fps)
    if isinstance(source, Iterable) and not isinstance(source, bytes | bytearray | memoryview | dict | set | frozenset):
        return paced(Sequence(lambda: source, loop), fps or USUAL_FPS)
    if callable(source):
        return _of_function(source, fps, loop)
    raise TypeError(
        f"A camera can't be made of {type(source).__name__!r}. Give a path, an array, the number of a device, a "
        "cv2.VideoCapture, an iterable of arrays, or an object with read() and close()."
    )


def _of_function(source: Callable[[], Any], fps: float | None, loop: bool) -> Camera:
    made = source()
    if _is_capture(made):
        return _of_capture(made, source, fps, loop)
    if not isinstance(made, Iterable) or is_array(made):
        name = getattr(source, "__qualname__", "The function")
        raise TypeError(
            f"{name} returned {type(made).__name__!r}, which a camera can't be made of. "
            "Return an iterator of arrays or a cv2.VideoCapture; a generator function does the former."
        )
    first = [made]
    return paced(Sequence(lambda: first.pop() if first else source(), loop), fps)


def _is_capture(source: Any) -> bool:
    return _has_methods(source, "grab", "retrieve", "release")


def _has_methods(source: Any, *names: str) -> bool:
    return not isinstance(source, type) and all(callable(getattr(source, name, None)) for name in names)
