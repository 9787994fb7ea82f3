"""How do frames come to an MQTT 5 broker, and back? As one message; and where MQTT promises too little, we add or say.

What is promised, and by whom (seen with mosquitto 2.0.11):

- *queue* is a shared subscription with QoS 1: at least once. ``send`` returns when the broker has confirmed, and raises
  if it says that nobody is to get the message: MQTT has no queues, only sessions of receivers. ``create=true`` makes a
  session first that keeps what comes. The broker assigns each message to a session at once and for good, so others
  would never get what one had that is gone; `sessions` hands it on. Nobody counts deliveries (``attempt`` is 0): a
  message that kills each receiver comes again and again; take RabbitMQ or NATS where that may happen. Dead letters are
  ours: a message to ``NAME/dead``, for which a session is made first.
- *broadcast* is a plain subscription with QoS 1.
- *log* is none: a receiver gets the newest message, which is retained, and then all that come, in the broker's order,
  which is one for all. What came before the newest is not to be had.
- What is lost: what mosquitto had confirmed when it was killed or its machine lost power, but had not written to its
  disk (by default it writes each 30 minutes, see ``autosave_interval``); what is above ``max_queued_messages``, 1,000
  per session unless told otherwise, which it drops without a word; what is kept for a receiver that was killed while
  the broker was down, since its will went with it; what another program sent with QoS 0, unless it was the turn of
  one who was connected, or if 1,000 messages wait here that nobody has received yet; what nobody has come for within
  seven days.
- mosquitto 2.0.11 sends more than ``prefetch`` after an acknowledgement, up to all that it has for the session. They
  wait here, in memory, until as few are unacknowledged as was asked for.
- Acknowledgements go out in the order of `Received.ack`, which mosquitto takes as it comes; a broker that insists on
  the order of delivery needs ``prefetch=1``.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping
from time import monotonic
from typing import Any, Final

from epypes.errors import BrokerError, MessageError
from epypes.transport.channels.mqtt.connection import Connection
from epypes.transport.channels.mqtt.headers import ID, headers_of
from epypes.transport.channels.mqtt.sessions import (
    Heirs,
    join,
    keep,
    keep_for_later,
    session_of,
)
from epypes.transport.channels.packing import ATTEMPTS, FROM, REASON, arrived, packed, readable
from epypes.transport.channels.place import Place
from epypes.transport.channels.seam import Frames, Received

log = logging.getLogger("epypes.transport")

# Whatever can be sent can be put aside, too: what goes along with a dead letter is no more than this.
_ROOM_BYTES: Final = 1_024
_REASON_BYTES: Final = 700
# For messages that nobody acknowledges: they count as received when somebody has taken them.
_AHEAD: Final = 64
_LOOK_S: Final = 1.0


class MqttChannel:
    """A way to one place of an MQTT 5 broker; see `seam.Channel`."""

    def __init__(self, place: Place, prefetch: int, timeout_s: float) -> None:
        self._place, self.prefetch, self._timeout_s = place, prefetch, timeout_s
        self._lock = threading.Lock()
        self._receiving: Connection | None = None
        self._heirs: Heirs | None = None
        self._session = ""
        self._is_closed = self._has_dead_letters = False
        self._sending = Connection(place, timeout_s)
        try:
            if place.create and place.kind == "queue":
                keep(place, timeout_s)
        except BaseException:
            self._sending.close()
            raise

    def send(self, frames: Frames, *, id: str = "", headers: Mapping[str, str] | None = None) -> None:  # noqa: A002
        """Send a message; see `seam.Channel.send`."""
        body, told = packed(frames, id, headers or {})
        more = told | ({ID: id} if id else {})
        place = self._place
        is_heard = self._sending.publish(place.name, body, more, retain=place.kind == "log", room=_ROOM_BYTES)
        if not is_heard and place.kind == "queue":
            text = (
                f"There is no queue {place.name!r} at {place}: nobody is subscribed, so the broker keeps no message. "
                "Start a receiver, or add ?create=true to the address."
            )
            raise BrokerError(str(place), text)

    def receive(self, timeout_s: float) -> Received | None:
        """Return the next message; see `seam.Channel.receive`."""
        connection = self._receiving or self._joined()
        until_s = monotonic() + timeout_s
        while True:
            # One may be lost and the other not.
            self._sending.check()
            left_s = max(until_s - monotonic(), 0.0)
            message = connection.next(min(left_s, _LOOK_S))
            if message is None:
                if left_s <= _LOOK_S:
                    return None
            elif self._is_of_heirs(message):
                connection.acknowledge(message)
            else:
                return self._received(connection, message)

    def _is_of_heirs(self, message: Any) -> bool:
        """Return whether it is what one has left who took this receiver for gone, and began to hand on what it has."""
        return self._place.kind == "queue" and message.topic != self._place.name

    @property
    def trouble(self) -> str:
        """Why it is over; see `seam.Channel.trouble`."""
        receiving = self._receiving
        return self._sending.trouble or ("" if receiving is None else receiving.trouble)

    def _joined(self) -> Connection:
        """Subscribe, when somebody wants to receive for the first time."""
        self._sending.check()
        place, session = self._place, ""
        if place.kind == "queue":
            session = session_of(place)
            made = join(place, session, self.prefetch, self._timeout_s)
        else:
            made = Connection(place, self._timeout_s, prefetch=max(self.prefetch, _AHEAD))
        try:
            if session:
                self._heirs = Heirs(place, session, self._sending, self._timeout_s)
            else:
                made.subscribe(place.name)
        except BaseException:
            made.close(with_notice=bool(session))
            raise
        with self._lock:
            self._receiving, self._session = made, session
            is_late = self._is_closed
        if is_late:
            self._end()
        return made

    def _received(self, connection: Connection, message: Any) -> Received:
        headers, body = headers_of(message), bytes(message.payload)
        is_queue = self._place.kind == "queue"
        if not is_queue:
            connection.acknowledge(message)
        name = headers.pop(ID, "")

        def settle(reason: str | None) -> None:
            if not is_queue or reason is None or self._put_aside(body, headers, name, reason):
                connection.acknowledge(message)

        frames, shown = arrived(body, headers)
        return Received(frames, name, 0, shown, settle)

    def _put_aside(self, body: bytes, headers: Mapping[str, str], name: str, reason: str) -> bool:
        """Return whether the message is among the dead letters; otherwise the broker delivers it again."""
        dead, shown = self._place.dead_letters, _short(reason)
        more = {REASON: shown, FROM: self._place.name, ATTEMPTS: "0"} | ({ID: name} if name else {})
        try:
            if not self._has_dead_letters:
                keep(dead, self._timeout_s)
                self._has_dead_letters = True
            return self._sending.publish(dead.name, body, {**readable(body, headers), **more})
        except (BrokerError, MessageError) as error:
            log.warning("a message of %s could not be put aside (%s): %s", self._place, shown, error)
            return False

    def close(self) -> None:
        """End it; see `seam.Channel.close`."""
        with self._lock:
            self._is_closed = True
        self._end()

    def _end(self) -> None:
        receiving, session = self._receiving, self._session
        if receiving is not None:
            with self._lock:
                self._session = ""
            if session and receiving.is_lost():
                keep_for_later(self._place, session)
            receiving.close(with_notice=bool(session))
        self._sending.close()
        if self._heirs is not None:
            self._heirs.close()


def _short(reason: str) -> str:
    return reason.encode(errors="replace")[:_REASON_BYTES].decode(errors="ignore")


def open_channel(place: Place, prefetch: int, timeout_s: float) -> MqttChannel:
    """Open a way to a place of an MQTT 5 broker."""
    if place.kind == "queue" and any(sign in place.name for sign in "#+"):
        raise BrokerError(str(place), f"A queue needs a topic without # and +, which {place} has. Write one topic.")
    return MqttChannel(place, prefetch, timeout_s)
