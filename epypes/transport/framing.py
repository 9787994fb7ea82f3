"""Which frames does an item become, and which envelope do frames make?"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Sequence

from epypes.errors import MessageError
from epypes.run import Failure
from epypes.wire import EncodedEnvelope, Envelope, Limits, decode, failure_event, serialized

Frames = Sequence[bytes | memoryview]

# Sources are remembered by whoever numbers their envelopes, and by whoever counts what is lost of them.
_MAX_SOURCE_BYTES = 1_024


class Framing:
    """Makes frames of items, and numbers the envelopes among them; one from a publisher's start to its stop."""

    def __init__(self, topic: str, limits: Limits) -> None:
        self._topic, self._limits = topic, limits
        self._sequences: Counter[str] = Counter()
        self._epoch = time.time_ns()

    def frames(self, item: object) -> Frames:
        """Return the frames of an item.

        Raises
        ------
        MessageError
            If it can't be sent. What code of the item itself raises comes as it is.
        """
        data: bytes
        if isinstance(item, bytes):
            data = item
        elif isinstance(item, Envelope):
            return self._envelope_frames(item)
        elif isinstance(item, tuple):
            return self._made_frames(item)
        elif callable(getattr(item, "SerializeToString", None)):
            data = serialized(item)  # type: ignore[arg-type]  # google is imported in wire alone
        elif isinstance(item, Failure):
            return self._envelope_frames(failure_event(item))
        elif isinstance(item, bytearray | memoryview):
            data = bytes(item)
        else:
            raise MessageError(
                "no codec",
                f"A publisher sends bytes, protobuf messages, Envelopes and Failures, not {type(item).__name__}. "
                "Let f_out return one of these.",
            )
        self._check_size(len(data))
        return (data,)

    def _made_frames(self, frames: tuple[object, ...]) -> Frames:
        made = [frame for frame in frames if isinstance(frame, bytes | memoryview)]
        if not made or len(made) < len(frames):
            raise MessageError("no codec", "A tuple is sent as the frames of a message, each bytes or a memoryview.")
        self._check_size(sum(len(frame) for frame in made))
        return made

    def _check_size(self, size: int) -> None:
        if size > self._limits.total_bytes:
            raise MessageError("too large", f"A message of {size:,} bytes; the limit is {self._limits.total_bytes:,}.")

    def _envelope_frames(self, envelope: Envelope) -> Frames:
        check_source(envelope.source)
        number = self._sequences[envelope.source] + 1
        encoded = EncodedEnvelope.encode(envelope, self._topic, limits=self._limits)
        frames = encoded.stamped(self._epoch, number, time.time_ns()).frames
        # Counted when it can be sent: a rejected item is no loss on the way.
        self._sequences[envelope.source] = number
        return frames


def envelope_of(frames: Sequence[bytes | memoryview], limits: Limits) -> Envelope:
    """Return the envelope of a message of several frames; raise MessageError if they make none."""
    envelope = decode(frames, limits)
    check_source(envelope.source)
    return envelope


def check_source(source: str) -> None:
    """Raise MessageError if a source's name is too long."""
    size = len(source.encode(errors="surrogatepass"))
    if size > _MAX_SOURCE_BYTES:
        raise MessageError("bad source", f"A source's name of {size:,} bytes; {_MAX_SOURCE_BYTES:,} is the limit.")
