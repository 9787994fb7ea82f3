"""Does a service under load keep order and count, whatever is done to it?

A publisher in a process of its own sends numbered events, of which some kill the worker and some raise, while the worker is killed,
the publisher stopped, parameters changed, a bad version deployed and then a good one, and in the end the service told to stop.
"""

from __future__ import annotations

import os
import queue
import re
import signal
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

import epypes as ep
from epypes.errors import EpypesError
from tests.service.bundles import written_bundle
from tests.service.chaos_publisher import kind_of
from tests.service.processes import running
from tests.service.states import read_state

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]
ENOUGH = 100_000
WAIT_S = 60.0
SOURCE = """
import os
import time

import numpy as np

OFFSET = 0


def work(number, kind, gain):
    if kind == 1:
        os.kill(os.getpid(), 9)
    if kind == 2:
        raise ValueError(f"event {number} is spoilt")
    time.sleep(0.001)
    return np.array([number, gain, number * gain + OFFSET])


func_dict = {"work": work}
func_io = {"work": (("number", "kind", "gain"), "result")}
"""


def until(condition, what):
    """Wait for something that happens in other processes."""
    deadline = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline, f"{what} did not happen within {WAIT_S:g} s"
        time.sleep(0.01)


@pytest.fixture
def bundles(tmp_path):
    """Three versions: the first, one that does not compute what it recorded, and a good one."""

    def version(name, offset, recorded):
        sample = {"number": 3, "kind": 0}, {"result": np.array([3, 1, 3 + recorded])}
        return written_bundle(
            tmp_path / name,
            SOURCE.replace("OFFSET = 0", f"OFFSET = {offset}"),
            ("number", "kind"),
            ("result",),
            hyperparameters={"gain": 1},
            sample=sample,
        )

    return version("first", 0, 0), version("bad", 1, 0), version("good", 7, 7)


class Received:
    """What came out, and what it says of the service."""

    def __init__(self, subscriber, answers, failures):
        self.subscriber, self._answers, self._failures = subscriber, answers, failures
        self.answers, self.reported = [], []

    def look(self):
        for found, inbox in ((self.answers, self._answers), (self.reported, self._failures)):
            while not inbox.empty():
                found.append(inbox.get_nowait())

    def number(self):
        self.look()
        return sum(answer.failure is None for answer in self.answers)


@pytest.mark.parametrize("poison", [1_000, pytest.param(250, marks=pytest.mark.soak)])
def test_nothing_is_lost_uncounted_and_order_is_kept(bundles, poison):
    first, bad, good = bundles
    answers, failures = queue.SimpleQueue(), queue.SimpleQueue()
    options = ["--http", "http://127.0.0.1:0", "--threads", "2", "--mailbox-size", "64"]
    with running(first, *options) as service:
        assert service.ready.startswith("READY"), service.stderr.read()
        state = read_state(first)
        control = ep.connect(state.http)
        with (
            ep.ZMQSubscriber(state.pub, answers) as outlet,
            ep.ZMQSubscriber(state.failures, failures, topic="failure") as reports,
        ):
            outlet.wait_joined(WAIT_S)
            reports.wait_joined(WAIT_S)
            received = Received(outlet, answers, failures)
            publisher = subprocess.Popen(
                [sys.executable, "-m", "tests.service.chaos_publisher", state.sub, str(poison), str(ENOUGH), "3"],
                cwd=ROOT,
                stdout=subprocess.PIPE,
                text=True,
            )
            gains = {control.parameters().revision: 1}
            try:
                assert publisher.stdout.readline() == "JOINED\n"

                def pass_by(count):
                    goal = received.number() + count
                    until(lambda: received.number() >= goal, f"{count} more answers")

                pass_by(100)
                until(lambda: has_killed(control), "a worker to kill")
                pass_by(150)
                publisher.send_signal(signal.SIGSTOP)
                until(lambda: is_idle(control), "idleness while nobody publishes")
                publisher.send_signal(signal.SIGCONT)
                for gain in range(2, 18):
                    pass_by(10)
                    gains[changed(control, gain)] = gain
                with pytest.raises(EpypesError, match="differ"):
                    control.deploy(bad)
                pass_by(100)
                assert control.info()["bundle"] == str(first)
                digest = control.deploy(good)["digest"]
                pass_by(100)
                assert received.answers[-1].bundle_digest == digest
                gains[control.parameters().revision] = 1
                for gain in range(40, 48):
                    pass_by(10)
                    gains[changed(control, gain)] = gain
                counted = control.info()
                asked_to_stop = time.monotonic()
                service.send_signal(signal.SIGTERM)
                service.wait(timeout=WAIT_S)
                took_s = time.monotonic() - asked_to_stop
            finally:
                publisher.send_signal(signal.SIGCONT)
                publisher.terminate()
                sent = int(publisher.communicate(timeout=WAIT_S)[0].split()[-1])
            stopped = service.stdout.read()
            counts = {name: int(count) for name, count in re.findall(r"(\w+) (\d+)", stopped)}
            until(lambda: (received.look(), len(received.answers))[1] >= counts["received"], "the last answers")
    assert service.returncode == 0, stopped
    assert took_s < WAIT_S / 2
    assert counted["restarts"] >= 2
    check_counts(counts, sent, received)
    check_order(received)
    check_poison(received, sent, poison)
    check_revisions(received, gains, digest)


