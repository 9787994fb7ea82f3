"""Video files as sequences of images: an index of times, frames that are read when they are asked for, a bounded cache.

PyAV reads the packets of a file once, without decoding them: that gives each frame's exact time and the key frames. A
frame is found by its time, never by a number of frames per second, so files of a variable frame rate are read exactly.
"""

from __future__ import annotations

import os
import threading
import time
from bisect import bisect_left, bisect_right
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, overload
from warnings import warn
from weakref import WeakValueDictionary

from epypes.acquisition.frames import Frame
from epypes.errors import ImageFileError
from epypes.images import swapped
from epypes.optional import optional_import

if TYPE_CHECKING:
    import numpy as np
    import numpy.typing as npt

    from epypes.images import Order

    Pixels = npt.NDArray[np.uint8]

# Of the images that one video keeps: 20 of 1080p. A step back need not decode again from the key frame before.
_CACHE_BYTES: Final = 128_000_000
# To decode so many frames on is cheaper than to seek.
_NEAR_FRAMES: Final = 32
# A container's duration is rounded, and its last frame may have none.
_MISSING_S: Final = 0.5
_BOX_HEADER: Final = 8
# The first version of PyAV that reads metadata in any encoding.
_ANY_METADATA: Final = 19


class Video(Sequence["Pixels"]):
    """The frames of a video file as a sequence of images, each read when it is asked for.

    ``video[3]`` is an image (y, x, 3), uint8, BGR, the very pixels that ``cv2.VideoCapture`` gives, turned as the file
    says, read-only. ``video[100:200:10]`` is a video again, of these frames alone. Any thread may read.

    Parameters
    ----------
    path
        The file, of any container and codec that PyAV decodes.

    Attributes
    ----------
    path
        The file.
    numbers
        The number of each frame in the file, from 0: a slice keeps them.

    Raises
    ------
    ImageFileError
        The file can't be read, is no video, has no frames, was cut off before its index was written, or has a codec
        that can't be decoded. Reading a damaged frame raises it, too.

    Warns
    -----
    UserWarning
        The file was cut off or is damaged: it has fewer frames than it announces.

    Notes
    -----
    At most 128 MB of images are kept. The file is opened when a frame is read, and closed by ``close`` or with the
    object.

    Examples
    --------
    ``video = Video("belt.avi")`` of 300 frames at 25 per second: ``len(video)`` is 300, ``video.times_s[:3]`` is
    (0.0, 0.04, 0.08), and ``video[-1]`` is the last image.
    """

    def __init__(self, path: str | Path) -> None:
        self._file = _VideoFile(Path(path))
        self.path: Path = self._file.path
        self.numbers: range = range(len(self._file.pts))

    @property
    def times_s(self) -> tuple[float, ...]:
        """The time of each frame in s since the first frame of the file."""
        return tuple(self._file.time_s(number) for number in self.numbers)

    def time_s(self, place: int) -> float:
        """Return the time of one frame in s since the first frame of the file."""
        return self._file.time_s(self.numbers[place])

    @property
    def fps(self) -> float:
        """The mean number of frames per second of the file; 0 for a single frame."""
        last_s = self._file.time_s(len(self._file.pts) - 1)
        return round((len(self._file.pts) - 1) / last_s, 6) if last_s else 0.0

    def frames(self) -> Iterator[Frame]:
        """Yield the frames with their numbers and times; those that are damaged are left out. None is kept."""
        for number in self.numbers:
            # Without a name here, which would be one more reference to the image, the reader need not copy it.
            with suppress(UnreadableFrame):
                yield Frame(self._file.image(number, is_kept=False), time.time_ns(), number, self._file.time_s(number))

    def image(self, number: int, order: Order = "bgr") -> Pixels:
        """Return the frame of a number in the file, with its colours in an order.

        Raises
        ------
        ImageFileError
            It is damaged.
        """
        image: Pixels = self._file.image(number, order)
        return image

    def number_of(self, image: object) -> int | None:
        """Return the number of the frame that an array was read from, of this file and still in use; else None."""
        return self._file.number_of(image)

    def require_unchanged(self) -> None:
        """Raise ImageFileError if the file is another one by now."""
        self._file.require_unchanged()

    def close(self) -> None:
        """Let go of the file and of the images that are kept; the next read opens it again."""
        self._file.close()

    def __len__(self) -> int:
        return len(self.numbers)

    @overload
    def __getitem__(self, index: int) -> Pixels: ...
    @overload
    def __getitem__(self, index: slice) -> Video: ...
    def __getitem__(self, index: int | slice) -> Pixels | Video:
        if not isinstance(index, slice):
            try:
                number = self.numbers[index]
            except IndexError:
                text = f"There is no frame {index} of {str(self.path)!r}: it has {len(self):,}, counted from 0."
                raise IndexError(text) from None
            return self.image(number)
        part: Video = object.__new__(Video)
        part._file, part.path, part.numbers = self._file, self.path, self.numbers[index]
        return part

    def __contains__(self, image: object) -> bool:
        return self.number_of(image) in self.numbers

    def __repr__(self) -> str:
        size = f"{len(self):,} frame{'s' * (len(self) != 1)}"
        lasts = self._file.time_s(self.numbers[-1]) - self._file.time_s(self.numbers[0]) if self.numbers else 0.0
        return f"<Video {self.path.name:.40}: {size}, {lasts:.3f} s>"


