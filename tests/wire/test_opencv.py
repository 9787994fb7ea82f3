"""Objects of OpenCV come back as they were; what can't be one is refused."""

from __future__ import annotations

import subprocess
import sys

import cv2
import numpy as np
import pytest

from epypes.errors import MessageError
from epypes.wire import Envelope, Limits, decode, encode, load_sample, save_sample
from epypes.wire.protobuf import message_class


def back(value, tmp_path, inline_below=8192):
    """Return a value as a message and as a sample give it back."""
    frames = [bytes(frame) for frame in encode(Envelope("", {"value": value}), inline_below=inline_below)]
    save_sample(tmp_path / "s.npz", {"value": value}, {})
    return decode(frames).parts["value"], load_sample(tmp_path / "s.npz")[0]["value"]


def record_fields(record):
    if isinstance(record, cv2.DMatch):
        return (record.queryIdx, record.trainIdx, record.imgIdx, record.distance)
    return (*record.pt, record.size, record.angle, record.response, record.octave, record.class_id)


def plain(value):
    """Return a value in which records are their fields."""
    if isinstance(value, list | tuple):
        return type(value)(map(plain, value))
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    return (type(value).__name__, record_fields(value)) if isinstance(value, cv2.KeyPoint | cv2.DMatch) else value


def found(count):
    image = np.random.default_rng(5).integers(0, 255, (200, 200), np.uint8)
    return cv2.ORB_create(count).detectAndCompute(image, None)


POINT, MATCH = cv2.KeyPoint(1.5, -2, 31, 359.9, 1e-30, 2**24 + 1, -1), cv2.DMatch(2**31 - 1, -(2**31), 0, 0.1)


@pytest.mark.parametrize("inline_below", [0, 8192])
@pytest.mark.parametrize(
    "value",
    [
        POINT,
        MATCH,
        [POINT, POINT],
        (MATCH,),
        [POINT, MATCH, 1],
        ((MATCH, MATCH), (MATCH,), ()),
        [[POINT], (POINT,)],
        [(), (MATCH,)],
        {"left": [POINT], "right": ([MATCH], [])},
        cv2.KeyPoint(float("nan"), float("inf"), 0),
    ],
)
def test_keypoints_and_matches_come_back_in_what_held_them(value, inline_below, tmp_path):
    for again in back(value, tmp_path, inline_below):
        assert repr(plain(again)) == repr(plain(value))


def test_hundreds_of_keypoints_are_one_tensor_that_numpy_alone_can_open(tmp_path):
    points, descriptors = found(300)
    pairs = cv2.BFMatcher(cv2.NORM_HAMMING).knnMatch(descriptors, descriptors, 2)
    frames = encode(Envelope("", {"points": points, "pairs": pairs}))
    assert len(points) > 200
    assert [len(frame) for frame in frames[2:]] == [len(points) * 56, len(points) * 64]
    assert len(frames[1]) < 500
    save_sample(tmp_path / "s.npz", {"points": points}, {"pairs": pairs})
    with np.load(tmp_path / "s.npz", allow_pickle=False) as sample:
        assert set(sample.files) == {"description", "inputs.points", "outputs.pairs"}
        assert sample["inputs.points"][7, :2].tolist() == list(points[7].pt)


@pytest.mark.parametrize(
    ("value", "instead"),
    [
        ({}.keys(), r"list\(value\)"),
        (np.array([None]), r"value\.tolist\(\)"),
        (np.zeros(2, [("a", "i4")]), r"\{name: value\[name\] for name in value.dtype.names\}"),
        (np.ma.masked_array([1]), r"value\.filled\(\)"),
        (object(), "Make it None, a bool"),
    ],
)
def test_a_refused_type_says_what_to_return_instead(value, instead):
    with pytest.raises(MessageError, match=f"Return {instead} instead" if instead[0] != "M" else instead):
        encode(Envelope("", {"v": value}))


def records(rows, kind="KeyPoint", outer=1, inner=0, counts=()):
    message = message_class("epypes.v1.Envelope")()
    content = message.parts.add(name="v").value.records
    array = np.array(rows, "<f8")
    content.type, content.outer, content.inner = kind, outer, inner
    content.counts.extend(counts)
    content.rows.dtype, content.rows.inline = "<f8", array.tobytes()
    content.rows.shape.extend(array.shape)
    return [b"/", message.SerializeToString()]


ROW = [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0]


@pytest.mark.parametrize(
    "frames",
    [
        records([ROW], kind="imread"),
        records([ROW[:6]]),
        records([[*ROW[:5], 0.5, 7.0]]),
        records([[*ROW[:5], 2.0**31, 7.0]]),
        records([[1e300, *ROW[1:]]]),
        records([[0.1, *ROW[1:]]]),
        records([[*ROW[:6], float("nan")]]),
        records([ROW, ROW], outer=0),
        records([ROW], outer=7),
        records([ROW], inner=2, counts=[2]),
        records([ROW], counts=[1]),
        records([ROW], outer=0, inner=1, counts=[1]),
    ],
)
def test_rows_that_are_no_objects_are_refused(frames):
    with pytest.raises(MessageError) as caught:
        decode(frames)
    assert caught.value.reason == "bad record"


def test_more_objects_than_values_may_be_are_refused_before_one_is_made():
    with pytest.raises(MessageError) as caught:
        decode(records([ROW] * 50), Limits(values=40))
    assert caught.value.reason == "too many values"


def test_a_set_with_an_item_twice_or_a_list_in_it_is_refused():
    for items in ([1, 1], [[]]):
        message = message_class("epypes.v1.Envelope")()
        content = message.parts.add(name="v").value.set
        for item in items:
            entry = content.items.add()
            entry.list.SetInParent() if item == [] else setattr(entry, "integer", item)
        with pytest.raises(MessageError) as caught:
            decode([b"/", message.SerializeToString()])
        assert caught.value.reason == "bad key"


@pytest.mark.slow
def test_the_bytes_of_a_set_do_not_depend_on_the_seed_of_hashes():
    code = (
        "import sys; from epypes.wire import Envelope, encode; "
        "print(encode(Envelope('', id='x', parts={'v': {'a', 'b', 'c', frozenset({'d', 'e'}), b'f', None}}))[1].hex())"
    )
    outputs = {
        subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True, env={"PYTHONHASHSEED": seed}
        ).stdout
        for seed in ("0", "1", "2")
    }
    assert len(outputs) == 1


def test_what_is_read_where_opencv_is_missing_says_so(monkeypatch):
    points = encode(Envelope("", {"v": [POINT]}))
    monkeypatch.setitem(sys.modules, "cv2", None)
    with pytest.raises(MessageError, match="pip install opencv-python-headless"):
        decode(points)
