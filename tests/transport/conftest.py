"""Raw sockets, and senders and receivers of channels."""

from __future__ import annotations

from uuid import uuid4

import pytest
import zmq

from tests.transport.peers import WAIT_S

# Programs of another environment.
collect_ignore = ["ros_peer"]


@pytest.fixture
def opened():
    """Open senders and receivers, and close them."""
    made = []

    def make(kind, address, **options):
        made.append(kind(address, **options))
        return made[-1]

    yield make
    for one in made:
        one.channel.close(0.0)


@pytest.fixture
def name():
    return f"test-{uuid4().hex[:12]}"


@pytest.fixture
def peer():
    """Makes raw sockets, as a peer without EPypes has them."""
    context = zmq.Context()
    # Otherwise the garbage collector waits for ever for what was not sent when a test fails.
    context.linger = 0
    made = []

    def make(kind: int, **options: int) -> zmq.Socket:
        socket = context.socket(kind)
        socket.rcvtimeo = int(WAIT_S * 1000)
        for name, value in options.items():
            setattr(socket, name, value)
        made.append(socket)
        return socket

    yield make
    for socket in made:
        socket.close(linger=0)
    context.term()
