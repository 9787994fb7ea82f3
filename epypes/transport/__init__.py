"""How messages leave and enter the process: publishers, subscribers, and the one I/O thread under them."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from epypes.optional import optional_import

if TYPE_CHECKING:
    from epypes.transport.address import check_bind, is_loopback, is_loopback_host
    from epypes.transport.mcap import RecordingInfo, recording_info
    from epypes.transport.publisher import Publisher, ZMQPublisher
    from epypes.transport.recording import Player, Recorder
    from epypes.transport.subscriber import Subscriber, ZMQSubscriber
    from epypes.transport.zeromq.curve import Keys, make_keys, read_keys

__all__ = [
    "Keys",
    "Player",
    "Publisher",
    "Recorder",
    "RecordingInfo",
    "Subscriber",
    "ZMQPublisher",
    "ZMQSubscriber",
    "check_bind",
    "is_loopback",
    "is_loopback_host",
    "make_keys",
    "read_keys",
    "recording_info",
]

_HOME = {
    "Keys": "zeromq.curve",
    "Player": "recording",
    "Publisher": "publisher",
    "Recorder": "recording",
    "RecordingInfo": "mcap",
    "Subscriber": "subscriber",
    "ZMQPublisher": "publisher",
    "ZMQSubscriber": "subscriber",
    "check_bind": "address",
    "is_loopback": "address",
    "is_loopback_host": "address",
    "make_keys": "zeromq.curve",
    "read_keys": "zeromq.curve",
    "recording_info": "mcap",
}


def __getattr__(name: str) -> Any:
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    with optional_import():
        found = getattr(importlib.import_module(f"epypes.transport.{_HOME[name]}"), name)
    # So that the next look-up does not come here.
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted(__all__)
