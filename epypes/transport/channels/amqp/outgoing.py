"""How does a message get to RabbitMQ, and when is it there?"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final

import pika
from pika.exceptions import ChannelClosed
from pika.spec import Basic

from epypes.errors import MessageError
from epypes.transport.channels.amqp.connection import Connection, Line
from epypes.transport.channels.amqp.places import missing
from epypes.transport.channels.amqp.reasons import leader_hint, reason_of
from epypes.transport.channels.place import Place

_PERSISTENT: Final = 2
_PRECONDITION_FAILED: Final = 406
_LONGEST_ID: Final = 255
# Properties have to fit a frame of AMQP, of 128 KB with RabbitMQ.
_MOST_HEADERS: Final = 100_000


@dataclass(slots=True, eq=False)
class _Sent:
    key: str
    word: str = ""


class Outgoing:
    """A channel of AMQP with publisher confirms; opened when something is sent."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._line: Line | None = None
        # Who sends and who puts a dead letter aside may be two threads.
        self._opening = threading.Lock()
        self._sent: dict[int, _Sent] = {}
        self._count = 0

    def send(self, place: Place, body: bytes, id: str, headers: Mapping[str, str]) -> None:  # noqa: A002
        """Send a message to a place, and return when the broker has it.

        Raises
        ------
        BrokerError
            The broker does not take it, or is away.
        MessageError
            It is too large for the broker.
        """
        properties = _properties(id, headers)
        line = self._opened()
        told = _Sent(place.name)
        is_broadcast = place.kind == "broadcast"

        def publish() -> None:
            if line.is_over:
                return
            self._count += 1
            self._sent[self._count] = told
            exchange, key = (place.name, "") if is_broadcast else ("", place.name)
            line.amqp.basic_publish(exchange, key, body, properties, mandatory=not is_broadcast)

        connection = self._connection
        connection.turns.run(publish, lambda: told.word or line.is_over, connection.timeout_s)
        if told.word != "ack":
            self._refuse(place, told.word, line, len(body))

    def _refuse(self, place: Place, word: str, line: Line, size: int) -> None:
        connection = self._connection
        connection.check()
        if word == "returned":
            raise missing(connection, place)
        if word == "nack":
            raise connection.error(f"{place} did not take a message: the queue is full, or can't keep it now.")
        error = line.error
        if error is None:
            text = f"{place} did not confirm a message within {connection.timeout_s:g} s: it may have it or not."
            raise connection.error(text + leader_hint(place))
        if isinstance(error, ChannelClosed) and error.reply_code == _PRECONDITION_FAILED and "size" in error.reply_text:
            raise MessageError(
                "too large", f"A message of {size:,} bytes is too large for {place}: {reason_of(error)}."
            )
        raise connection.error(f"{place} did not take a message: {reason_of(error)}.")

    def _opened(self) -> Line:
        with self._opening:
            line = self._line
            if line is None or line.is_over:
                self._connection.check()
                self._sent, self._count = {}, 0
                line = Line(self._connection)
                line.ask(self._confirm)
                self._line = line
            return line

    def _confirm(self, amqp: Any, done: Callable[[object], None]) -> None:
        amqp.add_on_return_callback(self._returned)
        amqp.confirm_delivery(self._confirmed, callback=done)

    def _returned(self, amqp: object, method: Any, properties: object, body: object) -> None:
        # The broker gives back in the order of sending, and before it confirms.
        for told in self._sent.values():
            if told.key == method.routing_key and not told.word:
                told.word = "returned"
                return

    def _confirmed(self, frame: Any) -> None:
        method = frame.method
        tags = [method.delivery_tag]
        if method.multiple:
            tags = [tag for tag in self._sent if tag <= method.delivery_tag or not method.delivery_tag]
        for tag in tags:
            told = self._sent.pop(tag, None)
            if told is not None and not told.word:
                told.word = "ack" if isinstance(method, Basic.Ack) else "nack"


def fits(headers: Mapping[str, str]) -> bool:
    """Return whether headers are small enough to be sent."""
    return sum(len(name.encode()) + len(value.encode()) for name, value in headers.items()) <= _MOST_HEADERS


def _properties(id: str, headers: Mapping[str, str]) -> pika.BasicProperties:  # noqa: A002
    if len(id.encode()) > _LONGEST_ID:
        raise MessageError("bad id", f"The id {id[:40]!r}... of a message is longer than {_LONGEST_ID} bytes.")
    for name in headers:
        if len(name.encode()) > _LONGEST_ID:
            raise MessageError("bad header", f"The header {name[:40]!r}... has a name over {_LONGEST_ID} bytes.")
    if not fits(headers):
        raise MessageError("too large", f"The headers of a message take more than {_MOST_HEADERS:,} bytes.")
    return pika.BasicProperties(message_id=id or None, headers=dict(headers) or None, delivery_mode=_PERSISTENT)
