"""The durations of a row are those of the paper."""

from __future__ import annotations

import math

import pandas as pd
import pytest

from epypes.experiment.results import COLUMNS, Results, comparison, durations_of, row_of, table_of
from epypes.experiment.run import Answer

# Clocks of three machines that know nothing of each other.
ACQUISITION_S, VISION_S = 1_000.0, 5_000_000.0
TIMES = {
    "t_vreq": 77.0,
    "acquisition.t_react": ACQUISITION_S,
    "acquisition.t_fin_start": ACQUISITION_S + 0.25,
    "acquisition.t_fin_end": ACQUISITION_S + 0.5,
    "acquisition.t_p": 1.0,
    "acquisition.o_cg": 0.125,
    "acquisition.t_fout_start": ACQUISITION_S + 2.0,
    "acquisition.t_fout_end": ACQUISITION_S + 2.5,
    "acquisition.t_pub": ACQUISITION_S + 3.0,
    "vision.t_react": VISION_S,
    "vision.t_fin_start": VISION_S + 1.0,
    "vision.t_fin_end": VISION_S + 3.0,
    "vision.t_p": 8.0,
    "vision.o_cg": 0.5,
    "vision.t_fout_start": VISION_S + 12.0,
    "vision.t_fout_end": VISION_S + 13.0,
    "vision.t_pub": VISION_S + 16.0,
}


def test_durations_are_those_of_the_paper():
    assert durations_of(20.0, TIMES) == {
        "t_trip": 20.0,
        "acquisition.t_rp": 3.0,
        "acquisition.t_p": 1.0,
        "acquisition.o_cg": 0.125,
        "acquisition.t_fin": 0.25,
        "acquisition.t_fout": 0.5,
        "acquisition.o_epypes": 1.25,
        "vision.t_rp": 16.0,
        "vision.t_p": 8.0,
        "vision.o_cg": 0.5,
        "vision.t_fin": 2.0,
        "vision.t_fout": 1.0,
        "vision.o_epypes": 5.0,
        "o_network": 1.0,
    }


@pytest.mark.parametrize("clock", ["acquisition", "vision"])
def test_no_duration_depends_on_how_the_clocks_are_set(clock):
    stamps = {"t_react", "t_fin_start", "t_fin_end", "t_fout_start", "t_fout_end", "t_pub"}
    moved = {f"{clock}.{name}" for name in stamps}
    other = {key: value + 4096.0 if key in moved else value for key, value in TIMES.items()}
    assert durations_of(20.0, other) == durations_of(20.0, TIMES)


def test_a_request_that_failed_has_a_row_without_numbers():
    row = row_of(Answer("abc", failure="no answer within 5 s"), 1, 7)
    assert set(row) == set(COLUMNS)
    assert (row["experiment"], row["request"], row["id"], row["failure"]) == (1, 7, "abc", "no answer within 5 s")
    numbers = [value for key, value in row.items() if key not in ("experiment", "request", "id", "failure")]
    assert len(numbers) == 14
    assert all(map(math.isnan, numbers))


@pytest.mark.parametrize("key", sorted(TIMES.keys() - {"t_vreq"}))
def test_an_answer_without_one_of_its_times_is_a_failure_that_names_it(key):
    times = {name: value for name, value in TIMES.items() if name != key}
    row = row_of(Answer("abc", 1.0, times), 0, 0)
    assert key in row["failure"]
    assert math.isnan(row["t_trip"])


def test_a_table_comes_back_from_its_file(tmp_path):
    rows = [row_of(Answer("a", 1 / 3, TIMES), 0, 0), row_of(Answer("b", failure="late, too"), 0, 1)]
    results = Results("paper", table_of(rows))
    results.to_csv(tmp_path / "requests.csv")
    again = pd.read_csv(tmp_path / "requests.csv", keep_default_na=False, na_values={"t_trip": [""]})
    assert tuple(again) == COLUMNS
    assert list(again["failure"]) == ["", "late, too"]
    assert again["t_trip"][0] == 1 / 3
    assert repr(results) == "<Results of layout paper: 2 requests, 1 failed>"


def test_a_table_of_no_rows_has_the_columns():
    assert tuple(table_of([])) == COLUMNS


def test_experiments_are_added_and_transports_are_compared_by_trips_and_cpu():
    def results(transport, trips_s, cpu_s):
        rows = [row_of(Answer(f"{trip}", trip, TIMES), 0, number) for number, trip in enumerate(trips_s)]
        rows.append(row_of(Answer("none", failure="no answer"), 0, len(rows)))
        return Results("three", table_of(rows), {"late answer": 1}, transport, cpu_s)

    both = results("zeromq", [20.0, 24.0], 3.0) + results("zeromq", [22.0], 1.0)
    assert (both.layout, both.transport, both.cpu_s, both.counts) == ("three", "zeromq", 4.0, {"late answer": 2})
    assert [*both.table["experiment"]] == [0, 0, 0, 1, 1]
    table = comparison([both, results("zenoh", [21.0], 1.0)])
    assert [*table.index] == ["zeromq", "zenoh"]
    assert [*table["requests"]] == [3, 1]
    assert table.loc["zeromq", "cpu_ms"] == pytest.approx(800.0)
    assert 23_900 < table.loc["zeromq", "trip_p99_ms"] <= 24_000
    assert table.loc["zenoh", "trip_mode_ms"] == pytest.approx(21_000.0)
    assert table.loc["zenoh", "network_mode_ms"] == pytest.approx(2_000.0)
