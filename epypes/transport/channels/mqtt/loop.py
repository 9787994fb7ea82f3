"""How is a connection of paho driven, step by step, by whoever waits?"""

from __future__ import annotations

from typing import Any, Final

import paho.mqtt.client as paho

from epypes.transport.channels.waking import READ, WRITE, Waiting

# So often paho looks after its heartbeats.
_LOOK_S: Final = 0.5


class Client(paho.Client):
    """A client that writes without copying: paho by itself copies what is left of a packet at each attempt."""

    def _packet_queue(self, command: int, packet: Any, *more: Any) -> Any:
        return super()._packet_queue(command, memoryview(packet), *more)  # type: ignore[arg-type]  # it is cut and sent


class PahoLoop:
    """A client of paho that is connected, as `turns.Loop`."""

    def __init__(self, client: paho.Client) -> None:
        self._client = client
        opened: Any = client.socket()
        self._socket, self._events = opened, READ
        self._waiting = Waiting()
        self._waiting.sockets.register(opened, READ)

    def step(self, timeout_s: float) -> None:
        """Take a step; see `turns.Loop.step`."""
        client = self._client
        if client.want_write():
            client.loop_write()
        if client.socket() is None:
            raise ConnectionError("it is closed")
        self._watch(READ | (WRITE if client.want_write() else 0))
        # What is encrypted may have come, and wait to be read, already.
        is_there = bool(getattr(self._socket, "pending", int)())
        for _, events in self._waiting.wait(0.0 if is_there else min(timeout_s, _LOOK_S)):
            is_there = is_there or bool(events & READ)
        if is_there:
            client.loop_read()
        client.loop_misc()

    def _watch(self, events: int) -> None:
        if events != self._events:
            self._events = events
            self._waiting.sockets.modify(self._socket, events)

    def wake(self) -> None:
        """Have a step end soon; see `turns.Loop.wake`."""
        self._waiting.wake()

    def suits(self) -> bool:
        """Return whether the calling thread may take steps; see `turns.Loop.suits`."""
        return True

    def close(self) -> None:
        """Take no more steps; see `turns.Loop.close`."""
        self._waiting.close()