def video(path: str | Path) -> Video:
    """Return the frames of a video file as a sequence of images, each read when it is asked for.

    Parameters
    ----------
    path
        The file, of any container and codec that PyAV decodes.

    Returns
    -------
    Video
        Has a length, indices, slices, ``times_s`` and ``fps``. It is taken wherever images are: by ``ep.map``,
        ``ep.sweep``, ``ep.check``, ``ep.optimize``, ``ep.camera`` and ``tune``. So is the path of a file that has the
        ending of a video.

    Raises
    ------
    ImageFileError
        The file is no video, or can't be decoded; as for `Video`.
    """
    return Video(path)


@dataclass(frozen=True, slots=True)
class VideoFrame:
    """A frame of a video that is read when its image is asked for.

    Attributes
    ----------
    video
        The video.
    number
        The number of the frame in the file, from 0.
    """

    video: Video
    number: int

    @property
    def time_s(self) -> float:
        """Its time in s since the first frame of the file."""
        return self.video._file.time_s(self.number)

    @property
    def name(self) -> str:
        """The name of the file and the number: ``"belt.mp4 #17"``."""
        return f"{self.video.path.name} #{self.number}"

    @property
    def image(self) -> Pixels:
        """Its pixels, BGR; ImageFileError if they are damaged."""
        return self.video.image(self.number)

    def __repr__(self) -> str:
        return f"<VideoFrame {self.name}, {self.time_s:.3f} s>"


class UnreadableFrame(ImageFileError):
    """A frame of a video that is damaged."""


# -- the index --------------------------------------------------------------------------------------------------------


def _index_of(path: Path) -> tuple[tuple[int, ...], tuple[int, ...], Fraction, str]:
    """Read the packets of a video.

    Returns
    -------
    tuple
        The presentation time stamp of each frame that is shown and whole, rising; the time stamps of the key frames,
        rising, of which the first ones may not be shown; seconds per time stamp, exact; what the file announces and
        does not have, as text, "" if it is whole.
    """
    with optional_import("vision"):
        import av

    container, stream = _open(path)
    with closing(container):
        pts: set[int] = set()
        keys: set[int] = set()
        end_s, is_cut, packets = 0.0, False, 0
        try:
            for packet in container.demux():
                stamp = packet.dts if packet.pts is None else packet.pts
                # An .avi has empty packets where a frame was dropped; the last one of any file is empty, too.
                packets += packet.stream is stream and (packet.size > 0 or stamp is not None)
                if not packet.size:
                    continue
                if stamp is not None and packet.time_base is not None:
                    end_s = max(end_s, float((stamp + (packet.duration or 0)) * packet.time_base))
                is_cut = is_cut or packet.is_corrupt
                if packet.stream is not stream:
                    continue
                if stamp is None:
                    text = (
                        f"The frames of {str(path)!r} have no times. Put them into a container: ffmpeg -i {path.name} "
                    )
                    raise ImageFileError(str(path), f"{text}-c copy {path.stem}.mkv")
                if packet.is_keyframe:
                    keys.add(stamp)
                # Discarded is what an edit list leaves out; corrupt is a packet within which the file ends.
                if not packet.is_discard and not packet.is_corrupt:
                    pts.add(stamp)
        except av.FFmpegError:
            is_cut = True
        if not pts:
            raise ImageFileError(str(path), f"Video {str(path)!r} has no frames. Record it again.")
        announced_s = (container.duration or 0) / av.time_base
        lasts_s = end_s - (container.start_time or 0) / av.time_base
        is_cut = is_cut or stream.frames > packets or announced_s > lasts_s + max(_MISSING_S, announced_s / 100)
        has = f"{len(pts):,} of {stream.frames:,} frames" if stream.frames > len(pts) else f"{lasts_s:.1f} s of video"
        return tuple(sorted(pts)), tuple(sorted(keys)), Fraction(stream.time_base or 0), has if is_cut else ""


