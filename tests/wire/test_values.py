"""Every value comes back exactly as it was."""

from __future__ import annotations

import datetime
import math
import struct
import subprocess
import sys
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

import epypes as ep
from epypes.errors import MessageError
from epypes.wire import Envelope, Limits, decode, encode, load_sample, save_sample


def same(a, b) -> bool:
    """Equal in type, value and order, with nan the same as nan and 0.0 other than -0.0."""
    if type(a) is not type(b):
        return False
    if isinstance(a, np.ndarray | np.generic):
        return a.dtype == b.dtype and a.shape == b.shape and a.tobytes() == b.tobytes()
    if isinstance(a, float):
        return struct.pack("d", a) == struct.pack("d", b) or (math.isnan(a) and math.isnan(b))
    if isinstance(a, list | tuple):
        return len(a) == len(b) and all(map(same, a, b))
    if isinstance(a, complex):
        return same((a.real, a.imag), (b.real, b.imag))
    if isinstance(a, dict):
        return same(list(a.items()), list(b.items()))
    return a == b


def len_of(integer: int) -> str:
    return f"{integer.bit_length()} bit"


DTYPES = st.one_of(
    hnp.boolean_dtypes(),
    hnp.integer_dtypes(endianness="?"),
    hnp.unsigned_integer_dtypes(endianness="?"),
    hnp.floating_dtypes(endianness="?", sizes=(16, 32, 64)),
    hnp.complex_number_dtypes(endianness="?", sizes=(64, 128)),
    hnp.byte_string_dtypes(min_len=1, max_len=5),
    hnp.unicode_string_dtypes(min_len=1, max_len=5, endianness="?"),
)
ARRAYS = hnp.arrays(DTYPES, hnp.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=4))
SCALARS = DTYPES.flatmap(lambda dtype: hnp.arrays(dtype, ())).map(lambda array: array[()])
TEXT = st.text(st.characters(exclude_categories=["Cs"]))
KEYS = st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | TEXT | st.binary()
PLAIN = st.none() | st.booleans() | st.integers() | st.floats() | st.complex_numbers() | TEXT | st.binary()
SETS = st.frozensets(KEYS | st.frozensets(KEYS, max_size=3), max_size=4)
VALUES = st.recursive(
    PLAIN | ARRAYS | SCALARS | SETS | SETS.map(set),
    lambda inner: (
        st.lists(inner, max_size=4)
        | st.lists(inner, max_size=4).map(tuple)
        | st.dictionaries(KEYS | st.tuples(KEYS, KEYS), inner, max_size=4)
    ),
    max_leaves=8,
)
RANDOM = settings(deadline=None, suppress_health_check=[HealthCheck.too_slow])


@pytest.mark.fuzz
@pytest.mark.slow
@RANDOM
@given(value=VALUES, inline_below=st.sampled_from([0, 16, 8192]))
def test_any_value_comes_back_as_it_was(value, inline_below):
    frames = encode(Envelope("test", {"value": value}), "topic", inline_below)
    back = decode([bytes(frame) for frame in frames]).parts["value"]
    assert same(back, value)


@pytest.mark.fuzz
@pytest.mark.slow
@RANDOM
@given(value=VALUES)
def test_any_value_comes_back_from_a_sample(value, tmp_path_factory):
    path = tmp_path_factory.mktemp("sample") / "s.npz"
    save_sample(path, {"value": value}, {"again": value})
    inputs, outputs = load_sample(path)
    assert same(inputs, {"value": value})
    assert same(outputs, {"again": value})


def test_the_array_layouts_of_vision_come_back_contiguous():
    image = np.arange(24, dtype=np.uint8).reshape(4, 6)
    readonly = image.copy()
    readonly.flags.writeable = False
    for array in (np.asfortranarray(image), image[::2, ::-1], image.T, readonly, image[1:1], np.array(3, ">u2")):
        back = decode(encode(Envelope("", {"a": array}), inline_below=0)).parts["a"]
        assert same(back, array)
        assert back.flags.c_contiguous


@pytest.mark.parametrize("integer", [2**63 - 1, 2**63, -(2**63), -(2**63) - 1, 7**20_000], ids=len_of)
def test_integers_of_any_size_come_back(integer):
    assert decode(encode(Envelope("", {"n": integer}))).parts["n"] == integer


@pytest.mark.parametrize("scalar", [np.bytes_(b"a\0"), np.str_("a\0"), np.str_(""), np.bool_(True), np.float32("nan")])
def test_numpy_scalars_come_back_as_they_were(scalar):
    assert same(decode(encode(Envelope("", {"s": scalar}))).parts["s"], scalar)


