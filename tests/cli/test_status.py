"""``epypes status`` shows each replica in a line."""

from __future__ import annotations

import json
import re
from contextlib import ExitStack, contextmanager

import pytest

from epypes.service import Service
from epypes.service.http import HttpServer
from epypes.service.replication.messages import Heartbeat
from epypes.service.state_file import StateLock
from epypes.transport import memory
from tests.service.replicated import publish_to_replicas
from tests.service.served import acting_bundle, until

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def acting(tmp_path_factory):
    return acting_bundle(tmp_path_factory.mktemp("bundles") / "acting")


@contextmanager
def replicas(host, **bundles):
    """Serve bundles on one queue, the first of them over HTTP; give the services."""
    where = [f"memory://{host}/{name}?create=true" for name in ("events", "answers")]
    with ExitStack() as held:
        services = []
        for name, (bundle, options) in bundles.items():
            lock = held.enter_context(StateLock(bundle, name))
            service = held.enter_context(Service(bundle, *where, replica=name, **options))
            if not services:
                server = held.enter_context(HttpServer(service, "127.0.0.1:0"))
                service.http, service.access_key_file = server.url, str(server.access_key_file)
            lock.publish(service.service_state)
            services.append(service)
        until(lambda: all(each.group()["replicas"] == len(services) for each in services))
        yield services


def members(told):
    return [line for line in told.splitlines() if line.startswith("- ")]


def test_each_replica_is_one_line_with_the_state_that_the_group_knows(epypes, acting):
    with replicas("lines", a=(acting, {}), b=(acting, {})) as (first, _):
        until(lambda: "ready 2" in epypes("status", acting).stdout)
        told = epypes("status", acting).stdout
        alone = epypes("status", acting, "--replica", "b").stdout
        first.pause()
        until(lambda: "PAUSED" in epypes("status", acting).stdout)
    assert "Group: replicas 2, ready 2, all with the same bundle and parameters" in told
    a, b = members(told)
    assert a.startswith("- a: READY, 0 answered, revision 0, ")
    assert a.endswith(first.http)
    assert b.startswith("- b: READY, 0 answered, revision 0, ")
    assert b.endswith("no --http")
    assert "RUNNING" not in told
    assert told.count("Parameters, ") == told.count("Events: ") == told.count("answers at") == 1
    assert re.match(rf"RUNNING {acting} \(\w+\), replica b, process \d+, no --http\.", alone)


def test_while_the_broker_is_away_nobody_is_said_to_agree_and_the_reason_is_said_once(epypes, acting):
    with replicas("gone", a=(acting, {}), b=(acting, {})) as (first, _), memory.away("gone"):
        until(lambda: first.group()["trouble"] and first.state == "DEGRADED")
        # The group, the events and the answers are three places of the broker, and each finds out by itself.
        until(lambda: epypes("status", acting).stdout.count("memory://gone/") == 3)
        told = epypes("status", acting).stdout
    assert "all with the same" not in told
    assert "the other replicas are not heard: " in told
    assert len(members(told)) == 2


def test_what_replicas_serve_is_said_where_they_differ(epypes, acting, tmp_path):
    other = acting_bundle(tmp_path / "other", k=3, expected=9)
    with replicas("mixed", a=(acting, {}), b=(other, {})) as (first, second):
        told = epypes("status", acting).stdout
        served = [f"bundle {each.info()['name']} ({each.info()['digest'][:12]})" for each in (first, second)]
    assert "not all with the same bundle and parameters" in told
    a, b = members(told)
    assert f"{served[0]}, " in a
    assert f"{served[1]}, " in b


def test_where_failures_go_besides_is_said_where_somebody_asked_for_it(epypes, acting, tmp_path):
    for failures in ("", f"ipc://{tmp_path}/failed"):
        with replicas("failed", a=(acting, {"failures": failures} if failures else {})) as (service,):
            told = epypes("status", acting).stdout
            known = json.loads(epypes("status", acting, "--json").stdout)["addresses"]["failures"]
            assert known == service.service_state.failures
        assert (f"failures at {known}" in told) is bool(failures)
        assert ("failures at" in told) is bool(failures)


def test_each_lost_replica_is_one_line_with_its_reason(epypes, acting):
    with replicas("lost", a=(acting, {})) as (first,):
        silent = [Heartbeat(name, replica=name, host="elsewhere", counts={"answered": 0}) for name in ("b", "c")]
        publish_to_replicas(first.options.sub, *silent)
        until(lambda: len(first.group()["lost"]) == 2 and first.group()["replicas"] == 1)
        shown = epypes("status", acting).stdout
    assert "Group: replicas 1, ready 1, lost 2, all with the same bundle and parameters" in shown
    assert [re.sub(r"[\d.]+ s,", "x s,", line).partition(", 0 answered")[0] for line in members(shown)] == [
        "- a: READY",
        "- b: LOST (no heartbeat for x s, and it did not stop in order; its counts are of then)",
        "- c: LOST (no heartbeat for x s, and it did not stop in order; its counts are of then)",
    ]
