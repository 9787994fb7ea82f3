"""The queue of a worker: events and jobs for whichever slot is free, and changes of parameters between them.

A change waits until no slot works, and what came after it waits for the change.
"""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

# As in EventLoop, whose threads poll once everything has ended.
_ENDED_POLL_S: Final = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class WorkerEvent:
    """An event: its number, and its frames; one frame is a message of 2019."""

    seq: int
    frames: list[memoryview]


@dataclass(frozen=True, slots=True, eq=False)
class Job:
    """Something else that runs the user's functions, so a slot does it; it must not raise."""

    run: Callable[[], object]


@dataclass(frozen=True, slots=True, eq=False)
class ParameterChange:
    """A change of parameters, made while no slot works; it must not raise."""

    revision: int
    apply: Callable[[], object]


class InputQueue:
    """Events, jobs and changes that wait for the slots."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._changed = threading.Condition(self._lock)
        self._items: deque[WorkerEvent | Job | ParameterChange] = deque()
        self._working = 0
        self._has_ended = False

    def put(self, item: WorkerEvent | Job | ParameterChange) -> None:
        """Add an item."""
        with self._lock:
            self._items.append(item)
            self._changed.notify()

    def take(self, block: bool = True) -> WorkerEvent | Job:
        """Wait for an item to work on; the slot works on it until `finished` is called.

        Raises
        ------
        queue.Empty
            Everything has ended: nothing waits, and nothing will come. Without ``block``: nothing waits now.
        """
        with self._lock:
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

    def _next(self) -> WorkerEvent | Job | None:
        """Return what may be worked on now, having made the changes that come before it."""
        while self._items:
            item = self._items[0]
            if isinstance(item, ParameterChange):
                if self._working:
                    return None
                self._items.popleft()
                item.apply()
            else:
                return self._items.popleft()  # type: ignore[return-value]  # it is the item above
        return None

    def withdraw(self, revision: int) -> bool:
        """Remove a change that has not been made; return whether it was there."""
        with self._lock:
            changes = (item for item in self._items if isinstance(item, ParameterChange))
            found = next((item for item in changes if item.revision == revision), None)
            if found is not None:
                self._items.remove(found)
                # What came after it need not wait any more.
                self._changed.notify_all()
            return found is not None

    def finished(self) -> None:
        """Note that a slot is free again."""
        with self._lock:
            self._working -= 1
            if not self._working and self._items:
                # A change may have waited for this; then what came after it is for all slots.
                self._changed.notify_all()

    def end(self) -> None:
        """Let slots end once nothing waits any more."""
        with self._lock:
            self._has_ended = True
            self._changed.notify_all()
