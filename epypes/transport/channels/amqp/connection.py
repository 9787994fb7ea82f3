"""How is a connection to RabbitMQ opened, kept alive and ended?"""

from __future__ import annotations

import logging
import ssl
from collections.abc import Callable
from typing import Any, Final

import pika
from pika.exceptions import AMQPError

from epypes.errors import BrokerError
from epypes.transport.channels.amqp.loop import JoiningConnection, PikaLoop
from epypes.transport.channels.amqp.reasons import leader_hint, opening_reason, reason_of
from epypes.transport.channels.place import Place
from epypes.transport.channels.turns import Turns, always, nothing

_HEARTBEAT_S: Final = 4
# Both sides say something every two seconds: who is silent at so many looks is cut off, whatever TCP thinks of it.
_KEEPING_S: Final = 1.0
_MOST_SILENT: Final = 8
_CLOSING_S: Final = 2.0

# Of each failure pika writes five lines, and so for each attempt while a broker is away; we raise it, and say it once.
if logging.getLogger("pika").level == logging.NOTSET:
    logging.getLogger("pika").setLevel(logging.CRITICAL)


class Line:
    """One of the connection's channels, as AMQP calls them, and why it is closed.

    Attributes
    ----------
    amqp
        Pika's channel; used by the thread whose turn it is.
    error
        What it was closed with; None while it is open.
    """

    def __init__(self, connection: Connection) -> None:
        self.amqp: Any = None
        self.error: BaseException | None = None
        self._is_open = False
        self._connection = connection
        connection.turns.run(self._begin, lambda: self._is_open or self.is_over, connection.timeout_s)
        connection.check()
        if not self._is_open:
            raise connection.error(f"{connection.place} did not open a channel within {connection.timeout_s:g} s.")

    def _begin(self) -> None:
        self.amqp = self._connection.pika.channel(on_open_callback=self._opened)
        self.amqp.add_on_close_callback(self._closed)

    def _opened(self, amqp: Any) -> None:
        self._is_open = True

    def _closed(self, amqp: Any, error: BaseException) -> None:
        self.error = error

    @property
    def is_over(self) -> bool:
        """Whether nothing can be said on it any more."""
        return self.error is not None or bool(self._connection.trouble)

    def ask(self, say: Callable[[Any, Callable[[object], None]], object]) -> BaseException | None:
        """Say something that is answered; return None, or what the broker closed the channel with.

        Parameters
        ----------
        say
            Given pika's channel and the callback for the answer.

        Raises
        ------
        BrokerError
            The connection is over, or there was no answer in time.
        """
        answers: list[object] = []
        connection = self._connection
        work = lambda: say(self.amqp, answers.append)  # noqa: E731
        connection.turns.run(work, lambda: answers or self.is_over, connection.timeout_s)
        connection.check()
        if not answers and self.error is None:
            text = f"{connection.place} did not answer within {connection.timeout_s:g} s."
            raise connection.error(text + leader_hint(connection.place))
        return self.error

    def close(self) -> None:
        """Close it, without waiting."""
        self._connection.turns.run(self._end, always, 0.0)

    def _end(self) -> None:
        if self.error is None and self.amqp.is_open:
            self.amqp.close()


