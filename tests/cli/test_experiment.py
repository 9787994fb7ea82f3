"""``epypes experiment`` runs the paper's experiment, and leaves its table and figures."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading

import cv2
import numpy as np
import pandas as pd
import psutil
import pytest

pytestmark = pytest.mark.slow  # each runs the command

TIMEOUT_S = 60.0


@pytest.fixture(scope="module")
def cameras(tmp_path_factory):
    """Options for two cameras, whose image is small."""
    lot = np.random.default_rng(13)
    picture = cv2.resize(lot.integers(0, 256, (16, 20), np.uint8), (160, 128), interpolation=cv2.INTER_NEAREST)
    file = tmp_path_factory.mktemp("images") / "picture.png"
    assert cv2.imwrite(str(file), picture)
    return "--camera", file, "--camera", file, "--fps", 50


def test_one_command_runs_the_experiment_prints_its_times_and_leaves_figures(epypes, cameras, tmp_path):
    folder = tmp_path / "new" / "folder"
    done = epypes("experiment", "--layout", "one", "--requests", 4, "--experiments", 2, *cameras, "--out", folder)
    assert done.returncode == 0, done.stderr
    for words in ("Layout one over zeromq, in milliseconds", "paper's mode", "t_trip", "o_network", "vision.o_epypes"):
        assert words in done.stdout
    assert len(pd.read_csv(folder / "requests.csv")) == 8
    assert {path.name for path in folder.iterdir()} == {
        "requests.csv",
        "figure_14.svg",
        "figure_15.svg",
        "figure_16.svg",
    }
    assert all("<svg" in path.read_text() for path in folder.glob("*.svg"))
    assert "Left in" in done.stdout
    assert done.stderr == "", "progress is for terminals"


def test_transports_are_compared_in_one_table(epypes, cameras, tmp_path):
    transports = [word for name in ("zeromq", "dds", "zenoh") for word in ("--transport", name)]
    counts = ("--layout", "three", "--requests", 3, "--experiments", 1)
    done = epypes("experiment", *transports, *counts, *cameras, "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    title, heads, *rows = done.stdout.splitlines()[:5]
    assert title == "Transports, in milliseconds, CPU of all processes"
    assert " ".join(heads.split()) == "requests trip mode trip p99 network mode network p99 CPU per request"
    for row, name in zip(rows, ("zeromq", "dds", "zenoh"), strict=True):
        transport, requests, *times = row.split()
        assert (transport, requests) == (name, "3")
        assert all(0 < float(time) < 1e3 * TIMEOUT_S for time in times)
        assert pd.read_csv(tmp_path / name / "requests.csv")["t_trip"].gt(0).all()


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        (("--layout", "four"), "There is no layout 'four'. There are: paper, one, three."),
        (("--requests", 0), "requests must be a whole number from 1, not 0."),
        (("--experiments", 0), "experiments must be a whole number from 1, not 0."),
        (("--workers", 0), "workers must be a whole number from 1, not 0."),
        (("--fps", "nan"), "fps must be a number above 0, and at most 9223372036, not nan."),
        (("--timeout", 0), "timeout_s must be a number above 0, and at most 9223372036, not 0.0."),
        (("--timeout", "1e10"), "timeout_s must be a number above 0, and at most 9223372036, not 10000000000.0."),
        (("--timeout", "inf"), "timeout_s must be a number above 0, and at most 9223372036, not inf."),
        (("--camera", "9" * 20, "--camera", 1), f"No camera has the number {'9' * 20}. They go from 0 to 2147483647."),
        (("--camera", "left.png"), "cameras must be two"),
    ],
)
def test_what_makes_no_sense_is_one_line_and_exit_status_1(epypes, wrong, says):
    done = epypes("experiment", *wrong)
    assert done.returncode == 1
    assert done.stderr.startswith(f"epypes: {says}")
    assert len(done.stderr.splitlines()) == 1


def test_a_folder_that_cannot_be_made_is_told_before_anything_runs(epypes, tmp_path):
    (tmp_path / "file").write_text("")
    done = epypes("experiment", "--out", tmp_path / "file" / "folder")
    assert done.stderr.startswith("epypes: ")
    assert "folder can't be used: Not a directory." in done.stderr


def test_requests_that_failed_are_counted_with_their_reason(epypes, tmp_path):
    deep = tmp_path / "deep.png"
    assert cv2.imwrite(str(deep), np.full((99, 99), 9_999, np.uint16)), "16 bit, which ORB does not take"
    cameras = ("--camera", deep, "--camera", deep)
    done = epypes("experiment", "--layout", "one", "--requests", 2, "--experiments", 1, *cameras, "--out", tmp_path)
    assert done.returncode == 0, done.stderr
    assert "2 of 2 requests failed: vision, detect_and_describe_features_1: error:" in done.stderr
    assert len(done.stderr.splitlines()) == 1
    assert len(pd.read_csv(tmp_path / "requests.csv")) == 2


# A command that says when a request was answered, and then waits.
ANSWERING = """
import sys, time
from epypes.cli import main
from epypes.experiment.run import Robot
ask = Robot.ask
def answered(robot):
    answer = ask(robot)
    print("answered", flush=True)
    time.sleep(60)
    return answer
Robot.ask = answered
main(sys.argv[1:])
"""


@pytest.mark.slow
@pytest.mark.parametrize("layout", ["paper", "one", "three"])
def test_ctrl_c_ends_everything_without_a_traceback(layout):
    command = [sys.executable, "-c", ANSWERING, "experiment", "--layout", layout, "--requests", "100000"]
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, **pipes, start_new_session=True) as process:
        watchdog = threading.Timer(TIMEOUT_S, process.kill)
        watchdog.start()
        mine = psutil.Process(process.pid)
        # Before that, Ctrl+C may be Python's own: one that interrupts the exec of a text, as an import of a dataclass is
        # made of, ends the process by the signal, whatever status it has asked for.
        assert process.stdout.readline() == "answered\n"
        children = mine.children()
        assert len(children) == {"paper": 1, "one": 0, "three": 2}[layout]
        # To all of its group, as a terminal does.
        os.killpg(process.pid, signal.SIGINT)
        out, err = process.communicate()
        watchdog.cancel()
    assert process.returncode == 130, err
    assert err.strip() == out == ""
    _, alive = psutil.wait_procs(children, timeout=TIMEOUT_S)
    assert not alive