def has_killed(control):
    """Kill the worker; poison may just have done so."""
    worker = control.info()["worker_pid"]
    try:
        os.kill(worker, signal.SIGKILL)
    except (TypeError, ProcessLookupError):
        return False
    return True


def is_idle(control):
    counts = control.info()["counts"]
    return counts["waiting"] == counts["in_flight"] == 0


def changed(control, gain):
    """Change the parameter; a worker that has just died is waited for."""
    deadline = time.monotonic() + WAIT_S
    while True:
        try:
            return control.set(gain=gain).revision
        except ep.errors.ServiceError:
            assert time.monotonic() < deadline
            time.sleep(0.05)


def check_counts(counts, sent, received):
    """Every event that came in has come out once, as what it was counted."""
    assert counts["received"] == sum(counts[name] for name in ("answered", "failed", "dropped", "dead_letters")), counts
    assert counts["received"] <= sent
    assert counts["received"] > 700
    ids = Counter(answer.correlation_id for answer in received.answers)
    assert len(received.answers) == counts["received"]
    assert set(ids.values()) == {1}
    good = sum(answer.failure is None for answer in received.answers)
    assert good == counts["answered"]
    assert len(received.reported) == counts["failed"] + counts["dropped"] + counts["dead_letters"]
    assert sum(received.subscriber.lost.values()) == 0


def check_order(received):
    numbers = [int(answer.parts["result"][0]) for answer in received.answers if answer.failure is None]
    assert numbers == sorted(numbers)


def check_poison(received, sent, poison):
    """Events that kill are dead letters, those that raise are failures with their own exception."""
    said = {answer.correlation_id: answer.failure for answer in received.answers}
    for number in range(sent):
        failure = said.get(f"event-{number}", "never received")
        if failure == "never received" or (failure is not None and failure.function == "mailbox"):
            continue
        kind = kind_of(number, poison)
        assert (failure is None) == (kind == 0), (number, failure)
        if kind == 2:
            assert failure.exception == "ValueError"
            assert f"event {number} is spoilt" in failure.message


def check_revisions(received, gains, digest):
    """What an answer was computed with is what its revision and its bundle say."""
    for answer in received.answers:
        if answer.failure is None:
            number, gain, product = map(int, answer.parts["result"])
            assert gain == gains[answer.revision], answer
            assert product == number * gain + (7 if answer.bundle_digest == digest else 0)
    assert len({answer.revision for answer in received.answers}) > 15
