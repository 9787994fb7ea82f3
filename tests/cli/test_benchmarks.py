"""The benchmarks run, compare equals and keep every row. No speed is asserted."""

from __future__ import annotations

import itertools
import json
import math

import numpy as np
import pytest
from rich.console import Console

from epypes.experiment.layouts import LAYOUTS, running
from epypes.experiment.nodes import Settings, decode_keypoints
from epypes.experiment.run import Robot
from epypes.wire import attributes
from tests.apart import apart
from tests.benchmarks import brokers, case, engine, pipeline, tuning
from tests.benchmarks.brokers.parties import replicas
from tests.benchmarks.case.by_hand import ByHand
from tests.benchmarks.peers import natural_functions
from tests.benchmarks.row import OURS, Goal, Row, row
from tests.benchmarks.table import as_table, write_json
from tests.benchmarks.timing import Effort, Times
from tests.benchmarks.tuning.goals import compared
from tests.benchmarks.tuning.latency import Seen, p95
from tests.benchmarks.tuning.session import IMAGE, MATPLOTLIB, Measured
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


def test_a_quick_run_of_the_pipelines_benchmark_compares_the_same_events():
    (found,) = pipeline.rows(QUICK)
    assert found.limit_ns > 0
    assert found.ours_ns > 0
    assert found.reached is not None


@pytest.mark.soak
def test_a_quick_run_of_the_case_system_keeps_every_row():
    rows = case.rows(QUICK)
    assert [found.work.removeprefix("the case system: ") for found in rows] == [
        "trip",
        "trip, two at a time",
        "o_network",
        "vision.o_cg, mode",
        "vision.o_epypes, mode",
        "CPU per request",
        "CPU of one idle second",
    ]
    assert all(found.ours_ns > 0 and found.goal is not None for found in rows)


@pytest.mark.slow
@pytest.mark.parametrize("threads", [1, pytest.param(2, marks=pytest.mark.soak)])
def test_hand_written_processes_answer_as_the_case_system_does(threads):
    with ByHand(threads) as system, running(LAYOUTS["paper"], Settings(workers=threads)) as ours:
        _, by_hand = system.ask()
        answer = Robot(ours.requests, ours.inbox).ask()
    assert np.array_equal(decode_keypoints(by_hand.contents), answer.keypoints)
    assert attributes(by_hand).keys() == answer.attributes.keys()


ARRAYS = ("an array of 1 kB: trip", "an array of 1 MB: trip")


@pytest.mark.soak
def test_a_quick_run_of_the_brokers_benchmark_keeps_every_row():
    present = [venue for venue in brokers.venues.present() if venue.name in ("ZeroMQ", "NATS JetStream")]
    rows = brokers.rows(QUICK, present)
    parts = [f"{size}: {what}" for size in ("1 kB", "1 MB") for what in ("trip", "time per event")]
    queued = [f"1 replica, queues at both ends, {part}" for part in (*parts, *ARRAYS)]
    served = [f"1 replica of epypes serve, an array of 1 kB: {what}" for what in ("trip", "time per event")]
    plain = [f"1 replica, {part}" for part in (*parts, *ARRAYS)]
    brokered = plain[: len(parts)]
    expected = [
        f"{venue.name}, {work}"
        for venue in present
        for work in ([*brokered, *queued, *served] if venue.is_brokered else plain)
    ]
    assert [found.work for found in rows] == expected
    assert all(found.limit_ns > 0 and found.ours_ns > 0 for found in rows)
    # A goal is set where both sides do the same.
    with_goal = {f"{venue.name}, {work}" for venue in present if venue.is_brokered for work in brokered}
    assert {found.work for found in rows if found.reached is not None} == with_goal


@pytest.mark.soak
@pytest.mark.parametrize("venue", [venue for venue in brokers.venues.ALL if venue.is_brokered], ids=str)
def test_what_is_asked_by_hand_comes_back_from_replicas_that_share_the_work(venue):
    if venue.missing():
        pytest.skip(venue.missing())
    with venue.opened() as place:
        meeting, _ = place("shared")
        venue.by_hand.prepare(meeting)
        with replicas(venue.by_hand, meeting, 2):
            asker = venue.by_hand.Asker(meeting, 2)
            image = np.arange(1_000_000, dtype=np.uint8).reshape(1000, 1000)
            assert np.array_equal(asker.ask(image), image)
            asker.ask_many(image[:10], 40)
            assert np.array_equal(asker.ask(image), image), "none was left over"
            asker.close()


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


