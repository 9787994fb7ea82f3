"""An envelope comes back from its frames; bad frames are refused by a MessageError and nothing else."""

from __future__ import annotations

import dataclasses
import random

import cv2
import numpy as np
import pandas as pd
import pytest

from epypes.errors import MessageError
from epypes.wire import Envelope, FailureRecord, Limits, decode, encode
from epypes.wire.protobuf import message_class
from tests.wire.former_tables import former_frames
from tests.wire.mutants import mutate_description, mutate_frames


def opencv_and_pandas():
    points = [cv2.KeyPoint(x, 2.5, 31, -1, 0.25, 1, -1) for x in range(30)]
    pairs = tuple((cv2.DMatch(n, 1, 0, 0.5), cv2.DMatch(n, 2, 0, 1.5)) for n in range(3))
    columns = {"row": [1, 2], "word": ["a", None], "score": [0.5, float("nan")], "more": pd.Categorical(["x", None])}
    table = pd.DataFrame(columns, index=pd.to_datetime(["2019-01-01", "2019-01-02"]))
    return {"keypoints": points, "pairs": pairs, "keypoint": points[0], "table": table, "column": table["score"]}


def full_envelope() -> Envelope:
    return Envelope(
        "edges",
        {
            "image": np.arange(60 * 80 * 3, dtype=np.uint8).reshape(60, 80, 3),
            "depth": np.ones((30, 40), "<u2"),
            "mask": np.eye(20, dtype=bool),
            "names": np.array(["left", "right"]),
            "points": [(1.5, 2), {"size": np.float32(3)}, None],
            "jpeg": b"\xff\xd8" + bytes(500),
            "huge": 1 << 80,
            "phase": 1 - 2j,
            "labels": {"left", 3, frozenset({None})},
            **opencv_and_pandas(),
        },
        source="cam1",
        epoch=1,
        sequence=7,
        acquired_ns=11,
        published_ns=12,
        correlation_id="request-1",
        revision=3,
        bundle_digest="sha256:00",
        attributes={"exposure": 0.5},
        rgb={"image"},
        timings={"blur": 100},
        failure=FailureRecord("canny", ("a", "b"), "ValueError", "no", "id", 2),
    )


def test_every_field_comes_back():
    sent = full_envelope()
    back = decode(encode(sent, "cam1", inline_below=64))
    for field in dataclasses.fields(Envelope):
        if field.name != "parts":
            assert getattr(back, field.name) == getattr(sent, field.name), field.name
    assert list(back.parts) == list(sent.parts)


def test_the_topic_frame_is_always_there_and_ends_in_a_slash():
    assert encode(Envelope("x"))[0] == b"/"
    assert encode(Envelope("x"), "cam1")[0] == b"cam1/"
    assert encode(Envelope("x"), "cam1/")[0] == b"cam1/"


def test_large_arrays_ride_beside_and_small_ones_inside():
    frames = encode(Envelope("x", {"small": np.zeros(8191, np.uint8), "large": np.zeros(8192, np.uint8)}))
    assert [len(frame) for frame in frames[2:]] == [8192]


def test_an_envelope_can_not_be_changed():
    envelope = Envelope("x", {"a": 1})
    with pytest.raises(TypeError):
        envelope.parts["a"] = 2  # type: ignore[index]
    with pytest.raises(dataclasses.FrozenInstanceError):
        envelope.type = "y"  # type: ignore[misc]


def test_the_repr_is_small_and_free_of_values():
    envelope = Envelope("x" * 500, {f"part{n}": np.zeros(10) for n in range(100)})
    assert len(repr(envelope)) < 100


def test_a_field_of_the_wrong_type_is_refused_by_the_sender():
    with pytest.raises(MessageError) as caught:
        encode(Envelope("x", sequence=-1))
    assert caught.value.reason == "bad field"


def header(**parts) -> object:
    message = message_class("epypes.v1.Envelope")()
    for name, fields in parts.items():
        kind, content = fields
        part = message.parts.add(name=name)
        getattr(part.value, kind).SetInParent()
        for field, value in content.items():
            target = getattr(part.value, kind)
            if field == "shape":
                target.shape.extend(value)
            else:
                setattr(target, field, value)
    return message


def refused(message, *payloads, limits=None) -> str:
    with pytest.raises(MessageError) as caught:
        decode([b"/", message.SerializeToString(), *payloads], limits or Limits())
    return caught.value.reason


def tensor(**fields) -> tuple[str, dict[str, object]]:
    return "tensor", {"dtype": "<f4", "shape": [2, 2], "inline": bytes(16), **fields}


def image(**fields) -> tuple[str, dict[str, object]]:
    return "image", {"width": 2, "height": 2, "encoding": "mono8", "step": 2, "inline": bytes(4), **fields}


