"""Raw connections that speak ZMTP byte by byte, as hostile peers do."""

from __future__ import annotations

import socket
import struct
from collections.abc import Iterator
from contextlib import contextmanager

MORE, LONG, COMMAND = 1, 2, 4
WAIT_S = 60.0


def frame(body: bytes, flags: int = 0) -> bytes:
    """Return a frame of ZMTP 3.0."""
    if len(body) < 256:
        return bytes([flags, len(body)]) + body
    return bytes([flags | LONG]) + struct.pack(">Q", len(body)) + body


def connection(address: str) -> socket.socket:
    """Return a TCP connection to the port of an address of ZeroMQ."""
    host, port = address.removeprefix("tcp://").split(":")
    return socket.create_connection((host, int(port)), WAIT_S)


@contextmanager
def connected(address: str, kind: bytes) -> Iterator[socket.socket]:
    """A connection of ZMTP 3.0 on which the handshake is done; kind is the type of socket that the peer claims to be."""
    ready = b"\x05READY\x0bSocket-Type" + struct.pack(">I", len(kind)) + kind
    with connection(address) as peer:
        peer.sendall(b"\xff" + bytes(8) + b"\x7f\x03\x00" + b"NULL".ljust(20, b"\0") + bytes(32))
        _receive(peer, 64)
        peer.sendall(frame(ready, COMMAND))
        _receive(peer, _receive(peer, 2)[1])
        yield peer


def _receive(peer: socket.socket, size: int) -> bytes:
    data = b""
    while len(data) < size:
        piece = peer.recv(size - len(data))
        assert piece, "the connection has ended"
        data += piece
    return data


def is_dropped(peer: socket.socket) -> bool:
    """Wait until the other side has ended a connection; raise TimeoutError if it does not."""
    try:
        while peer.recv(65_536):
            pass
    except ConnectionError:
        pass
    return True
