"""Which frames make the next message? Those that fit into the limits; of a larger one none is kept.

ZeroMQ itself keeps a message until its last frame has come; `guard` drops the peer that never sends it.
"""

from __future__ import annotations

from collections.abc import Sequence

import zmq

from epypes.transport.guard import Watch
from epypes.wire import Limits

# Of a longer message the rest is read at the next turn, so that other sockets get theirs. An image of a few parts
# is read at once.
_BATCH = 256
_DONTWAIT = int(zmq.DONTWAIT)
# Beside the payloads an envelope has a topic and a header.
_NO_PAYLOADS = 2


class Gatherer:
    """Reads a socket's messages frame by frame, some at a time."""

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._frames: list[zmq.Frame] = []
        self._bytes = 0
        self._reason = ""

    def read(self, socket: zmq.Socket[bytes], watch: Watch | None = None) -> Sequence[zmq.Frame] | None:
        """Return the frames of a message, or None if it goes on; none if it is `refused`.

        Raises
        ------
        zmq.Again
            If nothing has arrived.
        """
        for _ in range(_BATCH):
            frame = socket.recv(_DONTWAIT, copy=False)
            self._keep(frame)
            if not frame.more:
                if watch is not None:
                    watch.has_read(frame)
                frames, self._frames, self._bytes = self._frames, [], 0
                return frames
        return None

    def refused(self) -> str:
        """Return why the message that was read last is not there, if it is not."""
        reason, self._reason = self._reason, ""
        return reason

    def _keep(self, frame: zmq.Frame) -> None:
        if self._reason:
            return
        self._frames.append(frame)
        self._bytes += len(frame)
        if self._bytes > self._limits.total_bytes:
            self._reason = "too large"
        elif len(self._frames) > self._limits.frames + _NO_PAYLOADS:
            self._reason = "too many frames"
        else:
            return
        self._frames = []
