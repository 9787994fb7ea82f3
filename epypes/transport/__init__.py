"""How messages leave and enter the process: publishers, subscribers, and the one I/O thread under them."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from epypes.optional import optional_import

if TYPE_CHECKING:
    from epypes.transport.addresses import check_bind, is_loopback, is_loopback_host
    from epypes.transport.keys import Keys, make_keys, read_keys
    from epypes.transport.mcap import RecordingInfo, recording_info
    from epypes.transport.playing import Player
    from epypes.transport.publisher import ZMQPublisher
    from epypes.transport.receiving import Subscriber
    from epypes.transport.recording import Recorder
    from epypes.transport.sending import Publisher
    from epypes.transport.subscriber import ZMQSubscriber

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
    "Keys": "keys",
    "Player": "playing",
    "Publisher": "sending",
    "Recorder": "recording",
    "RecordingInfo": "mcap",
    "Subscriber": "receiving",
    "ZMQPublisher": "publisher",
    "ZMQSubscriber": "subscriber",
    "check_bind": "addresses",
    "is_loopback": "addresses",
    "is_loopback_host": "addresses",
    "make_keys": "keys",
    "read_keys": "keys",
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
