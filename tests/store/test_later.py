"""Are rows written without anybody waiting for the database, and is none lost while it is away for a while?"""

from __future__ import annotations

import logging
import sqlite3
from time import monotonic

import pytest

from epypes.errors import StoreError
from epypes.store import Store
from epypes.store.later import Line, SeriesWriter
from tests.store.postgres import server


def test_rows_are_written_in_order_and_what_was_opened_is_closed(place):
    writer = SeriesWriter(place, "events", "edges", about={"of": "a test"})
    for number in range(1_000):
        assert writer.append(f"{number}", {"n": number})
    assert writer.close(30)
    assert writer.counts() == {"written": 1_000, "skipped": 0, "unwritten": 0, "waiting": 0}
    with Store(place) as store:
        series = store.series("events", "edges")
        assert [row["n"] for row in series.rows()] == list(range(1_000))
        assert series.about == {"of": "a test"}


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


def test_what_can_not_be_written_at_all_holds_nothing_else_up(store, caplog):
    writer = SeriesWriter(store, "events", "edges")
    for number in range(10):
        writer.append(f"{number}", {"n": object() if number == 4 else number})
    assert writer.flush(30)
    assert writer.counts()["unwritten"] == 1
    assert writer.counts()["written"] == 9
    assert len(store.series("events", "edges")) == 9
    assert "Row '4' of events 'edges' can't be stored" in caplog.text


@pytest.mark.slow
def test_who_hands_over_rows_waits_for_nobody_and_what_does_not_fit_is_counted(tmp_path, monkeypatch):
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
        assert writer.counts() == {"written": 50, "skipped": 30, "unwritten": 0, "waiting": 0}
        assert sorted(row["n"] for row in series.rows()) == list(range(50))


@pytest.mark.slow
def test_rows_wait_for_a_server_that_is_away_which_is_told_once(caplog):
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


def test_a_database_that_fails_is_tried_less_and_less_often():
    line = Line()
    line.add(("a", {}))
    assert line.due_in_s(0.0) == 0.0
    pauses, now_s = [], 0.0
    for count in range(10):
        assert line.failed(now_s) is (count == 0)
        pauses.append(line.due_in_s(now_s))
        assert line.take(now_s + 0.05, at_once=True) is None, "not at once again, even if somebody waits"
        assert line.take(now_s + 0.11, at_once=True) is not None
        assert line.take(now_s + pauses[-1] - 0.01) is None
        now_s += pauses[-1]
        assert line.take(now_s) is not None
    assert pauses[:4] == [0.5, 1.0, 2.0, 4.0]
    assert max(pauses) == 30.0
    assert line.done(1)
    assert line.due_in_s(now_s) is None
    line.add(("b", {}))
    assert line.due_in_s(now_s) == 0.0
    assert line.failed(now_s), "it is told anew"
