"""How do frames come to whoever carries them, and back? One seam for ZeroMQ, RabbitMQ, NATS JetStream and MQTT 5."""

from __future__ import annotations

from epypes.transport.channels.place import Place, place_of
from epypes.transport.channels.seam import Channel, Kind, Received, extra_of, is_brokered, open_channel

__all__ = ["Channel", "Kind", "Place", "Received", "extra_of", "is_brokered", "open_channel", "place_of"]
