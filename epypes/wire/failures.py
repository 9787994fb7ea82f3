"""How does a failure travel, so that others hear of it?"""

from __future__ import annotations

import contextlib
from typing import Final

from epypes.run import Failure
from epypes.wire.envelope import Envelope, FailureRecord

FAILURE: Final = "epypes.failure"
_MESSAGE_CHARACTERS: Final = 2_000


def failure_event(failure: Failure, source: str = "", bundle_digest: str = "") -> Envelope:
    """Return the Envelope that reports a failure; it answers the event that failed, by its id.

    Parameters
    ----------
    source
        Who reports it; the failure's own source without.
    bundle_digest
        Digest of the bundle that was run, if it was one.
    """
    input_id = _sendable(failure.event_id)
    record = FailureRecord(
        function=_sendable(failure.function),
        tokens=tuple(map(_sendable, failure.tokens)),
        exception=_sendable(failure.kind),
        message=_sendable(" | ".join([failure.message, *_notes(failure.exception)])),
        input_id=input_id,
        attempt=failure.attempt,
    )
    return Envelope(
        type=FAILURE,
        source=_sendable(source or failure.source),
        correlation_id=input_id,
        bundle_digest=bundle_digest,
        failure=record,
    )


def _notes(exception: BaseException) -> list[str]:
    """Return the notes of an exception that are strings, if they can be had."""
    with contextlib.suppress(BaseException):  # whatever the exception's own attributes do
        notes = getattr(exception, "__notes__", None)
        if isinstance(notes, list):
            return [str.__str__(note) for note in list.__iter__(notes) if isinstance(note, str)]
    return []


def _sendable(text: str) -> str:
    """Return text cut to what a report needs, without halves of surrogate pairs, which no message can hold."""
    return text[:_MESSAGE_CHARACTERS].encode("utf-8", "replace").decode("utf-8")
