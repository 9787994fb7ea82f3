"""How does NATS JetStream carry messages? By nats-py, whose event loop is driven by whoever waits."""

from __future__ import annotations

from epypes.transport.channels.jetstream.channel import open_channel

__all__ = ["open_channel"]
