"""NATS JetStream by nats-py: ``nats://USER:PASSWORD@HOST/SUBJECT``, encrypted ``tls://``.

A queue is a stream of the subject with one durable consumer, the address' group, that all channels pull from. A log is
a stream that each channel reads by an ephemeral consumer of its own. A broadcast is plain NATS. What is there already
is taken as it is.

The session asks for messages ahead, so that none waits for a request; what it has asked for and what is unsettled are
together no more than the prefetch window, so a busy consumer leaves the rest to others. Each request ends by itself
after a few seconds and is replaced: a consumer whose link is cut is given nothing for longer than that.
"""

from __future__ import annotations

import asyncio
import json
import logging
import re
from collections.abc import Callable
from time import monotonic
from typing import Any, Final

from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.errors import Error as NatsError
from nats.errors import SlowConsumerError
from nats.js import JetStreamContext
from nats.js.api import AckPolicy, ConsumerConfig, DeliverPolicy, RetentionPolicy, StorageType, StreamConfig
from nats.js.errors import APIError, NoStreamResponseError, NotFoundError, ServiceUnavailableError

from epypes.errors import BrokerError, MessageError
from epypes.transport.address import Address
from epypes.transport.brokers.channel import BrokerChannel, BrokerSession, certificates_of, unreachable
from epypes.transport.brokers.message import IncomingMessage, OutgoingMessage, header_bytes
from epypes.transport.channel import ChannelOptions

# A consumer that has died is noticed by this: one that lives reports progress of each message every second.
ACK_WAIT_S: Final = 5.0
_PROGRESS_S: Final = 1.0
# Shorter than the wait for an acknowledgement, so that what a cut consumer was given last comes to another one.
_REQUEST_S: Final = 4.0
# Two unanswered pings in a row: the connection is lost.
_PING_S: Final = 2.5
_DUPLICATES_S: Final = 120.0
_FORGOTTEN_S: Final = 60.0
_ID, _STORED_ID = "epypes-id", "Nats-Msg-Id"
_TOO_LARGE: Final = 10_054
_SUBJECT: Final = re.compile(r"(?:[^\s.*>]+|\*)(?:\.(?:[^\s.*>]+|\*))*(?:\.>)?|>")

if logging.getLogger("nats").level == logging.NOTSET:
    logging.getLogger("nats").setLevel(logging.CRITICAL)


