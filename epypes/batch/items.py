"""The inputs of a map, a sweep or a check: image files, frames of videos, and values, one after another."""

from __future__ import annotations

import glob
import os
import zipfile
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sized
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any, Final

from epypes.acquisition.files import IMAGE_ENDINGS, image_files, is_video_name, natural_order, read_image
from epypes.acquisition.frames import Frame, with_images
from epypes.acquisition.video import Video, VideoFrame
from epypes.bundle.source.clone import clone_runner
from epypes.errors import InvalidType, ScaleError
from epypes.graph import CompGraph, colour_order
from epypes.run import CompGraphRunner
from epypes.run.guard import is_array, is_plain_array

_KINDS: Final = (
    "a folder, a video, a glob such as 'images/*.png', a list or a generator of images, paths or dicts by token"
)
_GLOB_MARKS: Final = "*?["
# The series of frames that are given one by one.
_CAMERA: Final = "camera"


# Not frozen, as a Job is not: that would take another 2 us for each of them, where a trivial item takes 15.
@dataclass(slots=True)
class Item:
    """One input.

    Attributes
    ----------
    number
        Its place, from 0.
    name
        Of a file its name, relative to the folder that was given, of a frame with its number: ``"belt.mp4 #17"``;
        otherwise its place, as ``"#3"``.
    payload
        Values by free source token; a Path stands for an image file, a VideoFrame for a frame of a video, which are
        read when the item is run.
    series
        The key of its series. Without one that the caller gives it is the video, as its path, or the camera that it is
        a frame of, and "" for an item that stands alone: the items of one series come in the order of their times.
    frame
        The number of the frame, from 0; None for what is none.
    time_s
        The time of the frame in s since the first one; None for what has no time.
    frames
        Of a case of a graph with state: the items that are run one after another in its place, or the path of a folder,
        of a glob or of a video of them; None of any other item.
    """

    number: int
    name: str
    payload: Mapping[str, Any]
    series: Hashable = ""
    frame: int | None = None
    time_s: float | None = None
    frames: tuple[Item, ...] | str | None = None


# -- image sets -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, slots=True)
class VideoInput:
    """A video among the inputs: iterate over it to get an input per frame, without decoding any.

    Attributes
    ----------
    video
        The video.
    token, others
        Of a dict by token, the token that has the video, and the dict; None where the video is given alone.
    """

    video: Video
    token: str = ""
    others: Mapping[str, Any] | None = None

    def __len__(self) -> int:
        return len(self.video)

    def __iter__(self) -> Iterator[Any]:
        for number in self.video.numbers:
            frame = VideoFrame(self.video, number)
            yield frame if self.others is None else {**self.others, self.token: frame}
        self.video.close()


def opened(value: Any) -> Any:
    """Return an input with its video opened, if it is one, the path of one, or a dict by token with one of these.

    Raises
    ------
    ScaleError
        A dict names several videos.
    ImageFileError
        The video can't be opened.
    """
    if isinstance(value, str | Path):
        return VideoInput(Video(Path(value).expanduser())) if is_video_name(Path(value)) else value
    if isinstance(value, Video):
        return VideoInput(value)
    if not isinstance(value, Mapping):
        return value
    videos = [token for token, one in value.items() if isinstance(one, Video) or _is_video_file(one)]
    if len(videos) > 1:
        tokens = ", ".join(map(repr, videos))
        text = f"An item has videos for {tokens}. Pair their frames, and make a dict of each pair:"
        raise ScaleError(f"{text} zip(ep.video('left.mp4'), ep.video('right.mp4')).")
    for token in videos:
        video = value[token]
        return VideoInput(video if isinstance(video, Video) else Video(Path(video).expanduser()), token, value)
    return value


def _is_video_file(value: Any) -> bool:
    """Whether a value of a dict names a video: a text only if there is such a file."""
    is_path = isinstance(value, str | Path) and is_video_name(Path(value))
    return is_path and (isinstance(value, Path) or Path(value).expanduser().is_file())


@dataclass(frozen=True, slots=True)
class ImageSet:
    """Inputs, one after another; iterate over it to get values, paths and VideoInputs.

    Attributes
    ----------
    values
        As they are given; those that are held have their videos opened.
    is_held
        Whether all of them are in memory or in files. Others may give one array, filled again, each time.
    count
        How many items there are; None where that is not known without going through them.
    root
        The folder that the names of files are relative to; None if they are named as they were given.
    """

    values: Iterable[Any]
    is_held: bool
    count: int | None
    root: Path | None = None

    def __iter__(self) -> Iterator[Any]:
        return iter(self.values) if self.is_held else map(opened, self.values)


