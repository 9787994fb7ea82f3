"""How is a connection of paho driven, step by step, by whoever waits?"""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Any, Final

import paho.mqtt.client as paho

from epypes.transport.channels.waking import READ, WRITE, SocketLoop

# So often paho looks after its heartbeats.
_LOOK_S: Final = 0.5


class Client(paho.Client):
    """A client that writes without copying: paho by itself copies what is left of a packet at each attempt."""

    def _packet_queue(self, command: int, packet: Any, *more: Any) -> Any:
        return super()._packet_queue(command, memoryview(packet), *more)  # type: ignore[arg-type]  # it is cut and sent


class PahoLoop(SocketLoop):
    """A client of paho that is connected, as `turns.Loop`."""

    def __init__(self, client: paho.Client) -> None:
        super().__init__()
        self._client = client
        self._socket: Any = client.socket()

    def step(self, timeout_s: float, aside: AbstractContextManager[object]) -> None:
        """Take a step; see `turns.Loop.step`."""
        self.flush()
        # What is encrypted may have come, and wait to be read, already.
        is_there = bool(getattr(self._socket, "pending", int)())
        self.is_waiting = True
        with aside:
            ready = self._waiting.wait(0.0 if is_there else min(timeout_s, _LOOK_S))
        self.is_waiting = False
        if is_there or any(events & READ for _, events in ready):
            self._client.loop_read()
        self._client.loop_misc()

    def flush(self) -> None:
        """Write what can be written; see `turns.Loop.flush`."""
        client = self._client
        if client.want_write():
            client.loop_write()
        if client.socket() is None:
            raise ConnectionError("the connection was closed")
        self._waiting.watch(self._socket, READ | (WRITE if client.want_write() else 0))
