"""Large headers are decoded on a thread of their own, so that the I/O thread goes on with its other sockets."""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Callable, Sequence
from typing import Final

import zmq

# A header of this size holds some 10,000 values, which take about 20 ms.
LARGE_HEADER_BYTES: Final = 32 * 1024
_MOST_WAITING: Final = 256

log = logging.getLogger("epypes.transport")

Frames = Sequence[zmq.Frame]


class Decoding:
    """Takes messages in order, one at a time; its thread lives while messages wait.

    Parameters
    ----------
    take
        Decodes a message and puts it into the user's queue.
    max_bytes
        Of all messages that wait.
    """

    def __init__(self, take: Callable[[Frames], None], max_bytes: int) -> None:
        self._take, self._max_bytes = take, max_bytes
        self._lock = threading.Lock()
        self._waiting: deque[Frames] = deque()
        self._bytes = 0
        self._thread: threading.Thread | None = None
        self._is_over = False

    @property
    def is_busy(self) -> bool:
        """Whether a message waits or is being decoded: what comes after it must wait for its turn."""
        return self._thread is not None

    def put(self, frames: Frames) -> bool:
        """Hand over a message; return False if too many wait already."""
        size = sum(map(len, frames))
        with self._lock:
            # One of the largest that are allowed can always wait.
            if len(self._waiting) >= _MOST_WAITING or (self._waiting and self._bytes + size > self._max_bytes):
                return False
            self._waiting.append(frames)
            self._bytes += size
            if self._thread is None:
                thread = threading.Thread(target=self._run, name="epypes-decoding", daemon=True)
                try:
                    thread.start()
                except RuntimeError:
                    # The system has no thread to give just now.
                    self._waiting.clear()
                    self._bytes = 0
                    return False
                self._thread = thread
        return True

    def end(self, timeout_s: float) -> bool:
        """Forget what waits; return whether the thread has ended in time."""
        with self._lock:
            self._is_over = True
            self._waiting.clear()
            thread = self._thread
        if thread is None or thread is threading.current_thread():
            return True
        thread.join(timeout_s)
        return not thread.is_alive()

    def _run(self) -> None:
        while True:
            with self._lock:
                if self._is_over or not self._waiting:
                    self._thread = None
                    return
                frames = self._waiting.popleft()
                self._bytes -= sum(map(len, frames))
            try:
                self._take(frames)
            except BaseException:
                # What can't be read is counted; this is a bug of ours, and must not stop the others.
                log.exception("a message could not be taken")
            del frames
