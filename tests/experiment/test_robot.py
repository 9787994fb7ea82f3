"""The robot takes the right answer, and never waits for ever."""

from __future__ import annotations

import math
import pickle
import queue
import threading
import time

import numpy as np
import pytest

from epypes.errors import ExperimentError
from epypes.experiment.nodes import encode_keypoints
from epypes.experiment.run import Robot
from epypes.run import Failure
from epypes.wire import Envelope, JustBytes, add_attribute, attributes, failure_event

TIMEOUT_S = 60.0
KEYPOINTS = np.ones((20, 4), np.float32)


@pytest.fixture
def robot_with():
    """Make a robot whose requests are answered with the items that a function makes of each."""
    threads = []

    def make(respond, **options):
        requests, inbox = queue.SimpleQueue(), queue.SimpleQueue()

        def answer_all():
            while (event := requests.get()) is not None:
                for item in respond(event):
                    inbox.put(item)

        thread = threading.Thread(target=answer_all, daemon=True)
        threads.append((thread, requests))
        thread.start()
        return Robot(requests, inbox, **{"timeout_s": TIMEOUT_S, **options})

    yield make
    for thread, requests in threads:
        requests.put(None)
        thread.join(TIMEOUT_S)


def answer(event, contents=None, **times) -> bytes:
    message = JustBytes(contents=encode_keypoints(KEYPOINTS) if contents is None else contents, id=event.id)
    for key, value in times.items():
        add_attribute(message, key, value)
    return message.SerializeToString()


def failed(event_id: str) -> Envelope:
    failure = Failure("nearest", ("t_vreq",), {}, LookupError("older than\nthe ring"), event_id, source="acquisition")
    return failure_event(failure)


def test_an_answer_brings_keypoints_times_and_how_long_it_took(robot_with):
    robot = robot_with(lambda event: [answer(event, t_vreq=attributes(event)["t_vreq"])])
    before, start = time.time(), time.perf_counter()
    came = robot.ask()
    assert np.array_equal(came.keypoints, KEYPOINTS)
    assert before <= came.attributes["t_vreq"] <= time.time()
    assert 0 < came.t_trip <= time.perf_counter() - start
    assert (came.failure, came.is_missing) == ("", False)


def test_a_robot_can_ask_for_any_time(robot_with):
    robot = robot_with(lambda event: [answer(event, t_vreq=attributes(event)["t_vreq"])])
    assert robot.ask(at=12.5).attributes["t_vreq"] == 12.5


def test_every_request_has_an_id_of_its_own(robot_with):
    robot = robot_with(lambda event: [answer(event)])
    assert len({robot.ask().id for _ in range(10)}) == 10


def test_late_answers_and_failures_are_counted_and_not_taken_for_those_of_the_next_request(robot_with):
    held = []

    def respond(event):
        held.append(event)
        if len(held) < 3:
            return []
        return [answer(held[0]), failed(held[1].id), answer(event, t=3.0)]

    robot = robot_with(respond, timeout_s=0.02)
    assert robot.ask().is_missing
    assert robot.ask().is_missing
    robot.timeout_s = TIMEOUT_S
    assert robot.ask().attributes == {"t": 3.0}
    assert robot.counts == {"late answer": 1, "late failure": 1}


def test_a_request_that_nobody_answers_ends_after_its_time_out(robot_with):
    robot = robot_with(lambda event: [], timeout_s=0.05)
    start = time.perf_counter()
    came = robot.ask()
    assert 0.05 <= time.perf_counter() - start < TIMEOUT_S
    assert came.failure == "no answer within 0.05 s"
    assert came.is_missing
    assert math.isnan(came.t_trip)


@pytest.mark.slow
def test_messages_that_are_no_answers_are_counted_and_do_not_prolong_the_wait(robot_with):
    given_up = threading.Event()

    def respond(event):
        # Until the robot has given up, but not for ever.
        end = time.monotonic() + TIMEOUT_S
        while not given_up.wait(0.01) and time.monotonic() < end:
            yield answer(event)[:-3]
            yield b"\xff\xff"

    robot = robot_with(respond, timeout_s=1.0)
    start = time.monotonic()
    assert robot.ask().is_missing
    given_up.set()
    assert time.monotonic() - start < TIMEOUT_S / 2
    assert robot.counts.total() > 1


def test_a_failure_is_the_answer_of_its_request_on_one_line(robot_with):
    robot = robot_with(lambda event: [failed(event.id)])
    came = robot.ask()
    assert came.failure == "acquisition, nearest: LookupError: older than the ring"
    assert math.isnan(came.t_trip)
    assert not came.is_missing
    assert not robot.counts


def test_a_failure_of_no_request_is_counted_by_what_it_says(robot_with):
    robot = robot_with(lambda event: [failed(""), answer(event)])
    assert robot.ask().failure == ""
    assert robot.counts == {"acquisition, nearest: LookupError: older than the ring": 1}


def test_the_end_of_a_process_ends_the_wait(robot_with):
    robot = robot_with(lambda event: [ExperimentError("vision", "The process of vision (7) was ended by SIGKILL.")])
    with pytest.raises(ExperimentError, match="SIGKILL") as error:
        robot.ask()
    assert error.value.name == "vision"


def test_a_pickled_answer_is_a_failure_unless_it_is_asked_for(robot_with):
    def respond(event):
        return [answer(event, pickle.dumps(KEYPOINTS))]

    came = robot_with(respond).ask()
    assert "The contents are a pickle" in came.failure
    assert came.keypoints is None
    assert np.array_equal(robot_with(respond, unsafe_pickle=True).ask().keypoints, KEYPOINTS)
