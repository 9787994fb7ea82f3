"""Checks and counts the messages that a ZMQSubscriber receives, and puts them into the user's queue."""

from __future__ import annotations

import logging
import queue as queues
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any, Protocol

import zmq

from epypes.errors import MessageError
from epypes.transport.decoding import LARGE_HEADER_BYTES, Decoding
from epypes.transport.framing import envelope_of
from epypes.transport.joining import IDENTITY_BYTES, Guest
from epypes.transport.throttle import Throttle
from epypes.wire import Envelope, Limits

log = logging.getLogger("epypes.transport")

# Sources whose sequence numbers are followed; a peer that invents sources must not fill the memory.
_MAX_SOURCES = 1_024

Source = tuple[str, int]


class PutQueue(Protocol):
    """What a subscriber puts into: queue.Queue, queue.SimpleQueue, ep.Mailbox."""

    def put(self, item: Any, *, block: bool) -> object:
        """Take an item, or raise queue.Full; called with ``block=False``, by one thread at a time."""


class Inbox:
    """What happens to a message: on the I/O thread, unless its header is large or it comes behind such a one."""

    def __init__(self, queue: PutQueue, limits: Limits, undecoded: bool) -> None:
        self._queue, self._limits, self._undecoded = queue, limits, undecoded
        self.received = 0
        self.rejected: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self.lost: dict[Source, int] = {}
        self._log = Throttle(log)
        self._decoding = Decoding(self._take, limits.total_bytes)
        self._opened_ns = 0
        self._epochs: dict[str, int] = {}
        self._last: dict[Source, int] = {}

    def accept(self, frames: Sequence[zmq.Frame], guest: Guest) -> None:
        """Take a message: the answer to a join, an envelope, or one of 2019."""
        # A message that is no answer for its size goes the way of others.
        if len(frames) == 2 and len(frames[1]) == IDENTITY_BYTES and guest.saw(frames[0].bytes, frames[1].bytes):
            return
        is_large = len(frames) > 1 and len(frames[1]) > LARGE_HEADER_BYTES and not self._undecoded
        if not is_large and not self._decoding.is_busy:
            self._take(frames)
        elif not self._decoding.put(frames):
            self.reject("too many at once", "Large messages come faster than they are decoded.")

    def _take(self, frames: Sequence[zmq.Frame]) -> None:
        if self._undecoded:
            self.put(tuple(frame.buffer for frame in frames))
            return
        if len(frames) == 1:
            self.put(frames[0].bytes)
            return
        try:
            envelope = envelope_of([frame.buffer for frame in frames], self._limits)
        except MessageError as error:
            self.reject(error.reason, str(error))
            return
        except Exception as error:
            # Memory may be short: the message is gone, and is counted.
            self.reject(type(error).__name__, f"it can't be read here and now: {error!r:.200}")
            return
        self._follow(envelope)
        self.put(envelope)

    def reject(self, reason: str, text: str) -> None:
        """Count a message that can't be understood."""
        self.rejected[reason] += 1
        self._log.warning(reason, f"rejected a message ({reason}): {text}")

    def begin(self) -> None:
        """Take note that a socket is opened."""
        self._opened_ns = time.time_ns()
        self._decoding = Decoding(self._take, self._limits.total_bytes)

    def end(self, timeout_s: float) -> bool:
        """Put nothing more, once the socket is closed; return False if the queue's ``put`` takes too long."""
        return self._decoding.end(timeout_s)

    def put(self, item: object) -> None:
        """Put an item into the queue, or count it as dropped."""
        # Counted before: whoever has the item must find it counted.
        self.received += 1
        try:
            self._queue.put(item, block=False)
        except queues.Full:
            self.received -= 1
            self.dropped["queue full"] += 1
        except BaseException as error:
            # The user's queue may raise anything, as a Mailbox of policy "fault" does; the others' sockets go on.
            self.received -= 1
            self.dropped[type(error).__name__] += 1
            self._log.warning("refused", f"the queue refused a message: {error!r}")

    def _follow(self, envelope: Envelope) -> None:
        if envelope.sequence == 0:
            return
        source = (envelope.source, envelope.epoch)
        last = self._last.pop(source, None)
        if last is None:
            last = 0 if self._has_restarted(envelope) else envelope.sequence - 1
        missing = envelope.sequence - last - 1
        if missing > 0:
            self.lost[source] = self.lost.get(source, 0) + missing
        self._last[source] = max(last, envelope.sequence)
        if len(self._last) > _MAX_SOURCES:
            oldest = next(iter(self._last))
            del self._last[oldest]
            self.lost.pop(oldest, None)
            self._epochs.pop(oldest[0], None)

    def _has_restarted(self, envelope: Envelope) -> bool:
        """Return whether a source that is known has begun anew while we listened.

        Then what came before this envelope is lost; otherwise it was sent before this subscriber had joined.
        """
        known = self._epochs.get(envelope.source)
        self._epochs[envelope.source] = max(envelope.epoch, known or 0)
        return known is not None and envelope.epoch > max(known, self._opened_ns)