def image_set(images: Any) -> ImageSet:
    """Return an image set whose files are found and whose videos are opened.

    Raises
    ------
    ScaleError
        There are no files, or it is no set.
    ImageFileError
        A video can't be opened.
    """
    if isinstance(images, ImageSet):
        return images
    if isinstance(images, str | Path):
        return _held_set(*_files(images))
    if isinstance(images, Video):
        return _held_set([images])
    if isinstance(images, bytes | bytearray | memoryview):
        raise ScaleError(
            "images is bytes, as the content of a file is. Give the path of the file, or decode them to a list of "
            "images: [cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)]."
        )
    if isinstance(images, Mapping):
        raise ScaleError("images is one dict. Give a list of dicts by token: [{...}, {...}].")
    if _is_image(images):
        raise ScaleError(
            f"images is one array of shape {images.shape}. Give a list of images, if need be of one: [image]."
        )
    if not isinstance(images, Iterable):
        raise ScaleError(f"images can't be {type(images).__name__!r}. Give {_KINDS}.")
    if holds_its_arrays(images):
        return _held_set(images)
    return ImageSet(images, False, len(images) if isinstance(images, Sized) else None)


def _held_set(values: Iterable[Any], root: Path | None = None) -> ImageSet:
    inputs = list(map(opened, values))
    videos = [len(value) for value in inputs if type(value) is VideoInput]
    return ImageSet(inputs, True, len(inputs) - len(videos) + sum(videos), root)


def items_of(images: Any, runner: CompGraphRunner) -> Iterator[Item]:
    """Yield the inputs of an image set, each when the caller wants the next one.

    Parameters
    ----------
    images
        A folder, a glob, one file, a video, or an iterable of images (arrays), frames, paths of image files and videos,
        or dicts by free source token, in which a Path stands for a file, and so does a text with the ending of an
        image, of a video, of ``.npy`` or of ``.npz`` if there is such a file; any other text stands for itself. A video
        gives an item per frame. What a generator gives is copied, since it may be one array that is filled again each
        time.
    runner
        Its free source tokens are what an item has to give.

    Raises
    ------
    ScaleError
        The set is empty, which of a generator is known at its end; or an item does not give these tokens.
    ImageFileError
        A video can't be opened.
    """
    given = image_set(images)
    if given.root is not None:
        only_token(runner.free_source_tokens, f"{str(given.root)!r} gives one image at a time")
    return _items(given, runner)


def _items(images: ImageSet, runner: CompGraphRunner) -> Iterator[Item]:
    number, free, cg = 0, runner.free_source_tokens, runner.cg
    for value in images:
        if type(value) is VideoInput:
            for frame in value:
                yield _item(number, frame, free, cg, images.root)
                number += 1
            continue
        item = _item(number, value, free, cg, images.root)
        # The image of a frame is nobody else's.
        if not (images.is_held or item.series):
            item = replace(item, payload=defensive_copy(item.payload))
        number += 1
        # This generator waits for its caller, and must not keep the value alive meanwhile.
        del value
        yield item
        del item
    if not number:
        kind = type(images.values)
        why = " A generator can be read only once: make a list of it." * issubclass(kind, Iterator)
        raise ScaleError(f"The image set is empty: the {kind.__name__} gave nothing.{why} Give {_KINDS}.")


def _item(number: int, value: Any, free: tuple[str, ...], cg: CompGraph, root: Path | None) -> Item:
    if isinstance(value, Item):
        return value
    if isinstance(value, Frame):
        payload = with_images({only_token(free, f"item #{number} is one frame"): value}, cg)
        return Item(number, f"#{value.number}", payload, _CAMERA, value.number, value.time_s)
    if isinstance(value, Mapping):
        if value.keys() != set(free):
            named, wanted = (", ".join(map(str, names)) or "nothing" for names in (value, free))
            raise ScaleError(f"Item #{number} gives {named}; the graph's free source tokens are: {wanted}.")
        payload = {token: _file_or_value(value[token]) for token in free}
    elif value is None:
        raise ScaleError(f"Item #{number} is None, which is no image. Leave it out.")
    else:
        payload = {only_token(free, f"item #{number} is one value"): Path(value) if isinstance(value, str) else value}
    frame, files = None, []
    for token, one in payload.items():
        if isinstance(one, Path):
            files.append(_name(one, root))
            # The process that reads it may have another working folder.
            payload[token] = one.absolute()
        elif isinstance(one, VideoFrame):
            frame = one
    if frame is not None:
        name, video = frame.name, frame.video.path
        name = name if root is None else f"{_name(video, root)} #{frame.number}"
        return Item(number, name, payload, str(video), frame.number, frame.time_s)
    return Item(number, ", ".join(files) or f"#{number}", payload)


