"""Rows are written without a caller waiting for the database, and none is lost while it is away for a while."""

from __future__ import annotations

import logging
import sqlite3
import threading
from time import monotonic

import pytest

from epypes.errors import StoreError
from epypes.store import Store
from epypes.store.writer import BackgroundWriter, SeriesWriter
from tests.store.postgres import server


def test_rows_are_written_in_order_and_what_was_opened_is_closed(place):
    writer = SeriesWriter(place, "events", "edges")
    for number in range(1_000):
        assert writer.append(f"{number}", {"n": number})
    assert writer.close(30)
    assert writer.counts() == {"written": 1_000, "skipped": 0, "waiting": 0}
    with Store(place) as store:
        series = store.series("events", "edges")
        assert [row["n"] for row in series.rows()] == list(range(1_000))


def test_a_writer_that_was_closed_opens_its_store_again(place):
    writer = SeriesWriter(place, "events", "edges")
    for key in ("a", "b"):
        writer.append(key, {})
        assert writer.close(30)
    assert writer.close(30), "a second time nothing is to be done"
    with Store(place) as store:
        assert store.series("events", "edges").keys() == {"a", "b"}


def test_a_store_that_was_given_stays_open(store):
    writer = SeriesWriter(store, "events", "edges")
    writer.append("a", {})
    assert writer.close(30)
    assert store.series("events", "edges").keys() == {"a"}


def test_what_is_no_json_is_refused_at_once_and_holds_nothing_else_up(store):
    writer = SeriesWriter(store, "events", "edges")
    writer.append("before", {"n": 1})
    with pytest.raises(TypeError, match="Row 'bad' of events 'edges' can't be stored"):
        writer.append("bad", {"n": object()})
    writer.append("after", {"n": 2})
    assert writer.flush(60)
    assert store.series("events", "edges").keys() == {"before", "after"}


@pytest.mark.slow
def test_a_caller_does_not_wait_for_the_database_and_rows_that_do_not_fit_are_counted(tmp_path, monkeypatch):
    path = tmp_path / "results.sqlite"
    with Store(path) as store:
        series = store.series("events", "edges")
        other = sqlite3.connect(path, isolation_level=None)
        other.execute("BEGIN IMMEDIATE")
        writer = SeriesWriter(store, "events", "edges", most=50)
        began_s = monotonic()
        fit = [writer.append(f"{number}", {"n": number}) for number in range(80)]
        assert monotonic() - began_s < 5
        assert fit == [True] * 50 + [False] * 30
        assert not writer.flush(0.2), "the database is held by another"
        assert monotonic() - began_s < 10
        other.execute("ROLLBACK")
        other.close()
        assert writer.flush(60)
        assert writer.counts() == {"written": 50, "skipped": 30, "waiting": 0}
        assert sorted(row["n"] for row in series.rows()) == list(range(50))


@pytest.mark.slow
def test_rows_wait_for_a_server_that_is_away_which_is_logged_once(caplog):
    caplog.set_level(logging.INFO, "epypes.store")
    with server() as own:
        url = own.url()
        own.stop()
        writer = SeriesWriter(url, "events", "edges")
        writer.append("first", {"n": 1})
        assert not writer.flush(1.0)
        own.start()
        assert writer.flush(60)
        own.stop(at_once=True)
        writer.append("second", {"n": 2})
        assert not writer.flush(1.0)
        own.start()
        assert writer.close(60)
        with Store(url) as store:
            assert [row["n"] for row in store.series("events", "edges").rows()] == [1, 2]
    away = [record for record in caplog.records if "wait for it" in record.message]
    back = [record for record in caplog.records if "written again" in record.message]
    assert len(away) == len(back) == 2
    assert "can't be reached" in away[0].message


def test_a_place_that_can_never_be_is_refused_at_once(tmp_path):
    with pytest.raises(StoreError, match="There is no folder"):
        SeriesWriter(tmp_path / "none" / "results.sqlite", "events", "edges")
    with pytest.raises(StoreError, match="SQLAlchemy knows no"):
        SeriesWriter("nosuch://host/db", "events", "edges")


def test_rows_wait_for_a_folder_that_is_away_which_is_reported_once(tmp_path):
    folder = tmp_path / "results"
    folder.mkdir()
    reports, is_reported = [], threading.Event()

    def report(text):
        reports.append(text)
        is_reported.set()

    writer = SeriesWriter(folder / "results.sqlite", "events", "edges", report=report)
    folder.rmdir()
    writer.append("a", {"n": 1})
    assert is_reported.wait(60)
    folder.mkdir()
    assert writer.close(60)
    assert writer.counts() == {"written": 1, "skipped": 0, "waiting": 0}
    assert len(reports) == 1
    assert "Rows of events 'edges' wait for it." in reports[0]


@pytest.mark.slow
def test_what_can_not_be_written_now_stays_in_order_and_is_tried_again(monkeypatch):
    monkeypatch.setattr("epypes.store.writer._RETRY_S", 0.05)
    tried, enough = [], threading.Event()

    def write(items):
        tried.append(list(items))
        if len(tried) == 6:
            enough.set()
        return len(tried) > 6

    writer = BackgroundWriter("a test", write, most=3, at_a_time=2)
    assert [writer.put(number) for number in range(4)] == [True, True, True, False]
    assert enough.wait(60)
    assert writer.flush(60)
    assert [item for items in tried[6:] for item in items] == [0, 1, 2], "in order, and each once"
    assert len(writer) == 0


def test_a_write_that_failed_is_tried_again_at_once_when_a_caller_waits(monkeypatch):
    monkeypatch.setattr("epypes.store.writer._RETRY_S", 3_600.0)
    tried, is_tried = [], threading.Event()

    def write(items):
        tried.append(items)
        is_tried.set()
        return len(tried) > 1

    writer = BackgroundWriter("a test", write, most=3)
    writer.put("a")
    assert is_tried.wait(60)
    assert any(writer.flush(1.0) for _ in range(60))


def test_what_can_not_be_written_at_all_is_logged_and_the_next_is_written(caplog):
    written = []

    def write(items):
        if items == ["bad"]:
            raise ValueError("no such thing")
        written.extend(items)
        return True

    writer = BackgroundWriter("a test", write, most=10)
    for item in ("a", "bad", "b"):
        writer.put(item)
    assert writer.flush(60)
    assert written == ["a", "b"]
    assert "a test could not write" in caplog.text
