"""The frames of an Envelope as a message of ROS 2 and back, for an address with ``type=`` and ``token=``."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping

from epypes.errors import AddressError, MessageError
from epypes.transport.address import Address
from epypes.transport.channel import NO_HEADERS, ChannelOptions, Frames
from epypes.wire import Limits, decode, encode
from epypes.wire.ros import RosType, ros_type


def ros_type_of(address: Address) -> RosType:
    """Return the type of ROS 2 that an address names; AddressError if EPypes has no such type."""
    try:
        return ros_type(address.options["type"])
    except ValueError as error:
        raise AddressError(str(address), f"{address}: {error}") from error


class RosCodec:
    """Packs and unpacks the messages of one topic, which carry neither id nor headers.

    Parameters
    ----------
    address
        Its option ``type`` names the type, ``token`` the part of the Envelope.
    options
        Of the channel.

    Attributes
    ----------
    type
        A `epypes.wire.ros.RosType`.

    Raises
    ------
    AddressError
        EPypes has no such type.
    """

    def __init__(self, address: Address, options: ChannelOptions) -> None:
        self.type = ros_type_of(address)
        self._token = address.options.get("token", "")
        self._limits = dataclasses.replace(Limits(), total_bytes=options.max_message_bytes)

    def pack(self, frames: Frames, id: str, headers: Mapping[str, str]) -> memoryview:  # noqa: A002
        """Return the CDR of the one value of an Envelope that becomes the message.

        Raises
        ------
        MessageError
            It is no Envelope, or has no such value.
        """
        if len(frames) == 1:
            raise MessageError("no envelope", f"An Envelope can be sent as {self.type.name}, a single frame can't.")
        return self.type.from_envelope(decode(frames, self._limits), self._token, self._limits)

    def unpack(self, cdr: bytes | memoryview) -> tuple[Frames, str, Mapping[str, str]]:
        """Return the frames of the Envelope of a message, a new id, and no headers.

        Raises
        ------
        MessageError
            The bytes are no such message.
        """
        envelope = self.type.to_envelope(cdr, self._token, self._limits)
        return encode(envelope, limits=self._limits), envelope.id, NO_HEADERS
