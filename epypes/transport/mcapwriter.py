"""How do messages get into a recording, so that even one that is killed can be played?

Chunks are not compressed, since a recorder must keep up with images, and a file grows by whole chunks: what a full disk
took of one is cut off again.
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from pathlib import Path

from epypes.errors import RecordingError
from epypes.optional import optional_import
from epypes.transport.mcapformat import COUNTS, ENCODING, START, Counts, Frames, packed, topic_of

_CHUNK_BYTES = 1024**2
# Channels have numbers of 16 bit, and a peer that invents topics must not use them up.
_MAX_TOPICS = 1_024
_OTHER_TOPICS = "(other topics)"


class RecordingWriter:
    """A new recording; its methods are for one thread.

    Parameters
    ----------
    path
        The file.
    about
        What is kept at its start, for people.
    force
        Whether a file that is there is replaced.

    Attributes
    ----------
    pending
        How many messages have been appended that are not in the file yet.

    Raises
    ------
    RecordingError
        If the file is there already or can't be written.
    """

    def __init__(self, path: Path, about: Mapping[str, str], force: bool) -> None:
        with optional_import():
            from mcap.writer import CompressionType, Writer

        self.path, self.pending = path, 0
        self._count = self._bytes = 0
        self._channels: dict[str, int] = {}
        self._file = _File(path, force)
        # Chunks are cut here alone, so that it is known which messages are in the file.
        self._writer = Writer(self._file, chunk_size=2**62, compression=CompressionType.NONE)
        try:
            self._writer.start(library="epypes")
            self._writer.add_metadata(START, dict(about))
        except OSError as error:
            self.close()
            raise _refused(path, error) from error
        self._whole = self._file.tell()

    def append(self, time_ns: int, frames: Frames) -> None:
        """Append a message; it is in the file after the next `flush`, which this calls if much is pending."""
        self.pending += 1
        data = packed(frames)
        self._count += 1
        number = self._count % 2**32
        channel = self._channel(topic_of(frames))
        self._writer.add_message(channel, log_time=time_ns, data=data, publish_time=time_ns, sequence=number)
        self._bytes += len(data)
        if self._bytes >= _CHUNK_BYTES:
            self.flush()

    def flush(self) -> None:
        """Bring what is pending into the file.

        Raises
        ------
        RecordingError
            If the disk does not take it. The file can be played up to there; nothing more can be appended.
        """
        try:
            self._writer.flush()
        except OSError as error:
            self._file.cut(self._whole)
            raise _refused(self.path, error) from error
        self.pending = self._bytes = 0
        self._whole = self._file.tell()

    def finish(self, counts: Counts) -> None:
        """Write the counts and the index, and close the file; what is pending must have been flushed."""
        try:
            self._writer.add_metadata(COUNTS, counts.to_metadata())
            self._writer.finish()
        except OSError as error:
            self._file.cut(self._whole)
            raise _refused(self.path, error) from error
        finally:
            self.close()

    def close(self) -> None:
        """Close the file as it is."""
        self._file.close()

    def _channel(self, topic: str) -> int:
        if topic not in self._channels and len(self._channels) >= _MAX_TOPICS:
            topic = _OTHER_TOPICS
        if topic not in self._channels:
            self._channels[topic] = self._writer.register_channel(topic, ENCODING, schema_id=0)
        return self._channels[topic]


class _File:
    """A new file without a buffer, which would keep what the disk has refused and try again."""

    def __init__(self, path: Path, force: bool) -> None:
        try:
            self._raw = path.open("wb" if force else "xb", buffering=0)
        except FileExistsError as error:
            text = f"{path} is there already. Take another name, or say --force (force=True) to replace it."
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
        return self._size

    def flush(self) -> None:
        """Do nothing: there is no buffer."""

    def cut(self, size: int) -> None:
        """Throw away what is beyond, as far as the system can."""
        with contextlib.suppress(OSError):
            self._raw.truncate(size)

    def close(self) -> None:
        self._raw.close()


def _refused(path: Path, error: OSError) -> RecordingError:
    return RecordingError(path, f"{path} can't be written: {error.strerror or error}.")
