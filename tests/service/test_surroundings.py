"""A service whose disk fills up, or whose clock jumps, answers every event in order, and its counts add up."""

from __future__ import annotations

import json
import random
import resource
import subprocess
import textwrap
import urllib.request
from contextlib import nullcontext

import pytest

from tests.service.processes import lowered, running
from tests.service.served import check_counts, peer_at
from tests.service.states import read_state

pytestmark = [pytest.mark.slow, pytest.mark.soak]

ROUNDS, EVENTS = 50, 100
JUMPS = """
    import random
    import time

    now_s, now_ns = time.time, time.time_ns
    time.time = lambda: now_s() + random.uniform(-1e8, 1e8)
    time.time_ns = lambda: now_ns() + random.randrange(-10**17, 10**17)
"""


def test_on_a_disk_that_is_full_now_and_then_every_event_is_answered(acting, tmp_path):
    options = ("--http", "127.0.0.1:0", "--store", str(tmp_path / "events.sqlite"), "--mailbox-size", "200")
    with running(acting, *options, stderr=subprocess.DEVNULL) as process:
        full = lambda: lowered(resource.RLIMIT_FSIZE, 0, process.pid)  # noqa: E731 - made anew for each round
        ask_in_rounds(acting, lambda number: full() if number % 2 else nullcontext())
    assert process.returncode == 0


def test_while_the_clock_jumps_to_and_fro_every_event_is_answered(acting, tmp_path, monkeypatch):
    (tmp_path / "sitecustomize.py").write_text(textwrap.dedent(JUMPS))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    with running(acting, "--http", "127.0.0.1:0", "--mailbox-size", "200", stderr=subprocess.DEVNULL) as process:
        ask_in_rounds(acting, lambda _: nullcontext())
    assert process.returncode == 0


def ask_in_rounds(bundle, surroundings):
    """Send events of which some raise, each round in surroundings of its own; each has its answer."""
    state = read_state(bundle)
    with peer_at(state.sub, state.pub, state.failures) as peer:
        for number in range(ROUNDS):
            with surroundings(number):
                wanted = random.choices(["plain", "fail:wanted"], [9, 1], k=EVENTS)
                sent = [peer.send(what, index) for index, what in enumerate(wanted)]
                answers = peer.take(EVENTS)
            assert [answer.correlation_id for answer in answers] == sent
            assert [answer.failure is None for answer in answers] == [what == "plain" for what in wanted]
    with urllib.request.urlopen(state.http + "/v1/info", timeout=60) as said:
        info = json.load(said)
    check_counts(info["counts"])
    assert info["state"] == "READY"
    assert info["counts"]["received"] == ROUNDS * EVENTS
