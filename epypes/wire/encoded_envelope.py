"""An Envelope as its frames, of which only the header is read.

What arrives as frames leaves as frames: a process that routes, numbers or counts messages needs none of their values.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

from epypes.errors import MessageError
from epypes.wire.decoder import as_view, decode, read_failure, read_header
from epypes.wire.encoder import REFUSALS, encode, topic_frame
from epypes.wire.envelope import Envelope, FailureRecord, scalar_fields
from epypes.wire.limits import DEFAULT_LIMITS, Limits
from epypes.wire.protobuf import message_class


def stamped_frames(
    frames: Sequence[bytes | memoryview], epoch: int, sequence: int, published_ns: int, limits: Limits
) -> tuple[bytes | memoryview, ...]:
    """Return the frames of an envelope with other values of three fields of its header; see `EncodedEnvelope.stamped`.

    protobuf merges concatenated messages, so that nothing is parsed or encoded again.

    Raises
    ------
    MessageError
        Of reason ``"bad field"`` or ``"too large"``.
    """
    try:
        message = message_class("epypes.v1.Stamp")(epoch=epoch, sequence=sequence, published_ns=published_ns)
        stamp: bytes = message.SerializeToString()
    except REFUSALS as error:
        raise MessageError("bad field", f"A stamp has a field that can't be sent: {error}") from error
    topic, header, *payloads = frames
    stamped = (topic, b"".join((header, stamp)), *payloads)
    limits.check_sizes([len(frame) for frame in stamped])
    return stamped


# Not frozen: that would triple the time of making one, which is a part of every message's time.
@dataclass(slots=True, eq=False, repr=False)
class EncodedEnvelope:
    """A v1 message as its frames, with the fields of its header; made by `read` or `encode`.

    Attributes
    ----------
    frames
        Topic, header, payloads: each bytes or a read-only memoryview. A memoryview from `encode` is the memory of an
        array: leave the array alone until the frames are sent.
    has_attributes
        Whether the envelope has attributes.
    failure
        None, or the failure that the envelope reports.
    limits
        The limits that it was checked against.
    id, type, source, epoch, sequence, acquired_ns, published_ns, correlation_id, revision, bundle_digest, \
    request_source, request_epoch, request_sequence
        As in `Envelope`.
    """

    frames: tuple[bytes | memoryview, ...]
    id: str
    type: str
    source: str
    epoch: int
    sequence: int
    acquired_ns: int
    published_ns: int
    correlation_id: str
    revision: int
    bundle_digest: str
    request_source: str
    request_epoch: int
    request_sequence: int
    has_attributes: bool
    failure: FailureRecord | None
    limits: Limits

    @classmethod
    def read(cls, frames: Sequence[bytes | bytearray | memoryview], limits: Limits = DEFAULT_LIMITS) -> Self:
        """Return a received message; its values are neither checked nor decoded.

        Parameters
        ----------
        frames
            Topic, header, payloads. They are kept, not copied.
        limits
            Sizes and number of frames that are accepted.

        Raises
        ------
        MessageError
            The frame count, a size, the topic, the version or the header is not that of a v1 message.
        """
        views = [*map(as_view, frames)]
        header = read_header(views, limits)
        return cls(
            tuple([frame if type(frame) is bytes else view for frame, view in zip(frames, views, strict=True)]),
            **scalar_fields(header),
            has_attributes=bool(header.attributes),
            failure=read_failure(header),
            limits=limits,
        )

    @classmethod
    def encode(cls, envelope: Envelope, topic: str = "", *, limits: Limits = DEFAULT_LIMITS) -> Self:
        """Return an envelope encoded.

        Raises
        ------
        MessageError
            As `epypes.wire.encode`.
        """
        return cls(
            tuple(encode(envelope, topic, limits=limits)),
            **scalar_fields(envelope),
            has_attributes=bool(envelope.attributes),
            failure=envelope.failure,
            limits=limits,
        )

    def decode(self) -> Envelope:
        """Return the envelope with its values.

        Raises
        ------
        MessageError
            As `epypes.wire.decode`.
        """
        return decode(self.frames, self.limits)

    def stamped(self, epoch: int, sequence: int, published_ns: int, topic: str | None = None) -> Self:
        """Return the message with other values of ``epoch``, ``sequence`` and ``published_ns``; no value is touched.

        Parameters
        ----------
        epoch, sequence, published_ns
            As in `Envelope`.
        topic
            Another topic; None keeps the one it has.

        Raises
        ------
        MessageError
            Of reason ``"bad field"`` for a number that the field can't hold, ``"too large"`` or ``"bad topic"``.
        """
        topic_, *rest = stamped_frames(self.frames, epoch, sequence, published_ns, self.limits)
        frames = (topic_ if topic is None else topic_frame(topic), *rest)
        fields = scalar_fields(self) | {"epoch": epoch, "sequence": sequence, "published_ns": published_ns}
        return type(self)(
            frames, **fields, has_attributes=self.has_attributes, failure=self.failure, limits=self.limits
        )

    def __repr__(self) -> str:
        number = f" #{self.sequence}" if self.sequence else ""
        return f"<EncodedEnvelope {self.type[:20]!r}{number}: {sum(map(len, self.frames)):,} bytes>"
