"""Can a peer built on the published library be talked to?"""

from __future__ import annotations

import struct
import subprocess
import sys

import pytest

from epypes.errors import MessageError
from epypes.wire import (
    AttributeList,
    Event,
    Image,
    ImagePair,
    JustBytes,
    TimeStamp,
    TimeStampList,
    add_attribute,
    attributes,
    serialized,
)
from epypes.wire.compile import PROTO_FILES, SCHEMA_PATH, compiled


def field(number: int, content: bytes | float) -> bytes:
    """One field on the wire, made by hand: bytes, varint or double."""
    if isinstance(content, float):
        return bytes([number << 3 | 1]) + struct.pack("<d", content)
    if isinstance(content, int):
        assert 0 <= content < 128
        return bytes([number << 3, content])
    assert len(content) < 128
    return bytes([number << 3 | 2, len(content)]) + content


TEXT_ATTRIBUTE = field(1, 1) + field(2, b"name") + field(3, b"left")
DOUBLE_ATTRIBUTE = field(1, 2) + field(2, b"time") + field(4, 0.25)
INT_ATTRIBUTE = field(1, 3) + field(2, b"count") + field(5, 7)
ATTRIBUTES = field(1, TEXT_ATTRIBUTE) + field(1, DOUBLE_ATTRIBUTE) + field(1, INT_ATTRIBUTE)
WANTED = {"name": "left", "time": 0.25, "count": 7}


def test_an_attribute_list_has_the_published_field_numbers():
    message = AttributeList()
    for key, value in WANTED.items():
        add_attribute(message, key, value)
    assert message.SerializeToString() == ATTRIBUTES
    assert attributes(AttributeList.FromString(ATTRIBUTES)) == WANTED


@pytest.mark.parametrize(
    ("message_class", "data", "fields"),
    [
        (Event, field(1, b"request") + field(2, b"7"), {"type": "request", "id": "7"}),
        (JustBytes, field(1, b"\0\1") + field(2, b"7"), {"contents": b"\0\1", "id": "7"}),
        (
            Image,
            field(1, b"\xff\xd8") + field(2, b"7") + field(3, b"jpg"),
            {"bytes": b"\xff\xd8", "id": "7", "format": "jpg"},
        ),
        (TimeStamp, field(1, b"start") + field(2, 1.5), {"description": "start", "unixtime": 1.5}),
    ],
)
def test_hand_made_bytes_are_the_message_and_the_message_is_these_bytes(message_class, data, fields):
    message = message_class.FromString(data)
    assert {name: getattr(message, name) for name in fields} == fields
    assert message_class(**fields).SerializeToString() == data


@pytest.mark.parametrize(("message_class", "number"), [(Event, 3), (JustBytes, 3), (Image, 4)])
def test_attributes_ride_in_the_published_field(message_class, number):
    message = message_class.FromString(field(1, b"x") + field(number, ATTRIBUTES))
    assert attributes(message) == WANTED


def test_an_image_pair_holds_two_images():
    one, two = field(1, b"left"), field(1, b"right")
    data = field(1, one) + field(2, two) + field(3, b"7")
    pair = ImagePair.FromString(data)
    assert (pair.image1.bytes, pair.image2.bytes, pair.id) == (b"left", b"right", "7")
    assert ImagePair(image1=Image(bytes=b"left"), image2=Image(bytes=b"right"), id="7").SerializeToString() == data


def test_time_stamps_come_in_lists():
    stamp = field(1, b"start") + field(2, 1.5)
    assert TimeStampList.FromString(field(1, stamp) * 2).entries[1].unixtime == 1.5


@pytest.mark.parametrize("value", [True, None, b"bytes", [1], 2**31, -(2**31) - 1])
def test_an_attribute_that_2019_does_not_know_is_refused(value):
    with pytest.raises(MessageError, match="'key'") as caught:
        add_attribute(Event(type="x"), "key", value)
    assert caught.value.reason in {"no codec", "out of range"}


def test_a_message_without_attributes_is_refused():
    with pytest.raises(MessageError, match="TimeStamp has no attributes"):
        add_attribute(TimeStamp(), "key", 1)


def test_an_incomplete_message_is_refused_by_the_sender():
    with pytest.raises(MessageError) as caught:
        serialized(JustBytes())
    assert caught.value.reason == "incomplete"


def test_the_shipped_schema_is_what_proto_says(tmp_path):
    from google.protobuf.descriptor_pb2 import FileDescriptorSet

    shipped = FileDescriptorSet.FromString(SCHEMA_PATH.read_bytes())
    fresh = FileDescriptorSet.FromString(compiled(SCHEMA_PATH.parents[2] / "proto"))
    assert shipped == fresh, "run: python -m epypes.wire.compile"
    assert sorted(file.name for file in shipped.file) == sorted(PROTO_FILES)


USER = """
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory
def users():
    for path in ("image.proto", "messages.proto"):
        file = descriptor_pb2.FileDescriptorProto(name=path, syntax="proto2")
        name = "Image" if path == "image.proto" else "Event"
        field = file.message_type.add(name=name).field.add(name="mine", number=1, type=9, label=1)
        descriptor_pool.Default().AddSerializedFile(file.SerializeToString())
    found = descriptor_pool.Default().FindMessageTypeByName("Image")
    assert message_factory.GetMessageClass(found)(mine="x").mine == "x"
def ours():
    from epypes.wire import Image, Envelope, encode
    assert Image(bytes=b"x").bytes == b"x"
    encode(Envelope("x"))
"""


@pytest.mark.parametrize("order", ["users(); ours()", "ours(); users(); ours()"])
def test_a_users_own_messages_of_the_same_names_do_not_clash(order):
    subprocess.run([sys.executable, "-c", USER + order], check=True, timeout=60)
