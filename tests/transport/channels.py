"""Senders and receivers of channels, as tests use them."""

from __future__ import annotations

import queue

from epypes.transport.address import open_channel
from epypes.transport.channel import ChannelOptions
from epypes.transport.peers.channel import PeerChannel

# The middleware without a broker that the tests of channels run on.
PEERS = ("dds", "zenoh")
WAIT_S = 60.0
ABSENT_S = 0.3


class Sender:
    """A channel that sends, and waits for each confirmation."""

    def __init__(self, address, **options):
        self.channel = open_channel(address, ChannelOptions(**{"timeout_s": WAIT_S, **options}))
        self.channel.open(None)

    def send(self, *frames, timeout_s=WAIT_S, **more):
        """Send a message; return when it is confirmed, or raise the error that it was refused with."""
        outcomes = queue.SimpleQueue()
        self.channel.send(frames, confirmed=outcomes.put, **more)
        error = outcomes.get(timeout=timeout_s)
        if error is not None:
            raise error


class Receiver:
    """A channel that receives into a queue."""

    def __init__(self, address, **options):
        self.arrived = queue.SimpleQueue()
        self.channel = open_channel(address, ChannelOptions(**{"timeout_s": WAIT_S, **options}))
        self.channel.open(self.arrived.put)

    def next(self, timeout_s=WAIT_S):
        """Return the next delivery."""
        return self.arrived.get(timeout=timeout_s)

    def take(self, count):
        """Return so many deliveries."""
        return [self.next() for _ in range(count)]

    def is_quiet(self, timeout_s=ABSENT_S):
        """Return whether nothing comes for a moment."""
        try:
            self.arrived.get(timeout=timeout_s)
        except queue.Empty:
            return True
        return False


def body(delivery):
    """Return the frames of a delivery as one text of bytes."""
    return b"|".join(bytes(frame) for frame in delivery.frames)


class OfPeers:
    """The addresses of a middleware without a broker, with the same method as the servers."""

    def __init__(self, name):
        self.name = name

    def address(self, name, **options):
        """Return an address; what concerns brokers is left out."""
        return f"{'dds://7' if self.name == 'dds' else 'zenoh://127.0.0.1'}/{name}"


def join(sender, *receivers):
    """Wait until what is sent arrives, where there is no broker that keeps it."""
    for receiver in receivers:
        if isinstance(receiver.channel, PeerChannel):
            assert receiver.channel.publishers.wait(WAIT_S)
            assert sender.channel.subscriptions.wait(WAIT_S)
