"""An encoded envelope: its header is read and stamped, its values pass through untouched."""

from __future__ import annotations

import random

import numpy as np
import pytest

from epypes.errors import MessageError
from epypes.wire import EncodedEnvelope, Envelope, FailureRecord, Limits, decode, encode
from epypes.wire.encoder import stamped_frames
from epypes.wire.protobuf import message_class
from tests.wire.mutants import mutate_frames

HEADER_FIELDS = (
    *("id", "type", "source", "epoch", "sequence", "acquired_ns", "published_ns", "correlation_id", "revision"),
    *("bundle_digest", "failure"),
)


def full_envelope(**changes) -> Envelope:
    fields = {
        "parts": {"image": np.arange(12_000, dtype=np.uint8).reshape(100, 120), "lines": [(1.5, "a"), None]},
        "source": "cam1",
        "epoch": 3,
        "sequence": 7,
        "acquired_ns": 11,
        "published_ns": 12,
        "correlation_id": "request-1",
        "revision": 3,
        "bundle_digest": "sha256:00",
        "attributes": {"exposure": 0.5},
        "timings": {"blur": 100},
        "failure": FailureRecord("canny", ("a", "b"), "ValueError", "no", "id", 2),
        **changes,
    }
    return Envelope("edges", **fields)


def test_the_header_is_read_and_the_values_come_back_by_decode():
    sent = full_envelope()
    read = EncodedEnvelope.read(encode(sent, "cam1"))
    for name in HEADER_FIELDS:
        assert getattr(read, name) == getattr(sent, name), name
    back = read.decode()
    assert np.array_equal(back.parts["image"], sent.parts["image"])
    assert (back.parts["lines"], back.attributes, back.timings) == ([(1.5, "a"), None], {"exposure": 0.5}, sent.timings)


def test_an_envelope_without_failure_has_none():
    read = EncodedEnvelope.read(encode(Envelope("frame")))
    assert (read.failure, read.sequence, read.source) == (None, 0, "")


def test_encode_gives_the_frames_and_the_fields_of_the_envelope():
    sent = full_envelope()
    encoded = EncodedEnvelope.encode(sent, "cam1")
    assert list(encoded.frames) == encode(sent, "cam1")
    read = EncodedEnvelope.read(encoded.frames)
    for name in HEADER_FIELDS:
        assert getattr(read, name) == getattr(encoded, name), name


def test_received_frames_pass_through_without_a_copy():
    frames = [bytes(frame) for frame in encode(full_envelope(), "cam1")]
    read = EncodedEnvelope.read(frames)
    stamped = stamped_frames(read.frames, 1, 2, 3)
    for place in (0, 2):
        assert read.frames[place].obj is frames[place]
        assert stamped[place].obj is frames[place]


@pytest.mark.parametrize("numbers", [(100, 200, 300), (0, 0, 0), (-1, 2**64 - 1, 2**63 - 1)])
def test_a_stamp_replaces_epoch_sequence_and_time_and_nothing_else(numbers):
    sent = full_envelope()
    stamped = stamped_frames(encode(sent, "cam1"), *numbers)
    again = EncodedEnvelope.read(stamped)
    back = decode(stamped)
    for found in (again, back):
        assert (found.epoch, found.sequence, found.published_ns) == numbers
        for name in {*HEADER_FIELDS} - {"epoch", "sequence", "published_ns"}:
            assert getattr(found, name) == getattr(sent, name), name
    assert np.array_equal(back.parts["image"], sent.parts["image"])
    assert back.attributes == {"exposure": 0.5}


def test_the_last_of_several_stamps_counts_and_the_first_message_is_left_alone():
    first = encode(full_envelope())
    last = stamped_frames(stamped_frames(first, 1, 2, 3), 4, 5, 6)
    assert (decode(first).epoch, decode(first).sequence) == (3, 7)
    assert EncodedEnvelope.read(last).sequence == decode(last).sequence == 5


@pytest.mark.parametrize(("stamp", "reason"), [((1, -1, 1), "bad field"), ((1, "x", 1), "bad field")])
def test_a_stamp_that_no_field_holds_is_refused(stamp, reason):
    with pytest.raises(MessageError) as caught:
        stamped_frames(encode(Envelope("frame")), *stamp)
    assert caught.value.reason == reason


def test_a_stamp_keeps_the_limits_of_a_message():
    frames = encode(Envelope("frame", id="x"))
    with pytest.raises(MessageError) as caught:
        stamped_frames(frames, 2**60, 2**60, 2**60, Limits(header_bytes=len(frames[1]) + 5))
    assert caught.value.reason == "too large"


def header_bytes(**fields) -> bytes:
    return message_class("epypes.v1.Envelope")(**fields).SerializeToString()


@pytest.mark.parametrize(
    ("reason", "frames"),
    [
        ("too few frames", []),
        ("too few frames", [b"/"]),
        ("too many frames", [b"/", b"", *[b""] * 3]),
        ("too large", [b"/", header_bytes(source="x" * 2_000)]),
        ("too large", [b"/", b"", bytes(9_000)]),
        ("bad topic", [b"cam1", b""]),
        ("bad topic", [b"\xff/", b""]),
        ("bad topic", [b"a" * 1_024 + b"/", b""]),
        ("no envelope", [b"/", b"\xff"]),
        ("no envelope", [b"/", b"\x12\x01\xff"]),
        ("unknown version", [b"/", header_bytes(version=2)]),
        ("bad frame", [b"/", memoryview(bytes(8))[::2]]),
    ],
)
def test_a_hostile_header_is_refused(reason, frames):
    with pytest.raises(MessageError) as caught:
        EncodedEnvelope.read(frames, Limits(total_bytes=8_000, header_bytes=1_000, frames=2))
    assert caught.value.reason == reason


def test_of_many_broken_messages_none_raises_anything_but_a_message_error():
    rng = random.Random(2019)
    frames = [bytes(frame) for frame in encode(full_envelope(), "cam1", inline_below=64)]
    reasons = []
    for _ in range(300):
        try:
            stamped_frames(EncodedEnvelope.read(mutate_frames(frames, rng)).frames, 1, 2, 3)
        except MessageError as error:
            reasons.append(error.reason)
    assert all(reasons)
    assert 0 < len(reasons) < 300


def test_values_that_can_not_be_decoded_pass_through_unread():
    header = message_class("epypes.v1.Envelope")(type="frame")
    header.parts.add(name="image").value.tensor.dtype = "|O8"
    header.attributes.add(name="deep").value.encoded.frame = 5
    read = EncodedEnvelope.read([b"/", header.SerializeToString(), b"a payload that belongs to no value"])
    assert read.type == "frame"
    assert read.frames[2] == b"a payload that belongs to no value"
    with pytest.raises(MessageError):
        read.decode()


def test_values_are_not_even_parsed_until_they_are_decoded():
    part_of_garbage = bytes([12 << 3 | 2, 3]) + b"\xff\xff\xff"
    read = EncodedEnvelope.read([b"/", header_bytes(type="frame") + part_of_garbage])
    assert read.type == "frame"
    with pytest.raises(MessageError) as caught:
        read.decode()
    assert caught.value.reason == "no envelope"


def test_the_repr_is_small_and_free_of_values():
    assert repr(EncodedEnvelope.encode(full_envelope())).startswith("<EncodedEnvelope 'edges' #7: 12,")
    assert len(repr(EncodedEnvelope.encode(Envelope("x" * 500)))) < 100
