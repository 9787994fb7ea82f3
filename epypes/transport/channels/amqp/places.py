"""Which queues and exchanges of RabbitMQ stand for a place, and are they there?

A work queue is a quorum queue, and so is the one for its dead letters; a broadcast is a fanout exchange, with a queue
of its own for everybody who listens; a log is a stream. What is there already is taken as it is.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

from pika.exceptions import ChannelClosed

from epypes.errors import BrokerError
from epypes.transport.channels.amqp.connection import Connection, Line
from epypes.transport.channels.amqp.reasons import reason_of
from epypes.transport.channels.place import Place

_MISSING: Final = 404
_DEAD: Final = ".dead"
# What a listener that does not keep up leaves behind is thrown away, oldest first.
_HEARD: Final[Mapping[str, object]] = {"x-max-length": 10_000, "x-max-length-bytes": 256 * 1024 * 1024}


def make_sure(connection: Connection, place: Place) -> None:
    """See that a place is there, and make it if that was asked for.

    Raises
    ------
    BrokerError
        It is not there and was not to be made, or the broker refuses.
    """
    _make_one(connection, place)
    if has_dead_letters(place):
        _make_one(connection, place.dead_letters)


def has_dead_letters(place: Place) -> bool:
    """Return whether what is rejected goes to another queue; a dead letter that is rejected stays where it is."""
    return place.kind == "queue" and aside(place).name != place.name


def aside(place: Place) -> Place:
    """Return where what is rejected goes."""
    return place if place.name.endswith(_DEAD) and not place.dead else place.dead_letters


def _make_one(connection: Connection, place: Place) -> None:
    error = _try(connection, lambda amqp, done: _declare(amqp, place, done, passive=True))
    if error is None:
        return
    if _code(error) != _MISSING:
        raise connection.error(f"{place} can't be used: {reason_of(error)}.")
    if not place.create:
        raise missing(connection, place)
    error = _try(connection, lambda amqp, done: _declare(amqp, place, done, passive=False))
    if error is not None:
        # Another one may have made it in the meantime, in another way.
        again = _try(connection, lambda amqp, done: _declare(amqp, place, done, passive=True))
        if again is not None:
            raise connection.error(f"{place} can't be made: {reason_of(error)}.")


def _code(error: BaseException) -> int:
    return error.reply_code if isinstance(error, ChannelClosed) else 0


def _try(connection: Connection, say: Callable[[Any, Callable[[object], None]], object]) -> BaseException | None:
    """Ask on a channel of its own: the broker closes it when the answer is no."""
    line = Line(connection)
    error = line.ask(say)
    line.close()
    return error


def _declare(amqp: Any, place: Place, done: Callable[[object], None], *, passive: bool) -> None:
    if place.kind == "broadcast":
        amqp.exchange_declare(place.name, "fanout", passive=passive, durable=True, callback=done)
        return
    kind = "stream" if place.kind == "log" else "quorum"
    told: dict[str, object] = {"x-queue-type": kind}
    if has_dead_letters(place):
        # Should the broker itself give a message up (newer ones do after 20 deliveries), it is kept all the same.
        told |= {"x-dead-letter-exchange": "", "x-dead-letter-routing-key": place.dead_letters.name}
    amqp.queue_declare(place.name, passive=passive, durable=True, arguments=told, callback=done)


def missing(connection: Connection, place: Place) -> BrokerError:
    """Return the error for a place that is not there."""
    what = "exchange" if place.kind == "broadcast" else "queue"
    wanted = connection.place
    for_whom = f", for the dead letters of {wanted.name!r}," if place.name == aside(wanted).name != wanted.name else ""
    out = ", name another with ?dead=QUEUE" if for_whom else ""
    text = f"There is no {what} {place.name!r}{for_whom} at {wanted}. Make it{out}, or add ?create=true to the address."
    return connection.error(text)


def listen(line: Line, place: Place, prefetch: int, heard: Callable[..., object], tag: str) -> BaseException | None:
    """Have the broker deliver what comes to a place; return None, or what it closed the channel with.

    The tag tells it from others of the same line, each of which has its own prefetch.
    """
    queue: list[str] = [place.name]
    if place.kind == "broadcast":
        queue.clear()
        error = line.ask(lambda amqp, done: _own_queue(amqp, place, queue, done))
        if error is not None:
            return error
    first = {"x-stream-offset": "first"} if place.kind == "log" else {}
    error = line.ask(lambda amqp, done: amqp.basic_qos(prefetch_count=prefetch, callback=done))
    if error is not None:
        return error
    return line.ask(
        lambda amqp, done: amqp.basic_consume(queue[0], heard, consumer_tag=tag, arguments=first, callback=done)
    )


def _own_queue(amqp: Any, place: Place, queue: list[str], done: Callable[[object], None]) -> None:
    def bind(frame: Any) -> None:
        queue.append(frame.method.queue)
        amqp.queue_bind(queue[0], place.name, callback=done)

    amqp.queue_declare("", exclusive=True, auto_delete=True, arguments=dict(_HEARD), callback=bind)
