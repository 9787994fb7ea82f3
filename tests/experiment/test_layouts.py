"""Layouts differ in their wiring alone, and everything ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import psutil
import pytest

from epypes.errors import ExperimentError, ImageFileError
from epypes.experiment.layouts import LAYOUTS, ChildStation, running
from epypes.experiment.nodes import Settings
from epypes.experiment.run import Robot
from epypes.pipeline import FullPipeline

TIMEOUT_S = 60.0
LOCAL = "tcp://127.0.0.1:*"
IN_CHILDREN = pytest.mark.slow


def settings_of(images) -> Settings:
    return Settings(images, fps=50.0)


def robot_of(system, timeout_s=TIMEOUT_S) -> Robot:
    return Robot(system.requests, system.inbox, timeout_s=timeout_s)


def children() -> list[psutil.Process]:
    """Those of the experiment; tests of other things have children, too."""
    found = psutil.Process().children(recursive=True)
    return [child for child in found if child.is_running() and "epypes.experiment.layouts" in _command(child)]


def _command(child: psutil.Process) -> list[str]:
    try:
        return child.cmdline()
    except psutil.Error:  # it has ended meanwhile
        return []


def test_the_layouts_are_those_of_the_paper_and_the_two_beside_it():
    assert dict(LAYOUTS) == {
        "paper": (("acquisition", "vision"),),
        "one": (),
        "three": (("acquisition",), ("vision",)),
    }


def test_in_one_process_a_request_is_answered(images):
    before = set(threading.enumerate())
    with running(LAYOUTS["one"], settings_of(images)) as system:
        answers = [robot_of(system).ask() for _ in range(3)]
        assert all(isinstance(node, FullPipeline) for node in system.stations[0].nodes)
    assert [answer.failure for answer in answers] == [""] * 3
    assert set(threading.enumerate()) <= before


@IN_CHILDREN
def test_answers_are_the_same_in_every_layout(images):
    keypoints = {}
    for name, layout in LAYOUTS.items():
        with running(layout, settings_of(images)) as system:
            answer = robot_of(system).ask()
            assert answer.failure == ""
            keypoints[name] = answer.keypoints
    assert np.array_equal(keypoints["paper"], keypoints["one"])
    assert np.array_equal(keypoints["paper"], keypoints["three"])
    assert keypoints["paper"].shape == (20, 4)


@IN_CHILDREN
@pytest.mark.parametrize("layout", LAYOUTS)
def test_a_request_for_a_time_long_ago_is_a_failure_and_the_next_one_is_answered(layout, images):
    with running(LAYOUTS[layout], settings_of(images)) as system:
        robot = robot_of(system)
        assert "acquisition, nearest: FrameUnavailable" in robot.ask(at=time.time() - 3600).failure
        assert robot.ask().failure == ""
        assert not robot.counts


@IN_CHILDREN
@pytest.mark.parametrize("layout", ["paper", "three"])
def test_a_vision_process_that_is_killed_ends_the_wait_with_an_error_that_names_it(layout, images):
    with running(LAYOUTS[layout], settings_of(images)) as system:
        robot = robot_of(system)
        robot.ask()
        victim = system.stations[-1]
        os.kill(victim.pid, signal.SIGKILL)
        start = time.monotonic()
        with pytest.raises(ExperimentError, match=rf"The process of .*vision \({victim.pid}\) was ended by SIGKILL"):
            # The first one may still be answered.
            [robot.ask() for _ in range(10)]
        assert time.monotonic() - start < TIMEOUT_S
    assert not children()


@IN_CHILDREN
def test_a_vision_process_that_is_stopped_is_a_request_without_answer(images):
    with running(LAYOUTS["three"], settings_of(images)) as system:
        robot = robot_of(system, timeout_s=1.0)
        robot.ask()
        os.kill(system.stations[-1].pid, signal.SIGSTOP)
        answers = [robot.ask() for _ in range(2)]
        os.kill(system.stations[-1].pid, signal.SIGCONT)
        robot.timeout_s = TIMEOUT_S
        assert answers[-1].is_missing
        assert robot.ask().failure == ""
        assert robot.counts["late answer"] >= 1


@IN_CHILDREN
def test_no_process_outlives_its_parent_however_that_ends(images):
    code = (
        "import sys; from epypes.experiment.layouts import LAYOUTS, running\n"
        "from epypes.experiment.nodes import Settings\n"
        f"with running(LAYOUTS['three'], Settings({images!r}, 50.0)) as system:\n"
        "    print(*(station.pid for station in system.stations), flush=True); sys.stdin.read()"
    )
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, "-c", code], **pipes) as parent:
        orphans = [psutil.Process(int(pid)) for pid in parent.stdout.readline().split()]
        assert len(orphans) == 2
        parent.kill()
    _, alive = psutil.wait_procs(orphans, timeout=TIMEOUT_S)
    assert not alive


@IN_CHILDREN
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM])
def test_a_process_that_hangs_while_it_starts_ends_with_its_parent(end, tmp_path):
    pipe = tmp_path / "camera"
    os.mkfifo(pipe)
    code = (
        "from epypes.experiment.layouts import ChildStation\n"
        "from epypes.experiment.nodes import Settings\n"
        f"station = ChildStation(['acquisition'], Settings(({str(pipe)!r},) * 2), {LOCAL!r}, print)\n"
        "print(station.pid, flush=True); station.start('tcp://127.0.0.1:1')"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as parent:
        orphan = psutil.Process(int(parent.stdout.readline()))
        writer = opened_by_both(pipe)
        parent.send_signal(end)
    try:
        orphan.wait(TIMEOUT_S)
    finally:
        os.close(writer)


def opened_by_both(pipe) -> int:
    """Return a named pipe's end for writing, when another process has opened it for reading."""
    deadline_s = time.monotonic() + TIMEOUT_S
    while True:
        try:
            return os.open(pipe, os.O_WRONLY | os.O_NONBLOCK)
        except OSError:
            assert time.monotonic() < deadline_s, "no process reads"
            threading.Event().wait(0.02)


@IN_CHILDREN
def test_a_process_that_cannot_start_is_an_error_with_the_reason(tmp_path):
    missing = str(tmp_path / "nothing.png")
    with (
        pytest.raises(ExperimentError, match=r"ended with exit status 1: ImageFileError: .*nothing\.png") as error,
        running(LAYOUTS["three"], Settings((missing, missing))),
    ):
        pass
    assert error.value.name == "acquisition"
    assert "nothing.png" in error.value.printed
    assert not children()


def test_a_camera_that_cannot_be_opened_is_an_error_at_once_in_one_process(tmp_path):
    before = set(threading.enumerate())
    with pytest.raises(ImageFileError), running(LAYOUTS["one"], Settings((str(tmp_path / "nothing.png"),) * 2)):
        pass
    assert set(threading.enumerate()) <= before


@IN_CHILDREN
def test_a_process_ends_before_it_was_started_and_twice(images):
    ended = []
    station = ChildStation(["vision"], settings_of(images), LOCAL, ended.append)
    station.stop()
    station.stop()
    assert not children()
    assert not ended, "it was asked to"


@IN_CHILDREN
def test_a_process_that_does_not_end_by_itself_is_killed(images):
    station = ChildStation(["vision"], settings_of(images), LOCAL, lambda error: None)
    os.kill(station.pid, signal.SIGSTOP)
    start = time.monotonic()
    station.stop(timeout_s=0.2)
    assert time.monotonic() - start < TIMEOUT_S
    assert not children()
