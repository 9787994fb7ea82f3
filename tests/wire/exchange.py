"""Exchange of messages between two versions of protobuf.

Run as a script it needs numpy and protobuf alone: it reads bytes from another version on standard input, checks that
they mean the same here, and prints its own.
"""

from __future__ import annotations

import json
import random
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

from epypes.errors import MessageError
from epypes.wire import (
    AttributeList,
    Envelope,
    Event,
    FailureRecord,
    Image,
    ImagePair,
    JustBytes,
    TimeStamp,
    TimeStampList,
    add_attribute,
    attributes,
    decode,
    encode,
    load_sample,
    parsed,
    save_sample,
    serialized,
)
from tests.wire.mutants import mutate_description, mutate_frames

PARTS = {
    "image": np.arange(60 * 80 * 3, dtype=np.uint8).reshape(60, 80, 3),
    "depth": np.arange(1200, dtype="<u2").reshape(30, 40),
    "floats": np.linspace(-1, 1, 7, dtype="<f4"),
    "big_endian": np.arange(3, dtype=">i8"),
    "mask": np.eye(4, dtype=bool),
    "names": np.array(["left", "rechts \u00fc"]),
    "points": [(1.5, -2), {"size": np.float32(3), (1, "k"): None}, True],
    "text": "\u20ac \0 \U0001f600",
    "bytes": b"\xff\xd8" + bytes(20),
    "integers": [0, -1, 2**63 - 1, -(2**63), 1 << 80, -(1 << 200)],
    "numbers": [0.0, -0.0, 1e308, float("inf")],
}


def envelope() -> Envelope:
    """An envelope that uses every field and kind of value, the same every time."""
    return Envelope(
        "edges",
        PARTS,
        id="fixed",
        source="cam1",
        epoch=1,
        sequence=2**40,
        acquired_ns=11,
        published_ns=12,
        correlation_id="request-1",
        revision=3,
        bundle_digest="sha256:00",
        attributes={"exposure": 0.5, "gain": 3},
        rgb={"image"},
        timings={"blur": 100, "canny": -1},
        failure=FailureRecord("canny", ("a", "b"), "ValueError", "no", "id", 2),
    )


def messages_2019() -> dict[str, object]:
    """Each message of 2019 with every field."""
    listed = AttributeList()
    for key, value in {"name": "\u00fc", "time": 0.25, "count": -7}.items():
        add_attribute(listed, key, value)
    image = Image(bytes=b"\xff\xd8", id="7", format="jpg", attributes=listed)
    start = TimeStamp(description="start", unixtime=1.5)
    return {
        "AttributeList": listed,
        "Event": Event(type="request", id="7", attributes=listed),
        "JustBytes": JustBytes(contents=b"\0\1", id="7", attributes=listed),
        "Image": image,
        "ImagePair": ImagePair(image1=image, image2=image, id="7", attributes=listed),
        "TimeStamp": start,
        "TimeStampList": TimeStampList(entries=[start, start]),
    }


def made() -> dict[str, list[str]]:
    """Return what is made here: frames and messages in hexadecimal, by name."""
    result = {name: [serialized(message).hex()] for name, message in messages_2019().items()}
    result["inside"] = [bytes(frame).hex() for frame in encode(envelope(), "cam1")]
    result["beside"] = [bytes(frame).hex() for frame in encode(envelope(), "cam1", inline_below=0)]
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "s.npz"
        save_sample(path, {"value": PARTS["image"]}, PARTS)
        result["sample"] = [path.read_bytes().hex()]
    return result


def check(theirs: dict[str, list[str]]) -> None:
    """Raise AssertionError unless the bytes of another version mean the same here."""
    for name in ("inside", "beside"):
        frames = [bytes.fromhex(frame) for frame in theirs[name]]
        assert same(decode(frames), envelope()), name
    for name, message in messages_2019().items():
        read = parsed(type(message), bytes.fromhex(theirs[name][0]))
        assert read == message, name
        if hasattr(message, "attributes"):
            assert attributes(read) == {"name": "\u00fc", "time": 0.25, "count": -7}, name
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "s.npz"
        path.write_bytes(bytes.fromhex(theirs["sample"][0]))
        inputs, outputs = load_sample(path)
    assert repr(inputs) == repr({"value": PARTS["image"]})
    assert repr(outputs) == repr(PARTS)


def same(a: Envelope, b: Envelope) -> bool:
    """Whether two envelopes are the same in every field; text and dtype of all arrays count."""
    np.set_printoptions(threshold=10**9)
    return all(repr(getattr(a, name)) == repr(getattr(b, name)) for name in Envelope.__dataclass_fields__)


def refusals() -> dict[str, int]:
    """Return how many of 1,000 broken messages were refused, by reason."""
    rng, reasons = random.Random(37), Counter()
    frames = [bytes(frame) for frame in encode(envelope(), "cam1", inline_below=64)]
    for number in range(1_000):
        mutation = mutate_description if number % 3 == 0 else mutate_frames
        try:
            decode(mutation(frames, rng))
        except MessageError as error:
            reasons[error.reason] += 1
    for kind, data in ((Event, b""), (Event, b"\x0a\x01\xff"), (JustBytes, b"\xff"), (ImagePair, b"\x0a\x00\x12\x00")):
        try:
            parsed(kind, data)
        except MessageError as error:
            reasons[error.reason] += 1
    return dict(reasons)


def users_own() -> None:
    """Register messages of the user's that are called like ours."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    for path, name in (("image.proto", "Image"), ("messages.proto", "Event")):
        file = descriptor_pb2.FileDescriptorProto(name=path, syntax="proto2")
        file.message_type.add(name=name).field.add(name="mine", number=1, type=9, label=1)
        descriptor_pool.Default().AddSerializedFile(file.SerializeToString())
        found = descriptor_pool.Default().FindMessageTypeByName(name)
        assert message_factory.GetMessageClass(found)(mine="x").mine == "x"


def main(order: str) -> None:
    """Check what is read from standard input, and print what is made here."""
    import google.protobuf
    from google.protobuf.internal import api_implementation

    if order == "users first":
        users_own()
    check(json.load(sys.stdin))
    if order == "ours first":
        users_own()
    report = {"protobuf": google.protobuf.__version__, "made_by": api_implementation.Type(), "refusals": refusals()}
    json.dump({**report, "made": made()}, sys.stdout)


if __name__ == "__main__":
    main(sys.argv[1])