def test_a_decoded_image_is_a_read_only_view_of_its_frame():
    image = np.arange(480 * 640 * 3, dtype=np.uint8).reshape(480, 640, 3)
    frames = encode(Envelope("", {"image": image}))
    back = decode(frames).parts["image"]
    assert np.shares_memory(back, np.frombuffer(frames[2], np.uint8))
    assert np.shares_memory(back, image)
    with pytest.raises(ValueError, match="read-only"):
        back[0, 0, 0] = 1


def test_an_image_travels_with_its_colour_order():
    image = np.zeros((2, 2, 3), np.uint8)
    assert b"bgr8" in encode(Envelope("", {"image": image}))[1]
    assert b"rgb8" in encode(Envelope("", {"image": image}, rgb="image"))[1]


@pytest.mark.parametrize("inline_below", [0, 8192])
def test_the_receiver_knows_which_parts_are_rgb_and_nothing_is_converted(inline_below):
    image = np.arange(2 * 3 * 4, dtype=np.uint16).reshape(2, 3, 4)
    parts = {"left": image, "right": image, "both": [image, {"mask": image[:, :, 0]}], "depth": image[:, :, 0]}
    sent = Envelope("", parts, attributes={"right": image}, rgb=["left", "both", "depth"])
    back = decode(encode(sent, inline_below=inline_below))
    assert back.rgb == {"left", "both"}, "a part without colours has no order"
    assert same(dict(back.parts), parts)
    assert same(back.attributes["right"], image)


def test_a_part_with_images_of_both_orders_is_brought_to_that_of_the_first():
    image = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
    topic, header = encode(Envelope("", {"pair": (image, image)}, rgb=["pair"]))
    first = header.index(b"rgb8")
    mixed = decode([topic, header[: first + 4] + header[first + 4 :].replace(b"rgb8", b"bgr8")])
    assert mixed.rgb == {"pair"}
    assert np.array_equal(mixed.parts["pair"][0], image)
    assert np.array_equal(mixed.parts["pair"][1], image[:, :, ::-1])
    assert not mixed.parts["pair"][1].flags.writeable


class Point(NamedTuple):
    x: int
    y: int


@pytest.mark.parametrize(
    "value",
    [
        object(),
        Point(1, 2),
        datetime.date(2019, 1, 1),
        np.array([object()], dtype=object),
        np.zeros(2, [("a", "i4")]),
        np.ma.masked_array([1], [True]),
        np.datetime64("2019-01-01"),
    ],
)
def test_a_type_without_codec_is_named_with_its_place(value):
    with pytest.raises(MessageError, match=r"keypoints\[0\] is of type") as caught:
        encode(Envelope("", {"keypoints": [value]}))
    assert caught.value.reason == "no codec"


def test_what_holds_itself_is_refused():
    endless: list[object] = []
    endless.append(endless)
    with pytest.raises(MessageError, match="holds itself") as caught:
        encode(Envelope("", {"endless": endless}))
    assert caught.value.reason == "too deep"


def test_the_deepest_allowed_nesting_comes_back():
    value: object = np.zeros(3)
    for _ in range(Limits().depth):
        value = {"deeper": value}
    assert same(decode(encode(Envelope("", {"v": value}))).parts["v"], value)


def test_lone_surrogates_are_refused_with_a_way_out():
    with pytest.raises(MessageError, match="surrogateescape"):
        encode(Envelope("", {"path": "\udc80"}))


def test_an_envelope_that_is_too_large_is_refused_by_the_sender():
    with pytest.raises(MessageError, match="limit") as caught:
        encode(Envelope("", {"image": np.zeros(2_000, np.uint8)}), limits=Limits(total_bytes=1_000))
    assert caught.value.reason == "too large"


def test_importing_wire_imports_neither_protobuf_nor_numpy():
    script = (
        "import sys, epypes.wire; epypes.wire.Envelope('x'); "
        "sys.exit(any(n in sys.modules for n in ('numpy', 'google.protobuf')))"
    )
    assert subprocess.run([sys.executable, "-c", script], timeout=60).returncode == 0


def test_nothing_comes_back_as_itself_wherever_it_stands(tmp_path):
    values = {"place": ep.Nothing, "places": [(1, 2), ep.Nothing], "by name": {"a": ep.Nothing, "b": None}}
    envelope = decode([bytes(frame) for frame in encode(Envelope("t", parts=values, attributes={"why": ep.Nothing}))])
    assert envelope.parts == values
    assert envelope.parts["place"] is envelope.parts["places"][1] is envelope.attributes["why"] is ep.Nothing
    save_sample(tmp_path / "s.npz", {"place": ep.Nothing}, values)
    inputs, outputs = load_sample(tmp_path / "s.npz")
    assert (inputs["place"], outputs) == (ep.Nothing, values)
