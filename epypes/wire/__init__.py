"""Messages: the v1 envelope and its values, the messages published in 2019, samples in files.

Neither protobuf nor numpy is imported before it is needed.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from epypes.wire.decoder import EncodedEnvelope, decode
    from epypes.wire.encoder import encode, topic_frame
    from epypes.wire.envelope import Envelope, FailureRecord, failure_event, new_id
    from epypes.wire.limits import Limits
    from epypes.wire.protobuf import parsed, serialized
    from epypes.wire.published2019 import (
        Attribute,
        AttributeList,
        Event,
        Image,
        ImagePair,
        JustBytes,
        TimeStamp,
        TimeStampList,
        add_attribute,
        attributes,
    )
    from epypes.wire.samples import load_sample, save_sample

__all__ = [
    "Attribute",
    "AttributeList",
    "EncodedEnvelope",
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
    "new_id",
    "parsed",
    "save_sample",
    "serialized",
    "topic_frame",
]

_MODULES = {
    "decoder": ("EncodedEnvelope", "decode"),
    "encoder": ("encode", "topic_frame"),
    "envelope": ("Envelope", "FailureRecord", "failure_event", "new_id"),
    "limits": ("Limits",),
    "protobuf": ("parsed", "serialized"),
    "samples": ("load_sample", "save_sample"),
}
# published2019 has all other names.
_HOME = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    found = getattr(importlib.import_module(f"epypes.wire.{_HOME.get(name, 'published2019')}"), name)
    # The next look-up finds it without this function.
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted(__all__)
