"""Messages between the replicas of a bundle: JSON objects, checked field by field when they are received.

A peer on the broker can publish anything on the broadcast address: what is no message of this version raises
MessageError, and text that a terminal will show has no control characters.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from typing import Any, Final

from epypes.errors import MessageError

VERSION: Final = 2
# Ids in one message; more are sent in the next one. With the longest ids it is still below the limit of bytes.
MAX_IDS: Final = 250
# Longer ids are not sent: the broker's own redelivery count covers them.
MAX_ID_CHARACTERS: Final = 256
_MAX_BYTES: Final = 1024**2
_MAX_CHARACTERS: Final = 2_000
_MAX_ITEMS: Final = 1_000
# The largest number of a message: JSON readers of other languages hold it exactly.
MAX_INTEGER: Final = 2**53

# Revision and author of hyperparameters.
Version = tuple[int, str]


@dataclass(frozen=True, slots=True)
class Member:
    """What a replica publishes of itself with each heartbeat.

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

    id: str
    replica: str = ""
    host: str = ""
    pid: int = 0
    name: str = ""
    digest: str = ""
    revision: int = 0
    author: str = ""
    state: str = ""
    reason: str = ""
    counts: Mapping[str, int] = field(default_factory=dict)
    http: str = ""
    trouble: str = ""

    @property
    def version(self) -> Version:
        """Of the hyperparameters that it computes with."""
        return self.revision, self.author


@dataclass(frozen=True, slots=True)
class Heartbeat:
    """A replica is alive.

    Attributes
    ----------
    is_joining
        Whether it does not know yet which parameters the others compute with.
    lost
        Members that it has missed lately, and how many milliseconds ago it heard each: newcomers can't know them.
    """

    member: Member
    is_joining: bool = False
    lost: Sequence[tuple[Member, int]] = ()


@dataclass(frozen=True, slots=True)
class Goodbye:
    """A replica stops in order."""

    id: str


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

    digest: str
    revision: int
    author: str
    values: Mapping[str, Mapping[str, Any]]

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

    id: str
    digest: str


@dataclass(frozen=True, slots=True)
class Answered:
    """A replica has answered events; one that is delivered again is a duplicate."""

    id: str
    events: Sequence[str]


ReplicaMessage = Heartbeat | Goodbye | ParameterSet | ParameterQuery | Answered
_KINDS: Final[Mapping[str, type[ReplicaMessage]]] = {
    "heartbeat": Heartbeat,
    "goodbye": Goodbye,
    "parameters": ParameterSet,
    "query": ParameterQuery,
    "answered": Answered,
}
_NAMES: Final = {message_type: name for name, message_type in _KINDS.items()}


def encode_message(message: ReplicaMessage) -> bytes:
    """Return a message as it is published."""
    document = {"v": VERSION, "kind": _NAMES[type(message)], **asdict(message)}
    return json.dumps(document, separators=(",", ":")).encode()


def decode_message(data: bytes | memoryview) -> ReplicaMessage:
    """Return a message that was received.

    Raises
    ------
    MessageError
        The bytes are no message of this version, or a field has another type or exceeds its limit.
    """
    if len(data) > _MAX_BYTES:
        raise MessageError("too large", f"A message of {len(data):,} bytes; between replicas {_MAX_BYTES:,} is most.")
    try:
        document = json.loads(bytes(data), parse_constant=_refuse_constant)
        if document["v"] != VERSION:
            raise ValueError(f"version {document['v']!r:.20}")
        return _READERS[document["kind"]](document)
    except (ValueError, TypeError, LookupError, RecursionError) as error:
        text = f"This is no message between replicas (version {VERSION}): {error!r:.200}."
        raise MessageError("bad replica message", text) from error


def _refuse_constant(name: str) -> None:
    raise ValueError(f"JSON has no {name}")


def _read_member(document: Any) -> Member:
    readers: dict[str, Callable[[Any], Any]] = {"int": _integer, "str": _text, "Mapping[str, int]": _counts}
    return Member(**{each.name: readers[str(each.type)](document[each.name]) for each in fields(Member)})


def _read_heartbeat(document: Any) -> Heartbeat:
    lost = [(_read_member(member), _integer(silent_ms)) for member, silent_ms in _items(document["lost"])]
    return Heartbeat(_read_member(document["member"]), document["is_joining"] is True, lost)


def _read_parameters(document: Any) -> ParameterSet:
    values = _items(document["values"], dict)
    if not all(isinstance(value, dict) for value in values.values()):
        raise TypeError("values")
    return ParameterSet(_text(document["digest"]), _integer(document["revision"]), _text(document["author"]), values)


_READERS: Final[Mapping[str, Callable[[Any], ReplicaMessage]]] = {
    "heartbeat": _read_heartbeat,
    "goodbye": lambda document: Goodbye(_text(document["id"])),
    "parameters": _read_parameters,
    "query": lambda document: ParameterQuery(_text(document["id"]), _text(document["digest"])),
    "answered": lambda document: Answered(_text(document["id"]), [*map(_short, _items(document["events"]))]),
}


def _items(value: Any, kind: type[list[Any] | dict[str, Any]] = list) -> Any:
    if type(value) is not kind or len(value) > _MAX_ITEMS:
        raise TypeError(f"{value!r:.40} is no {kind.__name__} of at most {_MAX_ITEMS} items")
    return value


def _integer(value: Any) -> int:
    if type(value) is not int or not 0 <= value <= MAX_INTEGER:
        raise TypeError(f"{value!r:.40} is no count")
    return int(value)


def _short(value: Any) -> str:
    if type(value) is not str or len(value) > _MAX_CHARACTERS:
        raise TypeError(f"{value!r:.40} is no short text")
    return str(value)


def _text(value: Any) -> str:
    # `epypes status` prints it: a terminal obeys control characters, and can't show half of a surrogate pair.
    return "".join(character if character.isprintable() else " " for character in _short(value))


def _counts(value: Any) -> dict[str, int]:
    return {_text(name): _integer(count) for name, count in _items(value, dict).items()}
