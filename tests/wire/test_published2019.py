"""The messages of 2019 have the published bytes, so that peers built on the published library understand them."""

from __future__ import annotations

import struct
import subprocess
import sys
from pathlib import Path

import pytest

from epypes.errors import MessageError
from epypes.wire import (
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
    parsed,
    serialized,
)


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


def test_an_int_is_a_varint_of_ten_bytes_when_it_is_negative():
    message = AttributeList()
    add_attribute(message, "n", -2)
    by_hand = field(1, 3) + field(2, b"n") + bytes([5 << 3, 0xFE, *[0xFF] * 8, 0x01])
    assert message.SerializeToString() == field(1, by_hand)
    assert attributes(AttributeList.FromString(field(1, by_hand))) == {"n": -2}


ONE_IMAGE = field(1, b"x")
# What must be there, without which nothing else is read.
REQUIRED = {
    Attribute: field(1, 1) + field(2, b"key"),
    Event: field(1, b"x"),
    JustBytes: field(1, b"x"),
    Image: ONE_IMAGE,
    ImagePair: field(1, ONE_IMAGE) + field(2, ONE_IMAGE),
    TimeStamp: field(1, b"start") + field(2, 1.5),
}


@pytest.mark.parametrize(("kind", "number"), [(Event, 3), (JustBytes, 3), (Image, 4), (ImagePair, 4)])
def test_attributes_ride_in_the_published_field(kind, number):
    by_hand = REQUIRED[kind] + field(number, ATTRIBUTES)
    message = parsed(kind, by_hand)
    assert attributes(message) == WANTED
    assert serialized(message) == by_hand


# The field table of the published system, as DESIGN.md has it: number, name, type, and whether it must be there.
TABLE = {
    Attribute: "1 type enum!, 2 key string!, 3 str_val string, 4 double_val double, 5 int_val int32",
    AttributeList: "1 entries Attribute*",
    Event: "1 type string!, 2 id string, 3 attributes AttributeList",
    JustBytes: "1 contents bytes!, 2 id string, 3 attributes AttributeList",
    Image: "1 bytes bytes!, 2 id string, 3 format string, 4 attributes AttributeList",
    ImagePair: "1 image1 Image!, 2 image2 Image!, 3 id string, 4 attributes AttributeList",
    TimeStamp: "1 description string!, 2 unixtime double!",
    TimeStampList: "1 entries TimeStamp*",
}


def written_out(kind) -> str:
    from google.protobuf.descriptor_pb2 import DescriptorProto

    found = DescriptorProto()
    kind.DESCRIPTOR.CopyToProto(found)
    types = {1: "double", 5: "int32", 9: "string", 12: "bytes", 14: "enum"}
    marks = {1: "", 2: "!", 3: "*"}
    return ", ".join(
        f"{f.number} {f.name} {types.get(f.type) or f.type_name.removeprefix('.')}{marks[f.label]}" for f in found.field
    )


@pytest.mark.parametrize("kind", TABLE, ids=lambda kind: kind.__name__)
def test_the_messages_have_the_published_fields_and_no_others(kind):
    assert written_out(kind) == TABLE[kind]
    assert kind.DESCRIPTOR.full_name == kind.__name__, "no package, as published"


def test_the_types_of_attributes_have_the_published_numbers():
    assert (Attribute.STRING, Attribute.DOUBLE, Attribute.INT) == (1, 2, 3)


INCOMPLETE = [
    *((kind, b"", words) for kind, words in [(Event, "type"), (JustBytes, "contents"), (Image, "bytes")]),
    (Attribute, field(1, 1), "key"),
    (Attribute, field(2, b"key"), "type"),
    (Attribute, field(1, 9) + field(2, b"key"), "type"),
    (AttributeList, field(1, field(2, b"key")), r"entries\[0\].type"),
    (ImagePair, field(1, ONE_IMAGE), "image2"),
    (ImagePair, field(2, ONE_IMAGE), "image1"),
    (ImagePair, field(1, b"") + field(2, ONE_IMAGE), "image1.bytes"),
    (TimeStamp, field(1, b"start"), "unixtime"),
    (TimeStamp, field(2, 1.5), "description"),
    (TimeStampList, field(1, b""), r"entries\[0\].description"),
]