class Connection:
    """A connection to a broker.

    Attributes
    ----------
    place
        What it was opened for.
    timeout_s
        Longest wait for the broker's word, in seconds.
    turns
        Who works on it.
    trouble
        Why it is over; empty while it is not.
    pika
        Pika's connection.
    """

    def __init__(self, place: Place, timeout_s: float) -> None:
        self.place, self.timeout_s = place, timeout_s
        self.trouble = self._blocked = ""
        self._is_open = self._is_ended = False
        self._opening: BaseException | None = None
        self._heard = self._silent = 0
        parameters = _parameters(place, timeout_s)
        self._loop = PikaLoop()
        self.pika = JoiningConnection(
            parameters, self._opened, self._not_opened, self._closed, custom_ioloop=self._loop
        )
        self.turns = Turns(self._loop, self.lose, f"epypes keeps {place.host}")
        self.turns.run(nothing, lambda: self._is_open or self._opening, timeout_s)
        if not self._is_open:
            text = opening_reason(self._opening, place, timeout_s)
            self._abandon()
            raise BrokerError(str(place), text)
        self.turns.run(self._watch, always, 0.0)

    def _opened(self, connection: object) -> None:
        self._is_open = self._loop.is_eager = True

    def _not_opened(self, connection: object, error: BaseException) -> None:
        self._opening = error

    def _closed(self, connection: object, error: BaseException) -> None:
        self.trouble = self.trouble or reason_of(error)

    def _watch(self) -> None:
        self.pika.add_on_connection_blocked_callback(lambda _, frame: self._block(frame.method.reason))
        self.pika.add_on_connection_unblocked_callback(lambda _, frame: self._block(""))
        self._loop.call_later(_KEEPING_S, self._listen)

    def _block(self, reason: object) -> None:
        self._blocked = f" It takes no messages just now: {reason}." if reason else ""

    def lose(self, error: Exception | str) -> None:
        """Take it for broken; by the thread whose turn it is."""
        self.trouble = self.trouble or (error if isinstance(error, str) else reason_of(error))

    def later(self, delay_s: float, work: Callable[[], object]) -> None:
        """Have something done after so many seconds, unless it is over then."""
        self.turns.run(lambda: self._loop.call_later(delay_s, work), always, 0.0)

    def error(self, text: str) -> BrokerError:
        """Return the error that says a text, and what the broker told of itself."""
        return BrokerError(str(self.place), text + self._blocked)

    def check(self) -> None:
        """Raise BrokerError if it is over."""
        if self.trouble:
            raise self.error(f"The connection to {self.place} is over: {self.trouble}.")

    def _listen(self) -> None:
        """Notice a broker that says nothing any more: a link that was cut tells nobody."""
        # Counted, not timed: what has come while this process itself stood still is read before the next look.
        if self.pika.bytes_received != self._heard:
            self._heard, self._silent = self.pika.bytes_received, 0
        else:
            self._silent += 1
        if self._silent > _MOST_SILENT:
            self.lose(f"nothing was heard from the broker for {_MOST_SILENT * _KEEPING_S:g} s")
        if not self.trouble:
            self._loop.call_later(_KEEPING_S, self._listen)

    def close(self, reason: str = "it was closed") -> None:
        """End it; as often as you like, bounded by two times two seconds."""
        if self._is_ended:
            return
        self._is_ended = True
        was_open = not self.trouble
        self.turns.run(lambda: self._part(reason), lambda: self.pika.is_closed, _CLOSING_S if was_open else 0.0)
        self._abandon()

    def _part(self, reason: str) -> None:
        self.lose(reason)
        if self.pika.is_open:
            self.pika.close()

    def _abandon(self) -> None:
        """Have nothing be left open, whatever the broker says or does not say."""
        if not self.pika.is_closed:
            self.turns.run(self._cut, lambda: self.pika.is_closed, _CLOSING_S)
        self.turns.end(_CLOSING_S)

    def _cut(self) -> None:
        # As pika's own heartbeats do: there is no public word for closing without asking the other side.
        if not self.pika.is_closed:
            self.pika._terminate_stream(AMQPError("abandoned"))


def _parameters(place: Place, timeout_s: float) -> pika.ConnectionParameters:
    return pika.ConnectionParameters(
        host=place.host,
        port=place.port,
        virtual_host=place.vhost,
        credentials=pika.PlainCredentials(place.user or "guest", place.password or "guest"),
        heartbeat=_HEARTBEAT_S,
        socket_timeout=timeout_s,
        stack_timeout=timeout_s,
        connection_attempts=1,
        ssl_options=_encryption(place) if place.is_encrypted else None,
        client_properties={"product": "EPypes", "connection_name": f"epypes {place.name}"},
    )


def _encryption(place: Place) -> pika.SSLOptions:
    try:
        context = ssl.create_default_context(cafile=place.ca or None)
    except OSError as error:
        why = getattr(error, "strerror", None) or error
        text = f"The certificates for {place} can't be read from {place.ca}: {why}."
        raise BrokerError(str(place), text) from error
    return pika.SSLOptions(context, place.host)
