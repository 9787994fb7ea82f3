"""When is a process that runs on to end? When it is asked to, or has nothing left to do."""

from __future__ import annotations

import signal
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from types import FrameType
from typing import Any, Final, Self

_SIGNALS: Final = (signal.SIGTERM, signal.SIGINT)
# No signal has this number.
_DONE: Final = 0


class Signals:
    """While its block runs, SIGTERM and SIGINT end `wait` instead of the process.

    A signal may be given to any thread, and then the main thread, which waits, would not hear of it. So each writes its
    number into a socket, which the main thread reads from.
    """

    def __enter__(self) -> Self:
        self._reader, self._writer = socket.socketpair()
        self._writer.setblocking(False)
        self._woken_before = signal.set_wakeup_fd(self._writer.fileno(), warn_on_full_buffer=False)
        self._before = {number: signal.signal(number, _hear) for number in _SIGNALS}
        return self

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(self._woken_before)
        self._reader.close()
        self._writer.close()

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait for a signal, for `now`, or for ``timeout_s`` seconds; return whether it was a signal."""
        self._reader.settimeout(timeout_s)
        with suppress(TimeoutError):
            while (number := self._reader.recv(1)[0]) not in (*_SIGNALS, _DONE):
                continue
            return number != _DONE
        return False

    def now(self) -> None:
        """End `wait`; from any thread. Does nothing if nobody waits any more."""
        with suppress(OSError):
            self._writer.send(bytes([_DONE]))

    def wait_during(self, work: Callable[[], Any]) -> bool:
        """Do something on a thread of its own; return whether it was done before a signal came.

        What it raises is raised.
        """
        errors: list[BaseException] = []

        def run() -> None:
            try:
                work()
            except BaseException as error:
                errors.append(error)
            self.now()

        try:
            threading.Thread(target=run, name="epypes serve", daemon=True).start()
        except RuntimeError:
            # The system has no thread to give: then no signal is heard meanwhile.
            run()
        is_signal = self.wait()
        if errors:
            raise errors[0]
        return not is_signal


def _hear(number: int, frame: FrameType | None) -> None:
    """Do nothing: the signal's number has been written."""
