"""How are images that lie still, in files or in memory, given as frames?"""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, Final

from epypes.acquisition.files import read_image
from epypes.acquisition.frames import lasting_copy
from epypes.acquisition.quiet import quiet
from epypes.errors import ImageFileError
from epypes.optional import optional_import

# Endings of what OpenCV reads. A folder may hold notes and tables too; but a file that says it is an image must be one.
IMAGE_ENDINGS: Final = frozenset(
    {".avif", ".bmp", ".dib", ".exr", ".gif", ".hdr", ".jp2", ".jpe", ".jpeg", ".jpg", ".pbm"}
    | {".pgm", ".png", ".pnm", ".ppm", ".ras", ".sr", ".tif", ".tiff", ".webp"}
)


class Still:
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
        return f"<Still: {self._image.shape} {self._image.dtype}>"


class Sequence:
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
        return f"<Sequence of {getattr(self._start, '__qualname__', 'frames'):.60}>"


def _required(item: Any) -> Any:
    if item is None:
        raise TypeError("The iterator gave None, which is no image. Let it end, or wait inside it for the next one.")
    return item


def folder(path: Path, loop: bool = True) -> Sequence:
    """Return a camera that reads the images of a folder from their files, by name: ``img2`` before ``img10``.

    Hidden files, folders and files without the ending of an image are left out.

    Raises
    ------
    ImageFileError
        There are no images in it, or a file has the ending of an image and is none; that file is named.
    """
    with optional_import():
        import cv2

    files = image_files(path)
    if not files:
        raise ImageFileError(str(path), f"There are no images in folder {str(path)!r}. Put PNG, JPEG or TIFF into it.")
    with quiet():
        broken = [file for file in files if not cv2.haveImageReader(str(file))]
    for file in itertools.islice(broken, 1):
        read_image(file)
        raise ImageFileError(str(file), f"{str(file)!r} is not an image that OpenCV can read. Take it out.")
    return Sequence(lambda: map(read_image, files), loop)


def image_files(path: Path) -> list[Path]:
    """Return the files of a folder that have the ending of an image, by name: ``img2`` before ``img10``.

    Raises
    ------
    ImageFileError
        The folder can't be read.
    """
    try:
        return sorted((file for file in path.iterdir() if _is_named_as_image(file)), key=natural_order)
    except OSError as error:
        raise ImageFileError(str(path), f"Folder {str(path)!r} can't be read: {error.strerror}.") from error


def _is_named_as_image(file: Path) -> bool:
    return file.suffix.lower() in IMAGE_ENDINGS and not file.name.startswith(".") and file.is_file()


def natural_order(file: Path) -> tuple[list[str | int], str]:
    """Return what files are sorted by, so that ``img2`` comes before ``img10``."""
    # Texts and numbers alternate, so only like is compared with like.
    parts = re.split(r"(\d+)", file.name.casefold())
    return [int(part) if place % 2 else part for place, part in enumerate(parts)], file.name
