from __future__ import annotations

import random
import struct
import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from epypes.errors import MessageError
from epypes.service.supervision.packing import pack, pack_event, unpack, unpack_event
from epypes.wire import Envelope, encode
from tests.wire.mutants import mutate_bytes

HEAD = struct.Struct("<4sI")


@pytest.mark.fuzz
@given(st.lists(st.binary(max_size=200), max_size=20))
def test_what_was_packed_is_unpacked_frame_by_frame(frames):
    unpacked = unpack(pack(frames))
    assert [bytes(frame) for frame in unpacked] == frames
    assert all(frame.readonly for frame in unpacked)


@pytest.mark.fuzz
@given(st.lists(st.binary(max_size=50), max_size=5), st.binary(min_size=1, max_size=9), st.integers(1, 60))
def test_bytes_too_many_or_too_few_are_refused(frames, more, fewer):
    block = pack(frames)
    with pytest.raises(MessageError):
        unpack(block + more)
    with pytest.raises(MessageError):
        unpack(block[:-fewer])


def test_frames_are_views_of_the_block_and_nothing_is_copied():
    block = bytearray(pack([b"a" * 10, np.arange(3, dtype=np.uint8)]))
    frames = unpack(block)
    block[-1] = 77
    assert list(frames[1]) == [0, 1, 77]


def test_ten_thousand_mutants_of_a_block_are_refused_or_read_and_nothing_else_is_raised():
    rng = random.Random(7)
    envelope = Envelope(type="x", parts={"image": np.arange(60_000, dtype=np.uint8).reshape(200, 300), "k": 3})
    block, event = pack([bytes(frame) for frame in encode(envelope)]), pack_event(envelope)
    reasons = set()
    for number in range(10_000):
        read, whole = ((unpack, block), (unpack_event, event))[number % 2]
        # What matters is at the beginning: of most mutants the rest stays as it is.
        cut = len(whole) if number % 5 == 0 else 60
        mutant = mutate_bytes(whole[:cut], rng) + whole[cut:]
        try:
            read(mutant)
        except MessageError as error:
            reasons.add(error.reason)
    assert {"no frames", "wrong size", "too large", "too many frames", "no event"} <= reasons


@pytest.mark.parametrize(
    ("block", "reason"),
    [
        (b"", "cut off"),
        (b"EPF1", "cut off"),
        (HEAD.pack(b"EPF2", 0), "no frames"),
        (HEAD.pack(b"EPF1", 2**32 - 1), "too many frames"),
        (HEAD.pack(b"EPF1", 1) + struct.pack("<Q", 2**63), "too large"),
        (HEAD.pack(b"EPF1", 2) + struct.pack("<QQ", 2**64 - 1, 2**64 - 1), "too large"),
        (HEAD.pack(b"EPF1", 1) + struct.pack("<Q", 200 * 1024**2), "wrong size"),
        ("text", "no bytes"),
        (np.zeros((4, 4))[::2], "no bytes"),
    ],
)
def test_what_a_block_only_claims_to_hold_is_refused_before_anything_is_allocated(block, reason):
    tracemalloc.start()
    try:
        with pytest.raises(MessageError) as error:
            unpack(block)
        assert tracemalloc.get_traced_memory()[1] < 100_000
    finally:
        tracemalloc.stop()
    assert error.value.reason == reason


def test_what_could_not_be_unpacked_is_not_packed():
    with pytest.raises(MessageError, match=r"2,000 frames; the limit is 1,026"):
        pack([b""] * 2_000)
    with pytest.raises(MessageError, match="the limit is"):
        pack([bytes(2**28), b"1"])


def test_an_event_comes_back_whole_whether_it_is_an_envelope_or_bytes():
    image = np.arange(30_000, dtype=np.uint16).reshape(100, 100, 3)
    envelope = unpack_event(pack_event(Envelope(type="x", parts={"image": image}, id="7", rgb=["image"])))
    assert (envelope.type, envelope.id, envelope.rgb) == ("x", "7", {"image"})
    assert np.array_equal(envelope.parts["image"], image)
    assert unpack_event(pack_event(b"r\x00v")) == b"r\x00v"
    assert unpack_event(pack_event(b"")) == b""
