"""Standard error that never blocks the writer.

A pipe that is not read is full after 64 KB, and a write to it blocks. So one thread does the writing; what does not
fit into its queue is dropped and counted.
"""

from __future__ import annotations

import atexit
import os
import threading
from collections import deque
from typing import Final

_MAX_BYTES: Final = 1024**2
# How long the end of the process waits for what was written last.
_EXIT_TIMEOUT_S: Final = 0.5


class NonBlockingStream:
    """Writes to a file descriptor from a thread of its own; takes text as a stream of `logging` does, and bytes.

    Any thread may use it.

    Parameters
    ----------
    descriptor
        The file.
    max_bytes
        Most bytes that may wait to be written.
    """

    def __init__(self, descriptor: int, max_bytes: int = _MAX_BYTES) -> None:
        self._descriptor, self._max_bytes = descriptor, max_bytes
        self._changed = threading.Condition()
        self._queue: deque[bytes] = deque()
        self._bytes = self._dropped = 0
        self._has_thread = False

    def write(self, text: str | bytes) -> int:
        """Queue text; returns at once. What does not fit is dropped, which a later line reports."""
        data = text.encode(errors="backslashreplace") if isinstance(text, str) else text
        with self._changed:
            if self._bytes + len(data) > self._max_bytes:
                self._dropped += 1
            else:
                self._queue.append(data)
                self._bytes += len(data)
                self._start()
                self._changed.notify_all()
        return len(text)

    def flush(self) -> None:
        """Do nothing: `logging` flushes after every line, and must not wait."""

    def wait(self, timeout_s: float) -> bool:
        """Wait until everything is written; return whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._bytes, timeout_s)

    def _start(self) -> None:
        if not self._has_thread:
            self._has_thread = True
            atexit.register(self.wait, _EXIT_TIMEOUT_S)
            threading.Thread(target=self._write_all, name="epypes standard error", daemon=True).start()

    def _write_all(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._queue)
                data, dropped, self._dropped = self._queue.popleft(), self._dropped, 0
            if dropped:
                _write(self._descriptor, f"{dropped} lines were dropped here: standard error was not read.\n".encode())
            _write(self._descriptor, data)
            with self._changed:
                self._bytes -= len(data)
                self._changed.notify_all()


def _write(descriptor: int, data: bytes) -> None:
    """Write everything; nothing if the reader is gone."""
    try:
        while data:
            data = data[os.write(descriptor, data) :]
    except OSError:
        return


# Of this process; the output of its workers goes here too.
STANDARD_ERROR: Final = NonBlockingStream(2)
