"""How is one connection to an MQTT 5 broker held, and how does a thread wait for the broker's word?"""

from __future__ import annotations

import contextlib
import logging
import socket
import ssl
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final

import paho.mqtt.client as paho
from paho.mqtt.enums import CallbackAPIVersion
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties
from paho.mqtt.reasoncodes import ReasonCode
from paho.mqtt.subscribeoptions import SubscribeOptions

from epypes.errors import BrokerError, MessageError
from epypes.transport.channels.mqtt.headers import Packed
from epypes.transport.channels.mqtt.loop import Client, PahoLoop
from epypes.transport.channels.place import Place
from epypes.transport.channels.turns import Turns, always, nothing

log = logging.getLogger("epypes.transport")

# The broker looks after one and a half of it, paho after two: a cut link is noticed within 9 s.
_KEEP_ALIVE_S: Final = 4
_CLOSE_S: Final = 2.0
# Somebody may come back for what is kept, but not for ever.
_KEPT_S: Final = 7 * 24 * 3600
_UNCONFIRMED: Final = 8
_MOST_UNASKED: Final = 1_000
_LARGEST: Final = 268_000_000
_REFUSED: Final = 0x80
_UNHEARD, _TOO_LARGE, _NO_ACCESS = 0x10, 0x95, (0x84, 0x85, 0x86, 0x87, 0x8C)
_WITH_WILL: Final = 0x04
_SAID: Final[Mapping[str, str]] = {
    "Keep alive timeout": "nothing has come from the broker for several seconds",
    "Session taken over": "another connection has taken its session over",
    "Server shutting down": "the broker shuts down",
}


