"""Recordings as MCAP files: writing, reading, and a summary of their content.

Each multipart message is one MCAP message: its log time is the time of its arrival, its channel has the name of its
topic, and its data are its frames as they arrived: their number (4 bytes), then the length (8 bytes) and the bytes of
each, all little-endian. Frames are not decoded, so messages of 2019, of v1 and of other programs are kept alike.

An image of a v1 message is an MCAP message of its own before it, in Foxglove's schema, on a channel called
``TOPIC/PART``: so Foxglove and other programs show it. Its pixels are in the file once: the frame that they are has
their place among the images in place of its length, with the highest bit set.

A recorder that is killed leaves a file without an end, perhaps in the middle of a record: chunks are appended whole, a
chunk that the disk took in part is cut off again, and a reader gives every whole message before it raises.
"""

from __future__ import annotations

import contextlib
import os
import struct
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO, Final, Self

from epypes.errors import InvalidValue, RecordingError
from epypes.optional import optional_import
from epypes.transport.channel import Frames
from epypes.wire.foxglove import FoxgloveImage, foxglove_images, image_data

_ENCODING: Final = "epypes-multipart"
_IMAGE_ENCODING: Final = "protobuf"
_IMAGE_SCHEMAS: Final = frozenset({"foxglove.RawImage", "foxglove.CompressedImage"})
# Of a frame's length: the frame is the data of an image before the message.
_IS_IMAGE: Final = 2**63
# Names of the metadata records: one at the start, one at the end of a recording that was finished.
_START, _COUNTS = "epypes.recording", "epypes.counts"
_DROPPED: Final = "dropped: "
_NUMBER, _LENGTH = struct.Struct("<I"), struct.Struct("<Q")
_MAGIC_BYTES: Final = 8
_CHUNK_BYTES: Final = 1024**2
_MAX_TOPIC_CHARACTERS: Final = 256
# Channels have numbers of 16 bit, and a peer that invents topics must not use them up.
_MAX_TOPICS: Final = 1_024
_OTHER_TOPICS: Final = "(other topics)"


@dataclass(slots=True)
class RecordingCounts:
    """Numbers of messages of a recording; each received one was written, or dropped for a reason."""

    received: int = 0
    written: int = 0
    dropped: Counter[str] = field(default_factory=Counter)

    def __str__(self) -> str:
        reasons = ", ".join(f"{reason} {count}" for reason, count in sorted(self.dropped.items()))
        dropped = f"{sum(self.dropped.values())} ({reasons})" if reasons else "0"
        return f"received {self.received}, written {self.written}, dropped {dropped}"

    def to_metadata(self) -> dict[str, str]:
        """Return the counts as MCAP metadata: texts by name."""
        dropped = {f"{_DROPPED}{reason}": str(count) for reason, count in self.dropped.items()}
        return {"received": str(self.received), "written": str(self.written), **dropped}

    @classmethod
    def from_metadata(cls, metadata: Mapping[str, str]) -> Self:
        """Return the counts of `to_metadata`; raise LookupError or ValueError for anything else."""
        dropped = {
            name.removeprefix(_DROPPED): int(text) for name, text in metadata.items() if name.startswith(_DROPPED)
        }
        return cls(int(metadata["received"]), int(metadata["written"]), Counter(dropped))


@dataclass(frozen=True, slots=True)
class Recorded:
    """One message of a recording: its frames as they arrived, and the time of that (Unix time, ns)."""

    time_ns: int
    topic: str
    frames: list[memoryview]


@dataclass(frozen=True, slots=True)
class RecordingInfo:
    """Summary of a recording.

    Attributes
    ----------
    about
        Where it was recorded: address, topic.
    topics
        Number of messages by topic; those of one frame have the topic ``""``.
    first_ns, last_ns
        Arrival of the first and the last message, Unix time in ns; 0 if there is none.
    counts
        The recorder's counts; None if it was killed, so that the file has no end.
    """

    about: Mapping[str, str]
    topics: Mapping[str, int]
    first_ns: int
    last_ns: int
    counts: RecordingCounts | None

    @property
    def messages(self) -> int:
        """Number of messages that can be played."""
        return sum(self.topics.values())

    @property
    def duration_s(self) -> float:
        """Seconds from the first message to the last."""
        return (self.last_ns - self.first_ns) / 1e9


