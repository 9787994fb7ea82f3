"""A recorded sample is a file that numpy can open, with the same bytes every time."""

from __future__ import annotations

import json
import pickle
import zipfile

import numpy as np
import pytest

from epypes.errors import MessageError
from epypes.wire import load_sample, save_sample
from epypes.wire.samples import read_sample

INPUTS = {"image": np.arange(12, dtype=np.uint8).reshape(3, 4), "canny_lo": 70}
OUTPUTS = {"keypoints": [np.ones(2), {"size of it": np.zeros(1)}], "edges": np.eye(3, dtype=bool), "blob": b"\1\2"}


def test_numpy_alone_can_open_it(tmp_path):
    path = tmp_path / "0001.npz"
    save_sample(path, INPUTS, OUTPUTS)
    with np.load(path, allow_pickle=False) as archive:
        assert np.array_equal(archive["inputs.image"], INPUTS["image"])
        assert archive["outputs.edges"].dtype == bool
        assert set(archive.files) >= {"outputs.keypoints.0", "outputs.keypoints.1.size_of_it", "outputs.blob"}
        assert '"integer": "70"' in str(archive["description"])


def test_the_same_values_give_the_same_bytes(tmp_path, monkeypatch):
    save_sample(tmp_path / "a.npz", INPUTS, OUTPUTS)
    monkeypatch.setenv("TZ", "Asia/Tokyo")
    save_sample(tmp_path / "b.npz", INPUTS, OUTPUTS)
    assert (tmp_path / "a.npz").read_bytes() == (tmp_path / "b.npz").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.npz") as archive:
        assert {info.date_time for info in archive.infolist()} == {(1980, 1, 1, 0, 0, 0)}


def test_names_that_look_alike_keep_their_own_entries(tmp_path):
    values = {"a b": np.zeros(1), "a_b": np.ones(1), "a/b": np.full(1, 2.0)}
    save_sample(tmp_path / "s.npz", values, {})
    inputs, outputs = load_sample(tmp_path / "s.npz")
    assert {name: value.tolist() for name, value in inputs.items()} == {"a b": [0.0], "a_b": [1.0], "a/b": [2.0]}
    assert outputs == {}


def test_a_type_without_codec_is_named(tmp_path):
    with pytest.raises(MessageError, match="keypoints is of type"):
        save_sample(tmp_path / "s.npz", {}, {"keypoints": object()})
    assert not (tmp_path / "s.npz").exists()


def test_every_broken_file_is_a_message_error(tmp_path):
    path = tmp_path / "s.npz"
    save_sample(path, INPUTS, OUTPUTS)
    good = path.read_bytes()
    for length in range(0, len(good), 97):
        path.write_bytes(good[:length])
        with pytest.raises(MessageError) as caught:
            load_sample(path)
        assert caught.value.reason == "bad sample"
    reasons = set()
    for place in range(0, len(good), 41):
        changed = bytearray(good)
        changed[place] ^= 0xFF
        path.write_bytes(changed)
        try:
            load_sample(path)
        except MessageError as error:
            reasons.add(error.reason)
    assert reasons == {"bad sample"}


@pytest.mark.parametrize("description", ["[]", "{}", '{"format": 2}', '{"format": 1, "arrays": ["x"]}', "no json"])
def test_a_file_with_another_description_is_refused(tmp_path, description):
    np.savez(tmp_path / "s.npz", description=np.array(description))
    with pytest.raises(MessageError, match="is no sample"):
        load_sample(tmp_path / "s.npz")


def test_a_missing_file_and_a_pickle_are_refused(tmp_path):
    with pytest.raises(MessageError):
        load_sample(tmp_path / "missing.npz")
    (tmp_path / "p.npz").write_bytes(pickle.dumps({"a": 1}))
    with pytest.raises(MessageError):
        load_sample(tmp_path / "p.npz")


def test_a_sample_says_which_tokens_are_rgb_and_gives_them_as_they_were(tmp_path):
    image = np.arange(2 * 3 * 3, dtype=np.uint8).reshape(2, 3, 3)
    save_sample(tmp_path / "s.npz", {"left": image}, {"right": image}, rgb=["right"])
    with np.load(tmp_path / "s.npz", allow_pickle=False) as archive:
        described = json.loads(str(archive["description"]))
    encodings = [described[side][0][1]["image"]["encoding"] for side in ("inputs", "outputs")]
    assert encodings == ["bgr8", "rgb8"]
    (inputs, outputs) = load_sample(tmp_path / "s.npz")
    assert np.array_equal(inputs["left"], image)
    assert np.array_equal(outputs["right"], image)


def test_the_state_that_a_run_began_with_and_left_stands_beside_its_tokens(tmp_path):
    path = tmp_path / "s.npz"
    before, after = {"total": np.zeros(3), "inner.seen": None}, {"total": np.ones(3), "inner.seen": [1]}
    save_sample(path, INPUTS, OUTPUTS, state=before, state_after=after)
    sample = read_sample(path)
    assert sample.state["total"].tolist() == [0.0, 0.0, 0.0]
    assert (sample.state["inner.seen"], sample.state_after["inner.seen"]) == (None, [1])
    assert [side.keys() for side in load_sample(path)] == [INPUTS.keys(), OUTPUTS.keys()]
    with np.load(path, allow_pickle=False) as archive:
        assert archive["state_after.total"].tolist() == [1.0, 1.0, 1.0]
    save_sample(path, INPUTS, OUTPUTS)
    assert (read_sample(path).state, read_sample(path).state_after) == ({}, {})
