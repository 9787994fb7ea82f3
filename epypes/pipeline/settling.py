"""Settling of events: an event that a broker keeps has ``ack``, ``reject`` and ``nack``.

They are looked up in the event's class, so that events can be anything.
"""

from __future__ import annotations

from typing import Any

from epypes.errors import BrokerError
from epypes.pipeline.log import log_error


def settle(event: Any, error: BaseException | None = None, text: str = "") -> None:
    """Acknowledge, reject or return an event that has such methods; raises nothing.

    Parameters
    ----------
    event
        Any object.
    error
        Why it failed; None if it did not. After a BrokerError the outcome is unknown: ``nack`` is called if the event
        has it, and otherwise nothing, so that the broker delivers it again.
    text
        The reason it is rejected with; that of the error without.
    """
    kind = type(event)
    if getattr(kind, "ack", None) is None:
        return
    if error is None:
        _say(kind.ack, event)
    elif issubclass(type(error), BrokerError):
        if hasattr(kind, "nack"):
            _say(kind.nack, event)
    else:
        reject(event, text or _text_of(error))


def reject(event: Any, reason: str) -> None:
    """Have whoever keeps an event put it aside with a reason, if it can be told so; raises nothing."""
    found = getattr(type(event), "reject", None)
    if found is not None:
        _say(found, event, reason)


def _say(word: Any, event: Any, *reason: str) -> None:
    try:
        word(event, *reason)
    except KeyboardInterrupt:  # of the user, whom the event does not concern
        raise
    except BaseException as exception:
        log_error("an event could not be settled", error=exception)


def _text_of(error: BaseException) -> str:
    kind = type(error).__name__
    try:
        return f"{kind}: {error}"
    except BaseException:  # an exception's own __str__ may raise
        return kind