def _file_or_value(value: Any) -> Any:
    """Return the path that a text stands for: one with a file's ending, of a file that is there."""
    if isinstance(value, str) and is_file(value) and Path(value).expanduser().is_file():
        return Path(value).expanduser()
    return value


def only_token(free: tuple[str, ...], given: str) -> str:
    """Return the one free source token."""
    if len(free) != 1:
        tokens = ", ".join(free) or "none"
        example = ", ".join(f"{token!r}: ..." for token in free)
        raise ScaleError(f"The graph's free source tokens are: {tokens}; {given}. Give dicts: [{{{example}}}, ...].")
    return free[0]


def _name(file: Path, root: Path | None) -> str:
    return str(file.relative_to(root) if root is not None and file.is_relative_to(root) else file)


def _files(images: str | Path) -> tuple[list[Path], Path]:
    """Return the files that a folder or a glob names, and the folder that their names are relative to."""
    path = root = Path(images).expanduser()
    if path.is_dir():
        files = image_files(path)
        looked_for = (
            f"There are no images in folder {str(images)!r}: no file ends in {', '.join(sorted(IMAGE_ENDINGS))}."
        )
    elif path.exists() or not _has_glob_mark(images):
        files, root = ([path] if path.is_file() else []), path.parent
        looked_for = f"There is no folder or file {str(images)!r}. Check the path."
    else:
        found = (Path(name) for name in glob.glob(str(path), recursive=True))
        files = sorted(filter(Path.is_file, found), key=lambda file: (str(file.parent), natural_order(file)))
        while _has_glob_mark(root):
            root = root.parent
        looked_for = (
            f"No file matches {str(images)!r}. Check the path; in a glob * stands for any text, ** for folders."
        )
    if not files:
        raise ScaleError(looked_for)
    return files, root


def _has_glob_mark(path: str | os.PathLike[str]) -> bool:
    return any(mark in str(path) for mark in _GLOB_MARKS)


# -- series -----------------------------------------------------------------------------------------------------

SeriesKeys = Callable[[Any], Hashable] | Iterable[Hashable]

# Stands for a key that is not there, since None is one.
_ABSENT_KEY: Final = object()


def with_series(items: Iterator[Item], series: SeriesKeys | None) -> Iterator[Item]:
    """Yield items with the keys of their series.

    Parameters
    ----------
    items
        The inputs.
    series
        A function that is called with the value of an item, of several free source tokens with a dict of values; of a
        file it is given the Path, of a frame of a video the VideoFrame. Or a key per item. None: items keep theirs.

    Raises
    ------
    ScaleError
        There is no key for an item, or none that can be told from others.
    Exception
        What the function raises, with a note that names the item.
    """
    if series is None:
        return items
    if isinstance(series, str | Mapping) or not (callable(series) or isinstance(series, Iterable)):
        raise ScaleError(
            f"series={series!r:.60} says no series. Give a key per item, or a function of an item that returns one: "
            "series=lambda path: path.parent.name."
        )
    return _keyed(items, series)


def _keyed(items: Iterator[Item], series: SeriesKeys) -> Iterator[Item]:
    keys, count = iter(()) if callable(series) else iter(series), 0
    for item in items:
        if callable(series):
            given = next(iter(item.payload.values())) if len(item.payload) == 1 else dict(item.payload)
            try:
                key = series(given)
            except Exception as error:
                text = f"In series=, which was called with a {type(given).__name__!r}, the input of item {item.name}."
                error.add_note(f"{text} It gets the Path of a file, else the value itself.")
                raise
            del given
        else:
            key = next(keys, _ABSENT_KEY)
        if key is _ABSENT_KEY:
            raise ScaleError(f"series has {count} keys, and there are more items. Give a key per item.")
        if not _is_key(key):
            raise ScaleError(f"The series of {item.name} is {key!r:.60}, which is no key. Give numbers or texts.")
        count += 1
        yield replace(item, series=key)
        # This generator waits for its caller, and must not keep the item alive meanwhile.
        del item
    if next(keys, _ABSENT_KEY) is not _ABSENT_KEY:
        raise ScaleError(f"series has more keys than there are items: {count}. Give a key per item.")


def _is_key(key: Any) -> bool:
    """Whether a value is hashable, and equal to itself."""
    try:
        hash(key)
        return bool(key == key)
    except (TypeError, ValueError):
        return False


# -- the inputs of a case of a graph with state -----------------------------------------------------------------


