"""The test images of a panel, or the frames of its video: payloads that it can be switched to."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from operator import is_
from pathlib import Path, PurePath
from typing import TYPE_CHECKING, Any, Final

from epypes.acquisition.files import is_video_name
from epypes.acquisition.frames import with_images
from epypes.acquisition.video import Video
from epypes.display import encode_image, is_image
from epypes.errors import InvalidType, InvalidValue, PayloadError, UnknownName
from epypes.graph import colour_order
from epypes.images import Order
from epypes.run import CompGraphRunner
from epypes.run.guard import is_array

if TYPE_CHECKING:
    from epypes_widgets.session import Tunable

_THUMBNAIL_PX: Final = 96
_THUMBNAIL_BYTES: Final = 5_000
_TITLE_CHARACTERS: Final = 40


@dataclass(frozen=True, slots=True, eq=False)
class Payload:
    """A payload to choose.

    Attributes
    ----------
    title
        What it is called: the name of its file, else its number.
    values
        By free source token, for ``runner.run(**values)``.
    thumbnail
        A picture of at most 96 x 96 pixels; empty if none of its values is an image.
    """

    title: str
    values: Mapping[str, Any] = field(repr=False)
    thumbnail: bytes = field(default=b"", repr=False)


class Payloads:
    """The payloads that a panel can be switched to: single images, or the frames of a sequence.

    Parameters
    ----------
    payloads
        In the order in which they are listed.
    is_sequence
        Whether they are frames, which have a slider and numbers.

    Attributes
    ----------
    numbers
        The numbers of the frames; None of single images.
    name
        The name of the video; empty if it is none.
    """

    numbers: range | None = None
    name = ""

    def __init__(self, payloads: Iterable[Payload] = (), *, is_sequence: bool = False) -> None:
        self._payloads = tuple(payloads)
        if is_sequence:
            self.numbers = range(len(self._payloads))

    @property
    def inputs(self) -> Any:
        """The values, as a search takes them."""
        return [payload.values for payload in self._payloads]

    def title(self, index: int) -> str:
        """Return what a payload is called; nothing is read."""
        return self._payloads[index].title

    def time_s(self, index: int) -> float | None:
        """Return the time of a frame of a video in s."""
        return None

    def index_of(self, values: Mapping[str, Any], is_one: Callable[[Any, Any], bool] = is_) -> int | None:
        """Return the index of the payload that has these values, by token; None if none has."""
        for index, payload in enumerate(self._payloads):
            if all(is_one(values[token], value) for token, value in payload.values.items()):
                return index
        return None

    def __len__(self) -> int:
        return len(self._payloads)

    def __getitem__(self, index: int) -> Payload:
        return self._payloads[index]


class VideoPayloads(Payloads):
    """The frames of a video as payloads, each read when it is asked for.

    Parameters
    ----------
    video
        Gives the frames.
    token
        The one free source token.
    order
        The order of its colours.
    """

    def __init__(self, video: Video, token: str, order: Order) -> None:
        self._video, self._token, self._order = video, token, order
        self._numbers = self.numbers = video.numbers
        self.name = video.path.name

    @property
    def inputs(self) -> Any:
        """The video."""
        return self._video

    def title(self, index: int) -> str:
        """Return what a frame is called; it is not read."""
        return f"{self.name} #{self._numbers[index]}, {self._video.time_s(index):.3f} s"

    def time_s(self, index: int) -> float:
        """Return the time of a frame in s."""
        return self._video.time_s(index)

    def index_of(self, values: Mapping[str, Any], is_one: Callable[[Any, Any], bool] = is_) -> int | None:
        """Return the index of the frame whose array this is: to compare pixels, all frames would have to be decoded."""
        number = self._video.number_of(values[self._token])
        return None if number is None or number not in self._numbers else self._numbers.index(number)

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, index: int) -> Payload:
        return Payload(self.title(index), {self._token: self._video.image(self._numbers[index], self._order)})


def payloads(runner: Tunable, images: Any, titles: Sequence[str] = ()) -> Payloads:
    """Return what ``tune(runner, images=...)`` was given as payloads.

    Parameters
    ----------
    runner
        Its free source tokens are what a payload has values for.
    images
        Values of the one free source token, or mappings by token; a generator is read to its end. Or a video, or the
        path of one, whose frames are read one by one.
    titles
        What they are called; without, their files say it, or their numbers.

    Raises
    ------
    TypeError
        Not a list, but a single image, mapping or name.
    ValueError
        There is none.
    PayloadError
        A free source token has no value, or a value is for a token that is not free.
    UnknownName
        A value is for no token of the graph.
    ImageFileError
        The video can't be opened.
    """
    free = runner.free_source_tokens
    if isinstance(images, str | os.PathLike) and is_video_name(Path(images)):
        images = Video(Path(images).expanduser())
    if isinstance(images, Video):
        (token,) = _values(runner, free, images, "A frame of the video")
        return VideoPayloads(images, token, colour_order(runner.cg, token))
    given = _listed(images)
    values = [_values(runner, free, item, f"images[{place}]") for place, item in enumerate(given)]
    # Frames of a sequence have a slider, and no pictures to choose among.
    is_sequence = isinstance(runner, CompGraphRunner) and bool(runner.state)
    return Payloads(
        (
            Payload(
                titles[place] if titles else _title(payload, place),
                payload,
                b"" if is_sequence else _thumbnail(runner, payload),
            )
            for place, payload in enumerate(values)
        ),
        is_sequence=is_sequence,
    )


def is_alike(one: Any, other: Any) -> bool:
    """Whether two images are one, or have the same pixels: a cell that is run again reads its files again."""
    if one is other:
        return True
    if not (is_array(one) and is_array(other) and one.shape == other.shape and one.dtype == other.dtype):
        return False
    return bool((one == other).all())


def _listed(images: Any) -> list[Any]:
    if is_array(images) or isinstance(images, str | bytes | os.PathLike | Mapping) or not isinstance(images, Iterable):
        kind = type(images).__name__
        raise InvalidType(f"images is a list of what the graph is to be tuned on, not a single {kind!r}: images=[...].")
    listed = list(images)
    if not listed:
        raise InvalidValue("images is empty. Give at least one, or leave it out to tune on the last payload.")
    if any(isinstance(image, Video) for image in listed):
        raise InvalidType("A video in a list of images. Give it alone, images=video, or frames of it: [*video[::25]].")
    return listed


def _values(runner: Tunable, free: tuple[str, ...], item: Any, where: str) -> dict[str, Any]:
    if not free:
        raise PayloadError((), "The graph has no free source token to give images to. Leave images out.")
    if not isinstance(item, Mapping):
        if len(free) > 1:
            text = f"{where} does not say which of {_named(free)} it is. Give mappings: {_call(free)}."
            raise PayloadError(free, text)
        item = {free[0]: item}
    for token in item:
        if token not in runner.cg.tokens:
            raise UnknownName("token", token, free)
        if token not in free:
            text = f"{where} has a value for {token!r}, which is not a free source token. Those are: {_named(free)}."
            raise PayloadError((token,), text)
    missing = tuple(token for token in free if token not in item)
    if missing:
        raise PayloadError(missing, f"{where} has no value for {_named(missing)}. Give all: {_call(free)}.")
    return with_images({token: item[token] for token in free}, runner.cg)


def _named(tokens: tuple[str, ...]) -> str:
    return ", ".join(map(repr, tokens))


def _call(tokens: tuple[str, ...]) -> str:
    return f"images=[{{{', '.join(f'{token!r}: ...' for token in tokens)}}}, ...]"


def _title(payload: Mapping[str, Any], place: int) -> str:
    names = (value for value in payload.values() if isinstance(value, str | os.PathLike))
    name = next((PurePath(os.fsdecode(name)).name for name in names), "")
    return name[-_TITLE_CHARACTERS:] or f"{next(iter(payload))} {place + 1}"


def _thumbnail(runner: Tunable, payload: Mapping[str, Any]) -> bytes:
    token = next((token for token, value in payload.items() if is_image(value)), None)
    if token is None:
        return b""
    order = colour_order(runner.cg, token)
    return encode_image(payload[token], _THUMBNAIL_PX, order, most_bytes=_THUMBNAIL_BYTES).data
