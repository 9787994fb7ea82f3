"""What is a v1 message? An Envelope: named values, and where they come from."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from epypes.wire.ids import new_id


@dataclass(frozen=True, slots=True)
class FailureRecord:
    """What is sent of a failure.

    Attributes
    ----------
    function
        The function that failed.
    tokens
        Its input tokens.
    exception
        Name of the exception's type.
    message
        Its text.
    input_id
        Id of the envelope that was worked on.
    attempt
        From 1; 0 is "not counted".
    """

    function: str
    tokens: tuple[str, ...] = ()
    exception: str = ""
    message: str = ""
    input_id: str = ""
    attempt: int = 0


_NOTHING: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class Envelope:
    """A v1 message: named values, and where they come from. Its mappings are read-only.

    Attributes
    ----------
    type
        What kind of event it is, as the user names them.
    parts
        The values by name: None, bool, int, float, str, bytes, list, tuple, dict, numpy array or numpy scalar.
    id
        Unique; a new one unless given.
    source
        Who sent it.
    epoch, sequence
        Start of the publisher (Unix time, ns) and a count that rises by 1 from 1: so that loss becomes visible.
        The publisher stamps them.
    acquired_ns, published_ns
        Unix time in nanoseconds; 0 is "not known".
    correlation_id
        Id of the envelope that this one answers.
    revision
        Revision of the hyperparameters that the values were computed with.
    bundle_digest
        Digest of the bundle that computed them.
    attributes
        Small values by name, as those of parts.
    timings
        Durations by function name, in nanoseconds.
    failure
        None, or what failed.
    rgb
        Names of the parts whose images have three or four channels in RGB order; those of all others are BGR.
    """

    type: str
    parts: Mapping[str, Any] = field(default_factory=dict)
    id: str = field(default_factory=new_id)
    source: str = ""
    epoch: int = 0
    sequence: int = 0
    acquired_ns: int = 0
    published_ns: int = 0
    correlation_id: str = ""
    revision: int = 0
    bundle_digest: str = ""
    attributes: Mapping[str, Any] = field(default_factory=dict)
    timings: Mapping[str, int] = field(default_factory=dict)
    failure: FailureRecord | None = None
    rgb: Collection[str] = frozenset()

    def __post_init__(self) -> None:
        put = object.__setattr__
        put(self, "parts", MappingProxyType(dict(self.parts)))
        put(self, "attributes", MappingProxyType(dict(self.attributes)) if self.attributes else _NOTHING)
        put(self, "timings", MappingProxyType(dict(self.timings)) if self.timings else _NOTHING)
        put(self, "rgb", frozenset((self.rgb,) if isinstance(self.rgb, str) else self.rgb))

    def __repr__(self) -> str:
        number = f" #{self.sequence}" if self.sequence else ""
        names = ", ".join(map(str, self.parts)) or "no parts"
        text = f"<Envelope {str(self.type)[:20]!r}{number}: {names}"
        return f"{text[:95]}...>" if len(text) > 97 else f"{text}>"
