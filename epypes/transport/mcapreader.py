"""What is in a recording, and where does it end?

A recorder that is killed leaves a file without an end, perhaps in the middle of a record. What is whole is read, and
only then it is said that the rest is missing.
"""

from __future__ import annotations

import contextlib
import os
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from epypes.errors import RecordingError
from epypes.optional import optional_import
from epypes.transport.mcapformat import COUNTS, ENCODING, START, Counts, counts_of, unpacked

_MAGIC_BYTES = 8


@dataclass(frozen=True, slots=True)
class Recorded:
    """One message of a recording: its frames as they came, and when that was (Unix time, ns)."""

    time_ns: int
    topic: str
    frames: list[memoryview]


@dataclass(frozen=True, slots=True)
class RecordingInfo:
    """What `recording_info` found.

    Attributes
    ----------
    about
        What its recorder wrote at the start: address, topic.
    topics
        Number of messages by topic; those of one frame have the topic ``""``.
    first_ns, last_ns
        When the first and the last message came, Unix time in ns; 0 if there is none.
    counts
        What the recorder counted; None if it was killed, so that the file has no end.
    """

    about: Mapping[str, str]
    topics: Mapping[str, int]
    first_ns: int
    last_ns: int
    counts: Counts | None

    @property
    def messages(self) -> int:
        """How many messages can be played."""
        return sum(self.topics.values())

    @property
    def duration_s(self) -> float:
        """Seconds from the first message to the last."""
        return (self.last_ns - self.first_ns) / 1e9


class BrokenOff(RecordingError):
    """A recording that breaks off; what is whole in it has been read."""


def messages(path: Path) -> Iterator[Recorded]:
    """Yield the messages of a recording in the order in which they came.

    Raises
    ------
    RecordingError
        If it can't be read, is no recording of EPypes, or is damaged; after the last whole message if it breaks off.
    """
    channels: dict[int, str] = {}
    for kind, record in _records(path):
        if kind == "Channel":
            channels[record.id] = _topic(record, path)
        elif kind == "Message":
            yield _recorded(record, channels, path)


def recording_info(path: str | Path) -> RecordingInfo:
    """Return what is in a recording; all of it is read and checked.

    Raises
    ------
    RecordingError
        If it can't be read, is no recording of EPypes, or is damaged.
    """
    path = Path(path)
    named: dict[str, Mapping[str, str]] = {}
    channels: dict[int, str] = {}
    topics: Counter[str] = Counter()
    first_ns = last_ns = 0
    with contextlib.suppress(BrokenOff):
        for kind, record in _records(path):
            if kind == "Metadata":
                named[record.name] = record.metadata
            elif kind == "Channel":
                channels[record.id] = _topic(record, path)
            elif kind == "Message":
                last_ns = record.log_time
                first_ns = first_ns or last_ns
                topics[_recorded(record, channels, path).topic] += 1
    return RecordingInfo(named.get(START, {}), topics, first_ns, last_ns, _counts(named.get(COUNTS), path))


def _counts(metadata: Mapping[str, str] | None, path: Path) -> Counts | None:
    try:
        return None if metadata is None else counts_of(metadata)
    except (LookupError, ValueError) as error:
        raise _damaged(path, error) from error


def _topic(channel: Any, path: Path) -> str:
    if channel.message_encoding != ENCODING:
        text = (
            f"{path} is an MCAP file, but no recording of EPypes: its topic {channel.topic[:80]!r} has messages of "
            f"encoding {channel.message_encoding[:40]!r}. Play it with what wrote it."
        )
        raise RecordingError(path, text)
    topic: str = channel.topic
    return topic


def _recorded(message: Any, channels: Mapping[int, str], path: Path) -> Recorded:
    try:
        return Recorded(message.log_time, channels[message.channel_id], unpacked(message.data))
    except (LookupError, ValueError) as error:
        raise _damaged(path, error) from error


def _records(path: Path) -> Iterator[tuple[str, Any]]:
    with optional_import():
        from mcap.exceptions import InvalidMagic
        from mcap.stream_reader import StreamReader

    try:
        with path.open("rb") as file:
            source = _Whole(file)
            for record in StreamReader(source, validate_crcs=True).records:
                kind = type(record).__name__
                yield kind, record
                # What follows is an index, for those who want to find a place quickly.
                if kind == "DataEnd":
                    return
    except RecordingError:
        raise
    except (InvalidMagic, _TooShort) as error:
        raise RecordingError(path, f"{path} is no MCAP file, or an empty one.") from error
    except EOFError as error:
        raise BrokenOff(path, f"{path} breaks off: its recorder was killed, or a part of it is missing.") from error
    except OSError as error:
        raise RecordingError(path, f"{path} can't be read: {error.strerror or error}.") from error
    except Exception as error:
        # The reader and its decompressors raise whatever they like for bytes that make no sense.
        raise _damaged(path, error) from error


def _damaged(path: Path, error: Exception) -> RecordingError:
    return RecordingError(path, f"{path} is damaged: {error or type(error).__name__}.")


class _TooShort(Exception):
    """A file without room for the first bytes of any MCAP file."""


class _Whole:
    """A file of which as many bytes are read as were asked for, or none."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._left = os.fstat(file.fileno()).st_size
        if self._left < _MAGIC_BYTES:
            raise _TooShort

    def read(self, size: int) -> bytes:
        # Before it is read: a damaged length would allocate as much as it says.
        if size > self._left:
            raise EOFError
        self._left -= size
        return self._file.read(size)
