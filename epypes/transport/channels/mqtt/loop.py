"""How is a connection of paho driven, step by step, by whoever waits?"""

from __future__ import annotations

import contextlib
import selectors
import socket
from typing import Any, Final

import paho.mqtt.client as paho

from epypes.transport.channels.turns import own_selector

# So often paho looks after its heartbeats.
_LOOK_S: Final = 0.5
_MOST_WAKES: Final = 4_096


class Client(paho.Client):
    """A client that writes without copying: paho by itself copies what is left of a packet at each attempt."""

    def _packet_queue(self, command: int, packet: Any, *more: Any) -> Any:
        return super()._packet_queue(command, memoryview(packet), *more)  # type: ignore[arg-type]  # it is cut and sent


class PahoLoop:
    """A client of paho that is connected, as `turns.Loop`."""

    def __init__(self, client: paho.Client) -> None:
        self._client = client
        self._waking, self._woken = socket.socketpair()
        for end in (self._waking, self._woken):
            end.setblocking(False)
        self._selector = own_selector()
        self._selector.register(self._woken, selectors.EVENT_READ)
        opened: Any = client.socket()
        self._socket = opened
        self._events = selectors.EVENT_READ
        self._selector.register(opened, self._events)

    def step(self, timeout_s: float) -> None:
        """Take a step; see `turns.Loop.step`."""
        client = self._client
        if client.want_write():
            client.loop_write()
        if client.socket() is None:
            raise ConnectionError("it is closed")
        self._watch(selectors.EVENT_READ | (selectors.EVENT_WRITE if client.want_write() else 0))
        # What is encrypted may have come, and wait to be read, already.
        is_there = bool(getattr(self._socket, "pending", int)())
        for key, events in self._selector.select(0.0 if is_there else min(timeout_s, _LOOK_S)):
            if key.fileobj is self._woken:
                self._woken.recv(_MOST_WAKES)
            elif events & selectors.EVENT_READ:
                is_there = True
        if is_there:
            client.loop_read()
        client.loop_misc()

    def _watch(self, events: int) -> None:
        if events != self._events:
            self._events = events
            self._selector.modify(self._socket, events)

    def wake(self) -> None:
        """Have a step end soon; see `turns.Loop.wake`."""
        with contextlib.suppress(BlockingIOError):
            self._waking.send(b"0")

    def suits(self) -> bool:
        """Return whether the calling thread may take steps; see `turns.Loop.suits`."""
        return True

    def close(self) -> None:
        """Take no more steps; see `turns.Loop.close`."""
        self._selector.close()
        self._waking.close()
        self._woken.close()
