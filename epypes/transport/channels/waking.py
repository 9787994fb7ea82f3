"""How is a thread woken that waits for sockets?"""

from __future__ import annotations

import contextlib
import socket
import sys
from selectors import EVENT_READ as READ
from selectors import EVENT_WRITE as WRITE
from typing import Any, Final

# Of which a forked child has a copy: through one that is the kernel's it would change what we hear.
if sys.platform == "win32":
    from selectors import SelectSelector as OwnSelector
else:
    from selectors import PollSelector as OwnSelector

__all__ = ["READ", "WRITE", "OwnSelector", "SocketLoop", "Waiting"]

_MOST_WAKES: Final = 4_096


class Waiting:
    """What is waited for at some sockets; any thread may end the wait."""

    def __init__(self) -> None:
        self._selector = OwnSelector()
        self._waking, self._woken = socket.socketpair()
        for end in (self._waking, self._woken):
            end.setblocking(False)
        self._selector.register(self._woken, READ)

    def watch(self, opened: Any, events: int) -> None:
        """Wait for something at a socket from now on: `READ`, `WRITE` or both. Who waits just now is woken."""
        known = self._selector.get_map().get(opened)
        if known is None:
            self._selector.register(opened, events)
        elif known.events != events:
            self._selector.modify(opened, events)
            self.wake()

    def forget(self, opened: Any) -> None:
        """Wait for nothing at a socket any more."""
        self._selector.unregister(opened)

    def wait(self, timeout_s: float) -> list[tuple[Any, int]]:
        """Return what is ready within so many seconds, and for what."""
        ready = [(key.fileobj, events) for key, events in self._selector.select(timeout_s)]
        for found in ready:
            if found[0] is self._woken:
                self._woken.recv(_MOST_WAKES)
                ready.remove(found)
                break
        return ready

    def wake(self) -> None:
        """End the wait, or the next one; from any thread, as often as you like."""
        # If it is full, it wakes all the same; closed, there is nobody to be woken.
        with contextlib.suppress(OSError):
            self._waking.send(b"0")

    def close(self) -> None:
        """Wait no more."""
        self._selector.close()
        self._waking.close()
        self._woken.close()


class SocketLoop:
    """What the `turns.Loop`s have in common that wait for sockets by a `Waiting`, in any thread."""

    def __init__(self) -> None:
        self.is_waiting = False
        self._waiting = Waiting()

    def wake(self) -> None:
        """Have a step end soon; see `turns.Loop.wake`."""
        self._waiting.wake()

    def suits(self) -> bool:
        """Return whether the calling thread may take steps; see `turns.Loop.suits`."""
        return True

    def close(self) -> None:
        """Take no more steps; see `turns.Loop.close`."""
        self._waiting.close()
