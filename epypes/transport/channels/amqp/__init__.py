"""How does RabbitMQ carry messages? By pika, over one connection that whoever waits for something works on."""

from __future__ import annotations

from epypes.transport.channels.amqp.channel import open_channel

__all__ = ["open_channel"]
