"""How are messages carried by RabbitMQ?

``amqp://USER:PASSWORD@HOST/QUEUE``, encrypted ``amqps://``. A queue is a quorum queue: what was confirmed is on the
broker's disk (of most brokers of a cluster), and each message knows how often it was delivered. That there is the queue
RabbitMQ writes down up to a second after it was made: if it is killed before, the queue comes back empty. With a queue
of another type that somebody else made, RabbitMQ tells only whether a message was delivered before: `Received.attempt`
is 1 or 2 then. What a replica had been handed in advance counts as delivered too when it dies.
"""

from __future__ import annotations

import logging
from collections import deque
from collections.abc import Callable, Mapping
from typing import Any, Final

from epypes.errors import EpypesError
from epypes.transport.channels.amqp.connection import Connection, Line
from epypes.transport.channels.amqp.outgoing import Outgoing, fits
from epypes.transport.channels.amqp.places import aside, listen, make_sure
from epypes.transport.channels.amqp.reasons import reason_of
from epypes.transport.channels.packing import ATTEMPTS, FROM, REASON, SIZES, arrived, packed, readable
from epypes.transport.channels.place import Place
from epypes.transport.channels.seam import Frames, Received
from epypes.transport.channels.turns import always, nothing

log = logging.getLogger("epypes.transport")

# Quorum queues refuse more.
_MOST_PREFETCH: Final = 2_000
# Of what needs no acknowledgement so many are on their way at once; and so many make room that can't be put aside.
_AHEAD: Final = 100
_LONGEST_REASON: Final = 4_000
# After so long what could not be put aside comes again.
_AGAIN_S: Final = 5.0
_COUNT: Final = "x-delivery-count"
# What the broker writes for its own use; a dead letter of ours must not tell of deliveries of the queue it was in.
_OF_THE_BROKER: Final = ("x-delivery-count", "x-death", "x-first-death-", "x-last-death-", "x-stream-offset")