def _open(path: Path) -> tuple[Any, Any]:
    """Return the container of a video file and the stream of its frames.

    Raises
    ------
    ImageFileError
        With the reason why there are none.
    """
    with optional_import("vision"):
        import av

    name, (_, size, _) = str(path), _identity(path)
    if path.is_dir():
        text = (
            f"{name!r} is a folder, no video. ep.map and ep.camera take a folder of images; of videos, give one file."
        )
        raise ImageFileError(name, text)
    if not size:
        raise ImageFileError(name, f"{name!r} is empty. Copy or record the video again.")
    try:
        # PyAV 19 reads any metadata, and has no option for what is no UTF-8.
        lenient: dict[str, Any] = (
            {"metadata_errors": "ignore"} if int(av.__version__.partition(".")[0]) < _ANY_METADATA else {}
        )
        # An absolute path, since "rtsp:x.mp4" would be the address of a stream.
        container = av.open(str(path.absolute()), **lenient)
    except av.FFmpegError as error:
        raise ImageFileError(name, _unopened_text(path)) from error
    stream: Any = container.streams.best("video")
    if stream is None:
        container.close()
        raise ImageFileError(name, f"{name!r} has no video in it. Check the path, or record it again.")
    if stream.codec_context is None:
        container.close()
        text = f"The frames of {name!r} can't be decoded: PyAV has no codec for them. Convert it where there is one:"
        raise ImageFileError(name, f"{text} ffmpeg -i {path.name} -c:v libx264 {path.stem}_h264.mp4")
    stream.thread_type = "AUTO"
    return container, stream


def _unopened_text(path: Path) -> str:
    """Return why a file that FFmpeg does not open is no video."""
    boxes: list[bytes] = []
    with path.open("rb") as file:
        while len(header := file.read(2 * _BOX_HEADER)) >= _BOX_HEADER and boxes[:1] in ([], [b"ftyp"]):
            boxes.append(header[4:_BOX_HEADER])
            length = int.from_bytes(header[:4])
            if length == 1:
                length = int.from_bytes(header[_BOX_HEADER:])
            if length < _BOX_HEADER:
                break
            file.seek(length - len(header), os.SEEK_CUR)
    if boxes[:1] == [b"ftyp"] and b"moov" not in boxes:
        return (
            f"{str(path)!r} was cut off: its index is missing, which an .mp4 has at its end, so no frame can be found. "
            "Record it again; an .avi or .mkv can be read as far as it goes."
        )
    return f"{str(path)!r} is neither an image nor a video that can be read. Use .mp4, .avi, .mkv, .mov or .webm."


# -- frames -----------------------------------------------------------------------------------------------------------

_Identity = tuple[str, int, int]
# The images that are in use anywhere, of all videos: so a frame that is read twice is one array, and is known again.
_IN_USE: Final[WeakValueDictionary[tuple[_Identity, int, str], Any]] = WeakValueDictionary()