class BrokenOff(RecordingError):
    """A recording that breaks off; all of its whole messages have been read."""


class RecordingWriter:
    """A new recording; its methods are for one thread.

    Chunks are not compressed, since a recorder must keep up with images.

    Parameters
    ----------
    path
        The file.
    about
        Metadata at its start, for people.
    force
        Whether an existing file is replaced.

    Attributes
    ----------
    pending, written
        Number of appended messages that are not in the file yet, and that are.

    Raises
    ------
    RecordingError
        If the file exists already or can't be written.
    """

    def __init__(self, path: Path, about: Mapping[str, str], force: bool) -> None:
        with optional_import():
            import mcap_protobuf.schema  # noqa: F401  said now if it is missing, not at the first image
            from mcap.writer import CompressionType, Writer

        self.path = path
        self.pending = self.written = self._bytes = 0
        self._channels: dict[str, int] = {}
        self._image_channels: dict[tuple[str, str], int] = {}
        self._schemas: dict[str, int] = {}
        self._file = _UnbufferedFile(path, force)
        # Only `flush` ends a chunk, so that it is known which messages are in the file.
        self._writer = Writer(self._file, chunk_size=2**62, compression=CompressionType.NONE)
        with self._cut_on_error():
            self._writer.start(library="epypes")
            self._writer.add_metadata(_START, dict(about))

    def append(self, time_ns: int, frames: Frames) -> None:
        """Append a message; it is in the file after the next `flush`, which this calls if much is pending."""
        self.pending += 1
        number, topic = (self.written + self.pending) % 2**32, _topic_of(frames)
        records: list[tuple[int, bytes]] = []
        places: dict[int, int] = {}
        for image in foxglove_images(frames, time_ns):
            channel = self._image_channel(topic, image)
            if channel is not None:
                if image.frame is not None:
                    places[image.frame] = len(records)
                records.append((channel, image.message.SerializeToString()))
        records.append((self._channel(topic), _packed(frames, places)))
        for channel, data in records:
            self._writer.add_message(channel, log_time=time_ns, data=data, publish_time=time_ns, sequence=number)
            self._bytes += len(data)
        if self._bytes >= _CHUNK_BYTES:
            self.flush()

    def flush(self) -> None:
        """Write the pending messages into the file.

        Raises
        ------
        RecordingError
            If the disk refuses them. The file can be played up to there; nothing more can be appended.
        """
        with self._cut_on_error():
            self._writer.flush()
        self.written += self.pending
        self.pending = self._bytes = 0

    def finish(self, counts: RecordingCounts) -> None:
        """Write the counts and the index, and close the file; pending messages must have been flushed."""
        with self._cut_on_error():
            self._writer.add_metadata(_COUNTS, counts.to_metadata())
            self._writer.finish()
        self.close()

    def close(self) -> None:
        """Close the file as it is."""
        self._file.close()

    @contextlib.contextmanager
    def _cut_on_error(self) -> Iterator[None]:
        """Cut off and close the file where it is if the disk refuses what is written inside this block."""
        whole = self._file.tell()
        try:
            yield
        except OSError as error:
            self._file.cut(whole)
            self.close()
            raise _refused(self.path, error) from error

    def _channel(self, topic: str) -> int:
        if topic not in self._channels and len(self._channels) >= _MAX_TOPICS:
            topic = _OTHER_TOPICS
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, _ENCODING, schema_id=0)
        return self._channels[topic]

    def _image_channel(self, topic: str, image: FoxgloveImage) -> int | None:
        """Return the channel of an image; None if there are too many already."""
        from mcap_protobuf.schema import register_schema

        schema = image.message.DESCRIPTOR.full_name
        name = "/".join(filter(None, (topic, image.part)))[:_MAX_TOPIC_CHARACTERS]
        if (name, schema) not in self._image_channels and len(self._image_channels) < _MAX_TOPICS:
            if schema not in self._schemas:
                self._schemas[schema] = register_schema(self._writer, type(image.message))
            found = self._writer.register_channel(name, _IMAGE_ENCODING, schema_id=self._schemas[schema])
            self._image_channels[name, schema] = found
        return self._image_channels.get((name, schema))


