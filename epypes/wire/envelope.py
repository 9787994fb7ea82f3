"""The v1 message as Python objects: Envelope, the failure it may report, and ids of new messages.

A new field needs a line in both messages of ``proto/epypes/v1/envelope.proto``, from which ``make schema`` makes
``schema.binpb``, one in `SCALAR_FIELDS`, and an attribute of `Envelope` and of `epypes.wire.decoder.EncodedEnvelope`.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, Final

from epypes.run import Failure

# The type of an envelope that reports a failure.
FAILURE: Final = "epypes.failure"
# Fields of one name and meaning in Envelope, in EncodedEnvelope and in the protobuf messages Envelope and Header.
SCALAR_FIELDS: Final = (
    "id",
    "type",
    "source",
    "epoch",
    "sequence",
    "acquired_ns",
    "published_ns",
    "correlation_id",
    "revision",
    "bundle_digest",
    "request_source",
    "request_epoch",
    "request_sequence",
)
_EMPTY: Final[Mapping[str, Any]] = MappingProxyType({})
_FAILURE_CHARACTERS: Final = 2_000
_ID_BYTES: Final = 16
# A call of the kernel releases the interpreter's lock, and the caller then waits to get it back: so many ids per call.
_IDS_PER_CALL: Final = 256
_unused_ids: Final[list[str]] = []


def new_id() -> str:
    """Return 32 random hexadecimal digits; from any thread."""
    while True:
        try:
            return _unused_ids.pop()
        except IndexError:
            digits, size = os.urandom(_ID_BYTES * _IDS_PER_CALL).hex(), 2 * _ID_BYTES
            _unused_ids.extend([digits[begin : begin + size] for begin in range(0, len(digits), size)])


# A forked child must not use the ids that its parent will use.
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_unused_ids.clear)


@dataclass(frozen=True, slots=True)
class FailureRecord:
    """A failure as a message reports it.

    Attributes
    ----------
    function
        The function that failed.
    tokens
        Its input tokens.
    exception
        Name of the exception's type.
    message
        Its text.
    input_id
        Id of the envelope that was processed.
    attempt
        Count of attempts, from 1; 0 is "not counted".
    """

    function: str
    tokens: tuple[str, ...] = ()
    exception: str = ""
    message: str = ""
    input_id: str = ""
    attempt: int = 0


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Envelope:
    """A v1 message: named values and their origin. Its mappings are read-only.

    Attributes
    ----------
    type
        The kind of event, in the user's own terms.
    parts
        The values by name, of any type that `encode` takes.
    id
        Unique; a new one unless given.
    source
        Name of the sender.
    epoch, sequence
        Start of the publisher (Unix time, ns) and a count that rises by 1 from 1, so that a subscriber detects loss.
        The publisher sets them.
    acquired_ns, published_ns
        Unix time in nanoseconds; 0 is "not known".
    correlation_id
        Id of the envelope that this one answers.
    revision
        Revision of the hyperparameters that the values were computed with.
    bundle_digest
        Digest of the bundle that computed them.
    attributes
        Small values by name, of the same types as those of parts.
    timings
        Durations by function name, in nanoseconds.
    failure
        None, or the failure that this envelope reports.
    request_source, request_epoch, request_sequence
        Source, epoch and sequence of the envelope that this one answers.
    rgb
        Names of the parts whose images have three or four channels in RGB order; those of all others are BGR.
    """

    type: str
    parts: Mapping[str, Any] = field(default_factory=dict)
    id: str = field(default_factory=new_id)
    source: str = ""
    epoch: int = 0
    sequence: int = 0
    acquired_ns: int = 0
    published_ns: int = 0
    correlation_id: str = ""
    revision: int = 0
    bundle_digest: str = ""
    attributes: Mapping[str, Any] = field(default_factory=dict)
    timings: Mapping[str, int] = field(default_factory=dict)
    failure: FailureRecord | None = None
    request_source: str = ""
    request_epoch: int = 0
    request_sequence: int = 0
    rgb: Collection[str] = frozenset()

    def __post_init__(self) -> None:
        put = object.__setattr__
        put(self, "parts", MappingProxyType(dict(self.parts)))
        put(self, "attributes", MappingProxyType(dict(self.attributes)) if self.attributes else _EMPTY)
        put(self, "timings", MappingProxyType(dict(self.timings)) if self.timings else _EMPTY)
        put(self, "rgb", frozenset((self.rgb,) if isinstance(self.rgb, str) else self.rgb))

    def __repr__(self) -> str:
        number = f" #{self.sequence}" if self.sequence else ""
        names = ", ".join(map(str, self.parts)) or "no parts"
        text = f"<Envelope {str(self.type)[:20]!r}{number}: {names}"
        return f"{text[:95]}...>" if len(text) > 97 else f"{text}>"


def request_fields(request: Any) -> dict[str, Any]:
    """Return the fields of an envelope that answers a request, which is an Envelope or an EncodedEnvelope.

    With them `Subscriber(..., ordered=True)` puts the answers of all replicas into the order of the requests.
    """
    return {
        "request_source": request.source,
        "request_epoch": request.epoch,
        "request_sequence": request.sequence,
    }


def failure_event(failure: Failure, source: str = "", bundle_digest: str = "") -> Envelope:
    """Return the Envelope that reports a failure; its correlation id is the id of the event that failed.

    Parameters
    ----------
    failure
        The failure.
    source
        Name of the sender; by default the failure's own source.
    bundle_digest
        Digest of the bundle that was run, if it was one.
    """
    input_id = _sendable(failure.event_id)
    record = FailureRecord(
        function=_sendable(failure.function),
        tokens=tuple(map(_sendable, failure.tokens)),
        exception=_sendable(failure.kind),
        message=_sendable(" | ".join([failure.message, *_notes(failure)])),
        input_id=input_id,
        attempt=failure.attempt,
    )
    sender = _sendable(source or failure.source)
    return Envelope(FAILURE, source=sender, correlation_id=input_id, bundle_digest=bundle_digest, failure=record)


def _notes(failure: Failure) -> list[str]:
    """Return the notes on the exception of a failure, without its cause, which the message begins with."""
    # The exception's own attributes are user code, which may raise anything.
    with contextlib.suppress(BaseException):
        notes, cause = getattr(failure.exception, "__notes__", None), f"\n{failure.cause}"
        if isinstance(notes, list):
            texts = (str.__str__(note) for note in list.__iter__(notes) if isinstance(note, str))
            return [text.removesuffix(cause) for text in texts]
    return []


def _sendable(text: str) -> str:
    """Return text cut to the length of a report, without lone surrogates, which no message can hold."""
    return text[:_FAILURE_CHARACTERS].encode("utf-8", "replace").decode("utf-8")
