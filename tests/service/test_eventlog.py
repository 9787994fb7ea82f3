"""A row of each event that a service has resolved, also while its database is away."""

from __future__ import annotations

import sqlite3
from time import monotonic, time_ns

import pytest

from epypes.errors import StoreError
from epypes.service import Service
from epypes.service.http.metrics import exposed, registry_of
from epypes.store import Store
from tests.service.served import TIMEOUT_S, peer_of, serving, until
from tests.store.postgres import server

pytestmark = pytest.mark.slow


def rows_of(path):
    with Store(path) as store:
        assert store.kinds() == ("events",)
        (name,) = store.names("events")
        return list(store.series("events", name).rows())


def metrics_of(service):
    return exposed(registry_of(service), "text/plain")[1].decode()


def test_each_event_has_a_row(acting, tmp_path):
    path, began_ns = tmp_path / "events.sqlite", time_ns()
    with serving(acting, store=path, retries=0) as (service, peer):
        peer.ask(number=7)
        peer.ask("fail:no rows")
        service.set_parameters({"k": 5})
        peer.ask(number=8)
        peer.ask("kill")
        digest, sent = service.service_state.digest, list(peer.sent)
        assert service.failure_store.flush()
        known = {record.event_id: record.id for record in service.failure_records()}
    rows = rows_of(path)
    assert [row["event_id"] for row in rows] == sent
    assert [row["outcome"] for row in rows] == ["answered", "failed", "answered", "dead_letter"]
    assert [row["revision"] for row in rows] == [0, 0, 1, 1]
    assert {row["digest"] for row in rows} == {digest}
    answered, failed = rows[:2]
    assert set(answered["times_ns"]) == {"act"}
    assert 0 < answered["times_ns"]["act"] <= answered["total_ns"] <= answered["answered_ns"] - answered["received_ns"]
    assert began_ns < answered["received_ns"] < answered["answered_ns"] < time_ns()
    assert (failed["function"], failed["exception"], failed["message"]) == ("act", "ValueError", "no rows")
    assert failed["failure"] == known[sent[1]], "by this id it is opened in a notebook"
    assert "failure" not in answered


def test_what_was_dropped_has_a_row_too(acting, tmp_path):
    path = tmp_path / "events.sqlite"
    hold = tmp_path / "hold"
    hold.mkdir()
    with serving(acting, store=path, mailbox_size=1) as (service, peer):
        peer.send(f"hold:{hold}")
        until((hold / "started").exists)
        peer.send(number=2)
        peer.send(number=3)
        until(lambda: service.counts()["dropped"] == 1)
        (hold / "release").touch()
        peer.take(3)
    found = {row["seq"]: row["outcome"] for row in rows_of(path)}
    assert found == {1: "answered", 2: "dropped", 3: "answered"}


def test_a_database_that_is_held_up_holds_no_answer_up_and_is_seen_in_the_metrics(acting, tmp_path, caplog):
    path = tmp_path / "events.sqlite"
    Store(path).close()
    other = sqlite3.connect(path, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    service = Service(acting, store=path, drain_timeout_s=1.0)
    service.start()
    try:
        with peer_of(service) as peer:
            for number in range(50):
                assert peer.ask(number=number).parts["out"] == 2 * number
        assert 'epypes_event_rows_total{outcome="written"} 0.0' in metrics_of(service)
        assert "epypes_event_rows_waiting 50.0" in metrics_of(service)
    finally:
        began_s = monotonic()
        service.stop()
    assert monotonic() - began_s < TIMEOUT_S
    assert "50 rows of events could not be stored in time" in caplog.text
    other.execute("ROLLBACK")
    other.close()
    service.event_log.close(60)
    assert 'epypes_event_rows_total{outcome="written"} 50.0' in metrics_of(service)
    assert len(rows_of(path)) == 50


def test_a_file_that_is_deleted_under_a_service_is_made_anew_and_nothing_is_lost_from_then_on(acting, tmp_path, caplog):
    path = tmp_path / "events.sqlite"
    with serving(acting, store=path) as (service, peer):
        peer.ask(number=1)
        until(lambda: service.event_log.counts()["written"] == 1)
        path.unlink()
        for number in (2, 3):
            peer.ask(number=number)
        until(lambda: service.event_log.counts()["written"] == 3)
        assert [row["seq"] for row in rows_of(path)] == [2, 3]
    assert [row["seq"] for row in rows_of(path)] == [2, 3]
    assert caplog.text.count(f"{path} was deleted, moved or replaced") == 1


def test_a_service_without_a_store_has_no_such_metrics(acting):
    with serving(acting) as (service, peer):
        peer.ask()
        assert "epypes_event_rows" not in metrics_of(service)


def test_a_service_with_a_store_that_can_never_be_is_not_started(acting):
    with pytest.raises(StoreError, match="SQLAlchemy knows no 'nosuch'"):
        Service(acting, store="nosuch://host/db")


def test_a_server_that_dies_and_comes_back_has_all_rows_and_no_answer_waited(acting, caplog):
    with server() as own:
        url = own.url()
        with serving(acting, store=url) as (service, peer):
            peer.ask(number=1)
            until(lambda: service.event_log.counts()["written"] == 1)
            own.stop(at_once=True)
            for number in range(2, 7):
                assert peer.ask(number=number).parts["out"] == 2 * number
            until(lambda: "wait for it" in caplog.text)
            own.start()
            until(lambda: service.event_log.counts()["written"] == 6)
        found = rows_of(url)
    assert [row["seq"] for row in found] == [1, 2, 3, 4, 5, 6]
    assert caplog.text.count("wait for it") == 1