class _VideoFile:
    """An open video: where its decoder is, and the images that are kept.

    Parameters
    ----------
    path
        The file.

    Attributes
    ----------
    path, pts
        The file, and the time stamps of its frames.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.pts, self._keys, self._unit_s, missing = _index_of(path)
        self._identity = _identity(path)
        self._lock = threading.Lock()
        self._container: Any = None
        self._stream: Any = None
        self._decoded: Iterator[Any] = iter(())
        # The frame that was decoded last: the one that is wanted, or the first one behind it.
        self._frame: Any = None
        # How many key frames before the right one a seek must aim at, as in a transport stream.
        self._back = 0
        self._damaged: set[int] = set()
        self._kept: OrderedDict[int, Any] = OrderedDict()
        if missing:
            text = f"{str(path)!r} was cut off or is damaged: it has {missing}. These are used."
            warn(text, UserWarning, stacklevel=3)

    def time_s(self, number: int) -> float:
        """Return the time of a frame since the first one."""
        return float((self.pts[number] - self.pts[0]) * self._unit_s)

    def require_unchanged(self) -> None:
        """Raise ImageFileError if the file is another one than that of the index."""
        if _identity(self.path) != self._identity:
            text = f"{str(self.path)!r} has changed since it was opened. Open it again: ep.video(path)."
            raise ImageFileError(str(self.path), text)

    def image(self, number: int, order: Order = "bgr", *, is_kept: bool = True) -> Any:
        """Return a frame as an image; UnreadableFrame if it is damaged."""
        key = (self._identity, number, order)
        with self._lock:
            found = _IN_USE.get(key)
            if found is None:
                image = self._kept.get(number)
                if image is None:
                    image = self._read(number, is_kept=is_kept)
                found = image if order == "bgr" else _locked(swapped(image))
            elif order == "bgr" and is_kept:
                self._keep(number, found)
            if is_kept:
                _IN_USE[key] = found
            return found

    def number_of(self, image: object) -> int | None:
        """Return the number of the frame that an array in use was read from."""
        for (identity, number, _), known in list(_IN_USE.items()):
            if known is image and identity == self._identity:
                return number
        return None

    def close(self) -> None:
        """Close the file, and keep no image."""
        with self._lock:
            self._kept.clear()
            self._frame, self._decoded = None, iter(())
            container, self._container = self._container, None
            if container is not None:
                container.close()

    def _read(self, number: int, *, is_kept: bool) -> Any:
        if number in self._damaged:
            raise self._unreadable(number)
        wanted = self.pts[number]
        # Frames on the way back to an earlier one will be asked for next, by a slider.
        is_back = is_kept and self._frame is not None and wanted < self._frame.pts
        self._go_before(number)
        while self._frame is not None and self._frame.pts < wanted:
            if is_back:
                self._keep_passed(number)
            self._advance()
        frame = self._frame
        if frame is None or frame.pts != wanted or frame.is_corrupt:
            self._damaged.add(number)
            raise self._unreadable(number)
        image = _image_of(frame)
        if is_kept:
            self._keep(number, image)
        return image

    def _unreadable(self, number: int) -> UnreadableFrame:
        text = (
            f"Frame {number} of {str(self.path)!r} can't be decoded: the file is damaged there. Leave this frame out."
        )
        return UnreadableFrame(str(self.path), text)

    def _go_before(self, number: int) -> None:
        """Bring the decoder to a frame from which the wanted one is decoded, or to the wanted one."""
        wanted = self.pts[number]
        place = bisect_right(self._keys, wanted) - 1
        key = self._keys[place] if place >= 0 else wanted
        if self._frame is not None and self._frame.pts <= wanted:
            is_near = number - bisect_left(self.pts, self._frame.pts) <= _NEAR_FRAMES
            if is_near or self._frame.pts >= key:
                return
        step = self._back
        while (aim := place - step) > 0 and self._seek(self._keys[aim]):
            # What comes first after a seek must not be behind the key frame: frames before it may lack what they need.
            if self._frame is not None and self._frame.pts <= key:
                return
            self._back = step = 2 * step + 1
        self._start()

    def _seek(self, stamp: int) -> bool:
        import av

        if self._container is None:
            self._start()
        try:
            self._container.seek(stamp, stream=self._stream, backward=True)
        except av.FFmpegError:  # not every format can
            return False
        self._decoded = self._frames()
        self._frame = next(self._decoded, None)
        return True

    def _start(self) -> None:
        """Open the file anew, and decode its first frame."""
        if self._container is not None:
            self._container.close()
        self.require_unchanged()
        self._container, self._stream = _open(self.path)
        self._decoded = self._frames()
        self._frame = next(self._decoded, None)
        first = self._frame.pts if self._frame is not None else self.pts[-1] + 1
        self._damaged.update(range(bisect_left(self.pts, first)))

    def _frames(self) -> Iterator[Any]:
        import av

        for packet in self._container.demux(self._stream):
            try:
                frames = packet.decode()
            except av.FFmpegError:  # a damaged packet: its frame is missing, and others may come
                continue
            for frame in frames:
                if frame.pts is None:
                    frame.pts = frame.dts
                if frame.pts is not None:
                    yield frame

    def _advance(self) -> None:
        """Decode the next frame; what lies between it and the one before can't be decoded."""
        before = self._frame.pts
        self._frame = next(self._decoded, None)
        after = self._frame.pts if self._frame is not None else self.pts[-1] + 1
        self._damaged.update(range(bisect_right(self.pts, before), bisect_left(self.pts, after)))

    def _keep_passed(self, number: int) -> None:
        passed = bisect_left(self.pts, self._frame.pts)
        room = _CACHE_BYTES // (3 * self._frame.width * self._frame.height) // 2
        if number - passed <= room and passed not in self._kept and not self._frame.is_corrupt:
            self._keep(passed, _image_of(self._frame))

    def _keep(self, number: int, image: Any) -> None:
        self._kept[number] = image
        self._kept.move_to_end(number)
        while len(self._kept) > 1 and len(self._kept) * image.nbytes > _CACHE_BYTES:
            self._kept.popitem(last=False)


def _identity(path: Path) -> _Identity:
    try:
        found = path.stat()
    except OSError as error:
        text = f"Video '{path!s:.200}' can't be read: {error.strerror}. Check the path."
        raise ImageFileError(str(path), text) from error
    return str(path.absolute()), found.st_size, found.st_mtime_ns


def _image_of(frame: Any) -> Any:
    """Return a decoded frame as an image, turned as its file says."""
    import numpy as np

    image = frame.to_ndarray(format="bgr24")
    turns = round(frame.rotation / 90) % 4
    return _locked(np.ascontiguousarray(np.rot90(image, turns)) if turns else image)


def _locked(image: Any) -> Any:
    image.setflags(write=False)
    return image
