"""Who takes from the user's queue? Whoever puts, where the queue tells of it; else a thread that waits in it."""

from __future__ import annotations

import contextlib
import os
import queue as queues
import threading
import time
from collections.abc import Callable
from typing import Any, Protocol

from epypes.errors import StillRunning

# How long the bridge sleeps in the user's queue before it looks at its stop flag, while items come and when none comes:
# a stop takes this long at most. To wake up takes up to 100 us of a core.
_TICK_S = 0.025
_LONGEST_TICK_S = 0.045
# What it takes to close an outlet, or to find out that it is closed, when the time for a stop is over.
_CLOSE_S = 0.5


class TakeQueue(Protocol):
    """What a publisher takes from: queue.Queue, queue.SimpleQueue, ep.Mailbox."""

    def get(self, *, timeout: float) -> Any:
        """Return the next item, or raise queue.Empty after ``timeout`` seconds."""


class Outlet(Protocol):
    """How an item leaves: through a socket, or by way of a broker. Closing twice is allowed."""

    @property
    def name(self) -> str:
        """Whose it is, for errors."""

    def publish(self, item: Any) -> None:
        """Send an item. What it raises is counted, and whoever puts into a Mailbox gets it."""

    def reject(self, reason: str, text: str, log_once: bool = False) -> None:
        """Count an item that can't be sent."""

    def close(self, timeout_s: float = 10.0) -> None:
        """Send what was published, and end; raise TimeoutError if that takes longer."""

    def close_soon(self) -> None:
        """End without waiting, as the garbage collector must."""

    def is_gone(self) -> bool:
        """Return whether this is a forked child, where it is not open."""

    def is_own_thread(self) -> bool:
        """Return whether the caller runs on a thread that closing needs, so that it must not wait."""


class Taker(Protocol):
    """Takes items from a queue and publishes them, until it is stopped."""

    stopping: bool

    def is_alive(self) -> bool:
        """Return whether it takes; in a forked child none does."""

    def stop(self, timeout_s: float) -> None:
        """Send what is queued and close the outlet; raise StillRunning if the queue's ``get`` does not return."""

    def abandon(self) -> None:
        """Stop without waiting, as the garbage collector must."""


def taker(queue: TakeQueue, outlet: Outlet) -> Taker:
    """Return what takes from a queue from now on: a Bridge, if the queue does not hand items over as a Mailbox does."""
    hand_to = getattr(queue, "hand_to", None)
    return HandOver(outlet, hand_to) if callable(hand_to) else Bridge(queue, outlet)


class HandOver:
    """Has a queue hand its items to the outlet within the call of ``put``: no thread has to be woken up.

    When ``put`` returns, its item has been sent, and arrays that it could still change have been copied.
    """

    def __init__(self, outlet: Outlet, hand_to: Callable[[Callable[[Any], object]], Callable[[], None]]) -> None:
        self._outlet = outlet
        self.stopping = False
        self._end = hand_to(outlet.publish)

    def is_alive(self) -> bool:
        """Return whether it takes."""
        return not self.stopping and not self._outlet.is_gone()

    def stop(self, timeout_s: float) -> None:
        """Close the outlet; what is put from now on stays in the queue."""
        self.stopping = True
        self._end()
        try:
            self._outlet.close(timeout_s)
        except TimeoutError as error:
            # The I/O thread is held up in a subscriber's queue.
            raise StillRunning(self._outlet.name, ["put"], timeout_s) from error

    def abandon(self) -> None:
        """Stop without waiting."""
        self.stopping = True
        self._end()
        self._outlet.close_soon()


class Bridge:
    """A thread that waits in a queue which tells nobody of a put."""

    def __init__(self, queue: TakeQueue, outlet: Outlet) -> None:
        self._queue, self._outlet = queue, outlet
        self._process = os.getpid()
        self._deadline = 0.0
        # Whether the outlet could not be closed in time.
        self._is_held_up = False
        # Not an Event: the garbage collector sets it, in any thread, where a lock could be held already.
        self.stopping = False
        self._thread = threading.Thread(target=self._run, name="epypes-publisher", daemon=True)
        self._thread.start()

    def is_alive(self) -> bool:
        """Return whether the thread runs."""
        return self._process == os.getpid() and self._thread.is_alive()

    def stop(self, timeout_s: float) -> None:
        """Let the thread send what is queued, and wait until it has ended."""
        if self._process != os.getpid():
            return
        self._deadline = time.monotonic() + timeout_s
        self.stopping = True
        if self._thread is threading.current_thread() or self._outlet.is_own_thread():
            # Called by the user's queue, in get() or in put(): the thread ends by itself once that returns, and
            # needs the I/O thread for it.
            return
        self._thread.join(timeout_s)
        if self._thread.is_alive() or self._is_held_up:
            self._close_in_its_stead(timeout_s)
        if self._thread.is_alive():
            raise StillRunning(self._outlet.name, ["get"], timeout_s)

    def _close_in_its_stead(self, timeout_s: float) -> None:
        try:
            self._outlet.close(_CLOSE_S)
        except TimeoutError as error:
            raise StillRunning(self._outlet.name, ["put"], timeout_s) from error
        self._is_held_up = False
        # What waited for a broker has been told by that.
        self._thread.join(_CLOSE_S)

    def abandon(self) -> None:
        """Stop without waiting."""
        self.stopping = True

    def _run(self) -> None:
        try:
            tick_s = _TICK_S
            while not self.stopping:
                tick_s = _TICK_S if self._take(tick_s) else _LONGEST_TICK_S
            self._drain()
        finally:
            try:
                self._outlet.close(max(self._deadline - time.monotonic(), _CLOSE_S))
            except TimeoutError:
                # Told by stop, if somebody waits there.
                self._is_held_up = True

    def _drain(self) -> None:
        # As many as there were: a producer that goes on must not keep it from stopping.
        left = _size(self._queue)
        while left != 0 and time.monotonic() < self._deadline and self._take(0.0):
            left = None if left is None else left - 1

    def _take(self, timeout_s: float) -> bool:
        try:
            item = self._queue.get(timeout=timeout_s)
        except queues.Empty:
            return False
        except BaseException as error:
            # A queue that is shut down or broken raises at once, each time: without the pause this would spin.
            self._outlet.reject("queue failed", f"the queue raised {error!r}", log_once=True)
            time.sleep(_TICK_S)
            return False
        # The outlet has counted what the item's own code raises, even SystemExit; the thread goes on.
        with contextlib.suppress(BaseException):
            self._outlet.publish(item)
        return True


def _size(queue: object) -> int | None:
    """Return how many items a queue has, or None if it can't tell, as one of multiprocessing on macOS."""
    try:
        return int(queue.qsize())  # type: ignore[attr-defined]  # not every queue has one
    except BaseException:
        return None
