"""Messages between the replicas of a bundle: JSON objects, validated by pydantic when they are received.

A peer on the broker can publish anything on the broadcast address: what is no message of this version raises
MessageError, and text that a terminal will show has no control characters.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any, Final, Literal

from pydantic import AfterValidator, Field, StringConstraints, TypeAdapter, ValidationError

from epypes.errors import MessageError

_MAX_BYTES: Final = 1024**2
# The largest number of a message: JSON readers of other languages hold it exactly.
MAX_INTEGER: Final = 2**53


def _printable(text: str) -> str:
    # `epypes status` prints it: a terminal obeys control characters, and can't show half of a surrogate pair.
    return "".join(character if character.isprintable() else " " for character in text)


_Text = Annotated[str, StringConstraints(max_length=2_000), AfterValidator(_printable)]
_Count = Annotated[int, Field(ge=0, le=MAX_INTEGER)]
_MANY: Final = Field(max_length=1_000)
# Revision and author of hyperparameters.
Version = tuple[int, str]


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """A replica is alive: what it publishes of itself every second.

    Attributes
    ----------
    id
        Unique to one start of one replica.
    replica, host, pid
        Its name, machine and front process.
    name, digest
        Of the bundle that it serves.
    revision, author
        Version of the hyperparameters that it computes with: their revision, and the id of the replica that set them.
    state, reason
        As of the service.
    counts
        Of its events.
    http
        Address of its HTTP control; empty without.
    trouble
        Why it does not compute with the newest parameters; empty if it does.
    """

    id: _Text
    replica: _Text = ""
    host: _Text = ""
    pid: _Count = 0
    name: _Text = ""
    digest: _Text = ""
    revision: _Count = 0
    author: _Text = ""
    state: _Text = ""
    reason: _Text = ""
    counts: Annotated[Mapping[_Text, _Count], _MANY] = field(default_factory=dict)
    http: _Text = ""
    trouble: _Text = ""
    kind: Literal["heartbeat"] = "heartbeat"

    @property
    def version(self) -> Version:
        """Of the hyperparameters that it computes with."""
        return self.revision, self.author


@dataclass(frozen=True, slots=True)
class Goodbye:
    """A replica stops in order."""

    id: _Text
    kind: Literal["goodbye"] = "goodbye"


@dataclass(frozen=True, slots=True)
class ParameterSet:
    """All hyperparameters of a bundle, as one replica has set them. The higher `version` wins.

    Attributes
    ----------
    digest
        Of the bundle.
    revision
        From 1.
    author
        Id of the replica.
    values
        By token, as in pipeline.toml.
    """

    digest: _Text
    revision: _Count
    author: _Text
    values: Annotated[Mapping[str, Mapping[str, Any]], _MANY]
    kind: Literal["parameters"] = "parameters"

    @property
    def version(self) -> Version:
        """Two are never equal, so that all replicas settle on the same set."""
        return self.revision, self.author


@dataclass(frozen=True, slots=True)
class ParameterQuery:
    """A replica asks another one for the newest `ParameterSet` of a bundle.

    Attributes
    ----------
    id
        Of the replica that is asked.
    digest
        Of the bundle.
    """

    id: _Text
    digest: _Text
    kind: Literal["query"] = "query"


ReplicaMessage = Heartbeat | Goodbye | ParameterSet | ParameterQuery


@dataclass(frozen=True, slots=True)
class _Versioned:
    message: Annotated[ReplicaMessage, Field(discriminator="kind")]
    version: Literal[3]


_DOCUMENT: Final = TypeAdapter(_Versioned)


def encode_message(message: ReplicaMessage) -> bytes:
    """Return a message as it is published; raise MessageError if its readers would refuse it as too large."""
    data = json.dumps(asdict(_Versioned(message, 3)), separators=(",", ":")).encode()
    _check_size(data)
    return data


def decode_message(data: bytes | memoryview) -> ReplicaMessage:
    """Return a message that was received.

    Raises
    ------
    MessageError
        The bytes are no message of this version, or a field has another type or exceeds its limit.
    """
    _check_size(data)
    try:
        return _DOCUMENT.validate_json(bytes(data), strict=True).message
    except ValidationError as error:
        text = f"This is no message between replicas of this version: {error!r:.200}."
        raise MessageError("bad replica message", text) from error


def _check_size(data: bytes | memoryview) -> None:
    if len(data) > _MAX_BYTES:
        raise MessageError("too large", f"A message of {len(data):,} bytes; between replicas {_MAX_BYTES:,} is most.")