class _UnbufferedFile:
    """A new file without a buffer: a buffer would keep the bytes that the disk has refused, and try again."""

    def __init__(self, path: Path, force: bool) -> None:
        try:
            self._raw = path.open("wb" if force else "xb", buffering=0)
        except FileExistsError as error:
            text = f"{path} is there already. Take another name, or replace it with --force (force=True)."
            raise RecordingError(path, text) from error
        except OSError as error:
            raise _refused(path, error) from error
        self._size = 0

    def write(self, data: bytes) -> int:
        left = memoryview(data)
        while left.nbytes:
            done = self._raw.write(left) or 0
            self._size += done
            left = left[done:]
        return len(data)

    def tell(self) -> int:
        # Not that of the file, which may be a pipe.
        return self._size

    def flush(self) -> None:
        """Do nothing: there is no buffer."""

    def cut(self, size: int) -> None:
        """Truncate the file, as far as the system can."""
        with contextlib.suppress(OSError):
            self._raw.truncate(size)

    def close(self) -> None:
        self._raw.close()


def _refused(path: Path, error: OSError) -> RecordingError:
    return RecordingError(path, f"{path} can't be written: {error.strerror or error}.")


def _packed(frames: Frames, places: Mapping[int, int]) -> bytes:
    """Return the data of an MCAP message; ``places`` has those of images, by the places of the frames that they are."""
    parts: list[bytes | memoryview] = [_NUMBER.pack(len(frames))]
    for number, frame in enumerate(frames):
        if number in places:
            parts.append(_LENGTH.pack(_IS_IMAGE | places[number]))
        else:
            parts += (_LENGTH.pack(len(frame)), frame)
    return b"".join(parts)


def _unpacked(data: bytes, images: Sequence[bytes]) -> list[memoryview]:
    """Return the frames in the data of an MCAP message, without a copy; raise ValueError if these are none.

    ``images`` has the data of the images before it.
    """
    view = memoryview(data)
    count, place = int.from_bytes(view[: _NUMBER.size], "little"), _NUMBER.size
    frames = []
    for _ in range(count):
        start = place + _LENGTH.size
        length = int.from_bytes(view[place:start], "little")
        if length & _IS_IMAGE:
            if length ^ _IS_IMAGE >= len(images):
                raise InvalidValue("an image of a message is missing")
            frames.append(memoryview(images[length ^ _IS_IMAGE]))
            place = start
            continue
        place = start + length
        if place > len(view):
            raise InvalidValue("a frame is longer than its message")
        frames.append(view[start:place])
    if not frames or place != len(view):
        raise InvalidValue("the frames are not the whole message")
    return frames


def _topic_of(frames: Frames) -> str:
    """Return the topic of a message, without its slash: ``""`` for a message of one frame, which is its content."""
    if len(frames) == 1:
        return ""
    start = bytes(frames[0][: 4 * _MAX_TOPIC_CHARACTERS]).decode(errors="backslashreplace")
    return start.removesuffix("/")[:_MAX_TOPIC_CHARACTERS]


def messages(path: Path) -> Iterator[Recorded]:
    """Yield the messages of a recording in the order of their arrival.

    Raises
    ------
    RecordingError
        If it can't be read, is no recording of EPypes, or is damaged; BrokenOff after its last whole message if it
        breaks off.
    """
    for record in _records(path):
        if isinstance(record, Recorded):
            yield record


def recording_info(path: str | Path) -> RecordingInfo:
    """Return the summary of a recording; all of it is read and checked.

    Raises
    ------
    RecordingError
        If it can't be read, is no recording of EPypes, or is damaged.
    """
    path = Path(path)
    metadata: dict[str, Mapping[str, str]] = {}
    topics: Counter[str] = Counter()
    first_ns = last_ns = 0
    with contextlib.suppress(BrokenOff):
        for record in _records(path):
            if isinstance(record, Recorded):
                last_ns = record.time_ns
                first_ns = first_ns or last_ns
                topics[record.topic] += 1
            else:
                metadata[record.name] = record.metadata
    try:
        counts = RecordingCounts.from_metadata(metadata[_COUNTS]) if _COUNTS in metadata else None
    except (LookupError, ValueError) as error:
        raise _damaged(path, error) from error
    return RecordingInfo(metadata.get(_START, {}), topics, first_ns, last_ns, counts)


