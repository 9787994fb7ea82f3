"""ROS 2's messages: a message and its Envelope say the same, and no bytes do harm."""

from __future__ import annotations

import contextlib
import struct
import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from rosbags.typesys import Stores, get_typestore

from epypes.errors import MessageError
from epypes.wire import Envelope, FailureRecord, Limits, decode, encode
from epypes.wire.ros import ros_type

IMAGE = ros_type("sensor_msgs/msg/Image")
COMPRESSED = ros_type("sensor_msgs/msg/CompressedImage")
STRING, INTEGER = ros_type("std_msgs/msg/String"), ros_type("std_msgs/msg/Int64")
# By encoding: dtype and number of channels.
ENCODINGS = {
    **{f"mono{bits}": (f"<u{bits // 8}", 1) for bits in (8, 16)},
    **{f"{order}{bits}": (f"<u{bits // 8}", 3) for order in ("bgr", "rgb") for bits in (8, 16)},
    **{f"{order}{bits}": (f"<u{bits // 8}", 4) for order in ("bgra", "rgba") for bits in (8, 16)},
    "8UC1": ("<u1", 1),
    "8UC2": ("<u1", 2),
    "8UC3": ("<u1", 3),
    "16SC1": ("<i2", 1),
    "32FC1": ("<f4", 1),
    "32FC2": ("<f4", 2),
    "64FC5": ("<f8", 5),
}
# What ROS calls 8UC1 is mono8 as well, and 8UC3 is in OpenCV's order.
PUBLISHED_AS = {"8UC1": "mono8", "8UC3": "bgr8"}
JPEG = b"\xff\xd8\xff\xe0" + bytes(9)
ACQUIRED_NS = 1_700_000_000_123_456_789


@pytest.fixture(scope="module")
def published():
    """rosbags' own store of all types, made of ROS 2's packages."""
    return get_typestore(Stores.LATEST)


def image_cdr(published, image, encoding, *, padding=0, is_bigendian=False, little_endian=True, **changes):
    """A message as another program writes it; padding is in bytes a row, changes are of its fields."""
    types = published.types
    rows = image.astype(image.dtype.newbyteorder(">" if is_bigendian else "<")).reshape(image.shape[0], -1)
    data = np.pad(rows.view(np.uint8), ((0, 0), (0, padding)), constant_values=255)
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](12, 34), "camera")
    fields = {"height": image.shape[0], "width": image.shape[1], "step": data.shape[1], "data": data.reshape(-1)}
    fields |= {"header": header, "encoding": encoding, "is_bigendian": int(is_bigendian), **changes}
    message = types["sensor_msgs/msg/Image"](**fields)
    return published.serialize_cdr(message, "sensor_msgs/msg/Image", little_endian=little_endian)


@st.composite
def images(draw):
    encoding = draw(st.sampled_from(sorted(ENCODINGS)))
    dtype, channels = ENCODINGS[encoding]
    size = draw(st.tuples(st.integers(1, 5), st.integers(1, 5)))
    shape = size if channels == 1 else (*size, channels)
    return encoding, draw(hnp.arrays(dtype, shape))


@given(images(), st.integers(0, 5), st.booleans(), st.booleans())
def test_an_image_of_ros_is_an_envelope_with_the_same_pixels(published, drawn, padding, is_bigendian, little_endian):
    encoding, image = drawn
    given = {"padding": padding, "is_bigendian": is_bigendian, "little_endian": little_endian}
    envelope = IMAGE.to_envelope(image_cdr(published, image, encoding, **given), "photo")
    # As a channel delivers it.
    envelope = decode(encode(envelope))
    (name, value), order = next(iter(envelope.parts.items())), {"photo"} if encoding.startswith("rgb") else set()
    assert (name, value.dtype, value.shape) == ("photo", image.dtype, image.shape)
    assert value.tobytes() == image.tobytes()
    assert (envelope.type, envelope.source, envelope.acquired_ns) == ("sensor_msgs/msg/Image", "camera", 12_000_000_034)
    assert envelope.rgb == order


