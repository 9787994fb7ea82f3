"""How does a service write to its standard error without waiting for who reads it?

A pipe that nobody reads is full after 64 KB, and whoever writes to it then stands still. So a thread of its own writes,
and what has no room until it gets on is dropped and counted.
"""

from __future__ import annotations

import atexit
import os
import threading
from collections import deque
from typing import Final

_MOST_BYTES: Final = 1024**2
# So long the end of the process waits for what was written last.
_END_S: Final = 0.5


class Words:
    """Writes to a file by its number; takes text as a stream of `logging` does, and bytes. For any thread.

    Parameters
    ----------
    number
        The file's.
    most_bytes
        How much may wait to be written.
    """

    def __init__(self, number: int, most_bytes: int = _MOST_BYTES) -> None:
        self._number, self._most_bytes = number, most_bytes
        self._changed = threading.Condition()
        self._waiting: deque[bytes] = deque()
        self._bytes, self._lost = 0, 0
        self._has_thread = False

    def write(self, text: str | bytes) -> int:
        """Have something written; returns at once. What has no room is dropped, which is said when there is again."""
        data = text.encode(errors="backslashreplace") if isinstance(text, str) else text
        with self._changed:
            if self._bytes + len(data) > self._most_bytes:
                self._lost += 1
            else:
                self._waiting.append(data)
                self._bytes += len(data)
                self._start()
                self._changed.notify_all()
        return len(text)

    def flush(self) -> None:
        """Do nothing: a stream is flushed after every line, and nobody waits for this one."""

    def wait(self, timeout_s: float) -> bool:
        """Wait until all is written; return whether it is."""
        with self._changed:
            return self._changed.wait_for(lambda: not self._bytes, timeout_s)

    def _start(self) -> None:
        if not self._has_thread:
            self._has_thread = True
            atexit.register(self.wait, _END_S)
            threading.Thread(target=self._write_all, name="epypes words", daemon=True).start()

    def _write_all(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._waiting)
                data, lost = self._waiting.popleft(), self._lost
                self._lost = 0
            if lost:
                _write(self._number, f"{lost} times nothing was written here, as nobody read what had been.\n".encode())
            _write(self._number, data)
            with self._changed:
                self._bytes -= len(data)
                self._changed.notify_all()


def _write(number: int, data: bytes) -> None:
    """Write all of something; nothing, if there is nobody to read it any more."""
    try:
        while data:
            data = data[os.write(number, data) :]
    except OSError:
        return


# Of this process: what a worker says goes here too.
STANDARD_ERROR: Final = Words(2)