def _records(path: Path) -> Iterator[Any]:
    """Yield the messages as Recorded, and the metadata as records of the library."""
    with optional_import():
        from mcap.exceptions import InvalidMagic
        from mcap.records import Channel, DataEnd, Message, Metadata, Schema
        from mcap.stream_reader import StreamReader

    reader = _MessageReader(path)
    try:
        with path.open("rb") as file:
            if os.fstat(file.fileno()).st_size < _MAGIC_BYTES:
                raise RecordingError(path, f"{path} is no MCAP file, or an empty one.")
            for record in StreamReader(_WholeReads(file), validate_crcs=True).records:
                if isinstance(record, Schema | Channel):
                    reader.declare(record)
                elif isinstance(record, Message):
                    yield from reader.read(record)
                elif isinstance(record, Metadata):
                    yield record
                elif isinstance(record, DataEnd):
                    # The rest is an index, for readers that seek.
                    reader.check()
                    return
    except RecordingError:
        raise
    except InvalidMagic as error:
        raise RecordingError(path, f"{path} is no MCAP file, or an empty one.") from error
    except EOFError as error:
        raise BrokenOff(path, f"{path} breaks off: its recorder was killed, or a part of it is missing.") from error
    except OSError as error:
        raise RecordingError(path, f"{path} can't be read: {error.strerror or error}.") from error
    except Exception as error:
        # The reader and its decompressors raise errors of any type for damaged bytes.
        raise _damaged(path, error) from error


class _MessageReader:
    """Makes the records of messages and of their images what was recorded."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._schemas: dict[int, str] = {}
        self._topics: dict[int, str] = {}
        # The schema of each channel of images; and the images of one message, with its time and number.
        self._image_schemas: dict[int, str] = {}
        self._images: list[bytes] = []
        self._images_of = (0, 0)

    def declare(self, record: Any) -> None:
        """Take the record of a schema or of a channel."""
        if not hasattr(record, "schema_id"):
            self._schemas[record.id] = record.name
            return
        schema = self._schemas.get(record.schema_id, "")
        if record.message_encoding == _IMAGE_ENCODING and schema in _IMAGE_SCHEMAS:
            self._image_schemas[record.id] = schema
        elif record.message_encoding == _ENCODING:
            self._topics[record.id] = record.topic
        else:
            raise _no_recording(self._path, record.topic, f"messages of encoding {record.message_encoding[:40]!r}")

    def read(self, record: Any) -> Iterator[Recorded]:
        """Yield the message of a record; keep an image for the message that follows it."""
        if self._images_of != (record.log_time, record.sequence):
            self._images, self._images_of = [], (record.log_time, record.sequence)
        if record.channel_id in self._image_schemas:
            self._images.append(image_data(self._image_schemas[record.channel_id], record.data))
        else:
            yield Recorded(record.log_time, self._topics[record.channel_id], _unpacked(record.data, self._images))

    def check(self) -> None:
        """Raise RecordingError if there are images, and no messages that they belong to."""
        if self._image_schemas and not self._topics:
            raise _no_recording(self._path, "", "images alone")


def _no_recording(path: Path, topic: str, content: str) -> RecordingError:
    where = f"its topic {topic[:80]!r}" if topic else "it"
    text = f"{path} is an MCAP file, but no recording of EPypes: {where} has {content}."
    return RecordingError(path, f"{text} Play it with the program that wrote it.")


def _damaged(path: Path, error: Exception) -> RecordingError:
    return RecordingError(path, f"{path} is damaged: {error or type(error).__name__}.")


class _WholeReads:
    """A file of which all the bytes that are asked for are read, or EOFError is raised."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._left = os.fstat(file.fileno()).st_size

    def read(self, size: int) -> bytes:
        # Checked before it is read: a damaged length would allocate as much as it declares.
        if size > self._left:
            raise EOFError
        self._left -= size
        return self._file.read(size)
