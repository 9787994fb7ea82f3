"""The inputs of a map, a sweep or a check: image files, frames of videos, and values, one after another."""

from __future__ import annotations

import glob
import os
import zipfile
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path, PurePath
from typing import Any, Final

from epypes.acquisition.files import IMAGE_ENDINGS, image_files, is_video_name, natural_order, read_image
from epypes.acquisition.frames import Frame, with_images
from epypes.acquisition.video import Video, VideoFrame
from epypes.bundle.clone import clone_runner
from epypes.errors import ScaleError
from epypes.graph import CompGraph, colour_order
from epypes.run import CompGraphRunner
from epypes.run.guard import is_array, is_plain_array

_KINDS: Final = (
    "a folder, a video, a glob such as 'images/*.png', a list or a generator of images, paths or dicts by token"
)
_SHOWN: Final = "*?["
# The series of frames that are given one by one.
_CAMERA: Final = "camera"


@dataclass(frozen=True, slots=True)
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


@dataclass(frozen=True, slots=True)
class FileSet:
    """The files that a path or a glob names.

    Attributes
    ----------
    files
        In their order; videos are opened.
    root
        The folder that their names are relative to.
    """

    files: tuple[Path | Video, ...]
    root: Path


def image_set(images: Any) -> Any:
    """Return an image set whose files are found and whose videos are opened, so that its items can be counted.

    Raises
    ------
    ScaleError
        There are no files.
    ImageFileError
        A video can't be opened.
    """
    if isinstance(images, str | Path):
        files, root = _files(images)
        return FileSet(tuple(Video(file) if is_video_name(file) else file for file in files), root)
    return [_opened(value) for value in images] if type(images) in (list, tuple) else images


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
    free, images = runner.free_source_tokens, image_set(images)
    if isinstance(images, FileSet):
        return _of_files(images, _only(free, f"{str(images.root)!r} gives one image at a time"))
    if isinstance(images, Video):
        images = [images]
    _check_set(images)
    return _of_values(images, runner)


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


def count_of(images: Any) -> int | None:
    """Return how many items there will be, as far as that is known without going through them."""
    images = image_set(images)
    if isinstance(images, Video):
        return len(images)
    if isinstance(images, FileSet) or type(images) is list:
        return sum(map(_count, images.files if isinstance(images, FileSet) else images))
    try:
        return len(images)
    except TypeError:
        return None


def _count(value: Any) -> int:
    video = _video_in(value) if isinstance(value, Mapping | Video) else None
    return 1 if video is None else len(video[1])


# -- series -----------------------------------------------------------------------------------------------------