class Connection:
    """A connection, and what has come; any thread may use it.

    Parameters
    ----------
    place
        Whose broker.
    timeout_s
        Longest wait for the broker's word.
    session
        The name of a session that outlives the connection; "" for one that ends with it.
    notice
        The topic on which the broker tells, retained, that the session's connection is gone.
    prefetch
        How many messages come without being acknowledged, at most.

    Raises
    ------
    BrokerError
        The broker can't be reached, or refuses.
    """

    def __init__(
        self, place: Place, timeout_s: float, *, session: str = "", notice: str = "", prefetch: int = 64
    ) -> None:
        self._place, self._timeout_s, self._session = place, timeout_s, session
        self._answers: dict[int, ReasonCode | None] = {}
        self._arrived: deque[paho.MQTTMessage] = deque()
        self._held: set[int] = set()
        self._prefetch = min(max(prefetch, 1), 65_535)
        self._greeting: tuple[ReasonCode, Properties | None] | None = None
        self._trouble = ""
        self._is_too_large = self._is_dropping = False
        self.has_session = False
        self._client = client = self._made(session, notice)
        wish = _told(PacketTypes.CONNECT)
        wish.ReceiveMaximum = self._prefetch
        wish.SessionExpiryInterval = _KEPT_S if session else 0
        client.connect_timeout = timeout_s
        try:
            client.connect(place.host, place.port, keepalive=_KEEP_ALIVE_S, clean_start=not session, properties=wish)
        except (OSError, ValueError) as error:
            raise BrokerError(str(place), f"{place} can't be reached: {_why(error)}. {_WAY_OUT}") from error
        self._turns = Turns(PahoLoop(client), self._broke, f"epypes mqtt {place.host}")
        try:
            self._greeted()
        except BaseException:
            self.close()
            raise

    def _made(self, session: str, notice: str) -> paho.Client:
        client = Client(
            CallbackAPIVersion.VERSION2,
            client_id=session,
            protocol=paho.MQTTv5,
            reconnect_on_failure=False,
            manual_ack=True,
        )
        # Brokers may take no more than a few at a time, and say so when it is too late to tell paho.
        client.max_inflight_messages_set(_UNCONFIRMED)
        if self._place.user:
            client.username_pw_set(self._place.user, self._place.password)
        if notice:
            client.will_set(notice, session.encode(), qos=1, retain=True)
        if self._place.is_encrypted:
            client.tls_set_context(_Handshake(_trusted(self._place)))  # type: ignore[arg-type]  # all that paho asks for
        client.on_connect = lambda _client, _data, flags, code, told: self._greet(flags.session_present, code, told)
        client.on_publish = lambda _client, _data, mid, code, _told: self._answer(mid, code)
        client.on_subscribe = lambda _client, _data, mid, codes, _told: self._answer(mid, codes[0])
        client.on_unsubscribe = lambda _client, _data, mid, codes, _told: self._answer(mid, None)
        client.on_message = lambda _client, _data, message: self._arrive(message)
        client.on_disconnect = lambda _client, _data, flags, code, _told: self._lose(code)
        # Without it paho writes on whichever thread asks: only whose turn it is shall do so.
        client.on_socket_register_write = lambda _client, _data, _socket: None
        client.on_socket_open = lambda _client, _data, opened: _without_delay(opened)
        return client

    # On the thread whose turn it is.

    def _greet(self, has_session: bool, code: ReasonCode, told: Properties | None) -> None:
        self.has_session, self._greeting = has_session, (code, told)

    def _answer(self, mid: int, code: ReasonCode | None) -> None:
        self._answers[mid] = code

    def _arrive(self, message: paho.MQTTMessage) -> None:
        # For those with QoS 0 nobody waits, so nothing else keeps them from filling the memory.
        if message.qos or len(self._arrived) < _MOST_UNASKED:
            self._arrived.append(message)
        elif not self._is_dropping:
            self._is_dropping = True
            log.warning("%s: %d messages wait, so what comes with QoS 0 is dropped", self._place, _MOST_UNASKED)

    def _broke(self, error: Exception) -> None:
        self._break(str(error) if isinstance(error, OSError) else _no_mqtt(error))

    def _lose(self, code: ReasonCode) -> None:
        self._is_too_large = self._is_too_large or code.value == _TOO_LARGE
        name = code.getName()
        self._break(_SAID.get(name, "the connection broke" if name == "Unspecified error" else f"{name.lower()}"))

    def _break(self, trouble: str) -> None:
        self._trouble = self._trouble or trouble

    # On the threads of those who use it.

    def _greeted(self) -> None:
        self._wait(lambda: self._greeting is not None, "did not greet")
        code, told = self._greeting or (ReasonCode(PacketTypes.CONNACK), None)
        if code.value >= _REFUSED:
            raise BrokerError(str(self._place), f"{self._place} refuses: {self._refusal(code)}")
        self.most_bytes = int(getattr(told, "MaximumPacketSize", _LARGEST))
        self.shares = bool(getattr(told, "SharedSubscriptionAvailable", 1))

    def _refusal(self, code: ReasonCode) -> str:
        if code.value not in _NO_ACCESS:
            return f"{code.getName().lower()}."
        who = f"user {self._place.user!r} with this password" if self._place.user else "a connection without a user"
        return f"{who} ({code.getName().lower()}). {self._place.refused_way_out}"

    def _wait(self, is_so: Callable[[], bool], missing: str) -> None:
        """Wait for the broker's word; from whatever comes in its stead there is no way back."""
        self._turns.run(nothing, lambda: is_so() or self._trouble, self._timeout_s)
        if not is_so():
            self._break(f"the broker {missing} within {self._timeout_s:g} s")
            raise self._error()

    def _error(self) -> BrokerError:
        return BrokerError(str(self._place), f"The connection to {self._place} is over: {self._trouble}. {_WAY_OUT}")

    def check(self) -> None:
        """Raise BrokerError if the connection is over."""
        if self._trouble:
            raise self._error()

    @property
    def trouble(self) -> str:
        """Why it is over; empty while it is not."""
        return self._trouble

    def is_lost(self) -> bool:
        """Return whether it is over, by whomever, after a look: nobody may have had one for a moment."""
        self._turns.run(nothing, always, 0.0)
        return bool(self._trouble)

    def publish(
        self, topic: str, body: bytes, headers: Mapping[str, str], *, retain: bool = False, room: int = 0
    ) -> bool:
        """Send a message, and wait until the broker has it; return whether anybody is to get it.

        Parameters
        ----------
        topic, body, headers
            Whereto, and what.
        retain
            Whether the broker keeps it as the newest of its topic.
        room
            How many bytes are left for what may have to go along another time.

        Raises
        ------
        BrokerError
            The broker is away, refuses, or did not confirm in time.
        MessageError
            The message is larger than the broker takes, or its headers can't be sent.
        """
        size = len(body) + sum(len(key.encode()) + len(text.encode()) + 5 for key, text in headers.items())
        if size + len(topic.encode()) + 16 + room > self.most_bytes:
            raise _too_large(size, self._place, self.most_bytes)
        told: Any = Packed(headers) if headers else None
        self.check()
        mid = self._client.publish(topic, body, 1, retain, told).mid
        try:
            code = self._answered(mid, "did not confirm a message")
        except BrokerError as error:
            if self._is_too_large:
                raise _too_large(size, self._place, self.most_bytes) from error
            raise
        if code is not None and code.value == _TOO_LARGE:
            raise _too_large(size, self._place, self.most_bytes)
        self._check_refused(code, f"does not take messages for {topic!r}")
        return code is None or code.value != _UNHEARD

    def subscribe(self, topic: str) -> None:
        """Have what is sent to a topic come here, with QoS 1; first what is retained there."""
        self.check()
        _, mid = self._client.subscribe(topic, options=SubscribeOptions(qos=1))
        if mid is None:
            raise self._error()
        self._check_refused(self._answered(mid, "did not answer"), f"does not give {topic!r}")

    def unsubscribe(self, topic: str) -> None:
        """Have nothing more come from a topic."""
        self.check()
        _, mid = self._client.unsubscribe(topic)
        if mid is None:
            raise self._error()
        self._answered(mid, "did not answer")

    def _answered(self, mid: int, missing: str) -> ReasonCode | None:
        self._wait(lambda: mid in self._answers, missing)
        return self._answers.pop(mid)

    def _check_refused(self, code: ReasonCode | None, refused: str) -> None:
        if code is not None and code.value >= _REFUSED:
            self._break(f"the broker {refused}: {code.getName().lower()}")
            raise self._error()

    def next(self, timeout_s: float) -> paho.MQTTMessage | None:
        """Return the next message that has come; None if there is none within so many seconds.

        Raises
        ------
        BrokerError
            The connection is over.
        """
        if not self._has_come() and not self._trouble:
            self._turns.run(nothing, lambda: self._has_come() or self._trouble, timeout_s)
        self.check()
        if not self._has_come():
            return None
        message = self._arrived.popleft()
        if message.qos:
            self._held.add(message.mid)
        return message

    def _has_come(self) -> bool:
        # mosquitto sends one more than it is asked for after an acknowledgement.
        return bool(self._arrived) and len(self._held) < self._prefetch

    def acknowledge(self, message: paho.MQTTMessage) -> None:
        """Tell the broker that a message is done with; nothing happens if the connection is over."""
        # With QoS 0 nobody waits for it, and to be told is an error.
        if self._trouble or not message.qos:
            return
        self._held.discard(message.mid)
        self._turns.run(lambda: self._client.ack(message.mid, 1), always, 0.0)

    def close(self, *, with_notice: bool = False, with_session: bool = False) -> None:
        """End it, within a few seconds; as often as you like.

        Parameters
        ----------
        with_notice
            True to have the broker tell that the session is without a connection.
        with_session
            True to end the session, too.
        """
        told = _told(PacketTypes.DISCONNECT)
        if with_session:
            told.SessionExpiryInterval = 0
        was_over = self.is_lost()
        self._break("it was closed")
        client, within_s = self._client, min(self._timeout_s, _CLOSE_S)
        if not was_over:
            code = ReasonCode(PacketTypes.DISCONNECT, identifier=_WITH_WILL if with_notice else 0)
            part = partial(client.disconnect, code, told if with_session else None)
            self._turns.run(part, lambda: client.socket() is None, within_s)
        self._turns.run(self._cut, lambda: client.socket() is None, within_s)
        self._turns.end(_CLOSE_S)
        # Else the client and what it calls would hold each other, and its sockets would wait for the garbage collector.
        for name in ("connect", "publish", "subscribe", "unsubscribe", "message", "disconnect", "socket_open"):
            setattr(client, f"on_{name}", None)

    def _cut(self) -> None:
        opened = self._client.socket()
        if isinstance(opened, socket.socket):
            # What is left to be written never will be: to read the end has paho close it.
            with contextlib.suppress(OSError):
                opened.shutdown(socket.SHUT_RDWR)


