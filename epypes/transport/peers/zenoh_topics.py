"""What is sent and received on a key of Zenoh: EPypes' messages, or those of ROS 2 as rmw_zenoh_cpp has them.

The frames of a message are joined to one payload, and its id, headers and the sizes of its frames go into the
attachment, as a map from text to text in Zenoh's own serialization. A payload without that is one frame.

With ``type=`` the key is the name of a topic of ROS 2, and keys, attachments and tokens are those of rmw_zenoh_cpp
(Humble, Kilted, Rolling; Jazzy from 0.2.4 on): docs/design.md, attachment_helpers.cpp and liveliness_utils.cpp of
ros2/rmw_zenoh. A reader takes any hash of the type, since Humble has none.
"""

from __future__ import annotations

import contextlib
import itertools
import re
import time
import uuid
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Final

import zenoh
from zenoh import ext

from epypes.errors import AddressError
from epypes.transport.address import Address
from epypes.transport.brokers.message import IncomingMessage, pack, unpack
from epypes.transport.channel import ChannelOptions, Frames
from epypes.transport.peers.ros import RosCodec

_ID: Final = "epypes-id"
# Reliable, volatile, keep last 10, no deadline: what differs of it from rmw_zenoh_cpp's default.
_ROS_QOS: Final = "::,10:,:,:,,"


class ZenohTopic:
    """What is sent and received on a key, as EPypes does it.

    Attributes
    ----------
    key
        What is sent to.
    keys, tokens
        What is received from, and the tokens of its publishers.
    answers
        Whether publishers answer queries of their tokens.
    """

    answers = True

    def __init__(self, address: Address) -> None:
        self.key = self.keys = _checked_key(address, address.name)
        self.tokens = f"@epypes/*/{self.key}"

    def publisher_tokens(self, session: Any) -> list[str]:
        """Return the tokens of a publisher."""
        return [f"@epypes/{uuid.uuid4().hex}/{self.key}"]

    def subscriber_tokens(self, session: Any) -> list[str]:
        """Return the tokens of a subscriber."""
        return []

    def pack(self, frames: Frames, id: str, headers: Mapping[str, str]) -> tuple[bytes, Any]:  # noqa: A002
        """Return the payload and the attachment of a message, or raise MessageError."""
        body, texts = pack(frames, id, headers)
        if id:
            texts[_ID] = id
        return body, ext.z_serialize(texts) if texts else None

    def unpack(self, payload: bytes, attachment: Any) -> tuple[Frames, str, Mapping[str, str]]:
        """Return the frames, the id and the headers of a message, or raise MessageError."""
        texts: dict[str, str] = {}
        if attachment is not None:
            # Another program may attach what it likes.
            with contextlib.suppress(ext.ZDeserializeError, ValueError):
                texts = ext.z_deserialize(dict[str, str], attachment)
        known_as = texts.pop(_ID, "")
        frames, others = unpack(IncomingMessage(payload, known_as, texts))
        return frames, known_as, others


class _RosTopic(ZenohTopic):
    """What is sent and received on a topic of ROS 2, as rmw_zenoh_cpp does it."""

    answers = False

    def __init__(self, address: Address, options: ChannelOptions) -> None:
        self._codec, self._domain = RosCodec(address, options), address.options.get("domain", "0")
        name = address.name.strip("/")
        if not re.fullmatch(r"[\w/]+", name, re.ASCII):
            raise AddressError(str(address), f"{name!r} is no name of a ROS 2 topic, in {address}. Write camera/image.")
        if name.startswith("rt/"):
            text = f"{address}: in Zenoh, a topic of ROS 2 has no rt/ before its name"
            raise AddressError(str(address), f"{text}: write {replace(address, name=name.removeprefix('rt/'))}")
        kind = self._codec.type
        self.key = _checked_key(address, f"{self._domain}/{name}/{kind.dds_name}/{kind.rihs01}")
        self.keys = f"{self._domain}/{name}/{kind.dds_name}/*"
        self._about = f"%{name.replace('/', '%')}/{kind.dds_name}"
        self.tokens = f"@ros2_lv/{self._domain}/*/*/*/MP/*/*/*/{self._about}/*/*"
        # Of an entity, in each message; any that no other one has.
        self._gid, self._numbers = uuid.uuid4().bytes, itertools.count(1)

    def publisher_tokens(self, session: Any) -> list[str]:
        """Return the tokens of a node and of its publisher."""
        return self._entity_tokens(session, "MP")

    def subscriber_tokens(self, session: Any) -> list[str]:
        """Return the tokens of a node and of its subscription."""
        return self._entity_tokens(session, "MS")

    def _entity_tokens(self, session: Any, entity: str) -> list[str]:
        before, node = f"@ros2_lv/{self._domain}/{session.zid()}/0", "%/%/epypes"
        about = f"{self._about}/{self._codec.type.rihs01}/{_ROS_QOS}"
        return [f"{before}/0/NN/{node}", f"{before}/1/{entity}/{node}/{about}"]

    def pack(self, frames: Frames, id: str, headers: Mapping[str, str]) -> tuple[bytes, Any]:  # noqa: A002
        """Return the CDR of the message, and its number, its time and the sender as attachment."""
        cdr = bytes(self._codec.pack(frames, id, headers))
        return cdr, ext.z_serialize((ext.Int64(next(self._numbers)), ext.Int64(time.time_ns()), self._gid))

    def unpack(self, payload: bytes, attachment: Any) -> tuple[Frames, str, Mapping[str, str]]:
        """Return the frames of the Envelope of a message."""
        return self._codec.unpack(payload)


def topic_of(address: Address, options: ChannelOptions) -> ZenohTopic:
    """Return the topic of an address.

    Raises
    ------
    AddressError
        It has a key, or a type of ROS 2, that there can't be.
    """
    return _RosTopic(address, options) if "type" in address.options else ZenohTopic(address)


def _checked_key(address: Address, key: str) -> str:
    try:
        return str(zenoh.KeyExpr(key))
    except zenoh.ZError as error:
        text = f"{key!r} can't be a key of Zenoh: write words between slashes, as line/camera. {why(error)}."
        raise AddressError(str(address), text) from error


def why(error: zenoh.ZError) -> str:
    """Return the text of an error without the places in Zenoh's source that it names."""
    return re.sub(r" at /\S+?:\d+\.?", "", str(error)).rstrip("! .")
