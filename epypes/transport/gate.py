"""Who may connect to a socket that is bound with keys? Whose public key is on its list (ZAP, RFC 27)."""

from __future__ import annotations

import logging
import uuid
from collections import Counter
from collections.abc import Collection

import zmq
from zmq.utils import z85

log = logging.getLogger("epypes.transport")

_ADDRESS = "inproc://zeromq.zap.01"
_BATCH = 100
# Strangers that are counted by their key; a peer that makes keys must not fill the memory.
_MAX_STRANGERS = 1_024


class Gate:
    """The list of one socket, and the strangers that have tried, by public key."""

    def __init__(self, allowed: Collection[str], refused: Counter[str]) -> None:
        self.domain = uuid.uuid4().hex.encode()
        self._allowed, self._refused = frozenset(allowed), refused

    def admits(self, mechanism: bytes, credentials: list[bytes]) -> bool:
        """Return whether a peer may connect; count it if it may not."""
        key = "no key"
        if mechanism == b"CURVE" and len(credentials) == 1 and len(credentials[0]) == 32:
            key = z85.encode(credentials[0]).decode()
        if key in self._allowed:
            return True
        known = key in self._refused or len(self._refused) < _MAX_STRANGERS
        self._refused[key if known else "others"] += 1
        if self._refused[key] == 1:
            log.warning("refused a peer with the unknown key %s; to let it in, add it to allow=", key)
        return False


class Gatekeeper:
    """The ZAP handler of a context, on its I/O thread: ZeroMQ asks it about every peer of a guarded socket."""

    def __init__(self, context: zmq.Context[zmq.Socket[bytes]]) -> None:
        self.gates: dict[bytes, Gate] = {}
        self._socket: zmq.Socket[bytes] = context.socket(zmq.REP)
        self._socket.linger = 0
        self._socket.bind(_ADDRESS)
        self.descriptor = int(self._socket.get(zmq.FD))

    def close(self) -> None:
        """Close the socket; from then on ZeroMQ would let everybody in, so no guarded socket must be left."""
        self._socket.close()

    def read(self) -> bool:
        """Answer some questions; return whether there may be more."""
        for _ in range(_BATCH):
            if self._socket.closed:
                return False
            try:
                self._answer(self._socket.recv_multipart(zmq.DONTWAIT))
            except zmq.Again:
                return False
        return True

    def _answer(self, question: list[bytes]) -> None:
        version, request, domain, _, _, mechanism, *credentials = question
        gate = self.gates.get(domain)
        ok = gate is not None and gate.admits(mechanism, credentials)
        status = [b"200", b"OK"] if ok else [b"400", b"This key is not on the list"]
        self._socket.send_multipart([version, request, *status, b"", b""], zmq.DONTWAIT)
