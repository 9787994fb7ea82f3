"""Messages between the nodes arrive as they were sent."""

from __future__ import annotations

import io
import pickle
import struct
from pathlib import Path

import numpy as np
import pytest

from epypes.errors import MessageError
from epypes.experiment.nodes import (
    decode_keypoints,
    encode_keypoints,
    images_of,
    time_of_request,
)
from epypes.wire import Envelope, Event, add_attribute, decode, encode

KEYPOINTS = np.arange(80, dtype=np.float32).reshape(20, 4) / 3


def request(**attributes) -> bytes:
    event = Event(type="vision_request", id="abc")
    for key, value in attributes.items():
        add_attribute(event, key, value)
    return event.SerializeToString()


def test_a_request_has_its_time():
    assert time_of_request(request(t_vreq=1234.5)) == 1234.5


@pytest.mark.parametrize("event", [b"", b"\xff\xff", request(), request(t_vreq="now"), request(t_vreq=3)])
def test_a_request_without_a_time_is_refused(event):
    with pytest.raises(MessageError):
        time_of_request(event)


def test_a_pair_comes_through_frames_as_it_was():
    images = {
        "image_1": np.full((50, 70), 9, np.uint8),
        "image_2": np.arange(50 * 70 * 3, dtype=np.uint8).reshape(50, 70, 3),
    }
    came = images_of(decode(encode(Envelope("epypes.experiment.pair", images))))
    assert all(np.array_equal(came[name], image) for name, image in images.items())


@pytest.mark.parametrize(
    "item", [b"bytes", Envelope(type="x"), Envelope(type="epypes.experiment.pair", parts={"image_1": np.zeros(3)})]
)
def test_what_is_no_pair_is_refused(item):
    with pytest.raises(MessageError, match="Vision takes pairs of images, not"):
        images_of(item)


@pytest.mark.parametrize("rows", [0, 1, 20])
def test_contents_are_the_coordinates_row_after_row(rows):
    contents = encode_keypoints(KEYPOINTS[:rows])
    assert contents == struct.pack(f"<{4 * rows}f", *KEYPOINTS[:rows].flat)
    assert np.array_equal(decode_keypoints(contents), KEYPOINTS[:rows])


def test_contents_of_a_view_are_in_the_order_of_its_rows():
    flipped = KEYPOINTS[::-1, ::-1]
    assert np.array_equal(decode_keypoints(encode_keypoints(flipped)), flipped)


def test_a_pickle_is_read_when_it_is_asked_for_by_its_name():
    pickled = encode_keypoints(KEYPOINTS, unsafe_pickle=True)
    assert pickled[:2] == b"\x80\x02", "protocol 2, which any peer reads"
    assert b"numpy.core" in pickled, "where numpy was in 2019"
    assert np.array_equal(decode_keypoints(pickled, unsafe_pickle=True), KEYPOINTS)
    with pytest.raises(MessageError, match="The contents are a pickle") as error:
        decode_keypoints(pickled)
    assert error.value.reason == "pickle"


class Trap:
    """Unpickled, it touches a file."""

    def __init__(self, canary: Path) -> None:
        self.canary = canary

    def __reduce__(self):
        return Path.touch, (self.canary,)


def npy_with_objects(trap: Trap) -> bytes:
    buffer = io.BytesIO()
    np.save(buffer, np.array([trap], dtype=object), allow_pickle=True)
    return buffer.getvalue()


@pytest.mark.parametrize("disguise", [pickle.dumps, npy_with_objects])
def test_a_poisoned_answer_runs_nothing(tmp_path, disguise):
    canary = tmp_path / "sprung"
    with pytest.raises(MessageError):
        decode_keypoints(disguise(Trap(canary)))
    assert not canary.exists()


@pytest.mark.parametrize("contents", [b"\x00", encode_keypoints(KEYPOINTS)[:-1], b"\x80\x02garbage"])
@pytest.mark.parametrize("unsafe_pickle", [False, True])
def test_broken_contents_are_refused(contents, unsafe_pickle):
    with pytest.raises(MessageError):
        decode_keypoints(contents, unsafe_pickle=unsafe_pickle)