class NatsSession(BrokerSession):
    """A connection to a NATS server."""

    # The server takes 64 kB, its own first line with them.
    most_header_bytes = 65_000

    def __init__(self, address: Address, timeout_s: float) -> None:
        super().__init__(address, timeout_s)
        self._client = Client()
        self._stream = self._requests = ""
        self._subscription: Any = None
        self._keeping_alive: asyncio.Task[None] | None = None
        self._deliver: Callable[[IncomingMessage], object] = lambda message: None
        self._window, self._progress_s = 0, _PROGRESS_S
        # By its reply subject: what was delivered and is not settled.
        self._held: dict[str, Msg] = {}
        # How many messages were asked for and have not come; until when, by the number of the request.
        self._expected = self._last_request = 0
        self._open_requests: dict[int, float] = {}

    def check(self, message: OutgoingMessage) -> None:
        """Raise MessageError for what can be no header, and for an address that stands for many subjects."""
        if _is_pattern(message.address.name):
            text = f"{message.address} stands for many subjects: name the one to send to."
            raise MessageError("many subjects", text)
        for name in message.headers:
            if not name.isascii() or not name.isprintable() or ":" in name or " " in name or not name:
                raise MessageError("bad header", f"{name!r} can't be the name of a header at {message.address}.")

    async def connect(self, window: int) -> None:
        """Connect once, without the client's own reconnecting, and see that the streams are there, or make them."""
        address = self.address
        _check_names(address)
        self._held.clear()
        self._open_requests.clear()
        self._expected = 0
        self._client, errors = Client(), list[Exception]()
        certificates = certificates_of(address)

        def password() -> str:
            # The client asks when it is about to send it: a server that doesn't encrypt must not get it.
            if certificates is not None and address.is_encrypted and not certificates.session_stats()["connect_good"]:
                text = f"{address} can't be trusted: it does not encrypt. Write nats:// for an unencrypted connection."
                raise BrokerError(str(address), text)
            return address.password

        async def failed(error: Exception) -> None:
            errors.append(error)
            if self._client.is_connected and not isinstance(error, SlowConsumerError):
                self.lose(f"the server refuses: {_reason(error)}" if "permissions" in str(error) else _gone(error))

        async def closed() -> None:
            self.lose(_gone(self._client.last_error))

        host = f"[{address.host}]" if ":" in address.host else address.host
        options: dict[str, Any] = {"tls": certificates} if certificates is not None else {}
        if address.user:
            options |= {"user": address.user, "password": password}
        elif address.password:
            options["token"] = password
        try:
            await self._client.connect(
                f"{'tls' if address.is_encrypted else 'nats'}://{host}:{address.port}",
                name="epypes",
                allow_reconnect=False,
                connect_timeout=self.timeout_s,
                reconnect_time_wait=0,
                max_reconnect_attempts=1,
                ping_interval=_PING_S,
                max_outstanding_pings=2,
                error_cb=failed,
                disconnected_cb=closed,
                closed_cb=closed,
                **options,
            )
        except Exception as error:
            # The first error says why; the client's last one that no server is left.
            raise self._unreachable(errors[0] if errors else error) from error
        self._keeping_alive = asyncio.ensure_future(self._keep_alive())
        if address.kind != "broadcast":
            await self._find_streams()

    def _unreachable(self, error: Exception) -> BrokerError:
        address = self.address
        if "authorization" in str(error).lower():
            user = f"the user {address.user!r} with this password" if address.user else "a connection without a user"
            return BrokerError(str(address), f"{address} refuses {user}. {address.refused_way_out}")
        otherwise = f"{address} can't be reached: what answers there is no NATS server ({_reason(error)})."
        return unreachable(address, error, self.timeout_s, "a NATS server", otherwise)

    async def _find_streams(self) -> None:
        address, jetstream = self.address, self._client.jetstream(timeout=self.timeout_s)
        try:
            self._stream = await _stream_of(jetstream, address)
            if address.has_dead_letters:
                await _stream_of(jetstream, address.dead_letters)
        except ServiceUnavailableError as error:
            text = f"{address} can't keep messages: JetStream is off there. Start the server with it: nats-server -js."
            raise BrokerError(str(address), text) from error
        except APIError as error:
            raise BrokerError(str(address), f"{address} refuses: {_reason(error)}.") from error

    async def publish(self, message: OutgoingMessage) -> None:
        """Send a message; return when its stream has it, or for a broadcast when the server has read it."""
        address, headers = message.address, dict(message.headers)
        if message.id or message.origin:
            # A stream drops the second message of one Nats-Msg-Id, and may keep several subjects: events, their answers
            # and their dead letters, which all have the event's id. So the subject is in it. An event that was sent
            # again and rejected again is another dead letter.
            stored_id = f"{message.origin or message.id}@{(message.origin and self.address.name) or address.name}"
            headers |= {_ID: message.id, _STORED_ID: stored_id}
        size, most = len(message.body) + header_bytes(headers), self._client.max_payload
        if size > most:
            way_out = (
                "Raise max_payload in the server's settings (nats-server takes up to 64MB), or send less at a time."
            )
            raise MessageError("too large", f"A message of {size:,} bytes; {address} takes {most:,} at most. {way_out}")
        try:
            if address.kind == "broadcast":
                await self._client.publish(address.name, message.body, headers=headers or None)
                await self._client.flush(self.timeout_s)
            else:
                jetstream = self._client.jetstream()
                await jetstream.publish(address.name, message.body, self.timeout_s, headers=headers or None)
        except NoStreamResponseError as error:
            raise BrokerError(str(address), f"No stream at {address} keeps what is sent there any more.") from error
        except APIError as error:
            text = f"{address} refuses a message: {_reason(error)}."
            if error.err_code == _TOO_LARGE:
                raise MessageError("too large", text) from error
            raise BrokerError(str(address), text) from error

    async def consume(self, deliver: Callable[[IncomingMessage], object], window: int) -> None:
        """Have a function called with each message of the queue, broadcast or log."""
        address, self._deliver = self.address, deliver
        # The channel itself bounds what waits.
        unbounded = {"pending_msgs_limit": -1, "pending_bytes_limit": -1}
        if address.kind == "broadcast":
            self._subscription = await self._client.subscribe(address.name, cb=self._take_broadcast, **unbounded)
            await self._client.flush(self.timeout_s)
            return
        consumer, ack_wait_s = await self._find_consumer()
        self._requests = f"$JS.API.CONSUMER.MSG.NEXT.{self._stream}.{consumer}"
        self._inbox = self._client.new_inbox()
        self._subscription = await self._client.subscribe(f"{self._inbox}.*", cb=self._take, **unbounded)
        self._progress_s, self._window = min(_PROGRESS_S, ack_wait_s / 4), window
        await self._request(least=1)

    async def _find_consumer(self) -> tuple[str, float]:
        """Return the name of the consumer that is pulled from, and how long it waits for an acknowledgement."""
        address, stream = self.address, self._stream
        jetstream = self._client.jetstream(timeout=self.timeout_s)
        try:
            if address.kind == "log":
                made = await jetstream.add_consumer(stream, _own_consumer(), filter_subject=address.name)
                return str(made.name), ACK_WAIT_S
            try:
                found = (await jetstream.consumer_info(stream, address.group)).config
            except NotFoundError:
                shared = _shared_consumer().evolve(durable_name=address.group, filter_subject=address.name)
                found = (await jetstream.add_consumer(stream, shared)).config
        except APIError as error:
            raise BrokerError(str(address), f"{address} can't be received from: {_reason(error)}.") from error
        what = f"The consumer {address.group!r} of the stream {stream!r}"
        if found.filter_subject and found.filter_subject != address.name:
            raise BrokerError(str(address), f"{what} is for {found.filter_subject}. Add &group=NAME to {address}.")
        if found.deliver_subject or found.ack_policy != AckPolicy.EXPLICIT:
            raise BrokerError(str(address), f"{what} is no pull consumer with explicit acknowledgements.")
        return address.group, found.ack_wait or ACK_WAIT_S

    async def _request(self, least: int) -> None:
        """Ask for as many messages as there is room for, if that is enough."""
        now_s = monotonic()
        if self._open_requests and max(self._open_requests.values()) < now_s:
            # The server never ended them.
            self._open_requests.clear()
            self._expected = 0
        room = self._window - len(self._held) - self._expected
        if room < least:
            return
        self._expected += room
        self._last_request += 1
        self._open_requests[self._last_request] = now_s + _REQUEST_S + _PROGRESS_S
        wish = json.dumps({"batch": room, "expires": int(_REQUEST_S * 1e9)}).encode()
        await self._client.publish(self._requests, wish, f"{self._inbox}.{self._last_request}")

    async def _keep_alive(self) -> None:
        """Tell the server that the consumer of each unsettled message lives, and ask for what no request brought."""
        try:
            while not self.lost.done():
                await asyncio.sleep(self._progress_s)
                if not self._client.is_connected:
                    # The client calls back only when all that it had to send was taken, which may never be.
                    self.lose(_gone(self._client.last_error))
                elif self._requests:
                    for message in tuple(self._held.values()) if self.address.kind == "queue" else ():
                        await message.in_progress()
                    await self._request(least=1)
        except Exception as error:
            # Without it the server would deliver each unsettled message again and again.
            self.lose(_reason(error))

    async def _take_broadcast(self, message: Msg) -> None:
        self._deliver(_incoming(message, 0))

    async def _take(self, message: Msg) -> None:
        """Take a message that was asked for, or the end of a request."""
        if message.reply.startswith("$JS.ACK."):
            self._expected = max(self._expected - 1, 0)
            self._held[message.reply] = message
            metadata = message.metadata
            taken = _incoming(message, metadata.num_delivered if self.address.kind == "queue" else 0)
            taken.receipt, taken.origin = message, f"{metadata.sequence.stream}.{metadata.timestamp.timestamp()}"
            self._deliver(taken)
            return
        headers = message.headers or {}
        status, description = headers.get("Status", ""), headers.get("Description", "").lower()
        number = message.subject.rpartition(".")[2]
        if number.isdecimal() and self._open_requests.pop(int(number), 0.0):
            self._expected = max(self._expected - int(headers.get("Nats-Pending-Messages", "0")), 0)
        if status == "503" or "deleted" in description:
            self.lose("the stream is gone, or the consumer that it is received by")
        else:
            await self._request(least=1)

    async def settle(self, message: IncomingMessage, *, requeue: bool) -> None:
        """Acknowledge a message, or have the server deliver it again."""
        if self._held.pop(message.receipt.reply, None) is not None:
            if self.address.kind == "queue":
                await (message.receipt.nak() if requeue else message.receipt.ack())
            # Not one by one: a request costs as much as a message.
            await self._request(least=max(self._window // 2, 1))

    async def close(self) -> None:
        """Return what is unsettled, and disconnect."""
        client, subscription = self._client, self._subscription
        self._subscription, self._requests = None, ""
        if self._keeping_alive is not None:
            self._keeping_alive.cancel()
        try:
            if client.is_connected and subscription is not None and self._held and not self.lost.done():
                await subscription.drain()
                for message in tuple(self._held.values()) if self.address.kind == "queue" else ():
                    await message.nak()
                await client.flush(self.timeout_s)
        finally:
            self._held.clear()
            await client.close()


def _incoming(message: Msg, attempt: int) -> IncomingMessage:
    headers = dict(message.headers or {})
    stored_id = headers.pop(_STORED_ID, "")
    return IncomingMessage(message.data, headers.pop(_ID, stored_id), headers, attempt)


def _shared_consumer() -> ConsumerConfig:
    # The subscriber counts the attempts, so that the last failure is kept and not just dropped.
    return ConsumerConfig(
        deliver_policy=DeliverPolicy.ALL,
        ack_policy=AckPolicy.EXPLICIT,
        ack_wait=ACK_WAIT_S,
        max_deliver=-1,
        max_ack_pending=-1,
    )


def _own_consumer() -> ConsumerConfig:
    return ConsumerConfig(
        deliver_policy=DeliverPolicy.ALL,
        ack_policy=AckPolicy.NONE,
        inactive_threshold=_FORGOTTEN_S,
        mem_storage=True,
    )


async def _stream_of(jetstream: JetStreamContext, address: Address) -> str:
    """Return the name of the stream that keeps a subject; make one if the address says so."""
    try:
        return str(await jetstream.find_stream_name_by_subject(address.name))
    except NotFoundError:
        if not address.create:
            text = f"No stream at {address} keeps the subject {address.name!r}."
            raise BrokerError(str(address), f"{text} Make one, or add ?create=true to the address.") from None
    stream = re.sub(r"[\s.*>/\\]", "_", address.name)
    config = StreamConfig(
        name=stream,
        subjects=[address.name],
        retention=RetentionPolicy.WORK_QUEUE if address.kind == "queue" else RetentionPolicy.LIMITS,
        storage=StorageType.FILE,
        duplicate_window=_DUPLICATES_S,
    )
    await jetstream.add_stream(config)
    return stream


def _is_pattern(subject: str) -> bool:
    """Return whether a subject stands for many; such can be received from, and not sent to."""
    return "*" in subject or ">" in subject


def _check_names(address: Address) -> None:
    """Raise BrokerError if an address' name can't be a subject, or its group no consumer."""
    if not _SUBJECT.fullmatch(address.name):
        text = f"{address.name!r} is no subject of NATS: write words with dots between them, such as robot.events."
        raise BrokerError(str(address), text)
    if address.kind == "queue" and _is_pattern(address.dead_letters.name):
        text = f"{address} stands for many subjects: name the dead-letter queue, by dead=SUBJECT."
        raise BrokerError(str(address), text)
    if not re.fullmatch(r"[^\s.*>/\\]+", address.group):
        text = f"{address.group!r} can't be a group at {address}: it may have no spaces, dots, slashes, * and > in it."
        raise BrokerError(str(address), text)


def _reason(error: BaseException) -> str:
    """Return what an error of the client or the server says, without its prefix."""
    described = getattr(error, "description", None)
    return str(described or error).removeprefix("nats: ").strip("'. ") or type(error).__name__


def _gone(error: BaseException | None) -> str:
    why = f" ({_reason(error)})" if isinstance(error, NatsError) else ""
    return f"the server has closed the connection, or has gone away{why}"


def make_channel(address: Address, options: ChannelOptions) -> BrokerChannel:
    """Return a channel to a NATS server."""
    return BrokerChannel(NatsSession(address, options.timeout_s), options)
