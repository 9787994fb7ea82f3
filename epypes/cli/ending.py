"""When is a command that runs on to end? When it is asked to, or has nothing left to do."""

from __future__ import annotations

import queue
import signal
from types import FrameType
from typing import Any, Self

_SIGNALS = (signal.SIGTERM, signal.SIGINT)


class Ending:
    """While its block runs, SIGTERM and Ctrl+C end `wait` instead of the process."""

    def __init__(self) -> None:
        # Not an Event, whose lock the main thread may hold when a signal arrives in it.
        self._reasons: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._before: dict[int, Any] = {}

    def now(self) -> None:
        """End `wait`; from any thread."""
        self._reasons.put(None)

    def wait(self, timeout_s: float | None = None) -> None:
        """Return at a signal, at `now`, or after ``timeout_s`` seconds."""
        try:
            self._reasons.get(timeout=timeout_s)
        except queue.Empty:
            return

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.now()

    def __enter__(self) -> Self:
        self._before = {number: signal.signal(number, self._on_signal) for number in _SIGNALS}
        return self

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