@pytest.mark.parametrize(("kind", "data", "lacks"), INCOMPLETE)
def test_a_message_without_what_it_must_have_is_refused_by_the_receiver(kind, data, lacks):
    with pytest.raises(MessageError, match=f"{kind.__name__}: it lacks .*{lacks}") as caught:
        parsed(kind, data)
    assert caught.value.reason == "incomplete"


@pytest.mark.parametrize(
    ("kind", "data"),
    [
        (Event, field(1, b"\xff")),
        (Event, field(1, b"x") + field(3, field(1, field(1, 1) + field(2, b"k") + field(3, b"\xff")))),
        (ImagePair, field(1, ONE_IMAGE + field(3, b"\xff")) + field(2, ONE_IMAGE)),
    ],
)
def test_text_that_is_none_is_refused_by_the_receiver(kind, data):
    with pytest.raises(MessageError) as caught:
        parsed(kind, data)
    assert caught.value.reason == "not utf-8"


@pytest.mark.parametrize("entry", [field(2, b"\xff") + field(3, b"x"), field(2, b"k") + field(3, b"\xff")])
def test_attributes_that_are_no_text_are_refused(entry):
    with pytest.raises(MessageError) as caught:
        attributes(AttributeList.FromString(field(1, field(1, 1) + entry)))
    assert caught.value.reason == "not utf-8"


@pytest.mark.parametrize(("data", "reason"), [(b"\xff\xff", "no message"), ("text", "not bytes"), (None, "not bytes")])
def test_what_is_no_message_is_refused_by_the_receiver(data, reason):
    with pytest.raises(MessageError) as caught:
        parsed(Event, data)
    assert caught.value.reason == reason


def test_an_event_that_lacks_a_field_is_counted_and_the_next_one_is_handled():
    import queue

    import epypes as ep

    cg = ep.CompGraph({"length": len}, {"length": ("contents", "n")})
    events, answers = queue.SimpleQueue(), queue.SimpleQueue()
    pipe = ep.FullPipeline(
        "sizes",
        cg,
        events,
        answers,
        lambda event: {"contents": parsed(JustBytes, event).contents},
        lambda view: view["n"],
    )
    failures = queue.SimpleQueue()
    pipe.on_error = failures.put
    with pipe:
        for event in (b"", field(2, b"7"), field(1, b"good")):
            events.put(event)
        assert answers.get(timeout=60) == 4
    assert pipe.failed == 2
    assert {failures.get(timeout=60).exception.reason for _ in range(2)} == {"incomplete"}


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

    root = Path(__file__).parents[2]
    proto, fresh = root / "proto", tmp_path / "schema.binpb"
    # Names with a folder: they never clash with a user's own messages.proto.
    files = sorted(path.relative_to(proto).as_posix() for path in proto.rglob("*.proto"))
    arguments = [f"-I{proto}", "--include_imports", f"--descriptor_set_out={fresh}", *files]
    subprocess.run([sys.executable, "-m", "grpc_tools.protoc", *arguments], check=True, timeout=60)
    shipped = FileDescriptorSet.FromString((root / "epypes/wire/schema.binpb").read_bytes())
    made = FileDescriptorSet.FromString(fresh.read_bytes())
    # Another compiler may have another text of what is imported.
    imported = "google/protobuf/timestamp.proto"
    ours = [{file.name: file for file in each.file if file.name != imported} for each in (shipped, made)]
    assert ours[0] == ours[1], "run: make schema"
    assert sorted(file.name for file in shipped.file) == sorted([*files, imported])


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


def test_help_lists_the_messages_and_their_fields():
    import pydoc

    from epypes import wire

    assert "class Event" in pydoc.plain(pydoc.render_doc(wire))
    assert "contents, id, attributes" in pydoc.plain(pydoc.render_doc(wire.JustBytes))
