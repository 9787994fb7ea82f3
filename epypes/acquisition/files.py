"""Image files and folders of them: reading, writing, and their order by name."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import ImageFileError
from epypes.images import in_order
from epypes.optional import optional_import

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from epypes.images import Order

# Endings of the formats that OpenCV reads. A folder may hold notes and tables too.
IMAGE_ENDINGS: Final = frozenset(
    {".avif", ".bmp", ".dib", ".exr", ".gif", ".hdr", ".jp2", ".jpe", ".jpeg", ".jpg", ".pbm"}
    | {".pgm", ".png", ".pnm", ".ppm", ".ras", ".sr", ".tif", ".tiff", ".webp"}
)
# Endings of the containers that FFmpeg reads with times.
VIDEO_ENDINGS: Final = frozenset(
    {".3gp", ".asf", ".avi", ".flv", ".m2ts", ".m4v", ".mkv", ".mov", ".mp4", ".mpeg", ".mpg", ".mts", ".mxf", ".ogv"}
    | {".ts", ".webm", ".wmv"}
)
# cv2.utils.logging.LOG_LEVEL_SILENT
_SILENT: Final = 0
_quiet_lock = threading.Lock()
_quiet_blocks = 0
_level_before = 0


def read_image(path: str | Path, order: Order = "bgr") -> npt.NDArray[np.uint8 | np.uint16]:
    """Read an image file as OpenCV does, unchanged: (y, x), (y, x, 3) BGR or (y, x, 4) BGRA, uint8 or uint16.

    With ``order="rgb"``, RGB and RGBA.

    Raises
    ------
    ImageFileError
        There is no such file, or OpenCV does not know what is in it.
    """
    with optional_import("vision"):
        import cv2
        import numpy as np

    file = Path(path)
    try:
        data = np.frombuffer(file.read_bytes(), np.uint8)
    except OSError as error:
        text = f"Image {str(path)!r} can't be read: {error.strerror}. Check the path."
        raise ImageFileError(str(path), text) from error
    # Reading the bytes first tells a missing file from a broken one.
    with quiet_opencv():
        image: Any = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if data.size else None
    if image is None:
        text = f"{str(path)!r} is not an image that OpenCV can read. Use PNG, JPEG, TIFF, BMP or WebP."
        if is_video_name(file):
            text = f"{str(path)!r} is a video, where one image is wanted. Take a frame of it: ep.video(path)[0]."
        raise ImageFileError(str(path), text)
    return in_order(image, order)  # type: ignore[no-any-return]


def write_image(path: str | Path, image: npt.NDArray[Any], order: Order = "bgr") -> None:
    """Write an array as an image file, by its ending; ``.png`` keeps every value.

    Parameters
    ----------
    path
        The file.
    image
        bool, uint8 or uint16; (y, x), (y, x, 3) or (y, x, 4).
    order
        ``"bgr"`` or ``"rgb"``: what three and four channels are.

    Raises
    ------
    ImageFileError
        The array is no image that the format can hold, or the file can't be written.
    """
    with optional_import("vision"):
        import cv2
        import numpy as np

    shown = image.astype(np.uint8) * 255 if image.dtype == np.bool_ else image
    if shown.dtype not in (np.uint8, np.uint16) or shown.ndim not in (2, 3):
        kind = f"{image.dtype} {image.shape}"
        raise ImageFileError(str(path), f"An array of {kind} can't be written as an image. Use a file ending in .npy.")
    try:
        _, data = cv2.imencode(Path(path).suffix, in_order(shown, order))
    except cv2.error as error:
        text = f"OpenCV can't write {str(path)!r}: no such format as {Path(path).suffix!r}. Use .png."
        raise ImageFileError(str(path), text) from error
    try:
        Path(path).write_bytes(data.tobytes())
    except OSError as error:
        raise ImageFileError(str(path), f"{str(path)!r} can't be written: {error.strerror}.") from error


def image_files(path: Path) -> list[Path]:
    """Return the files of a folder that have the ending of an image, by name: ``img2`` before ``img10``.

    Raises
    ------
    ImageFileError
        The folder can't be read.
    """
    try:
        named = (file for file in path.iterdir() if file.suffix.lower() in IMAGE_ENDINGS and file.name[0] != ".")
        return sorted(filter(Path.is_file, named), key=natural_order)
    except OSError as error:
        raise ImageFileError(str(path), f"Folder {str(path)!r} can't be read: {error.strerror}.") from error


def is_video_name(path: Path) -> bool:
    """Whether a path has the ending of a video."""
    return path.suffix.lower() in VIDEO_ENDINGS


def is_image_file(path: Path) -> bool:
    """Whether a file has the first bytes of an image, or is named as one, which would open as an empty film.

    It is not read as an image: that would load a film into the memory.
    """
    with optional_import("vision"):
        import cv2

    with quiet_opencv():
        return bool(cv2.haveImageReader(str(path)) or (path.suffix and cv2.haveImageWriter(str(path))))


def natural_order(file: Path) -> tuple[list[str | int], str]:
    """Return the key that sorts files so that ``img2`` comes before ``img10``."""
    # Texts and numbers alternate, so texts are compared with texts, and numbers with numbers.
    parts = re.split(r"(\d+)", file.name.casefold())
    return [int(part) if place % 2 else part for place, part in enumerate(parts)], file.name


@contextmanager
def quiet_opencv() -> Iterator[None]:
    """Silence OpenCV's log in a block whose failures are reported as errors.

    The level belongs to the whole process and cameras read side by side, so the last block to end sets it back.
    """
    global _quiet_blocks, _level_before
    with optional_import():
        import cv2

    # Up to OpenCV 4.12 the function is in cv2 itself. It returns the level before.
    set_level = getattr(cv2.utils, "logging", cv2).setLogLevel
    with _quiet_lock:
        _quiet_blocks += 1
        if _quiet_blocks == 1:
            _level_before = set_level(_SILENT)
    try:
        yield
    finally:
        with _quiet_lock:
            _quiet_blocks -= 1
            if _quiet_blocks == 0:
                set_level(_level_before)
