"""How does an MQTT 5 broker carry messages? By paho-mqtt, one connection to send and one to receive."""

from __future__ import annotations

from epypes.transport.channels.mqtt.channel import open_channel

__all__ = ["open_channel"]
