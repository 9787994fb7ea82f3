"""Is what the hand stopped at in the database, and does no hand wait for that?"""

from __future__ import annotations

import math
import sqlite3
from datetime import datetime
from pathlib import Path
from time import monotonic

import pytest

import epypes as ep
from epypes.errors import StoreError
from epypes_widgets import tune
from tests.transport.peers import wait_until


def runner_of(**values: object) -> ep.CompGraphRunner:
    def scaled(image: int, gain: float, offset: int) -> float:
        return image * gain + offset

    cg = ep.CompGraph({"scaled": scaled}, {"scaled": (("image", "gain", "offset"), "bright")})
    runner = ep.CompGraphRunner(cg, {"gain": 2.0, "offset": 1, **values})
    runner.run(image=3)
    return runner


def test_each_committed_setting_is_a_row_that_a_later_session_reads(tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    for gains in ((3.0, 4.0), (5.0,)):
        panel = tune(runner_of(), gain=(0.0, 10.0), offset=(0, 9), store=path, name="by hand")
        for gain in gains:
            panel["gain"] = gain
            panel.wait(60)
        frame = panel.stored
        panel.close()
    assert list(frame["values.gain"]) == [2.0, 3.0, 4.0, 2.0, 5.0]
    assert set(frame["values.offset"]) == {1}
    assert list(frame["changed"]) == ["", "gain 2.0 -> 3.0", "gain 3.0 -> 4.0", "", "gain 2.0 -> 5.0"]
    assert all(frame["total_ms"].iloc[[1, 2, 4]] > 0)
    assert frame.index.is_unique
    with ep.Store(path) as store:
        assert store.names("tuning") == ("by hand",)
        row = next(store.series("tuning", "by hand").rows())
    assert datetime.fromisoformat(row["at"]) <= panel.history.iloc[0]["at"]


def test_what_was_committed_before_there_was_a_store_is_stored_too_and_nothing_twice(tmp_path: Path) -> None:
    runner = runner_of()
    first = tune(runner, gain=(0.0, 10.0))
    first["gain"] = 3.0
    first.wait(60)
    with ep.Store(tmp_path / "history.sqlite") as store:
        for gain in (4.0, 5.0):
            panel = tune(runner, gain=(0.0, 10.0), store=store)
            panel["gain"] = gain
            panel.wait(60)
            assert panel.undo()
            panel.wait(60)
            assert panel.redo()
            panel.wait(60)
        panel.close()
        frame = panel.stored
        assert store.names("tuning") == ("bright",), "the name of its sink token"
    assert list(frame["values.gain"]) == [2.0, 3.0, 4.0, 5.0]


def test_values_that_are_no_json_are_said_shortly(tmp_path: Path) -> None:
    runner = runner_of(gain=math.inf, offset=complex(1, 2))
    panel = tune(runner, store=tmp_path / "history.sqlite")
    panel.wait(60)
    (row,) = [row for _, row in panel.stored.iterrows()]
    panel.close()
    assert row["values.gain"] == math.inf
    assert row["values.offset"] == "(1+2j)"


def test_a_database_that_is_held_up_holds_no_hand_up(tmp_path: Path) -> None:
    path = tmp_path / "history.sqlite"
    ep.Store(path).close()
    other = sqlite3.connect(path, isolation_level=None)
    other.execute("BEGIN IMMEDIATE")
    panel = tune(runner_of(), gain=(0.0, 100.0), store=path)
    began_s = monotonic()
    for gain in range(20):
        panel["gain"] = float(gain)
        panel.wait(60)
    assert monotonic() - began_s < 10
    other.execute("ROLLBACK")
    other.close()
    assert list(panel.stored["values.gain"]) == [2.0, *map(float, range(20))]
    panel.close()


@pytest.mark.slow
def test_a_database_that_is_away_is_told_in_the_panel_and_one_that_can_never_be_at_once(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="SQLAlchemy knows no"):
        tune(runner_of(), store="nosuch://host/db")
    panel = tune(runner_of(), store="postgresql://nobody:s3cr3t@127.0.0.1:1/db")
    with pytest.raises(StoreError, match="can't be reached"):
        _ = panel.stored
    wait_until(lambda: any("can't be reached" in line for line in panel.log))
    assert not any("s3cr3t" in line for line in panel.log)
    panel.close(0.2)


def test_a_panel_without_a_store_says_how_to_have_one() -> None:
    panel = tune(runner_of())
    with pytest.raises(RuntimeError, match=r"tune\(runner, store='history.sqlite'\)"):
        _ = panel.stored
    panel.close()
