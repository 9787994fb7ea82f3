"""RabbitMQ by aio-pika: ``amqp://USER:PASSWORD@HOST/QUEUE``, encrypted ``amqps://``.

A queue is a quorum queue, and so is its dead-letter queue; a broadcast is a fanout exchange, with a queue of its own
for each consumer; a log is a stream. What is there already is taken as it is.

What was confirmed is on the broker's disk (of most brokers of a cluster), and each message has a count of its
deliveries. RabbitMQ writes down that there is a queue up to a second after it was made: if it is killed before, the
queue comes back empty. With a queue of another type RabbitMQ says only whether a message was delivered before:
`Delivery.attempt` is 1 or 2 then. What a consumer had prefetched counts as delivered too when it dies.
"""

from __future__ import annotations

import asyncio
import logging
import re
from collections.abc import Callable, Mapping
from shlex import quote
from typing import Any, Final

import aio_pika
from aio_pika.abc import AbstractChannel, AbstractIncomingMessage
from aio_pika.connection import make_url
from aio_pika.exceptions import (
    AMQPError,
    ChannelClosed,
    ChannelNotFoundEntity,
    ChannelPreconditionFailed,
    DeliveryError,
    ProbableAuthenticationError,
    PublishError,
)

from epypes.errors import BrokerError, MessageError
from epypes.transport.address import Address
from epypes.transport.brokers.channel import BrokerChannel, BrokerSession, certificates_of, unreachable
from epypes.transport.brokers.message import IncomingMessage, OutgoingMessage
from epypes.transport.channel import ChannelOptions

# aio-pika takes a broker for gone after three of them, RabbitMQ a client after two.
_HEARTBEAT_S: Final = 4
# Quorum queues refuse more.
_MOST_PREFETCH: Final = 2_000
# A consumer of a broadcast that does not keep up loses the oldest messages.
_BROADCAST_QUEUE: Final[Mapping[str, Any]] = {"x-max-length": 10_000, "x-max-length-bytes": 256 * 1024 * 1024}
_LONGEST_ID: Final = 255
_COUNT: Final = "x-delivery-count"
# What the broker writes for its own use; a dead letter of ours must not have the deliveries of the queue it was in.
_OF_THE_BROKER: Final = ("x-delivery-count", "x-death", "x-first-death-", "x-last-death-", "x-stream-offset")
# aiormq gives each message an id; this header says that the sender gave none.
_NO_ID: Final = "epypes-no-id"
_NO_HOST, _NOT_ALLOWED = 530, 403

# Of each failed connection attempt aiormq writes some lines; the channel reports an outage once.
for _name in ("aio_pika", "aiormq"):
    if logging.getLogger(_name).level == logging.NOTSET:
        logging.getLogger(_name).setLevel(logging.CRITICAL)


