"""Replicas as they are served, on a real broker."""

from __future__ import annotations

import subprocess
import sys

import pytest

import epypes as ep
from epypes.errors import ServiceError
from tests.brokers.traffic import Reader, event, until
from tests.service.replicated import control, promoted, replicas

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def bundle(tmp_path_factory):
    return promoted(tmp_path_factory.mktemp("group"))


def status(url):
    """Return what ``epypes status`` prints."""
    done = subprocess.run(
        [sys.executable, "-m", "epypes.cli", "status", url], capture_output=True, text=True, timeout=60, check=True
    )
    return done.stdout


def test_one_address_tells_of_all_replicas_whoever_is_killed(bundle, nats):
    sub, pub = nats.address("told.events", create=True), nats.address("told.answers", create=True)
    outbox = ep.Mailbox("block")
    with (
        replicas(bundle, sub, pub) as members,
        Reader(pub) as reader,
        ep.Publisher(sub, outbox),
        control(members[0]) as first,
        control(members[2]) as third,
    ):
        until(lambda: first.group()["replicas"] == 3, first.group)
        for number in range(90):
            outbox.put(event(number))
        until(lambda: reader.look() == 90, lambda: f"{reader.look()} answers")
        until(lambda: first.group()["counts"]["answered"] == 90, first.group)
        assert first.set(gain=5).revision == 1
        until(lambda: third.parameters().revision == 1, third.group)
        said = status(first.url)
        assert "Group: replicas 3, ready 3" in said
        assert f"process {members[2].process.pid}" in said
        members[2].kill()
        until(lambda: first.group()["replicas"] == 2, first.group)
        until(lambda: first.group()["lost"], first.group)
        (lost,) = first.group()["lost"]
        assert (lost["state"], lost["pid"], lost["counts"]["failed"]) == ("LOST", members[2].process.pid, 0)
        (line,) = (line for line in status(first.url).splitlines() if "LOST" in line)
        assert line.startswith("- 3: LOST (it was heard last ")
        assert " s ago, and has not said that it ends; its counts are of then), " in line
        assert "Group: replicas 2, ready 2, lost 1, all with" in status(first.url)
        with replicas(bundle, sub, pub, names=["again"]) as (newcomer,), control(newcomer) as last:
            # It is ready at once; its events wait until it has read the others' log.
            until(lambda: last.parameters().revision == 1, last.group)
            assert last.parameters().entries["gain"]["value"] == 5
            until(lambda: first.group()["replicas"] == last.group()["replicas"] == 3, last.group)
            assert last.group()["agree"] is True
            until(lambda: [each["replica"] for each in last.group()["lost"]] == ["3"], last.group)
        # One of its name has come in its place, as a supervisor starts it, and the newcomer was killed.
        with replicas(bundle, sub, pub, names=["3"]):
            until(lambda: [each["replica"] for each in first.group()["lost"]] == ["again"], first.group)


def test_a_group_finds_together_again_when_its_broker_was_away(bundle, nats):
    sub, pub = nats.address("lost.events", create=True), nats.address("lost.answers", create=True)
    with (
        replicas(bundle, sub, pub, names=["1", "2"]) as members,
        control(members[0]) as first,
        control(members[1]) as second,
    ):
        until(lambda: first.group()["replicas"] == 2, first.group)
        assert first.set(gain=3).revision == 1
        nats.stop(at_once=True)
        try:
            until(lambda: first.group()["trouble"], first.group)
            with pytest.raises(ServiceError, match="group can't be reached, so nothing is changed"):
                first.set(gain=4)
            assert first.info()["state"] == "DEGRADED"
        finally:
            nats.start()
        # Each finds back by itself, one later than the other.
        until(lambda: first.group()["replicas"] == 2 and not first.group()["trouble"], first.group)
        until(lambda: second.group()["replicas"] == 2 and not second.group()["trouble"], second.group)
        assert second.set(gain=6).revision == 2
        until(lambda: first.parameters().revision == 2, first.group)
        assert first.parameters().entries["gain"]["value"] == 6