class AmqpChannel:
    """A way to one place of a RabbitMQ; see `seam.Channel`."""

    def __init__(self, place: Place, prefetch: int, timeout_s: float) -> None:
        self._place, self.prefetch = place, prefetch
        self._connection = connection = Connection(place, timeout_s)
        self._outgoing = Outgoing(connection)
        self._incoming: Line | None = None
        # How much each consumer lets be in hand, by its tag: RabbitMQ leaves that as it was when a consumer began.
        self._consumers: dict[str, int] = {}
        self._arrived: deque[tuple[Any, Any, bytes]] = deque()
        # Whether there is a place for dead letters, as far as is known; what waits for it, by delivery.
        self._can_put_aside = True
        self._waiting: set[int] = set()
        try:
            make_sure(connection, place)
        except BaseException:
            connection.close()
            raise

    def send(self, frames: Frames, *, id: str = "", headers: Mapping[str, str] | None = None) -> None:  # noqa: A002
        """Send a message; see `seam.Channel.send`."""
        body, told = packed(frames, id, headers or {})
        self._connection.check()
        self._outgoing.send(self._place, body, id, told)

    def receive(self, timeout_s: float) -> Received | None:
        """Return the next message; see `seam.Channel.receive`."""
        connection, arrived = self._connection, self._arrived
        connection.check()
        if self._incoming is None:
            try:
                self._incoming = self._listen()
            except BaseException as error:
                # By a signal, too: what has come meanwhile can't be acknowledged over another line.
                connection.lose(f"it could not begin to receive: {str(error) or type(error).__name__}")
                raise
        self._make_room(self._incoming)
        if not arrived:
            connection.turns.run(nothing, lambda: arrived or connection.trouble, timeout_s)
            connection.check()
        return self._received(*arrived.popleft()) if arrived else None

    @property
    def trouble(self) -> str:
        """Why it is over; see `seam.Channel.trouble`."""
        return self._connection.trouble

    def _listen(self) -> Line:
        line = Line(self._connection)
        self._consume(line, self._room)
        self._connection.turns.run(lambda: self._watch(line), always, 0.0)
        return line

    @property
    def _room(self) -> int:
        if self._place.kind == "queue":
            # Others come while something waits to be put aside.
            needed = self.prefetch + min(len(self._waiting), _AHEAD)
        else:
            needed = max(self.prefetch, _AHEAD)
        return min(max(needed, 1), _MOST_PREFETCH)

    def _consume(self, line: Line, prefetch: int) -> None:
        tag = f"epypes.{len(self._consumers)}"
        error = listen(line, self._place, prefetch, self._heard, tag)
        if error is not None:
            raise self._connection.error(f"{self._place} can't be received from: {reason_of(error)}.")
        self._consumers[tag] = prefetch

    def _make_room(self, line: Line) -> None:
        """See that there are consumers for as much as may be in hand just now, and no more of them than it takes."""
        missing = self._room - sum(self._consumers.values())
        if missing > 0:
            self._consume(line, missing)
        while missing < 0 and len(self._consumers) > 1:
            tag, prefetch = next(reversed(self._consumers.items()))
            missing += prefetch
            if missing > 0:
                return
            # What it has delivered can be acknowledged all the same.
            line.ask(lambda amqp, done: amqp.basic_cancel(tag, callback=done))  # noqa: B023 - asked at once
            del self._consumers[tag]

    def _watch(self, line: Line) -> None:
        lose = self._connection.lose
        line.amqp.add_on_cancel_callback(lambda _: lose(f"the queue {self._place.name!r} was deleted"))
        line.amqp.add_on_close_callback(lambda _, error: lose(reason_of(error)))

    def _heard(self, amqp: object, method: Any, properties: Any, body: bytes) -> None:
        self._arrived.append((method, properties, body))

    def _received(self, method: Any, properties: Any, body: bytes) -> Received:
        told = dict(properties.headers or {})
        headers = {name: _text(value) for name, value in told.items() if not name.startswith(_OF_THE_BROKER)}
        message_id, tag = _text(properties.message_id or ""), method.delivery_tag
        frames, shown = arrived(body, headers)
        if self._place.kind != "queue":
            self._ack(tag)
            return Received(frames, message_id, 0, shown)
        attempt = _attempt(told.get(_COUNT), method.redelivered)

        def settle(reason: str | None) -> None:
            if reason is None or self._put_aside(reason, body, message_id, headers, attempt):
                self._ack(tag)
            else:
                self._waiting.add(tag)
                self._connection.later(_AGAIN_S, self._saying(lambda amqp: self._give_back(amqp, tag)))

        return Received(frames, message_id, attempt, shown, settle)

    def _ack(self, tag: int) -> None:
        self._connection.turns.run(self._saying(lambda amqp: amqp.basic_ack(tag)), always, 0.0)

    def _give_back(self, amqp: Any, tag: int) -> None:
        self._waiting.discard(tag)
        amqp.basic_nack(tag)

    def _saying(self, say: Callable[[Any], object]) -> Callable[[], None]:
        """Return what says something of what was delivered, if its line is open then."""
        line = self._incoming

        def said() -> None:
            if line is not None and not line.is_over and line.amqp.is_open:
                say(line.amqp)

        return said

    def _put_aside(self, reason: str, body: bytes, id: str, headers: Mapping[str, str], attempt: int) -> bool:  # noqa: A002
        """Send a message to the dead letters, and return whether it is there."""
        more = {REASON: reason[:_LONGEST_REASON], FROM: self._place.name, ATTEMPTS: str(attempt)}
        told = {**readable(body, headers), **more}
        if not fits(told):
            told = {name: value for name, value in told.items() if name in more or name == SIZES}
        try:
            if not self._can_put_aside:
                make_sure(self._connection, self._place)
            self._outgoing.send(aside(self._place), body, id, told)
        except EpypesError as error:
            self._can_put_aside = False
            if not self._connection.trouble:
                text = "A message of %s can't be put among the dead letters, and comes again in %g s: %s"
                log.warning(text, self._place, _AGAIN_S, error)
            return False
        self._can_put_aside = True
        return True

    def close(self) -> None:
        """End it; see `seam.Channel.close`."""
        self._connection.close()


def _text(value: object) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def _attempt(count: object, redelivered: bool) -> int:
    if isinstance(count, int):
        return count + 1
    return 2 if redelivered else 1


def open_channel(place: Place, prefetch: int, timeout_s: float) -> AmqpChannel:
    """Open a way to a place of a RabbitMQ."""
    return AmqpChannel(place, prefetch, timeout_s)