class AmqpSession(BrokerSession):
    """A connection to RabbitMQ."""

    # Properties have to fit a frame of AMQP, of 128 KB with RabbitMQ.
    most_header_bytes = 100_000

    def __init__(self, address: Address, timeout_s: float) -> None:
        super().__init__(address, timeout_s)
        self._connection: Any = None
        self._publishing: AbstractChannel | None = None
        self._opening = asyncio.Lock()
        self._deliver: Callable[[IncomingMessage], object] = lambda message: None

    def check(self, message: OutgoingMessage) -> None:
        """Raise MessageError for ids and headers that AMQP has no room for."""
        if len(message.id.encode()) > _LONGEST_ID:
            text = f"The id {message.id[:40]!r}... of a message is longer than {_LONGEST_ID} bytes."
            raise MessageError("bad id", text)
        for name in message.headers:
            if len(name.encode()) > _LONGEST_ID:
                text = f"The header {name[:40]!r}... has a name over {_LONGEST_ID} bytes."
                raise MessageError("bad header", text)

    async def connect(self, window: int) -> None:
        """Connect, and see that the queues are there, or make them."""
        address = self.address
        self._publishing = None
        url = make_url(
            host=address.host,
            port=address.port,
            login=address.user or "guest",
            password=address.password or "guest",
            virtualhost=address.vhost,
            ssl=address.is_encrypted,
            heartbeat=_HEARTBEAT_S,
        )
        self._connection = connection = aio_pika.Connection(
            url,
            ssl_context=certificates_of(address) if address.is_encrypted else None,
            client_properties={"product": "EPypes", "connection_name": f"epypes {address.name}"},
        )
        try:
            await connection.connect()
        except BaseException as error:
            # Otherwise its destructor would close it, on any thread: aio-pika 10.2 needs a running event loop there.
            await connection.close()
            if not isinstance(error, Exception):
                raise
            raise self._unreachable(error) from error
        self._connection.close_callbacks.add(lambda _, error: self.lose(_reason(error)))
        await self._make_sure(address)
        if address.has_dead_letters:
            await self._make_sure(address.dead_letters)
        if not window:
            # Before the first message, since those that waited for it could be overtaken.
            await self._open_publishing()

    def _unreachable(self, error: Exception) -> BrokerError:
        if isinstance(error, BrokerError):
            return error
        # aiormq wraps the errors of the network.
        inner = error.__cause__ if isinstance(error.__cause__, OSError) else error
        address, code = self.address, error.args[0] if error.args else None
        otherwise = f"What answers at {address} does not speak AMQP 0-9-1, or hung up: is it RabbitMQ, and this port?"
        if isinstance(error, ProbableAuthenticationError) or code == _NOT_ALLOWED:
            user = f"user {address.user!r}" if address.user else "a connection without a user"
            return BrokerError(str(address), f"{address} refuses {user} or the password. {address.refused_way_out}")
        # aiormq 7.2 has no error of its own for a broker that closes the connection instead of opening a virtual host.
        if code == _NO_HOST or "Connection.OpenOk" in str(error):
            text = f"{address} has no virtual host {address.vhost!r}, or user {address.user!r} may not use it."
            return BrokerError(str(address), text)
        return unreachable(address, inner, self.timeout_s, "a RabbitMQ", otherwise)

    async def _make_sure(self, address: Address) -> None:
        """See that a queue or exchange is there; make it if the address says so."""
        try:
            await self._declare(address, passive=True)
        except ChannelNotFoundEntity as error:
            if not address.create:
                raise self._missing(address) from error
            try:
                await self._declare(address, passive=False)
            except ChannelClosed as refused:
                try:
                    # Another client may have made it in the meantime, in another way.
                    await self._declare(address, passive=True)
                except AMQPError:
                    raise BrokerError(str(address), f"{address} can't be made: {_reason(refused)}.") from refused
        except AMQPError as error:
            raise BrokerError(str(address), f"{address} can't be used: {_reason(error)}.") from error

    async def _declare(self, address: Address, *, passive: bool) -> None:
        # On a channel of its own: the broker closes it when the answer is no.
        async with self._connection.channel() as channel:
            if address.kind == "broadcast":
                await channel.declare_exchange(address.name, "fanout", passive=passive, durable=True)
                return
            arguments = {"x-queue-type": "stream" if address.kind == "log" else "quorum"}
            if address.has_dead_letters:
                # If the broker itself gives a message up (newer ones do after 20 deliveries), it is kept all the same.
                letters = address.dead_letters.name
                arguments |= {"x-dead-letter-exchange": "", "x-dead-letter-routing-key": letters}
            await channel.declare_queue(address.name, passive=passive, durable=True, arguments=arguments)

    def _missing(self, address: Address) -> BrokerError:
        what, wanted = "exchange" if address.kind == "broadcast" else "queue", self.address
        is_other = address.name != wanted.name
        purpose = f", the dead-letter queue of {wanted.name!r}," if is_other else ""
        way_out = ", name another with ?dead=QUEUE" if is_other else ""
        text = (
            f"There is no {what} {address.name!r}{purpose} at {wanted}. "
            f"Make it{way_out}, or add ?create=true to the address."
        )
        return BrokerError(str(wanted), text)

    def hint(self, address: Address) -> str:
        """Return where to look when RabbitMQ is there and says nothing."""
        text = " RabbitMQ takes no messages while it is low on memory or disk: rabbitmqctl status says whether it is."
        if address.kind != "queue":
            return text
        # A quorum queue without a leader takes and gives no message, and no error.
        where = "" if address.vhost == "/" else f"--vhost {quote(address.vhost)} "
        return f"{text} rabbitmq-queues quorum_status {where}{quote(address.name)} says whether the queue has a leader."

    async def publish(self, message: OutgoingMessage) -> None:
        """Send a message; return when the broker has it on its disk."""
        address, is_broadcast = message.address, message.address.kind == "broadcast"
        headers: dict[str, Any] = dict(message.headers) if message.id else {**message.headers, _NO_ID: "1"}
        carried = aio_pika.Message(
            message.body,
            headers=headers,
            message_id=message.id or None,
            delivery_mode=aio_pika.DeliveryMode.PERSISTENT,
        )
        try:
            channel = self._publishing
            if channel is None or channel.is_closed:
                channel = await self._open_publishing()
            if is_broadcast:
                exchange = await channel.get_exchange(address.name, ensure=False)
                await exchange.publish(carried, "", mandatory=False)
            else:
                await channel.default_exchange.publish(carried, address.name)
        except PublishError as error:
            raise self._missing(address) from error
        except DeliveryError as error:
            text = f"{address} did not take a message: the queue is full, or can't keep it now."
            raise BrokerError(str(self.address), text) from error
        except ChannelPreconditionFailed as error:
            most = re.search(r"larger than.*?(\d+)", _reason(error))
            if most is not None and len(message.body) > int(most[1]):
                text = f"A message of {len(message.body):,} bytes is too large for {address}: {_reason(error)}."
                raise MessageError("too large", text) from error
            raise BrokerError(str(self.address), f"{address} did not take a message: {_reason(error)}.") from error

    async def _open_publishing(self) -> AbstractChannel:
        async with self._opening:
            if self._publishing is None or self._publishing.is_closed:
                self._publishing = await self._connection.channel(publisher_confirms=True, on_return_raises=True)
            return self._publishing

    async def consume(self, deliver: Callable[[IncomingMessage], object], window: int) -> None:
        """Have a function called with each message of the queue, broadcast or log."""
        address, self._deliver = self.address, deliver
        try:
            channel = await self._connection.channel(publisher_confirms=False)
            channel.close_callbacks.add(lambda _, error: self.lose(_reason(error)))
            underlay = await channel.get_underlay_channel()
            deleted = f"the queue {address.name!r} was deleted"
            underlay.on_consumer_cancel_callbacks.add(lambda frame: self.lose(deleted))
            if address.kind == "broadcast":
                queue = await channel.declare_queue(exclusive=True, auto_delete=True, arguments=dict(_BROADCAST_QUEUE))
                await queue.bind(address.name)
            else:
                queue = await channel.get_queue(address.name, ensure=False)
            await channel.set_qos(min(window, _MOST_PREFETCH))
            first: dict[str, Any] = {"x-stream-offset": "first"} if address.kind == "log" else {}
            await queue.consume(self._take, arguments=first)
        except AMQPError as error:
            raise BrokerError(str(address), f"{address} can't be received from: {_reason(error)}.") from error

    async def _take(self, message: AbstractIncomingMessage) -> None:
        headers = {name: _text(value) for name, value in message.headers.items()}
        known_as = "" if headers.pop(_NO_ID, "") else message.message_id or ""
        shown = {name: value for name, value in headers.items() if not name.startswith(_OF_THE_BROKER)}
        attempt = 0
        if self.address.kind == "queue":
            count = message.headers.get(_COUNT)
            attempt = count + 1 if isinstance(count, int) else 1 + bool(message.redelivered)
        self._deliver(IncomingMessage(message.body, known_as, shown, attempt, receipt=message))

    async def settle(self, message: IncomingMessage, *, requeue: bool) -> None:
        """Acknowledge a message, or return it to its queue."""
        if requeue:
            await message.receipt.nack()
        else:
            await message.receipt.ack()

    async def close(self) -> None:
        """Disconnect; RabbitMQ delivers again what was not acknowledged."""
        connection, self._connection = self._connection, None
        self._publishing = None
        if connection is not None:
            await connection.close()


def _reason(error: BaseException | None) -> str:
    """Return why a connection or channel was closed: the end of a sentence, without its full stop."""
    if error is None or isinstance(error, asyncio.CancelledError):
        return "nothing was heard from the broker" if error is not None else "it was closed"
    text = next((argument for argument in reversed(error.args) if isinstance(argument, str)), "")
    if isinstance(error, ChannelClosed):
        return f"the broker says {text[:300]!r}"
    return f"the broker has gone away ({text[:300] or type(error).__name__})"


def _text(value: object) -> str:
    return value.decode(errors="replace") if isinstance(value, bytes) else str(value)


def make_channel(address: Address, options: ChannelOptions) -> BrokerChannel:
    """Return a channel to RabbitMQ."""
    return BrokerChannel(AmqpSession(address, options.timeout_s), options)