@pytest.mark.parametrize(
    ("reason", "part"),
    [
        ("size differs", tensor(shape=[2, 3])),
        ("size differs", tensor(shape=[2**40, 2**40])),
        ("size differs", tensor(dtype="|S0", shape=[2**40], inline=b"")),
        ("bad shape", tensor(shape=[-2, -2])),
        ("bad shape", tensor(shape=[2**62, 0], inline=b"")),
        ("bad shape", tensor(shape=[1] * 33)),
        ("bad shape", tensor(shape=[1], inline=bytes(4), scalar=True)),
        ("bad dtype", tensor(dtype="|O8")),
        ("bad dtype", tensor(dtype="|V4")),
        ("bad dtype", tensor(dtype="<M8[s]")),
        ("bad dtype", tensor(dtype="f4,f4")),
        ("bad dtype", tensor(dtype="<f3")),
        ("bad data", tensor(dtype="|b1", inline=b"\0\1\2\3")),
        ("bad data", tensor(dtype="<U1", inline=b"\xff" * 16)),
        ("bad data", tensor(dtype="<U1", shape=[], inline=b"\xff" * 4, scalar=True)),
        ("size differs", tensor(dtype="<U2", shape=[], inline=b"\0" * 4, scalar=True)),
        ("bad step", image(step=1)),
        ("bad step", image(width=0, step=0, inline=b"")),
        ("size differs", image(step=3)),
        ("size differs", image(height=2**32 - 1, step=2**32 - 1)),
        ("bad encoding", image(encoding="yuv422")),
        ("missing frame", tensor(frame=1)),
        ("no data", ("encoded", {})),
        ("unknown value", ("list", {})),
    ],
)
def test_a_part_that_does_not_fit_its_description_is_refused(reason, part):
    message = header(part=part)
    if reason == "unknown value":
        message.parts[0].value.list.items.add()
    payloads = [bytes(16)] if reason == "missing frame" else []
    assert refused(message, *payloads) == reason


def test_each_frame_belongs_to_exactly_one_value():
    assert refused(header(a=tensor()), bytes(16)) == "unused frame"
    assert refused(header(a=tensor(frame=0), b=tensor(frame=0)), bytes(16)) == "frame used twice"


def test_padded_rows_of_other_senders_are_read():
    message = header(a=image(step=3, inline=b"\1\2\0\3\4\0"))
    assert decode([b"/", message.SerializeToString()]).parts["a"].tolist() == [[1, 2], [3, 4]]


def test_names_and_keys_may_come_once():
    message = header(a=tensor())
    message.parts.add(name="a").value.none = True
    assert refused(message) == "name used twice"
    twice = header(m=("map", {}))
    for _ in range(2):
        entry = twice.parts[0].value.map.entries.add()
        entry.key.integer = 1
        entry.value.none = True
    assert refused(twice) == "bad key"
    unhashable = header(m=("map", {}))
    entry = unhashable.parts[0].value.map.entries.add()
    entry.key.list.SetInParent()
    entry.value.none = True
    assert refused(unhashable) == "bad key"


@pytest.mark.parametrize("version", [0, 1])
def test_version_0_and_1_are_v1_and_fields_of_a_later_minor_change_are_passed_over(version):
    message = header(a=tensor())
    message.version = version
    # Fields 99 and 16, which v1 does not know, at the end of the Envelope and inside its part.
    later = message.SerializeToString() + varint(99 << 3 | 2) + b"\x03new"
    part = message.parts[0].SerializeToString() + varint(16 << 3) + b"\x01"
    for data in (later, b"\x62" + varint(len(part)) + part):
        assert decode([b"/", data]).parts["a"].shape == (2, 2)


@pytest.mark.parametrize("version", [2, 2**32 - 1])
def test_an_unknown_version_is_refused_with_both_versions_named(version):
    message = header(a=tensor())
    message.version = version
    with pytest.raises(MessageError, match=f"version {version}, and this EPypes reads version 1") as caught:
        decode([b"/", message.SerializeToString()])
    assert caught.value.reason == "unknown version"


def test_what_is_sent_says_its_version():
    assert message_class("epypes.v1.Envelope").FromString(encode(Envelope("x"))[1]).version == 1


def test_limits_hold():
    many = header(**{f"p{n}": tensor() for n in range(5)})
    assert refused(many, limits=Limits(parts=4)) == "too many parts"
    assert refused(many, limits=Limits(values=4)) == "too many values"
    assert refused(many, limits=Limits(total_bytes=50)) == "too large"
    assert refused(many, limits=Limits(header_bytes=50)) == "too large"
    assert refused(many, b"", b"", limits=Limits(frames=1)) == "too many frames"
    deep = header(a=("list", {}))
    value = deep.parts[0].value
    for _ in range(30):
        value = value.list.items.add()
    value.none = True
    assert refused(deep) == "too deep"


@pytest.mark.parametrize(
    "frames", [[], [b"/"], [b"cam1", b""], [b"\xff/", b""], [b"a" * 5000 + b"/", b""], [b"", b""], [b"/", b"\xff"]]
)
def test_frames_that_are_no_message_are_refused(frames):
    with pytest.raises(MessageError):
        decode(frames)


def test_a_header_nested_beyond_the_parser_is_refused():
    value = b"\x08\x01"
    for _ in range(500):
        item = b"\x0a" + varint(len(value)) + value
        value = b"\x32" + varint(len(item)) + item
    part = b"\x12" + varint(len(value)) + value
    with pytest.raises(MessageError):
        decode([b"/", b"\x62" + varint(len(part)) + part])


def varint(number: int) -> bytes:
    out = bytearray()
    while number > 127:
        out.append(number & 127 | 128)
        number >>= 7
    return bytes([*out, number])


@pytest.mark.parametrize("count", [300, pytest.param(10_000, marks=pytest.mark.soak)])
def test_of_many_broken_messages_none_raises_anything_but_a_message_error(count):
    rng = random.Random(2019)
    frames = [bytes(frame) for frame in encode(full_envelope(), "cam1", inline_below=64)]
    table = opencv_and_pandas()["table"].drop(columns="more")
    former = former_frames(table=table, series=table["row"])
    reasons = []
    for number in range(count):
        mutation = mutate_description if number % 3 == 0 else mutate_frames
        try:
            envelope = decode(mutation(former if number % 5 == 0 else frames, rng))
        except MessageError as error:
            reasons.append(error.reason)
        else:
            # What is accepted can be looked at in full.
            repr(dict(envelope.parts))
    assert all(reasons)
    assert len(reasons) > count / 2