def is_one_image(inputs: Any) -> bool:
    """Whether the inputs of a case of a graph with state are one payload, and no sequence of them."""
    if isinstance(inputs, str | os.PathLike):
        path = Path(inputs).expanduser()
        is_several = path.is_dir() or _has_glob_mark(inputs)
        return not is_video_name(path) and (path.is_file() or not is_several)
    if isinstance(inputs, Mapping):
        return not any(isinstance(value, Video) or _is_video_file(value) for value in inputs.values())
    return _is_image(inputs) or not isinstance(inputs, Iterable)


def _is_image(value: Any) -> bool:
    """Whether a value is an array of one image, and no stack of them."""
    shape = getattr(value, "shape", None)
    return isinstance(shape, tuple) and (len(shape) < 3 or (len(shape) == 3 and shape[2] in (3, 4)))


def frames_of(item: Item, runner: CompGraphRunner) -> Iterator[Item]:
    """Return what is run of an item, one after another: its frames, or the item itself.

    Raises
    ------
    ScaleError
        There is no such folder, or nothing in it.
    """
    if isinstance(item.frames, str):
        return items_of(item.frames, runner)
    return iter((item,) if item.frames is None else item.frames)


# -- values -----------------------------------------------------------------------------------------------------

ARRAYS: Final = frozenset({".npy", ".npz"})


def is_file(value: Any) -> bool:
    """Whether a value names a file: a path, or a text with the ending of an image or an array."""
    if isinstance(value, os.PathLike):
        return True
    return isinstance(value, str) and PurePath(value).suffix.lower() in IMAGE_ENDINGS | ARRAYS


def payload_of(item: Item, cg: CompGraph) -> dict[str, Any]:
    """Return the payload with its files read: BGR, or RGB where the graph has the token marked so.

    Raises
    ------
    ImageFileError
        A file is missing, or no image; a frame is damaged.
    ScaleError
        A ``.npy`` or ``.npz`` can't be read.
    """
    return {
        token: read_value(value, cg, token) if isinstance(value, Path | VideoFrame) else value
        for token, value in item.payload.items()
    }


def read_value(value: Any, cg: CompGraph, token: str) -> Any:
    """Return a value, of a path what is in its file.

    Parameters
    ----------
    value
        A value, a frame of a video, or the path of an image, of ``.npy`` or of ``.npz``: an archive of one array is
        that array, of several a dict.
    cg, token
        The graph and the token that has the value: they give the order of an image's colours.

    Raises
    ------
    ScaleError
        The file can't be read as an array.
    ImageFileError
        It can't be read as an image.
    """
    if isinstance(value, VideoFrame):
        return value.video.image(value.number, colour_order(cg, token))
    if not is_file(value):
        return value
    path = Path(value)
    return _arrays(path) if path.suffix.lower() in ARRAYS else read_image(path, colour_order(cg, token))


def _arrays(path: Path) -> Any:
    import numpy as np

    try:
        found = np.load(path, allow_pickle=False)
        if not hasattr(found, "files"):
            return found
        with found:
            arrays = {name: found[name] for name in found.files}
    except (OSError, ValueError, EOFError, zipfile.BadZipFile) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error).partition("\n")[0]
        raise ScaleError(f"{str(path)!r} can't be read as an array: {reason}. Check the path.") from error
    return next(iter(arrays.values())) if len(arrays) == 1 else arrays


def defensive_copy(value: Any) -> Any:
    """Return a value whose arrays are copies, also those in tuples, lists and dicts."""
    if is_plain_array(value):
        return value.copy(order="K")
    if is_array(value):
        return value.copy()
    if type(value) in (list, tuple):
        return type(value)(map(defensive_copy, value))
    if isinstance(value, tuple) and hasattr(value, "_make"):
        return value._make(map(defensive_copy, value))
    return {key: defensive_copy(item) for key, item in value.items()} if type(value) is dict else value


def holds_its_arrays(values: Any) -> bool:
    """Whether an iterable is a list, a tuple or an array; any other may give one array, filled again, each time."""
    return type(values) in (list, tuple) or is_array(values)


def detached_runner(runner: CompGraphRunner) -> CompGraphRunner:
    """Return another runner, which keeps its values when the given runner's hyperparameters are set or written into.

    Raises
    ------
    TypeError
        It is no runner.
    """
    if not isinstance(runner, CompGraphRunner):
        text = f"The first argument must be a CompGraphRunner, not {type(runner).__name__!r}."
        way_out = " Make one of the graph: ep.CompGraphRunner(cg, hparams)." * isinstance(runner, CompGraph)
        raise InvalidType(f"{text}{way_out}")
    own = {token: defensive_copy(value) for token, value in runner.hyperparameters.items()}
    return clone_runner(runner, own)
