"""In which order do the slots of a worker take what comes?

One line of work for all slots: events and jobs are taken by whichever slot is free; a change of parameters waits
until no slot works, and what came after it waits for the change.
"""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

# As in EventLoop, whose threads ask again and again once everything has ended.
_ENDED_POLL_S: Final = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Event:
    """An event as it came: its number, whether it is bytes of a peer of 2019, and its frames."""

    seq: int
    is_raw: bool
    frames: list[memoryview]


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """Something else that runs the user's functions, so a slot does it; it must not raise."""

    run: Callable[[], object]


@dataclass(frozen=True, slots=True, eq=False)
class Change:
    """A change of parameters, made while no slot works; it must not raise."""

    revision: int
    apply: Callable[[], object]


class Inbox:
    """What waits for the slots."""

    def __init__(self) -> None:
        self._changed = threading.Condition(threading.Lock())
        self._items: deque[Event | Job | Change] = deque()
        self._working = 0
        self._has_ended = False

    def put(self, item: Event | Job | Change) -> None:
        """Add something to the line."""
        with self._changed:
            self._items.append(item)
            self._changed.notify()

    def take(self, block: bool = True) -> Event | Job:
        """Wait for something to work on; it is under way until `finished` is called.

        Raises
        ------
        queue.Empty
            Everything has ended: nothing waits, and nothing will come. Without ``block``: nothing waits now.
        """
        with self._changed:
            while True:
                item = self._next()
                if item is not None:
                    self._working += 1
                    return item
                if not block:
                    raise queue.Empty
                if self._has_ended and not self._items:
                    self._changed.wait(_ENDED_POLL_S)
                    raise queue.Empty
                self._changed.wait()

    def _next(self) -> Event | Job | None:
        """Return what may be worked on now, having made the changes that come before it."""
        while self._items:
            item = self._items[0]
            if isinstance(item, Change):
                if self._working:
                    return None
                self._items.popleft()
                item.apply()
            else:
                del self._items[0]
                return item
        return None

    def withdraw(self, revision: int) -> bool:
        """Forget a change that has not been made; return whether it was there."""
        with self._changed:
            found = next((item for item in self._items if isinstance(item, Change) and item.revision == revision), None)
            if found is not None:
                self._items.remove(found)
                # What came after it need not wait any more.
                self._changed.notify_all()
            return found is not None

    def finished(self) -> None:
        """Tell that what was taken has been done."""
        with self._changed:
            self._working -= 1
            if not self._working:
                # A change may have waited for this; then what came after it is for all.
                self._changed.notify_all()

    def end(self) -> None:
        """Let slots go once nothing waits any more."""
        with self._changed:
            self._has_ended = True
            self._changed.notify_all()
