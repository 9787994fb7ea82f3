"""Replicas on two hosts whose link is cut."""

from __future__ import annotations

import json
import subprocess
import sys

import pytest

from tests.brokers.elsewhere import broker_at
from tests.brokers.fleet import fleet
from tests.brokers.hosts import two_hosts, why_not
from tests.brokers.traffic import until
from tests.service.replicated import promoted, replicas, stopped

pytestmark = pytest.mark.slow

COUNT, PACE_MS = 400, 10


@pytest.fixture
def hosts():
    reason = why_not()
    if reason:
        pytest.skip(f"Two hosts can't be made on this machine: {reason}")
    with two_hosts() as made:
        yield made


def status_across(host, bundle):
    """Return what ``epypes status`` prints on a host."""
    command = [*host.before, sys.executable, "-m", "epypes.cli", "status", str(bundle), "--replica", "across"]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=60).stdout


@pytest.mark.parametrize("name", ["nats", pytest.param("rabbitmq", marks=pytest.mark.soak)])
def test_a_link_that_is_cut_until_the_far_replica_reports_it_loses_nothing_that_was_acknowledged(hosts, tmp_path, name):
    near, far, cable = hosts
    bundle = promoted(tmp_path)
    with broker_at(near, name, "hosts.events", "hosts.answers") as (sub, pub):
        peer = "-m", "tests.brokers.peer", sub, pub, str(COUNT), str(PACE_MS)
        with (
            replicas(bundle, sub, pub, names=["beside"], before=near.before) as (beside,),
            replicas(bundle, sub, pub, names=["across"], before=far.before) as (across,),
            fleet([peer], far.before) as (outside,),
        ):

            def now():
                return json.loads(outside.lines[-1]) if len(outside.lines) > 1 else {"replicas": 0, "answered": 0}

            until(lambda: now()["answered"] > COUNT // 8 and now()["replicas"] == 2, lambda: f"both to work: {now()}")
            cable.pull()
            until(lambda: "DEGRADED" in status_across(far, bundle), lambda: status_across(far, bundle))
            at_the_end = now()
            cable.plug()
            until(lambda: not outside.is_running, lambda: f"everything to be answered: {now()}")
            found, counts = now(), [stopped(replica) for replica in (beside, across)]
    assert at_the_end["confirmed"] < COUNT, "it was all over before the link was cut"
    assert (found["confirmed"], found["answered"]) == (COUNT, COUNT), found
    assert (found["unanswered"], found["twice"]) == ([], []), found
    assert counts[0]["reconnects"] == 0, "its link was not cut"
