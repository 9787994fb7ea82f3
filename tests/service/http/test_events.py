"""Server-sent events: what clients receive, and what they cost."""

from __future__ import annotations

import json
import threading
from contextlib import ExitStack, contextmanager
from time import monotonic

import httpx
import pytest
from httpx_sse import EventSource

from epypes.bundle.adapters import REQUEST
from epypes.service.http import HttpServer
from epypes.service.http.server import MAX_CONNECTIONS
from epypes.wire import Envelope
from tests.service.http.raw import connection, until
from tests.service.served import TIMEOUT_S, peer_of


@contextmanager
def listening(url, **query):
    """Give what a listener is told, as pairs of kind and data."""
    with httpx.stream("GET", f"{url}/v1/events", params=query, timeout=60, trust_env=False) as answer:
        assert answer.status_code == 200
        yield ((event.event, json.loads(event.data)) for event in EventSource(answer).iter_sse())


@pytest.fixture(scope="module")
def peer(service):
    with peer_of(service) as peer:
        yield peer


def work(peer, photograph, count):
    for _ in range(count):
        peer.requests.put(Envelope(type=REQUEST, parts={"image": photograph[:40, :40]}))
        peer.take()


@pytest.mark.slow
def test_a_listener_is_told_first_how_things_are(http, service):
    with listening(http.url) as told:
        first = [next(told) for _ in range(3)]
    assert [kind for kind, _ in first] == ["state", "parameters", "counts"]
    assert first[0][1] == {"state": "READY", "reason": ""}
    assert first[1][1]["parameters"].keys() == {"side", "lo", "hi"}
    assert first[2][1] == service.counts()


@pytest.mark.slow
def test_counts_are_told_each_second(http):
    with listening(http.url) as told:
        counts = (data for kind, data in told if kind == "counts")
        start = monotonic()
        assert next(counts).keys() == next(counts).keys()
    assert monotonic() - start > 0.5


def test_runs_are_told_ten_times_a_second_at_most_and_the_last_one_always(http, service, peer, photograph):
    with listening(http.url) as told:
        before = service.counts()["answered"]
        start = monotonic()
        work(peer, photograph, 60)
        took_s = monotonic() - start
        runs = []
        while sum(1 + run["skipped"] for run in runs) < 60:
            kind, data = next(told)
            if kind == "run":
                runs.append(data)
    until(lambda: service.counts()["answered"] == before + 60)
    assert len(runs) <= took_s * 10 + 3
    assert [run["seq"] for run in runs] == sorted(run["seq"] for run in runs)
    assert all(run["total_ns"] > 0 and run["event_id"] for run in runs)


def test_a_failure_is_told_with_its_record(http, peer):
    with listening(http.url) as told:
        peer.requests.put(Envelope(type=REQUEST, parts={"image": "no image"}))
        record = next(data for kind, data in told if kind == "failure")
    assert record["function"] == "smooth"
    assert record["id"]


def test_a_change_of_parameters_is_told_to_all(http, changing):
    with listening(http.url) as one, listening(http.url) as other:
        revision = changing.patch("/v1/parameters", json={"values": {"lo": 61}}).json()["revision"]
        for told in (one, other):
            assert (
                next(d for k, d in told if k == "parameters" and d["revision"] == revision)["parameters"]["lo"]["value"]
                == 61
            )


@pytest.mark.slow
def test_many_listen_at_once_and_one_too_many_is_refused(http, peer, photograph):
    with ExitStack() as all_of_them:
        told = [all_of_them.enter_context(listening(http.url)) for _ in range(4)]
        for _ in range(MAX_CONNECTIONS // 2 - 4):
            more = all_of_them.enter_context(connection(http.url))
            more.sendall(b"GET /v1/events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        until(lambda: http.listeners == MAX_CONNECTIONS // 2)
        work(peer, photograph, 1)
        for each in told:
            assert next(data for kind, data in each if kind == "run")["total_ns"] > 0
        refused = httpx.get(f"{http.url}/v1/events", trust_env=False)
        assert refused.status_code == 503
        assert f"{MAX_CONNECTIONS // 2} listeners" in refused.json()["detail"]
        assert httpx.get(f"{http.url}/livez", trust_env=False).status_code == 200
    until(lambda: http.listeners == 0)


def test_one_who_goes_away_is_forgotten(http):
    with connection(http.url) as gone:
        gone.sendall(b"GET /v1/events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        until(lambda: http.listeners == 1)
    until(lambda: http.listeners == 0)


@pytest.mark.slow
def test_listeners_are_let_go_when_the_server_stops(service):
    server, before = HttpServer(service, "127.0.0.1:*"), set(threading.enumerate())
    with ExitStack() as all_of_them:
        url = server.start()
        told = [all_of_them.enter_context(listening(url)) for _ in range(5)]
        deaf = all_of_them.enter_context(connection(url))
        deaf.sendall(b"GET /v1/events HTTP/1.1\r\nHost: localhost\r\n\r\n")
        start = monotonic()
        server.stop()
        assert monotonic() - start < TIMEOUT_S / 2
        for each in told:
            list(each)
    assert not [thread for thread in set(threading.enumerate()) - before if thread.name.startswith("epypes-http")]


def test_for_s_of_zero_tells_how_things_are_and_ends(http):
    with listening(http.url, for_s=0) as told:
        assert [kind for kind, _ in told] == ["state", "parameters", "counts"]
