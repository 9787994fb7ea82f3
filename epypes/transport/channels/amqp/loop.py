"""How is a connection of pika driven, step by step, by whoever waits?

Pika takes any loop that has the methods it asks for. With its own a message is three calls of the kernel to write it
and three more to learn that it can be written, and to read again.
"""

from __future__ import annotations

import heapq
import itertools
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from time import monotonic
from typing import Final

import pika

from epypes.transport.channels.waking import READ, WRITE, SocketLoop

Handler = Callable[[int, int], object]

# To write a large message in parts costs less than to copy it into one.
_SMALL_BYTES: Final = 16_384


class JoiningConnection(pika.SelectConnection):  # type: ignore[misc]  # pika has no types
    """A connection that sends the frames of a small message as one."""

    def _output_marshaled_frames(self, marshaled_frames: Sequence[bytes]) -> None:
        is_small = sum(map(len, marshaled_frames)) <= _SMALL_BYTES
        super()._output_marshaled_frames([b"".join(marshaled_frames)] if is_small else marshaled_frames)


class PikaLoop(SocketLoop):
    """What pika asks of a loop, see `pika.adapters.utils.selector_ioloop_adapter`; and `turns.Loop`.

    Attributes
    ----------
    is_eager
        Whether what is to be written is tried at once. Not before the connection is open: to be writable tells pika
        that it is.
    """

    READ, WRITE, ERROR = READ, WRITE, 0

    def __init__(self) -> None:
        super().__init__()
        self.is_eager = False
        self._handlers: dict[int, Handler] = {}
        # What is waited for at each, and which are to be written to before that is waited for.
        self._events: dict[int, int] = {}
        self._unwritten: set[int] = set()
        self._callbacks: deque[Callable[[], object]] = deque()
        self._timers: list[tuple[float, int, list[Callable[[], object]]]] = []
        self._numbers = itertools.count()

    # --- turns.Loop ---

    def step(self, timeout_s: float, aside: AbstractContextManager[object]) -> None:
        """Take a step; see `turns.Loop.step`."""
        self.flush()
        patience_s = self._patience_s(timeout_s)
        self.is_waiting = True
        with aside:
            ready = self._waiting.wait(patience_s)
        self.is_waiting = False
        for fd, events in ready:
            handler = self._handlers.get(fd)
            if handler is not None:
                handler(fd, events)
        self._call()
        self.flush()

    def _patience_s(self, timeout_s: float) -> float:
        if self._callbacks:
            return 0.0
        return max(min(timeout_s, self._timers[0][0] - monotonic()), 0.0) if self._timers else timeout_s

    def flush(self) -> None:
        """Write what can be written; see `turns.Loop.flush`."""
        for fd in tuple(self._unwritten):
            # If all is written it asks for no more; if a signal's handler raises here, it is tried again.
            self._handlers[fd](fd, WRITE)
            if fd in self._unwritten:
                self._unwritten.discard(fd)
                self._waiting.watch(fd, self._events[fd])

    def _call(self) -> None:
        for _ in range(len(self._callbacks)):
            self._callbacks.popleft()()
        now_s = monotonic()
        while self._timers and self._timers[0][0] <= now_s:
            for callback in heapq.heappop(self._timers)[2]:
                callback()

    # --- what pika asks for ---

    def start(self) -> None:
        """Do nothing: who waits takes steps."""

    def stop(self) -> None:
        """Do nothing: who waits takes steps."""

    def call_later(self, delay: float, callback: Callable[[], object]) -> list[Callable[[], object]]:
        """Call something after so many seconds, unless what is returned is removed before."""
        timer = [callback]
        heapq.heappush(self._timers, (monotonic() + delay, next(self._numbers), timer))
        self._waiting.wake()
        return timer

    def remove_timeout(self, timeout_handle: list[Callable[[], object]]) -> None:
        """Call it no more."""
        timeout_handle.clear()

    def add_callback(self, callback: Callable[[], object]) -> None:
        """Call something in the next step; from any thread."""
        self._callbacks.append(callback)
        self._waiting.wake()

    def add_handler(self, fd: int, handler: Handler, events: int) -> None:
        """Have what is ready at a socket told to a handler."""
        self._handlers[fd], self._events[fd] = handler, events
        self._waiting.watch(fd, events)

    def update_handler(self, fd: int, events: int) -> None:
        """Have something else told."""
        self._events[fd] = events
        if self.is_eager and events & WRITE:
            self._unwritten.add(fd)
        else:
            self._unwritten.discard(fd)
            self._waiting.watch(fd, events)

    def remove_handler(self, fd: int) -> None:
        """Have nothing told any more."""
        self._unwritten.discard(fd)
        del self._handlers[fd], self._events[fd]
        self._waiting.forget(fd)
