"""What does it mean, in a sentence, that RabbitMQ or pika gives an error?"""

from __future__ import annotations

import socket
import ssl
from shlex import quote
from typing import Final

from pika.adapters.utils import connection_workflow as opening
from pika.exceptions import (
    AMQPHeartbeatTimeout,
    ChannelClosed,
    ConnectionClosed,
    ConnectionClosedByClient,
    IncompatibleProtocolError,
    ProbableAccessDeniedError,
    ProbableAuthenticationError,
    ProtocolSyntaxError,
    StreamLostError,
)

from epypes.transport.channels.place import Place

_REFUSED, _NOT_ALLOWED = 403, 530
_LONGEST: Final = 300


def reason_of(error: BaseException) -> str:
    """Return why a connection or a channel of AMQP was closed: the end of a sentence, without its full stop."""
    if isinstance(error, ConnectionClosedByClient):
        return "it was closed"
    if isinstance(error, ConnectionClosed | ChannelClosed):
        return f"the broker says {error.reply_text[:_LONGEST]!r}"
    if isinstance(error, StreamLostError):
        return "the broker has gone away"
    if isinstance(error, AMQPHeartbeatTimeout):
        return "nothing was heard from the broker"
    return f"{type(error).__name__}: {str(error)[:_LONGEST]}"


def leader_hint(place: Place) -> str:
    """Return where to look when a broker is there and a place of it says nothing: a sentence after a space, or nothing.

    A quorum queue without a leader takes and gives no message, and tells nobody.
    """
    if place.kind != "queue":
        return ""
    where = "" if place.vhost == "/" else f"--vhost {quote(place.vhost)} "
    command = f"rabbitmq-queues quorum_status {where}{quote(place.name)}"
    return f" If it goes on, {command} says whether the queue has a leader."


def innermost(error: BaseException | None) -> BaseException | None:
    """Return what pika has wrapped, some times."""
    while error is not None:
        if isinstance(error, opening.AMQPConnectionWorkflowFailed):
            inner: object = error.exceptions[-1] if error.exceptions else None
        else:
            inner = getattr(error, "exception", None) or (error.args[0] if error.args else None)
        if not isinstance(inner, BaseException):
            return error
        error = inner
    return error


def opening_reason(error: BaseException | None, place: Place, timeout_s: float) -> str:
    """Return what to tell of a connection that could not be opened: whole sentences."""
    inner = innermost(error)
    if inner is None or isinstance(inner, opening.AMQPConnectorStackTimeout | TimeoutError):
        return f"{place} did not answer within {timeout_s:g} s. Is it a RabbitMQ, and can it be reached from here?"
    if isinstance(inner, socket.gaierror):
        return f"{place} can't be reached: no host is called {place.host!r}."
    if isinstance(inner, ssl.SSLError):
        return f"{place} can't be reached with encryption: {inner.reason or inner}. Give its certificates as ?ca=FILE."
    if isinstance(inner, OSError):
        return f"{place} can't be reached: {inner.strerror or inner}. Is the broker running there?"
    return _refusal(inner, place)


def _refusal(inner: BaseException, place: Place) -> str:
    code = inner.reply_code if isinstance(inner, ConnectionClosed) else 0
    if code == _REFUSED or isinstance(inner, ProbableAuthenticationError):
        who = f"user {place.user!r}" if place.user else "a user without name"
        return f"{place} refuses {who} or the password. {place.refused_way_out}"
    if code == _NOT_ALLOWED or isinstance(inner, ProbableAccessDeniedError):
        return f"{place} has no virtual host {place.vhost!r}, or user {place.user!r} may not use it."
    if isinstance(inner, IncompatibleProtocolError | ProtocolSyntaxError | StreamLostError):
        return f"Who answers at {place} does not speak AMQP 0-9-1, or hung up: is it RabbitMQ, and is it this port?"
    return f"{place} can't be reached: {reason_of(inner)}."
