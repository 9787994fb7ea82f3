"""Acquisition and vision answer, with their times, whatever comes."""

from __future__ import annotations

import queue
import time

import cv2
import numpy as np
import pytest

from epypes.experiment.nodes import COMPONENTS, Settings, Vision, decode_keypoints
from epypes.run import Failure
from epypes.wire import Envelope, Event, add_attribute, attributes

TIMES = ("t_react", "t_fin_start", "t_fin_end", "t_fout_start", "t_fout_end", "t_pub")
TIMEOUT_S = 60.0


def request(at: float, request_id: str = "abc") -> bytes:
    event = Event(type="vision_request", id=request_id)
    add_attribute(event, "t_vreq", at)
    return event.SerializeToString()


def pair_of(images, attributes=None) -> Envelope:
    parts = dict(zip(("image_1", "image_2"), images, strict=True))
    return Envelope("epypes.experiment.pair", parts, "abc", attributes=attributes or {})


@pytest.fixture
def queues():
    return queue.SimpleQueue(), queue.SimpleQueue()


@pytest.fixture
def acquisition(images, queues):
    node = COMPONENTS["acquisition"](*queues, Settings(images, fps=50.0))
    failures = queue.SimpleQueue()
    node.on_error = failures.put
    node.failures = failures
    with node:
        assert node.wait_until_ready(TIMEOUT_S)
        yield node


def ordered(times, name):
    stamps = [times[f"{name}.{key}"] for key in TIMES]
    return stamps == sorted(stamps) and times[f"{name}.t_p"] > times[f"{name}.o_cg"] > 0


def test_a_request_is_answered_with_the_pair_nearest_to_its_time(acquisition, images, queues):
    q_in, q_out = queues
    before, now = time.time(), time.time()
    q_in.put(request(now))
    pair = q_out.get(timeout=TIMEOUT_S)
    assert list(pair.parts) == ["image_1", "image_2"]
    for came, file in zip(pair.parts.values(), images, strict=True):
        assert np.array_equal(came, cv2.imread(file, cv2.IMREAD_UNCHANGED))
    assert (pair.id, pair.attributes["t_vreq"]) == ("abc", now)
    assert ordered(pair.attributes, "acquisition")
    assert before <= pair.attributes["acquisition.t_react"] <= pair.attributes["acquisition.t_pub"] <= time.time()


def test_a_request_older_than_the_ring_is_a_failure_with_its_id(acquisition, queues):
    q_in, q_out = queues
    q_in.put(request(time.time() - 3600, "long ago"))
    failure = acquisition.failures.get(timeout=TIMEOUT_S)
    assert isinstance(failure, Failure)
    assert (failure.function, failure.event_id, failure.source) == ("nearest", "long ago", "acquisition")
    assert type(failure.exception).__name__ == "FrameUnavailable"
    assert q_out.empty()
    q_in.put(request(time.time(), "now"))
    assert q_out.get(timeout=TIMEOUT_S).id == "now"


@pytest.mark.parametrize(("fps", "is_answered"), [(50.0, False), (0.2, True)])
def test_a_slow_camera_is_no_dead_one(images, queues, fps, is_answered):
    q_in, _ = queues
    said = queue.SimpleQueue()
    node = COMPONENTS["acquisition"](q_in, said, Settings(images, fps=fps))
    node.on_error = said.put
    with node:
        assert node.wait_until_ready(TIMEOUT_S)
        q_in.put(request(time.time() + 3, "in 3 s"))
        assert isinstance(said.get(timeout=TIMEOUT_S), Envelope) is is_answered


def test_what_is_no_request_is_a_failure_and_the_next_one_is_answered(acquisition, queues):
    q_in, q_out = queues
    q_in.put(b"\xff\xff")
    assert acquisition.failures.get(timeout=TIMEOUT_S).function == "f_in"
    q_in.put(request(time.time()))
    assert q_out.get(timeout=TIMEOUT_S).id == "abc"


def test_a_camera_that_fails_while_it_runs_is_reported(acquisition):
    acquisition._report_camera(1, OSError("unplugged"))
    failure = acquisition.failures.get(timeout=TIMEOUT_S)
    assert str(failure) == "camera 1: OSError: unplugged"
    assert failure.source == "acquisition"


def test_vision_answers_a_pair_with_its_keypoints_and_the_times_of_both(pictures, queues):
    q_in, q_out = queues
    times = {"t_vreq": 1.5, "acquisition.t_pub": 2.5}
    with Vision(q_in, q_out, Settings()):
        q_in.put(pair_of(pictures, times))
        answer = q_out.get(timeout=TIMEOUT_S)
    said = attributes(answer)
    assert answer.id == "abc"
    assert times.items() <= said.items()
    assert set(said) == {*times, *(f"vision.{key}" for key in (*TIMES, "t_p", "o_cg"))}
    assert ordered(said, "vision")
    keypoints = decode_keypoints(answer.contents)
    assert keypoints.shape == (20, 4)
    assert np.allclose(keypoints[:, :2], keypoints[:, 2:]), "of two equal images"


def test_vision_fails_with_the_id_of_its_pair(queues):
    q_in, q_out = queues
    failures = queue.SimpleQueue()
    node = Vision(q_in, q_out, Settings())
    node.on_error = failures.put
    with node:
        q_in.put(pair_of((np.zeros((9, 9), complex),) * 2))
        failure = failures.get(timeout=TIMEOUT_S)
    assert failure.function == "detect_and_describe_features_1"
    assert failure.event_id == "abc"
    assert q_out.empty()


def test_contents_are_pickled_when_a_peer_of_2019_wants_them(pictures, queues):
    q_in, q_out = queues
    with Vision(q_in, q_out, Settings(unsafe_pickle=True)):
        q_in.put(pair_of(pictures))
        contents = q_out.get(timeout=TIMEOUT_S).contents
    assert decode_keypoints(contents, unsafe_pickle=True).shape == (20, 4)
    assert contents.startswith(b"\x80")


def test_functions_side_by_side_find_the_same(pictures, queues):
    q_in, q_out = queues
    found = []
    for workers in (1, 2):
        with Vision(q_in, q_out, Settings(workers=workers)):
            q_in.put(pair_of(pictures))
            found.append(q_out.get(timeout=TIMEOUT_S).contents)
    assert found[0] == found[1]
