"""What DDS carries: the types of messages, EPypes' own and those of ROS 2, and their bytes.

cyclonedds makes a list of numbers of ``sequence<octet>`` (1 MB: 37 ms to write, 7 ms to read). So `_sample_type`
overrides the public methods by which it asks a sample for its bytes. rosbags reads them, and makes those of ROS 2.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from itertools import chain
from typing import TYPE_CHECKING, Any, Final, Self

from cyclonedds.idl import IdlStruct, make_idl_struct
from cyclonedds.idl.types import byte, float64, int32, int64, sequence, uint32
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_idl, get_typestore

from epypes.transport.address import Address
from epypes.transport.channel import ChannelOptions, Frames
from epypes.transport.peers.ros import RosCodec
from epypes.wire.ros import dds_name, typestore

if TYPE_CHECKING:
    from rosbags.typesys.store import Typestore

# As in proto/epypes/v1/message.idl.
MESSAGE_IDL: Final = """
module epypes { module v1 {
  struct Header { string name; string value; };
  struct Frame { sequence<octet> data; };
  struct Message { string id; sequence<Header, 1024> headers; sequence<Frame, 1026> frames; };
}; };
"""
_MESSAGE: Final = "epypes/v1/Message"
# What CDR begins with.
_LITTLE_ENDIAN: Final = b"\0\1\0\0"

# The types of cyclonedds, by those of rosbags.
_BASES: Final[Mapping[str, Any]] = {
    "bool": bool,
    "byte": byte,
    "float64": float64,
    "int32": int32,
    "int64": int64,
    "string": str,
    # As ROS 2 maps it to IDL: octet.
    "uint8": byte,
    "uint32": uint32,
}


def _fields(store: Typestore, name: str) -> dict[str, Any]:
    """Return the fields of a type of rosbags, as cyclonedds has them."""

    def of(described: Any) -> Any:
        kind, content = described
        if kind is Nodetype.BASE:
            return _BASES[content[0]]
        if kind is Nodetype.NAME:
            name = content.rpartition("/")[2]
            return make_idl_struct(name, dds_name(content), _fields(store, content), dataclassify=False)
        element, most = of(content[0]), content[1]
        return sequence[element, most] if most else sequence[element]

    return {field: of(described) for field, described in store.fielddefs[name][1]}


def _sample_type(store: Typestore, name: str) -> type[IdlStruct]:
    """Return the class of a topic's samples: described as a type of rosbags, and made of bytes."""

    class Sample(IdlStruct, typename=dds_name(name)):  # type: ignore[misc, call-arg]
        __annotations__ = _fields(store, name)

        def __init__(self, cdr: bytes | memoryview) -> None:
            self.cdr = cdr

        def serialize(self, *arguments: object, **keywords: object) -> bytes:
            # Cyclone wants its length aligned, which that of rosbags is not.
            missing = -len(self.cdr) % 4
            return b"".join((self.cdr, bytes(missing))) if missing else bytes(self.cdr)

        @classmethod
        def deserialize(cls, data: bytes, *arguments: object, **keywords: object) -> Self:
            return cls(data)

        deserialize_key = deserialize

    return Sample


class MessageCodec:
    """Packs and unpacks EPypes' own messages."""

    def __init__(self) -> None:
        self._store = get_typestore(Stores.EMPTY)
        self._store.register(get_types_from_idl(MESSAGE_IDL))
        self.sample_type: Any = _sample_type(self._store, _MESSAGE)

    def pack(self, frames: Frames, id: str, headers: Mapping[str, str]) -> bytes:  # noqa: A002
        """Return the bytes of a sample, of aligned length, with one copy of the frames."""
        parts: list[bytes | memoryview] = [_LITTLE_ENDIAN]
        size = 0

        def add(count: int, content: bytes | memoryview = b"", end: bytes = b"") -> None:
            nonlocal size
            padding = bytes(-size % 4)
            parts.extend((padding, count.to_bytes(4, "little"), content, end))
            size += len(padding) + 4 + len(content) + len(end)

        def add_text(text: str) -> None:
            content = text.encode()
            add(len(content) + 1, content, b"\0")

        add_text(id)
        add(len(headers))
        for text in chain.from_iterable(headers.items()):
            add_text(text)
        add(len(frames))
        for frame in frames:
            add(len(frame), frame)
        return b"".join((*parts, bytes(-size % 4)))

    def unpack(self, cdr: bytes) -> tuple[Frames, str, Mapping[str, str]]:
        """Return the frames, which share the memory of a sample's bytes, its id and its headers."""
        message: Any = self._store.deserialize_cdr(cdr, _MESSAGE)
        frames = [each.data.data.cast("B") for each in message.frames]
        return frames, message.id, {each.name: each.value for each in message.headers}


_message_codec = cache(MessageCodec)


@cache
def _ros_sample_type(name: str) -> Any:
    return _sample_type(typestore(), name)


def codec_of(address: Address, options: ChannelOptions) -> tuple[MessageCodec | RosCodec, Any]:
    """Return what packs and unpacks the messages of an address, and the class of its topic's samples.

    Raises
    ------
    AddressError
        It names a type that EPypes does not have.
    """
    if "type" in address.options:
        codec = RosCodec(address, options)
        return codec, _ros_sample_type(codec.type.name)
    return (own := _message_codec()), own.sample_type
