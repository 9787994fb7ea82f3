"""MQTT 5 by paho-mqtt: ``mqtt://USER:PASSWORD@HOST/TOPIC``, encrypted ``mqtts://``.

The client runs on the channel's event loop, by the hooks that paho-mqtt has for that. (aiomqtt 2 does the same and
can't be used here: it acknowledges a message as soon as it comes, and drops the broker's reason codes.)

What is promised, and by which means (seen with mosquitto 2.0.11):

- *queue* is a shared subscription with QoS 1 in a session that outlives its connection: at least once. The broker
  assigns each message to a session at once, connected or not. It does not count deliveries (``attempt`` is 0): a
  message that kills each consumer comes again and again; take RabbitMQ or NATS where that may happen. A message that no
  session would get is refused, and sent again until there is one; ``create=true`` makes one that keeps what comes, and
  each consumer makes one for its dead-letter queue, ``NAME/dead``.
- The state of each session is retained at ``NAME/gone/GROUP/SESSION``. A consumer of that group that reads there that a
  session has lost its connection connects as that session, sends what the broker keeps there to its group again
  (``NAME/again/GROUP``), and ends it. What a consumer leaves behind that never returns waits for the next consumer,
  seven days at most. A broker that is killed announces no lost connection: so a consumer asks each session that it
  finds in use, and takes one that does not answer for lost.
- *broadcast* is a plain subscription with QoS 1.
- *log* is none: a consumer gets the newest message, which is retained, and then all that come, in the broker's order.
- What is lost: what mosquitto had confirmed when it was killed or its machine lost power, but had not written to its
  disk (by default it writes each 30 minutes, see ``autosave_interval``); what is above ``max_queued_messages``, 1,000
  per session by default, which it drops without a sign; what another program sent with QoS 0 while no consumer was
  connected.
- mosquitto sends more than the prefetch window after an acknowledgement. Such messages wait in the session.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import socket
from collections import deque
from collections.abc import Callable, Coroutine, Mapping
from typing import Any, Final

import paho.mqtt.client as paho
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode
from paho.mqtt.subscribeoptions import SubscribeOptions

from epypes.errors import BrokerError, MessageError
from epypes.transport.address import Address
from epypes.transport.brokers.channel import BrokerChannel, BrokerSession, certificates_of, unreachable
from epypes.transport.brokers.message import (
    DEAD_LETTER_BYTES,
    SIZES,
    IncomingMessage,
    OutgoingMessage,
    header_bytes,
)
from epypes.transport.channel import ChannelOptions

log = logging.getLogger("epypes.transport")

# The broker cuts off after one and a half of it, the client after two: a cut link is noticed within 9 s.
_KEEP_ALIVE_S: Final = 4
_KEPT_S: Final = 7 * 24 * 3600
# Brokers may take no more than a few at a time, and say so when it is too late to tell paho.
_MOST_IN_FLIGHT: Final = 8
_MOST_UNKEPT: Final = 1_000
_PATIENCE_MS: Final = 200
# A consumer that lives answers for its session within this time, also if it has to connect again first.
_ANSWER_S: Final = 10.0
# What is retained of a session, and sent to ask whether it has a connection. All else: it has lost its connection.
_IN_USE, _ENDED, _ASK = b"in use", b"", b"?"
_LARGEST: Final = 268_000_000
_REFUSED, _UNHEARD, _TOO_LARGE = 0x80, 0x10, 0x95
_NO_ACCESS: Final = (0x84, 0x85, 0x86, 0x87, 0x8C)
_ID: Final = "epypes-id"
# paho copies the rest of a message, body and all, three times for each property that it reads, 3.4 ms for two beside
# 1 MB. So the two headers that most messages have share one: the sizes of the frames, a space, and the id.
_SIZES_AND_ID: Final = "epypes-frames-id"
_REASONS: Final[Mapping[str, str]] = {
    "Keep alive timeout": "nothing was heard from the broker for several seconds",
    "Session taken over": "another consumer has taken its session over",
    "Server shutting down": "the broker shuts down",
    "Unspecified error": "the broker has gone away",
}


class PahoConnection:
    """One connection of a paho client, driven by the running event loop.

    Attributes
    ----------
    lost
        Done with the reason when it is over.
    most_bytes
        The largest packet that the broker takes.
    """

    def __init__(self, address: Address, timeout_s: float, session: str = "", window: int = 1) -> None:
        self._address, self._timeout_s, self._has_session, self._window = address, timeout_s, bool(session), window
        self._loop = asyncio.get_running_loop()
        self._answers: dict[int, asyncio.Future[int]] = {}
        self._greeting: asyncio.Future[tuple[ReasonCode, Properties | None]] = self._loop.create_future()
        self.lost: asyncio.Future[str] = self._loop.create_future()
        self.most_bytes = _LARGEST
        self.on_message: Callable[[paho.MQTTMessage], None] = lambda message: None
        self.client = client = paho.Client(
            CallbackAPIVersion.VERSION2,
            client_id=session,
            protocol=paho.MQTTv5,
            reconnect_on_failure=False,
            manual_ack=True,
        )
        if address.user:
            client.username_pw_set(address.user, address.password)
        if address.is_encrypted:
            client.tls_set_context(certificates_of(address))
        if session:
            client.will_set(_gone(address, session), session.encode(), qos=1, retain=True)
        client.max_inflight_messages_set(_MOST_IN_FLIGHT)
        client.connect_timeout = timeout_s
        client.on_connect = lambda _client, _data, _flags, code, properties: self._greet(code, properties)
        client.on_publish = lambda _client, _data, mid, code, _properties: self._answer(mid, code)
        client.on_subscribe = lambda _client, _data, mid, codes, _properties: self._answer(mid, codes[0])
        client.on_unsubscribe = lambda _client, _data, mid, codes, _properties: self._answer(mid, None)
        client.on_message = lambda _client, _data, message: self.on_message(message)
        client.on_disconnect = lambda _client, _data, _flags, code, _properties: self._lose(code.getName())
        client.on_socket_open = lambda _client, _data, opened: self._call(self._start_reading, opened)
        client.on_socket_close = lambda _client, _data, opened: self._stop_watching(opened)
        client.on_socket_register_write = lambda _client, _data, opened: self._call(self._start_writing, opened)
        client.on_socket_unregister_write = lambda _client, _data, opened: self._stop_writing(opened)
        self._looking_after: asyncio.Task[None] | None = None

    # paho connects on a thread of the executor; all else happens on the event loop.

    def _call(self, function: Callable[[Any], object], opened: Any) -> None:
        if not _is_running(self._loop):
            self._loop.call_soon_threadsafe(function, opened)
        else:
            function(opened)

    def _start_reading(self, opened: Any) -> None:
        if self.lost.done():
            # It was aborted while paho was connecting.
            with contextlib.suppress(OSError):
                opened.shutdown(socket.SHUT_RDWR)
        elif opened.fileno() >= 0:
            opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._loop.add_reader(opened, self._read, opened)

    def _start_writing(self, opened: Any) -> None:
        if opened.fileno() >= 0:
            self._loop.add_writer(opened, self._step, self.client.loop_write)

    def _stop_writing(self, opened: Any) -> None:
        if opened.fileno() >= 0 and not self._loop.is_closed():
            self._loop.remove_writer(opened)

    def _stop_watching(self, opened: Any) -> None:
        self._stop_writing(opened)
        if opened.fileno() >= 0 and not self._loop.is_closed():
            self._loop.remove_reader(opened)

    def _read(self, opened: Any) -> None:
        self._step(self.client.loop_read)
        # What is encrypted may have come, and wait to be read, already.
        while self.client.socket() is not None and getattr(opened, "pending", int)():
            self._step(self.client.loop_read)

    def _step(self, step: Callable[[], object]) -> None:
        try:
            step()
        except Exception as error:
            self._lose(f"what came is no MQTT ({error or type(error).__name__})")
            opened = self.client.socket()
            if opened is not None:
                self._stop_watching(opened)

    def _greet(self, code: ReasonCode, properties: Properties | None) -> None:
        if not self._greeting.done():
            self._greeting.set_result((code, properties))

    def _answer(self, mid: int, code: ReasonCode | None) -> None:
        answer = self._answers.pop(mid, None)
        if answer is not None and not answer.done():
            answer.set_result(0 if code is None else int(code.value))

    def _lose(self, reason: str) -> None:
        if not self.lost.done():
            self.lost.set_result(_REASONS.get(reason, reason))
        error = BrokerError(str(self._address), f"The connection to {self._address} is over: {self.lost.result()}.")
        unanswered: list[asyncio.Future[Any]] = [self._greeting, *self._answers.values()]
        for waiting in unanswered:
            if not waiting.done():
                waiting.set_exception(error)
                # Otherwise asyncio logs an exception that no task waits for any more.
                waiting.exception()

    async def open(self) -> None:
        """Connect, and wait until the broker has accepted the connection."""
        address, properties = self._address, Properties(PacketTypes.CONNECT)  # type: ignore[no-untyped-call]
        properties.ReceiveMaximum = min(max(self._window, 1), 65_535)
        properties.SessionExpiryInterval = _KEPT_S if self._has_session else 0

        def connect() -> None:
            clean = not self._has_session
            self.client.connect(address.host, address.port, _KEEP_ALIVE_S, clean_start=clean, properties=properties)

        try:
            await self._loop.run_in_executor(None, connect)
        except (OSError, ValueError) as error:
            raise unreachable(address, error, self._timeout_s, "an MQTT broker", f"{address}: {error}") from error
        self._looking_after = asyncio.ensure_future(self._look_after())
        try:
            code, granted = await self._greeting
        except BrokerError as error:
            text = f"What answers at {address} is no MQTT 5 broker, or hung up: {self.lost.result()}."
            raise BrokerError(str(address), text) from error
        if code.value >= _REFUSED:
            raise BrokerError(str(address), f"{address} refuses {self._refusal(code)}")
        self.most_bytes = int(getattr(granted, "MaximumPacketSize", _LARGEST))

    def _refusal(self, code: ReasonCode) -> str:
        if code.value not in _NO_ACCESS:
            return f"the connection: {code.getName().lower()}."
        user = self._address.user
        user = f"user {user!r} with this password" if user else "a connection without a user"
        return f"{user} ({code.getName().lower()}). {self._address.refused_way_out}"

    async def _look_after(self) -> None:
        while not self.lost.done():
            await asyncio.sleep(_KEEP_ALIVE_S / 4)
            self._step(self.client.loop_misc)

    async def _answered(self, mid: int | None) -> int:
        if mid is None or self.lost.done():
            raise BrokerError(str(self._address), f"The connection to {self._address} is over.")
        answer: asyncio.Future[int] = self._loop.create_future()
        self._answers[mid] = answer
        return await answer

    async def publish(self, topic: str, body: bytes, headers: Mapping[str, str], *, retain: bool = False) -> bool:
        """Send a message; return whether any session is to get it, when the broker has confirmed it."""
        properties = None
        if headers:
            properties = Properties(PacketTypes.PUBLISH)  # type: ignore[no-untyped-call]
            properties.UserProperty = list(headers.items())
        code = await self._answered(self.client.publish(topic, body, 1, retain, properties).mid)
        if code == _TOO_LARGE:
            raise MessageError("too large", f"A message of {len(body):,} bytes is too large for {self._address}.")
        self._check(code, f"does not take messages for {topic!r}")
        return code != _UNHEARD

    async def subscribe(self, topic: str, qos: int = 1) -> None:
        """Have what is sent to a topic come here; first what is retained there."""
        _, mid = self.client.subscribe(topic, options=SubscribeOptions(qos=qos))
        self._check(await self._answered(mid), f"does not give {topic!r}")

    async def unsubscribe(self, topic: str) -> None:
        """Have nothing more come from a topic."""
        _, mid = self.client.unsubscribe(topic)
        await self._answered(mid)

    def _check(self, code: int, refused: str) -> None:
        if code >= _REFUSED:
            name = ReasonCode(PacketTypes.PUBACK, identifier=code).getName() if code != 0x9E else "not supported"
            raise BrokerError(str(self._address), f"{self._address}: the broker {refused}: {name.lower()}.")

    async def close(self, *, with_session: bool = False) -> None:
        """Disconnect; with its session if that is to end."""
        properties = None
        if with_session:
            properties = Properties(PacketTypes.DISCONNECT)  # type: ignore[no-untyped-call]
            properties.SessionExpiryInterval = 0
        try:
            if not self.lost.done() and self.client.socket() is not None:
                self.client.disconnect(properties=properties)
                await asyncio.shield(self.lost)
        finally:
            self.abort()

    def abort(self) -> None:
        """Cut the connection, so that the broker announces the session as gone."""
        self._lose("it was cut here")
        if self._looking_after is not None:
            self._looking_after.cancel()
        # paho closes the socket when it reads the end.
        opened: Any = self.client.socket()
        if opened is not None:
            with contextlib.suppress(OSError):
                opened.shutdown(socket.SHUT_RDWR)
        for _ in range(_MOST_IN_FLIGHT):
            if self.client.socket() is None:
                break
            self._step(self.client.loop_read)


class MqttSession(BrokerSession):
    """A connection to an MQTT 5 broker."""

    # A user property takes no longer text; ours among them needs some of it.
    most_header_bytes = 65_000

    def __init__(self, address: Address, timeout_s: float) -> None:
        super().__init__(address, timeout_s)
        self._connection: PahoConnection | None = None
        # The name of the consumer's session, which outlives its connections.
        self._session = ""
        self._deliver: Callable[[IncomingMessage], object] | None = None
        self._window = 0
        self._arrived: deque[paho.MQTTMessage] = deque()
        # By identity, since messages have no hash.
        self._held: dict[int, paho.MQTTMessage] = {}
        self._is_dropping = False
        # Sessions without a connection, as far as is known, those that this one empties, and the tasks that do it.
        self._left: set[str] = set()
        self._emptying: set[str] = set()
        self._tasks: set[asyncio.Task[object]] = set()

    @property
    def _open(self) -> PahoConnection:
        if self._connection is None:
            raise BrokerError(str(self.address), f"The connection to {self.address} is over.")
        return self._connection

    async def connect(self, window: int) -> None:
        """Connect; a consumer of a queue with a session, which may be one that another has left."""
        address, is_queue = self.address, self.address.kind == "queue"
        if is_queue and any(sign in address.name for sign in "#+"):
            text = f"A queue needs a topic without # and +, which {address} has. Write one topic."
            raise BrokerError(str(address), text)
        self._arrived.clear()
        self._held.clear()
        self._window = window
        if window and is_queue and not self._session:
            self._session = f"epypes-{secrets.token_hex(8)}"
        made = PahoConnection(address, self.timeout_s, self._session, self._window)
        self._connection = made
        made.on_message = self._take
        made.lost.add_done_callback(lambda lost: self.lose(lost.result()))
        await made.open()
        # A queue of ours keeps what comes before there is a consumer; so does its dead-letter queue.
        kept = [address] if is_queue and address.create else []
        if window and address.has_dead_letters:
            kept.append(address.dead_letters)
        for queue in kept:
            if not (window and queue is address) and not await made.publish(_consumers(queue), b"", {}):
                await self._make_session(queue)

    async def _make_session(self, address: Address) -> None:
        """Have the broker keep what comes for a queue until there is a consumer.

        Each session has a name of its own: channels that make one at the same time don't take it over from each other.
        """
        session = f"epypes-kept-{secrets.token_hex(8)}"
        keeping = PahoConnection(address, self.timeout_s, session)
        try:
            await keeping.open()
            await keeping.publish(_gone(address, session), _IN_USE, {}, retain=True)
            for topic in _topics(address):
                await keeping.subscribe(_shared(address, topic))
            await keeping.publish(_gone(address, session), b"kept", {}, retain=True)
            await keeping.close()
        finally:
            keeping.abort()

    async def publish(self, message: OutgoingMessage) -> None:
        """Send a message; return when the broker has it, and a session is to get it."""
        address, headers, made = message.address, dict(message.headers), self._open
        if message.id and SIZES in headers:
            headers[_SIZES_AND_ID] = f"{headers.pop(SIZES)} {message.id}"
        elif message.id:
            headers[_ID] = message.id
        is_other = address.name != self.address.name
        size = len(message.body) + header_bytes(headers) + len(address.name.encode())
        if size + (0 if is_other else DEAD_LETTER_BYTES) > made.most_bytes:
            text = f"A message of {size:,} bytes; {address} takes {made.most_bytes:,} with all that goes along."
            raise MessageError("too large", text)
        is_heard = await made.publish(address.name, message.body, headers, retain=address.kind == "log")
        if is_heard or address.kind != "queue":
            return
        if is_other:
            await self._make_session(address)
            is_heard = await made.publish(address.name, message.body, headers)
        if not is_heard:
            way_out = "Start a consumer" if address.create else "Start a consumer, or add ?create=true to the address"
            text = f"There is no queue {address.name!r} at {address}: no session is subscribed. {way_out}."
            raise BrokerError(str(self.address), text)

    async def consume(self, deliver: Callable[[IncomingMessage], object], window: int) -> None:
        """Subscribe, and have a function called with each message."""
        address, made, self._deliver = self.address, self._open, deliver
        if address.kind != "queue":
            await made.subscribe(address.name)
            return
        await made.publish(_gone(address, self._session), _IN_USE, {}, retain=True)
        # Again after each restart: mosquitto 2.0 forgets shared subscriptions, and keeps the session.
        for topic in _topics(address):
            await made.subscribe(_shared(address, topic))
        await made.subscribe(_gone(address, "+"), qos=0)
        self._hand_over()

    def _take(self, message: paho.MQTTMessage) -> None:
        if self.address.kind == "queue" and message.topic not in (self.address.name, _again(self.address)):
            self._acknowledge(message)
            self._hear_of_session(message)
        elif message.qos or len(self._arrived) < _MOST_UNKEPT:
            self._arrived.append(message)
            self._hand_over()
        elif not self._is_dropping:
            self._is_dropping = True
            log.warning("%s: %d messages wait, so what comes with QoS 0 is dropped", self.address, _MOST_UNKEPT)

    def _hand_over(self) -> None:
        while self._deliver is not None and self._arrived and len(self._held) < self._window:
            message = self._arrived.popleft()
            self._held[id(message)] = message
            headers = _headers_of(message)
            self._deliver(IncomingMessage(memoryview(message.payload), headers.pop(_ID, ""), headers, receipt=message))

    def _acknowledge(self, message: paho.MQTTMessage) -> None:
        self._held.pop(id(message), None)
        if message.qos:
            self._open.client.ack(message.mid, message.qos)

    async def settle(self, message: IncomingMessage, *, requeue: bool) -> None:
        """Acknowledge a message; to have it delivered again, send it again first."""
        if requeue:
            await self._send_again(message.receipt)
        self._acknowledge(message.receipt)
        self._hand_over()

    async def _send_again(self, message: paho.MQTTMessage) -> None:
        user_properties = dict(getattr(message.properties, "UserProperty", ()))
        await self._open.publish(_again(self.address), bytes(message.payload), user_properties)

    def _hear_of_session(self, message: paho.MQTTMessage) -> None:
        """Take note of the state of a session, or answer for one."""
        session, state = message.topic.rpartition("/")[2], message.payload
        if not message.topic.startswith(_gone(self.address, "")):
            return
        if state == _ASK:
            if session == self._session or session in self._emptying:
                self._spawn(self._open.publish(message.topic, _IN_USE, {}, retain=True))
        elif session in (self._session, *self._emptying):
            return
        elif state == _ENDED or (state == _IN_USE and not message.retain):
            self._left.discard(session)
        elif session not in self._left:
            self._left.add(session)
            self._spawn(self._empty(session, is_asked=state == _IN_USE))

    def _spawn(self, work: Coroutine[Any, Any, object]) -> None:
        self._tasks.add(task := asyncio.ensure_future(work))
        task.add_done_callback(self._tasks.discard)

    async def _empty(self, session: str, *, is_asked: bool) -> None:
        """Send what the broker keeps for a session to the queue again, and end the session."""
        try:
            if is_asked:
                await self._open.publish(_gone(self.address, session), _ASK, {})
                await asyncio.sleep(_ANSWER_S)
            # All consumers read of it at the same time; one will do.
            await asyncio.sleep((secrets.randbelow(_PATIENCE_MS) + 20) / 1000)
            if session in self._left:
                await self._send_what_is_kept(session)
        except (BrokerError, MessageError, TimeoutError) as error:
            # Mostly another consumer was quicker; if not, the broker announces it again.
            log.debug("%s: the session %s was not emptied: %s", self.address, session, error)
        finally:
            self._left.discard(session)

    async def _send_what_is_kept(self, session: str) -> None:
        self._emptying.add(session)
        address, kept, mark = self.address, asyncio.Queue[paho.MQTTMessage | None](), secrets.token_bytes(16)
        emptied, end = PahoConnection(address, self.timeout_s, session), f"{_gone(address, session)}/end"
        emptied.on_message = kept.put_nowait
        emptied.lost.add_done_callback(lambda _: kept.put_nowait(None))
        is_done = False
        try:
            await emptied.open()
            await emptied.publish(_gone(address, session), _IN_USE, {}, retain=True)
            for topic in _topics(address):
                await emptied.unsubscribe(_shared(address, topic))
            await emptied.subscribe(end)
            # What is kept comes in order, so all of it before this.
            await emptied.publish(end, mark, {})
            while not is_done:
                message = await asyncio.wait_for(kept.get(), self.timeout_s)
                if message is None:
                    raise BrokerError(str(address), f"The connection to {address} is over: {emptied.lost.result()}.")
                is_done = message.topic == end and message.payload == mark
                if message.topic in (address.name, _again(address)):
                    await self._send_again(message)
                emptied.client.ack(message.mid, message.qos)
            await emptied.publish(_gone(address, session), _ENDED, {}, retain=True)
            await emptied.close(with_session=True)
        finally:
            self._emptying.discard(session)
            emptied.abort()

    async def close(self) -> None:
        """Disconnect; the session of a consumer stays, and is announced to the others."""
        made, self._connection, is_consumer = self._connection, None, self._deliver is not None and self._session
        self._deliver = None
        for task in tuple(self._tasks):
            task.cancel()
        self._left.clear()
        if made is None:
            return
        made.on_message = lambda message: None
        try:
            if is_consumer and not made.lost.done():
                await made.publish(_gone(self.address, self._session), b"left", {}, retain=True)
        finally:
            await made.close()


def _is_running(loop: asyncio.AbstractEventLoop) -> bool:
    try:
        return asyncio.get_running_loop() is loop
    except RuntimeError:
        return False


def _shared(address: Address, topic: str) -> str:
    return f"$share/{address.group}/{topic}"


def _consumers(address: Address) -> str:
    """Return the topic by which a channel finds out whether a queue has sessions."""
    return f"{address.name}/consumers"


def _again(address: Address) -> str:
    """Return the topic of messages that are delivered again: other groups have had them."""
    return f"{address.name}/again/{address.group}"


def _topics(address: Address) -> tuple[str, ...]:
    """Return the topics that each session of a queue shares with the others of its group."""
    return _consumers(address), address.name, _again(address)


def _gone(address: Address, session: str) -> str:
    """Return the topic at which the state of a session is retained."""
    return f"{address.name}/gone/{address.group}/{session}"


def _headers_of(message: paho.MQTTMessage) -> dict[str, str]:
    headers = dict(getattr(message.properties, "UserProperty", ()))
    both = headers.pop(_SIZES_AND_ID, None)
    if both is not None:
        sizes, _, known_as = both.partition(" ")
        headers |= {SIZES: sizes, _ID: known_as}
    return headers


def make_channel(address: Address, options: ChannelOptions) -> BrokerChannel:
    """Return a channel to an MQTT 5 broker."""
    return BrokerChannel(MqttSession(address, options.timeout_s), options)
