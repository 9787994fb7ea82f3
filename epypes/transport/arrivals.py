"""What happens to a message that a broker has delivered?

It is checked, told from those that were there before, and put into the user's queue with a word for the broker on it.
"""

from __future__ import annotations

import contextlib
import logging
import queue as queues
import threading
from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from typing import Any, Final, Literal, Protocol

from epypes.errors import BrokerError, MessageError
from epypes.transport.channels.packing import ERROR
from epypes.transport.channels.place import Place
from epypes.transport.channels.seam import Frames, Received
from epypes.transport.delivered import DeliveredBytes, DeliveredEnvelope, Delivery
from epypes.transport.forked import forget_in_child
from epypes.transport.framing import envelope_of
from epypes.transport.seen import Seen, Word
from epypes.transport.throttle import Throttle
from epypes.wire import Limits

log = logging.getLogger("epypes.transport")

Acknowledge = Literal["done", "received"]
Item = DeliveredEnvelope | DeliveredBytes

# A queue that takes nothing any more, whatever it is: that is no fault of the message, which others shall have.
_ENDED: Final = (BrokerError, getattr(queues, "ShutDown", BrokerError))
# How long it waits for room in the user's queue before it looks whether it shall stop.
_TICK_S: Final = 0.05


class PutQueue(Protocol):
    """What is put into: queue.Queue, queue.SimpleQueue, ep.Mailbox."""

    def put(self, item: Any, *, block: bool, timeout: float | None = None) -> object:
        """Take an item, or raise queue.Full: at once, or with ``block`` after ``timeout`` seconds."""


