"""What did the published system of 2019 send? These protobuf message classes.

Their field numbers are the published ones, so that a peer built on the published library can be talked to.
The classes are made when they are first asked for; ``messages2019.pyi`` tells type checkers their fields.
"""

from __future__ import annotations

from typing import Any

from epypes.wire.schema import message_class

NAMES = (
    "Attribute",
    "AttributeList",
    "Event",
    "Image",
    "ImagePair",
    "JustBytes",
    "TimeStamp",
    "TimeStampList",
)


def __getattr__(name: str) -> Any:
    if name not in NAMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return message_class(name)


def __dir__() -> list[str]:
    return sorted(NAMES)
