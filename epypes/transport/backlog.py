"""What waits for the disk, and what becomes of a message that finds no room?"""

from __future__ import annotations

import threading
import time
from collections import Counter, deque

from epypes.transport.channel import Delivery
from epypes.transport.mcapformat import Counts, Frames

_SLOW, _FAILED = "disk too slow", "disk failed"
# What a message takes beside its bytes: without it, millions of tiny ones would fill the memory.
_BESIDE_BYTES = 1_024


class Backlog:
    """Messages between the I/O thread, which puts them, and the recorder's, which takes them.

    Parameters
    ----------
    messages
        After how many it closes; None for never.
    most_bytes
        How much may wait; a message larger than that is taken when nothing else waits.
    """

    def __init__(self, messages: int | None, most_bytes: int) -> None:
        self._left, self._most_bytes = messages, most_bytes
        self._items: deque[tuple[int, Frames, int]] = deque()
        self._bytes = 0
        self._counts = Counts()
        self._closed = self._failed = False
        self._changed = threading.Condition()
        # The clocks are read together once: later times differ as those of the monotonic one.
        self._offset_ns = time.time_ns() - time.perf_counter_ns()

    def put(self, delivery: Delivery, *, block: bool) -> None:
        """Take the frames of a message, or count them as dropped."""
        item = tuple(delivery.frames)
        now_ns = self._offset_ns + time.perf_counter_ns()
        size = sum(map(len, item)) + _BESIDE_BYTES
        with self._changed:
            if self._closed and not self._failed:
                return
            self._counts.received += 1
            if self._failed:
                self._counts.dropped[_FAILED] += 1
            elif self._items and self._bytes + size > self._most_bytes:
                self._counts.dropped[_SLOW] += 1
            else:
                self._accept(now_ns, item, size)

    def _accept(self, now_ns: int, item: Frames, size: int) -> None:
        self._items.append((now_ns, item, size))
        self._bytes += size
        if self._left is not None:
            self._left -= 1
            self._closed = self._left <= 0
        self._changed.notify_all()

    def take(self, timeout_s: float | None) -> tuple[int, Frames] | None:
        """Return the next message, or None if there is none within ``timeout_s`` or none will come."""
        with self._changed:
            self._changed.wait_for(lambda: self._items or self._closed, timeout_s)
            if not self._items:
                return None
            time_ns, frames, size = self._items.popleft()
            self._bytes -= size
            return time_ns, frames

    def close(self) -> None:
        """Take no more; safe in a finalizer, since the lock is re-entrant."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def is_over(self) -> bool:
        """Return whether everything was taken and nothing will come."""
        with self._changed:
            return self._closed and not self._items

    def give_up(self) -> None:
        """Drop what waits, since the time for it is over."""
        with self._changed:
            self._drop(_SLOW, 0)

    def fail(self, taken: int) -> None:
        """Drop what waits and what will come, and so many that had been taken: the disk takes no more."""
        with self._changed:
            self._failed = True
            self._drop(_FAILED, taken)

    def _drop(self, reason: str, more: int) -> None:
        lost = len(self._items) + more
        if lost:
            self._counts.dropped[reason] += lost
        self._items.clear()
        self._bytes = 0

    def wrote(self, messages: int) -> None:
        """Count messages that are in the file."""
        with self._changed:
            self._counts.written = messages

    def counts(self) -> Counts:
        """Return a copy of the counts."""
        with self._changed:
            return Counts(self._counts.received, self._counts.written, Counter(self._counts.dropped))