class Arrivals:
    """What happens to messages; `accept` on the subscriber's thread, the words on them on any.

    Parameters
    ----------
    queue
        Of the user.
    topic
        The first bytes of what is wanted; empty for everything.
    limits
        What is accepted.
    place
        Where they come from: what is wanted by nobody here is a dead letter of a queue, and somebody else's elsewhere.
    acknowledge
        When the broker is told: ``"done"``, or ``"received"``.
    exhausted
        None, or called with what was delivered too often, instead of rejecting it.
    """

    def __init__(
        self,
        queue: PutQueue,
        topic: bytes,
        limits: Limits,
        place: Place,
        acknowledge: Acknowledge,
        exhausted: Callable[[Item], object] | None,
    ) -> None:
        self._queue, self._topic, self._limits = queue, topic, limits
        self._place, self._acknowledge, self._exhausted = place, acknowledge, exhausted
        self._lock = threading.RLock()
        self._log = Throttle(log)
        self.seen: Seen[Delivery] = Seen()
        self.received = self.duplicates = self.dead_letters = 0
        self.rejected: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        forget_in_child(self)

    def accept(self, received: Received, connection: int, is_over: threading.Event) -> None:
        """Take what was delivered over the connection of a number; waits for room in the queue until it is over."""
        if self._is_for_others(received):
            received.ack()
            return
        try:
            item = self._item(received, connection)
        except MessageError as error:
            self._refuse(error.reason, str(error), received)
            return
        delivery = item.delivery
        if delivery is None or self._is_duplicate(delivery, received, connection):
            return
        if received.attempt > self._place.attempts:
            self._exhaust(item)
        else:
            self._put(item, is_over)

    def _is_for_others(self, received: Received) -> bool:
        return self._place.kind != "queue" and not self._is_of_topic(received.frames)

    def _is_of_topic(self, frames: Frames) -> bool:
        return not self._topic or (bool(frames) and bytes(frames[0][: len(self._topic)]) == self._topic)

    def _item(self, received: Received, connection: int) -> Item:
        frames = received.frames
        if ERROR in received.headers or not frames:
            raise MessageError("bad frames", received.headers.get(ERROR, "The message has no frames."))
        size = sum(map(len, frames))
        if size > self._limits.total_bytes:
            raise MessageError("too large", f"A message of {size:,} bytes; the limit is {self._limits.total_bytes:,}.")
        if not self._is_of_topic(frames):
            raise MessageError("other topic", f"The message is not of topic {self._topic.decode()}.")
        envelope = None if len(frames) == 1 else envelope_of(frames, self._limits)
        known_as = received.id or (envelope.id if envelope is not None else "")
        delivery = Delivery(known_as, received, connection, self._done, self.seen.give_back)
        if envelope is None:
            return DeliveredBytes.of(frames[0], delivery)
        return DeliveredEnvelope.of(envelope, delivery)

    def _refuse(self, reason: str, text: str, received: Received) -> None:
        """Put aside what can't be understood."""
        self.rejected[reason] += 1
        self._log.warning(reason, f"rejected message {received.id!r} of {self._place} ({reason}): {text}")
        self._count_dead_letter()
        received.reject(text)

    def _is_duplicate(self, delivery: Delivery, received: Received, connection: int) -> bool:
        while True:
            word = self.seen.word(delivery.id)
            if word is not None:
                self._say_again(word, delivery.id, received, connection)
                break
            there = self.seen.arrive(delivery.id, delivery)
            if there is None:
                return False
            # If not, somebody has just said the word, which is looked up again.
            if there.again(received, connection):
                break
        self.duplicates += 1
        return True

    def _say_again(self, word: Word, known_as: str, received: Received, connection: int) -> None:
        """Tell the broker what it was told of an event before.

        A word that was said over a connection that broke may not have been heard, nor one on what the same connection
        delivers again. For an answered event nothing is lost by that, but what was rejected would not be among the dead
        letters. One that is delivered for the first time was sent twice.
        """
        is_heard = word.connection == connection and received.attempt <= 1
        if word.reason is None or is_heard:
            received.ack()
            return
        self.seen.finish(known_as, replace(word, connection=connection))
        received.reject(word.reason)

    def _exhaust(self, item: Item) -> None:
        self.rejected["exhausted"] += 1
        text = f"delivered {item.attempt} times, and no receiver has answered it"
        if self._exhausted is None:
            self._warn_of_exhausted(item, text)
            item.reject(text)
            return
        try:
            self._exhausted(item)
        except BaseException:
            log.exception("exhausted itself failed")
            item.reject(text)

    def _warn_of_exhausted(self, item: Item, text: str) -> None:
        known_as = "" if item.received is None else item.received.id
        way_out = (
            "Its receivers died of it, or took it and did not call ack() or reject(). It is among the dead letters, at "
            "%s; attempts=N in the address allows more."
        )
        log.warning(f"rejected message %r of %s: %s. {way_out}", known_as, self._place, text, self._place.dead_letters)

    def _put(self, item: Item, is_over: threading.Event) -> None:
        # Counted before: whoever has the item must find it counted.
        self.received += 1
        try:
            is_put = self._is_put(item, is_over)
        except BaseException as error:
            # The user's queue may raise anything, as a Mailbox of policy "fault" does; the thread goes on.
            self.received -= 1
            self.dropped[type(error).__name__] += 1
            self._log.warning("refused", f"the queue refused a message: {error!r}")
            if isinstance(error, _ENDED):
                item.give_back()
                return
            item.reject(f"the queue refused it: {error!r}")
            return
        if not is_put:
            self.received -= 1
            item.give_back()
        elif self._acknowledge == "received":
            item.ack()

    def _is_put(self, item: Item, is_over: threading.Event) -> bool:
        """Put an item when there is room; return False if it is over before."""
        with contextlib.suppress(queues.Full):
            self._queue.put(item, block=False)
            return True
        while not is_over.is_set():
            with contextlib.suppress(queues.Full):
                self._queue.put(item, block=True, timeout=_TICK_S)
                return True
        return False

    def _done(self, known_as: str, word: Word) -> None:
        self.seen.finish(known_as, word)
        if word.reason is not None:
            self._count_dead_letter()

    def _count_dead_letter(self) -> None:
        with self._lock:
            self.dead_letters += 1

    def forget(self) -> None:
        """Take new locks, in a forked child: the old ones may be held by threads that are not there."""
        self._lock = threading.RLock()
        self.seen.forget_locks()