def seen_of(moves, pictures):
    return Seen([(float(at), value) for at, value in moves], [(float(at), value) for at, value in pictures])


def test_a_value_waits_for_the_first_picture_of_it_or_of_a_later_one():
    seen = seen_of([(0, 70), (10, 71), (20, 72)], [(30, 70), (50, 72)])
    assert seen.latencies_ms == [30, 40, 30]
    assert (seen.values_shown, seen.last_late_ms, seen.duration_ms) == (2, 30, 50)


def test_a_picture_from_before_the_move_and_one_of_another_value_do_not_count():
    seen = seen_of([(10, 70), (20, 71)], [(5, 71), (15, 69), (40, 71), (90, 71)])
    assert seen.latencies_ms == [30, 20]


def test_a_value_that_is_never_shown_waits_for_ever():
    assert seen_of([(0, 70), (1, 71)], [(5, 70)]).latencies_ms == [5, math.inf]


def test_of_twenty_values_the_nineteenth_is_the_95th_percentile():
    assert p95(range(20, 0, -1)) == 19
    assert p95([3.0]) == 3


def measured_of(ours, image=()):
    image = image or ours
    peers = {OURS: [ours], IMAGE: [image], MATPLOTLIB: [image]}
    return Measured([10.0, 10.0], peers, peers, slow=ours, slow_runs=3)


def test_the_floor_and_the_peers_of_the_same_page_are_what_a_drag_is_held_to():
    fast, late = seen_of([(0, 1), (1, 2)], [(21, 1), (22, 2)]), seen_of([(0, 1), (1, 2)], [(26, 1), (27, 2)])
    verdicts = {each.work: each.reached for each in compared(measured_of(fast, late))}
    assert verdicts["JupyterLab: a key press, p50, to echo"] is True
    assert verdicts["JupyterLab: a drag of 60 moves, p95, to ipywidgets.Image"] is True
    verdicts = {each.work: each.reached for each in compared(measured_of(late, fast))}
    assert verdicts["JupyterLab: a key press, p50, to echo"] is False
    assert verdicts["JupyterLab: a drag of 60 moves, p95, to ipywidgets.Image"] is False


def test_fifty_pictures_are_asked_of_a_drag():
    def verdict(count):
        moves = [(at, at) for at in range(60)]
        found = compared(measured_of(seen_of(moves, [(at + 1, at) for at in range(60 - count, 60)])))
        return next(each.reached for each in found if "pictures" in each.work)

    assert verdict(50) is True
    assert verdict(49) is False


def test_what_is_counted_is_shown_and_kept_as_a_number():
    counted = Row("runs", {"allowed": 8.0, OURS: 6.0}, goal=Goal("ratio", 1), limit="allowed", unit="count")
    assert counted.as_dict()["medians_count"] == {"allowed": 8.0, OURS: 6.0}
    console = Console(width=150)
    with console.capture() as printed:
        console.print(as_table([counted]))
    assert "ms" not in printed.get()
    assert "0.750" in printed.get()


@pytest.mark.browser
@pytest.mark.soak
def test_a_quick_run_moves_the_sliders_and_keeps_every_row(tmp_path):
    rows = apart(lambda: tuning.rows(QUICK))
    write_json(rows, [], tmp_path / "benchmarks.json")
    kept = json.loads((tmp_path / "benchmarks.json").read_text())["rows"]
    assert len({each["work"] for each in kept}) == len(kept) == 10
    for each in kept:
        amounts = each.get("medians_ns") or each["medians_count"]
        assert all(0 < amount < math.inf for amount in amounts.values()), each


def test_without_a_browser_the_sliders_are_left_out_and_it_says_why(monkeypatch):
    monkeypatch.delenv("CHROMIUM", raising=False)
    monkeypatch.setenv("PATH", "")
    assert "No Chromium was found" in tuning.missing()
    assert tuning.rows(QUICK) == []
