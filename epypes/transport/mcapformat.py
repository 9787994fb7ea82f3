"""What does a recording look like inside?

It is an MCAP file. Each multipart message is one MCAP message: its log time is when it came, its channel is called like
its topic, and its data are its frames as they came: their number (4 bytes), then each one's length (8 bytes) and its
bytes, all little-endian. Frames are not looked into, so messages of 2019, of v1 and of strangers are kept alike.
"""

from __future__ import annotations

import struct
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

ENCODING = "epypes-multipart"
# Names of the metadata records: one at the start, one at the end of a recording that was finished.
START, COUNTS = "epypes.recording", "epypes.counts"
_DROPPED = "dropped: "
_MAX_TOPIC_CHARACTERS = 256
_NUMBER, _LENGTH = struct.Struct("<I"), struct.Struct("<Q")

Frames = Sequence[bytes | memoryview]


@dataclass(slots=True)
class Counts:
    """What became of the messages of a recording; those received were written, or dropped for a reason."""

    received: int = 0
    written: int = 0
    dropped: Counter[str] = field(default_factory=Counter)

    def __str__(self) -> str:
        reasons = ", ".join(f"{reason} {count}" for reason, count in sorted(self.dropped.items()))
        dropped = f"{sum(self.dropped.values())} ({reasons})" if reasons else "0"
        return f"received {self.received}, written {self.written}, dropped {dropped}"

    def to_metadata(self) -> dict[str, str]:
        """Return the counts as MCAP keeps metadata: texts by name."""
        dropped = {f"{_DROPPED}{reason}": str(count) for reason, count in self.dropped.items()}
        return {"received": str(self.received), "written": str(self.written), **dropped}


def counts_of(metadata: Mapping[str, str]) -> Counts:
    """Return the counts that `Counts.to_metadata` wrote; raise LookupError or ValueError for anything else."""
    dropped = {name.removeprefix(_DROPPED): int(text) for name, text in metadata.items() if name.startswith(_DROPPED)}
    return Counts(int(metadata["received"]), int(metadata["written"]), Counter(dropped))


def packed(frames: Frames) -> bytes:
    """Return frames as the data of one MCAP message."""
    parts: list[bytes | memoryview] = [_NUMBER.pack(len(frames))]
    for frame in frames:
        parts += (_LENGTH.pack(len(frame)), frame)
    return b"".join(parts)


def unpacked(data: bytes) -> list[memoryview]:
    """Return the frames in the data of an MCAP message, without a copy.

    Raises
    ------
    ValueError
        If these are not frames.
    """
    view = memoryview(data)
    count, place = int.from_bytes(view[: _NUMBER.size], "little"), _NUMBER.size
    frames = []
    for _ in range(count):
        start = place + _LENGTH.size
        place = start + int.from_bytes(view[place:start], "little")
        if place > len(view):
            raise ValueError("a frame is longer than its message")
        frames.append(view[start:place])
    if not frames or place != len(view):
        raise ValueError("the frames are not the whole message")
    return frames


def topic_of(frames: Frames) -> str:
    """Return the topic of a message, without its slash: ``""`` for one of one frame, which is its content."""
    if len(frames) == 1:
        return ""
    start = bytes(frames[0][: 4 * _MAX_TOPIC_CHARACTERS]).decode(errors="backslashreplace")
    return start.removesuffix("/")[:_MAX_TOPIC_CHARACTERS]
