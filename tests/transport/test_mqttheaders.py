"""Are headers sent as MQTT 5 writes them, and read back as they were?"""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from paho.mqtt.packettypes import PacketTypes
from paho.mqtt.properties import Properties

from epypes.errors import MessageError
from epypes.transport.channels.mqtt.headers import ID, Packed, headers_of
from epypes.transport.channels.packing import SIZES


def read(packed):
    """Return what paho reads, as a message has it."""
    properties = Properties(PacketTypes.PUBLISH)
    properties.unpack(packed)
    return SimpleNamespace(properties=properties)


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"a": ""},
        {ID: "event 1", "reason": "öäü · 猫"},
        {SIZES: "1,2,3"},
        {ID: "with spaces in it", SIZES: "0,12"},
        {ID: "", SIZES: ""},
        {"long": "x" * 60_000, "longer": "y" * 65_535},
        {f"header {number}": str(number) for number in range(300)},
    ],
)
def test_headers_are_read_as_they_were_sent(headers):
    assert headers_of(read(Packed(headers).pack())) == headers


@pytest.mark.parametrize("count", [1, 2, 300])
def test_it_is_what_paho_writes(count):
    pairs = {f"header {number}": "x" * number for number in range(count)}
    theirs = Properties(PacketTypes.PUBLISH)
    theirs.UserProperty = list(pairs.items())
    assert Packed(pairs).pack() == theirs.pack()


def test_a_message_of_several_frames_with_an_id_has_one_property():
    message = read(Packed({ID: "event 1", SIZES: "1,2"}).pack())
    assert len(message.properties.UserProperty) == 1


def test_another_program_may_send_each_in_a_property_of_its_own():
    properties = Properties(PacketTypes.PUBLISH)
    properties.UserProperty = [(ID, "event 1"), (SIZES, "1,2")]
    assert headers_of(SimpleNamespace(properties=properties)) == {ID: "event 1", SIZES: "1,2"}
    assert headers_of(SimpleNamespace(properties=None)) == {}


@pytest.mark.parametrize("headers", [{"a": "\0"}, {"\0": "a"}, {"a": "x" * 65_536}, {"é" * 32_768: "a"}])
def test_what_can_not_be_sent_is_refused(headers):
    with pytest.raises(MessageError, match="can't be sent"):
        Packed(headers)