_WAY_OUT: Final = "See that the broker runs there, and try again."


def _why(error: Exception) -> str:
    return str(getattr(error, "strerror", None) or error or type(error).__name__)


def _no_mqtt(error: Exception) -> str:
    return f"what came is no MQTT ({error or type(error).__name__})"


def _too_large(size: int, place: Place, most: int) -> MessageError:
    return MessageError("too large", f"A message of {size:,} bytes; {place} takes {most:,} with all that goes along.")


def _told(packet: int) -> Properties:
    return Properties(packet)  # type: ignore[no-untyped-call]  # the rest of paho is typed


def _trusted(place: Place) -> ssl.SSLContext:
    try:
        return ssl.create_default_context(cafile=place.ca or None)
    except OSError as error:
        text = f"The certificates for {place} can't be read from {place.ca}: {_why(error)}."
        raise BrokerError(str(place), text) from error


class _Handshake:
    """Encrypts a socket. paho would leave one open whose handshake fails; ssl by itself closes it."""

    check_hostname = True

    def __init__(self, context: ssl.SSLContext) -> None:
        self._context = context

    def wrap_socket(
        self, plain: socket.socket, *, server_hostname: str, do_handshake_on_connect: bool
    ) -> socket.socket:
        return self._context.wrap_socket(plain, server_hostname=server_hostname)


def _without_delay(opened: Any) -> None:
    with contextlib.suppress(OSError, AttributeError):
        opened.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
