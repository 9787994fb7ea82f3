"""How a value travels: the v1 envelope, the codecs, the messages of 2019, samples in files.

Neither protobuf nor numpy is imported before it is needed.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from epypes.optional import optional_import

if TYPE_CHECKING:
    from epypes.wire.attribute_list import add_attribute, attributes
    from epypes.wire.complete import parsed, serialized
    from epypes.wire.envelope import Envelope, FailureRecord
    from epypes.wire.failures import failure_event
    from epypes.wire.limits import Limits
    from epypes.wire.messages2019 import (
        Attribute,
        AttributeList,
        Event,
        Image,
        ImagePair,
        JustBytes,
        TimeStamp,
        TimeStampList,
    )
    from epypes.wire.multipart import decode, encode, topic_frame
    from epypes.wire.samples import load_sample, save_sample

__all__ = [
    "Attribute",
    "AttributeList",
    "Envelope",
    "Event",
    "FailureRecord",
    "Image",
    "ImagePair",
    "JustBytes",
    "Limits",
    "TimeStamp",
    "TimeStampList",
    "add_attribute",
    "attributes",
    "decode",
    "encode",
    "failure_event",
    "load_sample",
    "parsed",
    "save_sample",
    "serialized",
    "topic_frame",
]

_HOME = {
    "Envelope": "envelope",
    "FailureRecord": "envelope",
    "Limits": "limits",
    "add_attribute": "attribute_list",
    "attributes": "attribute_list",
    "decode": "multipart",
    "encode": "multipart",
    "failure_event": "failures",
    "load_sample": "samples",
    "parsed": "complete",
    "save_sample": "samples",
    "serialized": "complete",
    "topic_frame": "multipart",
}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    with optional_import():
        found = getattr(importlib.import_module(f"epypes.wire.{_HOME.get(name, 'messages2019')}"), name)
    # So that the next look-up does not come here.
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted(__all__)