SeriesKeys = Callable[[Any], Hashable] | Iterable[Hashable]


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
    """
    if series is None:
        return items
    if isinstance(series, str | Mapping) or not (callable(series) or isinstance(series, Iterable)):
        raise ScaleError(
            f"series={series!r:.60} says no series. Give a key per item, or a function of an item that returns one: "
            "series=lambda path: path.parent.name."
        )
    return _keyed(items, series) if callable(series) else _zipped(items, series)


def _keyed(items: Iterator[Item], key_of: Callable[[Any], Hashable]) -> Iterator[Item]:
    for item in items:
        key = key_of(next(iter(item.payload.values())) if len(item.payload) == 1 else dict(item.payload))
        yield _in_series(item, key)
        # This generator waits for its caller, and must not keep the item alive meanwhile.
        del item


def _zipped(items: Iterator[Item], series: Iterable[Hashable]) -> Iterator[Item]:
    keys, number = iter(series), -1
    for number, item in enumerate(items):
        try:
            key = next(keys)
        except StopIteration:
            raise ScaleError(f"series has {number} keys, and there are more items. Give a key per item.") from None
        yield _in_series(item, key)
        del item
    if next(keys, ABSENT_KEY) is not ABSENT_KEY:
        raise ScaleError(f"series has more keys than there are items: {number + 1}. Give a key per item.")


# Stands for a key that is not there, since None is one.
ABSENT_KEY: Final = object()


def _in_series(item: Item, key: Hashable) -> Item:
    try:
        hash(key)
        is_key = bool(key == key)
    except (TypeError, ValueError):
        is_key = False
    if not is_key:
        raise ScaleError(f"The series of {item.name} is {key!r:.60}, which is no key. Give numbers or texts.")
    return replace(item, series=key)


def is_one_image(inputs: Any) -> bool:
    """Whether the inputs of a case of a graph with state are one payload, and no sequence of them."""
    if isinstance(inputs, str | os.PathLike):
        path = Path(inputs).expanduser()
        is_several = path.is_dir() or any(mark in str(inputs) for mark in _SHOWN)
        return not is_video_name(path) and (path.is_file() or not is_several)
    shape = getattr(inputs, "shape", None)
    if isinstance(shape, tuple):
        return len(shape) < 3 or (len(shape) == 3 and shape[2] in (3, 4))
    if isinstance(inputs, Mapping):
        return not any(isinstance(value, Video) or _is_video_file(value) for value in inputs.values())
    return not isinstance(inputs, Iterable)


def case_items(inputs: Iterable[Any], runner: CompGraphRunner) -> Iterator[Item]:
    """Yield an item for the inputs of each case: of a graph with state, a series of its own.

    Raises
    ------
    ScaleError
        An item does not give the free source tokens.
    """
    if not runner.state:
        yield from items_of(inputs, runner)
        return
    for number, given in enumerate(inputs):
        if isinstance(given, str | os.PathLike) and not is_one_image(given):
            path = os.path.abspath(Path(given).expanduser())
            _only(runner.free_source_tokens, f"{str(given)!r} gives one image at a time")
            yield Item(number, str(given), {}, frames=path)
        else:
            is_payload = is_one_image(given) or isinstance(given, Mapping)
            frames = tuple(items_of([given] if is_payload else given, runner))
            yield Item(number, frames[0].name if len(frames) == 1 else f"#{number}", {}, frames=frames)


def frames_of(item: Item, runner: CompGraphRunner) -> Iterator[Item]:
    """Return what is run of an item, one after another: its frames, or the item itself.

    Raises
    ------
    ScaleError
        There is no such folder, or nothing in it.
    """
    if item.frames is None:
        return iter([item])
    return iter(item.frames) if isinstance(item.frames, tuple) else items_of(item.frames, runner)


# -- files ------------------------------------------------------------------------------------------------------


def _files(images: str | Path) -> tuple[list[Path], Path]:
    """Return the files that a folder or a glob names, and the folder that their names are relative to."""
    path = Path(images).expanduser()
    if path.is_dir():
        files, root = image_files(path), path
        looked_for = (
            f"There are no images in folder {str(images)!r}: no file ends in {', '.join(sorted(IMAGE_ENDINGS))}."
        )
    elif path.exists() or not any(mark in str(images) for mark in _SHOWN):
        files, root = ([path] if path.is_file() else []), path.parent
        looked_for = f"There is no folder or file {str(images)!r}. Check the path."
    else:
        found = (Path(name) for name in glob.glob(str(path), recursive=True))
        files = sorted(filter(Path.is_file, found), key=lambda file: (str(file.parent), natural_order(file)))
        root = _fixed_part(path)
        looked_for = (
            f"No file matches {str(images)!r}. Check the path; in a glob * stands for any text, ** for folders."
        )
    if not files:
        raise ScaleError(looked_for)
    return files, root


def _fixed_part(pattern: Path) -> Path:
    """Return the folder before the first part that has a mark in it."""
    fixed = pattern
    while any(mark in str(fixed) for mark in _SHOWN):
        fixed = fixed.parent
    return fixed


def _name(file: Path, root: Path) -> str:
    return str(file.relative_to(root)) if file.is_relative_to(root) else str(file)


def _of_files(files: FileSet, token: str) -> Iterator[Item]:
    number = 0
    for file in files.files:
        if isinstance(file, Video):
            name = _name(file.path, files.root)
            for frame in _frames(file):
                yield _frame_item(number, f"{name} #{frame.number}", {token: frame}, frame)
                number += 1
            file.close()
        else:
            yield Item(number, _name(file, files.root), {token: file.absolute()})
            number += 1


# -- videos -----------------------------------------------------------------------------------------------------


def by_frame(value: Any) -> Iterator[Any]:
    """Yield an input, or, of a video, each frame in its place.

    Parameters
    ----------
    value
        A value, a video or the path of one, or a dict by token with one of these in it.

    Raises
    ------
    ScaleError
        A dict names several videos.
    """
    found = _video_in(value)
    if found is None:
        yield value
        return
    token, video = found
    for frame in _frames(video):
        yield {**value, token: frame} if isinstance(value, Mapping) else frame
    video.close()


def _frames(video: Video) -> Iterator[VideoFrame]:
    return (VideoFrame(video, number) for number in video.numbers)


def _video_in(value: Any) -> tuple[str, Video] | None:
    """Return the video that an input is or has, opened, and its token in a dict; None if there is none."""
    opened = _opened(value)
    if isinstance(opened, Video):
        return "", opened
    videos = [(token, one) for token, one in opened.items() if isinstance(one, Video)] if _is_dict(opened) else []
    if len(videos) > 1:
        tokens = ", ".join(repr(token) for token, _ in videos)
        text = f"An item has videos for {tokens}. Pair their frames, and make a dict of each pair:"
        raise ScaleError(f"{text} zip(ep.video('left.mp4'), ep.video('right.mp4')).")
    return videos[0] if videos else None


def _opened(value: Any) -> Any:
    """Return the video that a path stands for, in a dict too; any other value as it is."""
    if isinstance(value, str | Path) and is_video_name(Path(value)):
        return Video(Path(value).expanduser())
    if _is_dict(value) and any(map(_is_video_file, value.values())):
        return {token: _opened(one) if _is_video_file(one) else one for token, one in value.items()}
    return value


def _is_dict(value: Any) -> bool:
    return isinstance(value, Mapping)


def _is_video_file(value: Any) -> bool:
    is_path = isinstance(value, str | Path) and is_video_name(Path(value))
    return is_path and (isinstance(value, Path) or Path(value).expanduser().is_file())


def _frame_item(number: int, name: str, payload: Mapping[str, Any], frame: VideoFrame) -> Item:
    return Item(number, name, payload, str(frame.video.path), frame.number, frame.time_s)


# -- values -----------------------------------------------------------------------------------------------------


def _check_set(images: Any) -> None:
    if isinstance(images, Mapping):
        raise ScaleError("images is one dict. Give a list of dicts by token: [{...}, {...}].")
    shape = getattr(images, "shape", None)
    if isinstance(shape, tuple) and (len(shape) < 3 or (len(shape) == 3 and shape[2] in (3, 4))):
        raise ScaleError(f"images is one array of shape {shape}. Give a list of images, if need be of one: [image].")
    if not isinstance(images, Iterable):
        raise ScaleError(f"images can't be {type(images).__name__!r}. Give {_KINDS}.")


def _of_values(images: Iterable[Any], runner: CompGraphRunner) -> Iterator[Item]:
    number, is_copied, free = 0, not holds_its_arrays(images), runner.free_source_tokens
    for value in images:
        if _video_in(value) is not None:
            for one in by_frame(value):
                yield _item(number, one, free, runner.cg)
                number += 1
            continue
        item = _item(number, value, free, runner.cg)
        # The image of a frame is nobody else's.
        if is_copied and not item.series:
            item = replace(item, payload=defensive_copy(item.payload))
        number += 1
        # This generator waits for its caller, and must not keep the value alive meanwhile.
        del value
        yield item
        del item
    if not number:
        raise ScaleError(f"The image set is empty: the {type(images).__name__} gave nothing. Give {_KINDS}.")


def _item(number: int, value: Any, free: tuple[str, ...], cg: CompGraph) -> Item:
    if isinstance(value, Item):
        return value
    if isinstance(value, Frame):
        token = _only(free, f"item #{number} is one frame")
        payload = with_images({token: value}, cg)
        return Item(number, f"#{value.number}", payload, _CAMERA, value.number, value.time_s)
    if isinstance(value, Mapping):
        if set(value) != set(free):
            named, wanted = (", ".join(map(str, names)) or "nothing" for names in (value, free))
            raise ScaleError(f"Item #{number} gives {named}; the graph's free source tokens are: {wanted}.")
        given = {token: value[token] for token in free}
    else:
        if value is None:
            raise ScaleError(f"Item #{number} is None, which is no image. Leave it out.")
        given = {_only(free, f"item #{number} is one value"): Path(value) if isinstance(value, str) else value}
    given = {token: _file_or_value(value) for token, value in given.items()}
    frame = next((one for one in given.values() if isinstance(one, VideoFrame)), None)
    if frame is not None:
        return _frame_item(number, frame.name, given, frame)
    files = [file for file in given.values() if isinstance(file, Path)]
    # The process that reads it may have another working folder.
    payload = {token: file.absolute() if isinstance(file, Path) else file for token, file in given.items()}
    return Item(number, ", ".join(map(str, files)) or f"#{number}", payload)


def _file_or_value(value: Any) -> Any:
    """Return the path that a text stands for: one with a file's ending, of a file that is there."""
    if isinstance(value, str) and is_file(value) and Path(value).expanduser().is_file():
        return Path(value).expanduser()
    return value


def _only(free: tuple[str, ...], given: str) -> str:
    """Return the one free source token."""
    if len(free) != 1:
        tokens = ", ".join(free) or "none"
        example = ", ".join(f"{token!r}: ..." for token in free)
        raise ScaleError(f"The graph's free source tokens are: {tokens}; {given}. Give dicts: [{{{example}}}, ...].")
    return free[0]


ARRAYS: Final = frozenset({".npy", ".npz"})


def is_file(value: Any) -> bool:
    """Whether a value names a file: a path, or a text with the ending of an image or an array."""
    if isinstance(value, os.PathLike):
        return True
    return isinstance(value, str) and PurePath(value).suffix.lower() in IMAGE_ENDINGS | ARRAYS


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
    if path.suffix.lower() in ARRAYS:
        return _arrays(path)
    return read_image(path, colour_order(cg, token))


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
    """Return another runner, which keeps its values when the given runner's hyperparameters are set or written into."""
    own = {token: defensive_copy(value) for token, value in runner.hyperparameters.items()}
    return clone_runner(runner, own)
