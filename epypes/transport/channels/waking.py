"""How is a thread woken that waits for sockets?"""

from __future__ import annotations

import contextlib
import selectors
import socket
from collections.abc import Iterator
from typing import Any, Final

READ: Final = selectors.EVENT_READ
WRITE: Final = selectors.EVENT_WRITE
_MOST_WAKES: Final = 4_096


def own_selector() -> selectors.BaseSelector:
    """Return a selector that a forked child has a copy of: through one of the kernel's it would change what we hear."""
    return getattr(selectors, "PollSelector", selectors.DefaultSelector)()


class Waiting:
    """A selector whose wait any thread may end.

    Attributes
    ----------
    sockets
        What is waited for is registered there.
    """

    def __init__(self) -> None:
        self.sockets = own_selector()
        self._waking, self._woken = socket.socketpair()
        for end in (self._waking, self._woken):
            end.setblocking(False)
        self.sockets.register(self._woken, READ)

    def wait(self, timeout_s: float) -> Iterator[tuple[Any, int]]:
        """Yield what is ready within so many seconds, and for what: `READ`, `WRITE` or both."""
        for key, events in self.sockets.select(timeout_s):
            if key.fileobj is self._woken:
                self._woken.recv(_MOST_WAKES)
            else:
                yield key.fileobj, events

    def wake(self) -> None:
        """End the wait, or the next one; from any thread, as often as you like."""
        # If it is full, it wakes all the same; closed, there is nobody to be woken.
        with contextlib.suppress(OSError):
            self._waking.send(b"0")

    def close(self) -> None:
        """Wait no more."""
        self.sockets.close()
        self._waking.close()
        self._woken.close()
