"""Deduplication: a message that is delivered again is not handled again, and is settled as the first one was.

A broker delivers a message again when it has heard nothing of it: of a consumer that died, of one whose connection
broke just as it acknowledged, or because its sender was not sure that it had arrived. The id is the same each time.
"""

from __future__ import annotations

import hashlib
import os
import threading
import weakref
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

from epypes.transport.channel import Delivery

# Acknowledges, rejects or returns one delivery; see `Delivery.settle`.
Settler = Callable[[str, str], object]
# So many ids of settled messages are remembered; the oldest are forgotten.
_MOST_ANSWERED: Final = 100_000
# Other programs give messages any ids; so many long ones would fill the memory.
_LONGEST: Final = 128


@dataclass(frozen=True, slots=True)
class _Outcome:
    """How a message was settled: why it was rejected, None if it was not, and over which connection."""

    reason: str | None
    connection: object


class _InFlight:
    """A message that is delivered and not settled. It lives as long as its Delivery: a lost one can't be answered."""

    __slots__ = ("__weakref__", "_owner", "attempt", "connection", "key", "settlers")

    def __init__(self, owner: Deduplication, key: str, delivery: Delivery, connection: object) -> None:
        self._owner, self.key = owner, key
        self.connection = connection
        # Of the deliveries of the channel, the newest one last; none once the message is settled.
        self.settlers: list[Settler] = [delivery.settle]
        # Of the newest delivery.
        self.attempt = delivery.attempt

    def settle(self, verdict: str, reason: str) -> None:
        self._owner.settle(self, verdict, reason)


class Deduplication:
    """The ids of the messages that are in flight, and of those that were settled last, with the outcome.

    Any thread may call it.

    Attributes
    ----------
    duplicates
        How many deliveries were of a message that was known.
    rejected
        How many messages were rejected.
    """

    def __init__(self) -> None:
        # Re-entrant, since a signal's handler may settle anywhere.
        self._lock = threading.RLock()
        self._process = os.getpid()
        self._in_flight: weakref.WeakValueDictionary[str, _InFlight] = weakref.WeakValueDictionary()
        # In the order of time.
        self._answered: dict[str, _Outcome] = {}
        self.duplicates = self.rejected = 0

    def is_first(self, id: str, delivery: Delivery, connection: object) -> bool:  # noqa: A002
        """Return whether a delivery is the first of its message. From then on, it settles its duplicates too.

        Parameters
        ----------
        id
            Of the message, and of the delivery then; a message without is never a duplicate.
        delivery
            Of the channel.
        connection
            What is equal as long as the channel has the same connection to the broker.
        """
        with self._lock:
            key = _key(id)
            outcome = self._answered.get(key) if key else None
            known = self._in_flight.get(key) if key else None
            if known is not None:
                self.duplicates += 1
                # The older one is kept over the same connection: to acknowledge it now would acknowledge the message,
                # where a broker counts by message.
                if connection != known.connection:
                    known.settlers.clear()
                    known.connection = connection
                known.settlers.append(delivery.settle)
                known.attempt = delivery.attempt
                return False
            if outcome is None:
                new = _InFlight(self, key, delivery, connection)
                if key:
                    self._in_flight[key] = new
                delivery.id, delivery.settle = id, new.settle
                return True
            self.duplicates += 1
            # The broker may not have received the verdict if the connection has changed, or if it delivers the message
            # again. To acknowledge twice is harmless; without a second reject the message would be missing in the
            # dead-letter queue. A first delivery over the same connection was sent twice; where the broker does not
            # count (attempt 0), it may as well be a redelivery.
            was_heard = outcome.connection == connection and delivery.attempt == 1
            if outcome.reason is not None and not was_heard:
                self._remember(key, _Outcome(outcome.reason, connection))
                delivery.reject(outcome.reason)
            else:
                delivery.ack()
            return False

    def settle(self, message: _InFlight, verdict: str, reason: str) -> None:
        """Settle all deliveries of a message: the newest by the verdict, and the older copies.

        A newest copy of attempt 1 is a message of its own at the broker, which was sent twice: the older ones are
        acknowledged. Otherwise all may be deliveries of one stored message. To acknowledge one would take it from the
        broker before it is delivered again, or before its dead letter is confirmed: so all get the same verdict.
        """
        if self._process != os.getpid():
            # The connection is that of the parent, and so is the message.
            return
        with self._lock:
            if not message.settlers:
                return
            (*older, newest), message.settlers = message.settlers, []
            self._in_flight.pop(message.key, None)
            if verdict != "nack":
                # Before the broker hears it: what it delivers meanwhile is a duplicate.
                self._remember(message.key, _Outcome(reason if verdict == "reject" else None, message.connection))
            self.rejected += verdict == "reject"
        newest(verdict, reason)
        for settler in older:
            if message.attempt == 1:
                settler("ack", "")
            else:
                settler(verdict, reason)

    def _remember(self, key: str, outcome: _Outcome) -> None:
        if not key:
            return
        self._answered.pop(key, None)
        self._answered[key] = outcome
        if len(self._answered) > _MOST_ANSWERED:
            del self._answered[next(iter(self._answered))]


def _key(id: str) -> str:  # noqa: A002
    """Return what an id is remembered by: itself, unless it is long."""
    return id if len(id) <= _LONGEST else hashlib.sha256(id.encode(errors="surrogatepass")).hexdigest()