@given(images(), st.sampled_from(["", "camera", "caméra"]), st.sampled_from([0, 1, ACQUIRED_NS]), st.booleans())
def test_rosbags_reads_the_image_that_is_published(published, drawn, source, acquired_ns, is_strided):
    encoding, image = drawn
    if is_strided:
        image = np.repeat(image, 2, axis=1)[:, ::2]
    rgb = ["edges"] if encoding.startswith("rgb") else []
    answer = Envelope("answer", {"n": 3, "edges": image}, source=source, acquired_ns=acquired_ns, rgb=rgb)
    message = published.deserialize_cdr(IMAGE.from_envelope(answer), "sensor_msgs/msg/Image")
    assert message.encoding == PUBLISHED_AS.get(encoding, encoding)
    assert (message.height, message.width, message.step) == (*image.shape[:2], image.nbytes // image.shape[0])
    assert message.data.tobytes() == image.tobytes()
    assert not message.is_bigendian
    assert (message.header.stamp.sec, message.header.stamp.nanosec) == divmod(acquired_ns, 10**9)
    assert message.header.frame_id == source


def test_types_are_those_of_ros_2s_packages(published):
    names = [f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage")]
    names += [f"std_msgs/msg/{name}" for name in ("String", "Bool", "Int64", "Float64")]
    assert {name: ros_type(name).rihs01 for name in names} == {name: published.hash_rihs01(name) for name in names}
    assert IMAGE.rihs01 == "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47"
    assert ros_type("sensor_msgs::msg::dds_::Image_") is ros_type("sensor_msgs/Image") is IMAGE
    with pytest.raises(ValueError, match=r"'sensor_msgs/Imag'.*Did you mean 'sensor_msgs/msg/Image'\?"):
        ros_type("sensor_msgs/Imag")
    with pytest.raises(ValueError, match=r"'geometry_msgs/msg/Pose'.*There are: sensor_msgs/msg/Image, "):
        ros_type("geometry_msgs/msg/Pose")


@pytest.mark.parametrize(
    ("type_", "value", "format_"),
    [
        (COMPRESSED, JPEG, "jpeg"),
        (COMPRESSED, b"\x89PNG\r\n\x1a\n" + bytes(3), "png"),
        (STRING, "zwölf Münzen €", None),
        (STRING, "", None),
        (ros_type("std_msgs/Bool"), True, None),
        (INTEGER, -(2**63), None),
        (INTEGER, np.uint8(7), None),
        (ros_type("std_msgs/Float64"), 0.1, None),
    ],
)
def test_files_texts_and_numbers_go_there_and_back(published, type_, value, format_):
    cdr = type_.from_envelope(Envelope("answer", {"found": value, "tuple": (1, 2)}, acquired_ns=ACQUIRED_NS))
    message = published.deserialize_cdr(cdr, type_.name)
    assert bytes(message.data) == value if format_ else message.data == value
    back = type_.to_envelope(cdr)
    assert dict(back.parts) == {"image" if format_ else "data": value}
    assert dict(back.attributes) == ({"format": format_} if format_ else {})
    assert back.acquired_ns == (ACQUIRED_NS if format_ else 0)


def test_an_answer_has_the_frame_of_its_request():
    answer = Envelope("answer", {"data": JPEG}, source="edges", request_source="camera")
    assert COMPRESSED.to_envelope(COMPRESSED.from_envelope(answer)).source == "camera"


def test_an_image_is_a_view_of_the_message(published):
    cdr = image_cdr(published, np.zeros((480, 640, 3), np.uint8), "bgr8", padding=6)
    assert np.shares_memory(IMAGE.to_envelope(cdr).parts["image"], np.frombuffer(cdr, np.uint8))


GRAY = np.arange(12, dtype=np.uint8).reshape(3, 4)
HOSTILE = {
    "an encoding that EPypes does not know": ({"encoding": "bayer_rggb8"}, "bad encoding"),
    "more channels than OpenCV has": ({"encoding": "8UC999"}, "bad encoding"),
    "fewer pixels than it says": ({"height": 4}, "size differs"),
    "more pixels than it says": ({"height": 2}, "size differs"),
    "rows that overlap": ({"step": 3, "height": 4}, "bad step"),
    "no pixels": ({"width": 0, "height": 0, "step": 0, "data": GRAY[0, :0]}, "bad step"),
    "endless rows without width": ({"width": 0, "height": 2**32 - 1, "step": 0, "data": GRAY[0, :0]}, "bad step"),
    "four thousand million columns": ({"width": 2**32 - 1, "step": 2**32 - 1}, "size differs"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_an_image_that_is_not_what_it_says_is_refused(published, case):
    changes, reason = HOSTILE[case]
    with pytest.raises(MessageError) as caught:
        IMAGE.to_envelope(image_cdr(published, GRAY, **{"encoding": "mono8", **changes}))
    assert caught.value.reason == reason


def test_a_time_stamp_before_1970_and_a_message_over_the_limit_are_refused(published):
    cdr = bytearray(image_cdr(published, GRAY, "mono8"))
    with pytest.raises(MessageError, match="limit is 50"):
        IMAGE.to_envelope(cdr, limits=Limits(total_bytes=50))
    struct.pack_into("<i", cdr, 4, -1)
    with pytest.raises(MessageError, match="before 1970: second -1"):
        IMAGE.to_envelope(cdr)


@given(st.data())
def test_bytes_that_are_no_message_are_refused_and_never_crash(published, data):
    type_ = data.draw(st.sampled_from([IMAGE, COMPRESSED, STRING, INTEGER]))
    content = {IMAGE: GRAY, COMPRESSED: JPEG, STRING: "some text", INTEGER: 7}[type_]
    cdr = bytearray(type_.from_envelope(Envelope("", {"value": content})))
    if data.draw(st.booleans()):
        del cdr[data.draw(st.integers(0, len(cdr) - 1)) :]
    for position in data.draw(st.lists(st.integers(0, max(len(cdr) - 1, 0)), max_size=4 if cdr else 0)):
        cdr[position] = data.draw(st.sampled_from([0, 1, 4, 127, 255]))
    with contextlib.suppress(MessageError):
        encode(type_.to_envelope(bytes(cdr)))


def test_a_message_that_was_cut_off_anywhere_is_refused():
    cdr = IMAGE.from_envelope(Envelope("", {"image": GRAY}))
    for length in range(len(cdr)):
        with pytest.raises(MessageError) as caught:
            IMAGE.to_envelope(cdr[:length])
        assert caught.value.reason == "bad cdr"


FAILED = Envelope("epypes.failure", failure=FailureRecord("canny", ("image",), "error", "too small"))
SEVERAL = Envelope("answer", {"gray": GRAY, "edges": GRAY, "count": 3})
REFUSED = {
    "a failure": (IMAGE, FAILED, "", "canny failed.*too small"),
    "two images": (IMAGE, SEVERAL, "", "Each of 'gray', 'edges'.*token=gray"),
    "no text": (STRING, SEVERAL, "", "must be a text; the message has 'gray' .uint8 3 x 4.*'count' .int"),
    "a token that is not there": (IMAGE, SEVERAL, "edge", "Did you mean 'edges'"),
    "a token that is no image": (IMAGE, SEVERAL, "count", "'count' is int; .*must be an array"),
    "a mask": (IMAGE, Envelope("", {"mask": GRAY > 3}), "", r"bool 3 x 4.*mask.astype\('uint8'\) \* 255"),
    "integers of 64 bits": (IMAGE, Envelope("", {"labels": GRAY.astype(int)}), "", "no encoding for int64 3 x 4"),
    "an image without pixels": (IMAGE, Envelope("", {"crop": GRAY[:0]}), "", "uint8 0 x 4.*at least one pixel"),
    "bytes of no image file": (COMPRESSED, Envelope("", {"file": b"GIF89a"}), "file", "file' is bytes; .*JPEG"),
    "an integer of more than 64 bits": (INTEGER, Envelope("", {"n": 2**63}), "n", "whole number of 64 bits"),
    "True as a number": (INTEGER, Envelope("", {"n": True}), "n", "'n' is bool"),
    "a text with a NUL": (STRING, Envelope("", {"text": "a\0b"}), "", "NUL"),
    "a text with a lone surrogate": (STRING, Envelope("", {"text": "\ud800"}), "", "surrogates"),
    "a source with a NUL": (COMPRESSED, Envelope("", {"file": JPEG}, source="\0"), "", "NUL"),
    "an image of 2100": (IMAGE, Envelope("", {"image": GRAY}, acquired_ns=4_102_444_800 * 10**9), "", "2038"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_no_ros_message_can_hold_is_refused_with_a_reason(case):
    type_, envelope, token, text = REFUSED[case]
    with pytest.raises(MessageError, match=text):
        type_.from_envelope(envelope, token)


def test_one_of_several_images_is_named():
    envelope = IMAGE.to_envelope(IMAGE.from_envelope(SEVERAL, "edges"), "edges")
    assert np.array_equal(envelope.parts["edges"], GRAY)


def test_the_types_load_without_databases_and_archives():
    code = (
        "import sys; from epypes.wire.ros import ros_type; ros_type('sensor_msgs/Image').rihs01;"
        "print(*sorted({'apsw', 'zstandard', 'lz4', 'cv2'} & set(sys.modules)), 'rosbags.typesys' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout == "True\n"
