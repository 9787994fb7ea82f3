"""Do the benchmarks run, compare equals and keep every row? No speed is asserted."""

from __future__ import annotations

import itertools
import json

import pytest

from tests.benchmarks import engine
from tests.benchmarks.peers import natural_functions
from tests.benchmarks.row import OURS, Goal, row
from tests.benchmarks.table import as_table, write_json
from tests.benchmarks.timing import Effort, Times
from tests.benchmarks.work import add_one, tuned_chain

QUICK = Effort(quick=True)
WORKS = [
    "chain of 100 trivial functions",
    "1 -> 50 -> 1 trivial functions",
    "rerun of the last of 100",
    "rerun of the last of 100, 8 MB array",
    "build and first result, 200 functions",
    "build and first result, 1,000 functions",
    "build and first result, 10,000 functions",
    "building, per function: 1,000 and 10,000",
    "union of two graphs of 1,000 functions",
    "edge graph, 64 x 64",
    "edge graph, 1 MP",
    "ORB graph, one after the other",
    "ORB graph, overhead reported",
    "ORB graph, two at a time",
    "workers=2 beside 1: chain of 100",
    "workers=2 beside 1: 1 -> 50 -> 1",
]


@pytest.mark.slow
def test_a_quick_run_of_the_engines_benchmarks_keeps_every_row(tmp_path):
    rows = engine.rows(QUICK)
    write_json(rows, {"loman"}, tmp_path / "out" / "benchmarks.json")
    kept = json.loads((tmp_path / "out" / "benchmarks.json").read_text())
    assert kept["absent_peers"] == ["loman"]
    assert [each["work"] for each in kept["rows"]] == WORKS
    for each in kept["rows"]:
        medians = each["medians_ns"]
        assert medians[each["limit"]] > 0, each
        assert medians[each["ours"]] > 0, each
        assert (each["reached"] is None) == (each["goal"] is None), each
    assert as_table(rows).row_count == len(WORKS)


def test_contenders_that_compute_something_else_are_not_timed():
    with pytest.raises(AssertionError, match="'theirs' computes 3, 'by hand' 2"):
        QUICK.measure({"by hand": lambda: 2, "theirs": lambda: 3}, 10)


def test_slow_contenders_take_part_in_evenly_spread_rounds():
    slow = Effort(budget_s=0)
    times = slow.measure({"by hand": lambda: 1, OURS: lambda: 1}, 10)
    assert [len(taken) for taken in times.durations_ns.values()] == [1, 1]


def test_all_rounds_are_taken_by_who_can_afford_them():
    calls = itertools.count()
    times = Effort(budget_s=60).measure({"by hand": lambda: next(calls) * 0}, 7)
    assert list(times.durations_ns["by hand"]) == list(range(7))


@pytest.mark.parametrize(
    ("goal", "reached"),
    [
        (Goal("ratio", 2.0), True),
        (Goal("ratio", 1.9), False),
        (Goal("total", 200), True),
        (Goal("total", 199), False),
        (Goal("above", 100), True),
        (Goal("above", 99), False),
        (Goal("per function", 10), True),
        (Goal("per function", 9), False),
        (None, None),
    ],
)
def test_a_goal_is_reached_up_to_its_number(goal, reached):
    times = Times({"by hand": {0: 100.0}, OURS: {0: 200.0}})
    assert row("work", times, functions=10, goal=goal).reached is reached


def test_a_ratio_must_hold_for_the_medians_and_within_the_rounds():
    by_hand, ours = {0: 100.0, 1: 200.0, 2: 300.0}, {0: 150.0, 1: 300.0, 2: 100.0}
    measured = row("work", Times({"by hand": by_hand, OURS: ours}), goal=Goal("ratio", 1.4))
    assert measured.ratio(OURS) == pytest.approx(0.75)
    assert measured.pairwise_ratio == pytest.approx(1.5)
    assert measured.reached is False


def test_peers_get_the_same_functions_under_the_names_of_the_tokens():
    functions = natural_functions(tuned_chain(3, add_one, 0, lambda x, k: x + k))
    assert list(functions) == ["t1", "t2", "y"]
    assert functions["t1"].__name__ == "t1"
    assert functions["t1"](t0=1) == 2
    assert functions["y"](t2=1, k=2) == 3


def test_only_what_depends_on_a_token_is_downstream_of_it():
    work = tuned_chain(3, add_one, 0, lambda x, k: x + k)
    assert list(work.downstream("k")) == ["last"]
    assert list(work.downstream("t1")) == ["f1", "last"]
