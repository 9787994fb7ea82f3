"""Cameras made of paths, arrays, devices, iterables and functions."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from numbers import Integral
from pathlib import Path
from typing import Any, Final

from epypes.acquisition.files import image_files, quiet_opencv, read_image
from epypes.acquisition.frames import lasting_copy
from epypes.acquisition.pace import USUAL_FPS, Camera, paced, require_fps
from epypes.errors import ImageFileError
from epypes.optional import optional_import
from epypes.run.guard import is_array

# OpenCV takes the number of a device as a C int.
LAST_DEVICE: Final = 2**31 - 1


def camera(source: Any, fps: float | None = None, *, loop: bool = True) -> Camera:
    """Return a camera: any source of images, behind ``read`` and ``close``.

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
        return paced(StillCamera(source, loop), fps or USUAL_FPS)
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
    with optional_import():
        from epypes.acquisition.captures import device_camera, video_camera
    if isinstance(source, str) and "://" in source:
        return device_camera(source, fps)
    path = Path(source)
    try:
        is_device, is_folder = path.is_char_device(), path.is_dir()
    except OSError as error:  # of a name that is too long
        text = f"Image '{source!s:.80}' can't be read: {error.strerror}. Check the path."
        raise ImageFileError(str(path), text) from error
    if is_device:
        return device_camera(str(path), fps)
    if is_folder:
        return paced(_folder_camera(path, loop), fps or USUAL_FPS)
    if not path.is_file() or _is_image(path):
        return paced(StillCamera(read_image(path), loop), fps or USUAL_FPS)
    return video_camera(path, fps, loop)


def _is_image(path: Path) -> bool:
    """Whether a file has the first bytes of an image, or is named as one, which would open as an empty film.

    It is not read as an image: that would load a film into the memory.
    """
    with optional_import():
        import cv2
    with quiet_opencv():
        return bool(cv2.haveImageReader(str(path)) or (path.suffix and cv2.haveImageWriter(str(path))))


def _folder_camera(path: Path, loop: bool) -> SequenceCamera:
    """Return a camera that reads the images of a folder, by name; a file with an image's ending that is none is named.

    Hidden files, folders and files without the ending of an image are left out.
    """
    with optional_import():
        import cv2
    files = image_files(path)
    if not files:
        raise ImageFileError(str(path), f"There are no images in folder {str(path)!r}. Put PNG, JPEG or TIFF into it.")
    with quiet_opencv():
        broken = [file for file in files if not cv2.haveImageReader(str(file))]
    if broken:
        read_image(broken[0])  # which says more, if it fails too
        raise ImageFileError(str(broken[0]), f"{str(broken[0])!r} is not an image that OpenCV can read. Take it out.")
    return SequenceCamera(lambda: map(read_image, files), loop)


def _of_number(number: int, fps: float | None) -> Camera:
    with optional_import():
        from epypes.acquisition.captures import device_camera
    if not 0 <= number <= LAST_DEVICE:
        raise ValueError(f"No camera has the number {number}. They go from 0 to {LAST_DEVICE}.")
    return device_camera(number, fps)


def _of_capture(capture: Any, opening: Callable[[], Any] | None, fps: float | None, loop: bool) -> Camera:
    with optional_import():
        from epypes.acquisition.captures import capture_camera
    return capture_camera(capture, opening, fps, loop)


def _of_many(source: Any, fps: float | None, loop: bool) -> Camera:
    if isinstance(source, Iterator):
        return paced(SequenceCamera(lambda: source, loop=False), fps)
    if isinstance(source, Iterable) and not isinstance(source, bytes | bytearray | memoryview | dict | set | frozenset):
        return paced(SequenceCamera(lambda: source, loop), fps or USUAL_FPS)
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
    return paced(SequenceCamera(lambda: first.pop() if first else source(), loop), fps)


def _is_capture(source: Any) -> bool:
    return _has_methods(source, "grab", "retrieve", "release")


def _has_methods(source: Any, *names: str) -> bool:
    return not isinstance(source, type) and all(callable(getattr(source, name, None)) for name in names)


# -- images in files or in memory --------------------------------------------------------------------------------------


class StillCamera:
    """The same image again and again, or once.

    Parameters
    ----------
    image
        (y, x) or (y, x, channels); a copy is taken, and every frame is that copy.
    loop
        Whether it comes again after the first time.
    """

    def __init__(self, image: Any, loop: bool = True) -> None:
        self._image = lasting_copy(image)
        self._loop, self._was_given = loop, False

    def read(self) -> Any:
        """Return the image; None from the second time on, if it comes only once."""
        if self._was_given and not self._loop:
            return None
        self._was_given = True
        return self._image

    def close(self) -> None:
        """Begin anew."""
        self._was_given = False

    def __repr__(self) -> str:
        return f"<StillCamera: {self._image.shape} {self._image.dtype}>"


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
                return _required(item)
            if not self._loop:
                return None
        self._items = items = iter(self._start())
        # A round without any item would be followed by others for ever.
        for item in items:
            return _required(item)
        return None

    def close(self) -> None:
        """Begin anew with the next `read`; an iterator, which can't, goes on where it was."""
        self._items = None

    def __repr__(self) -> str:
        return f"<SequenceCamera of {getattr(self._start, '__qualname__', 'frames'):.60}>"


def _required(item: Any) -> Any:
    if item is None:
        raise TypeError("The iterator gave None, which is no image. Let it end, or wait inside it for the next one.")
    return item
