"""The last reports of a runner are kept, small, and can be read while runs go on."""

from __future__ import annotations

import threading

import pytest

import epypes as ep
from epypes.run import timing


def wide_graph(count):
    """``count`` functions of x and one of k."""
    io = {f"f{place}": ("x", f"y{place}") for place in range(count)} | {"last": ("k", "z")}
    return ep.CompGraph(dict.fromkeys(io, lambda value: value), io)


def told(report):
    """Everything that a report says, but for its picture's text."""
    return (
        report.functions,
        report.durations_ns,
        report.ran,
        report.reused,
        report.failed,
        report.total_ns,
        report.side_by_side,
        report.overhead_ns,
        report.critical_path_ns,
        repr(report),
    )


def test_the_last_1000_reports_are_kept_the_oldest_first():
    runner = ep.CompGraphRunner(ep.CompGraph({"f": lambda x: x}, {"f": ("x", "y")}))
    totals = []
    for x in range(1_005):
        totals.append(runner.run(x=x).report.total_ns)
        assert len(runner.reports) == min(x + 1, 1_000)
    assert [report.total_ns for report in runner.reports] == totals[-1_000:]
    assert repr(runner.reports) == "<Reports of 1000 runs>"


def test_failed_runs_and_reruns_are_kept_too(way):
    def invert(x, n):
        return n / x

    runner = way.runner(ep.CompGraph({"invert": invert}, {"invert": (("x", "n"), "y")}), {"n": 1})
    for n in range(2, 2 + way.runs):
        runner.run(x=1)
        runner.rerun(n=n)
    with pytest.raises(ZeroDivisionError):
        runner.run(x=0)
    assert len(runner.reports) == 2 * way.runs + 1
    assert told(runner.reports[-1]) == told(runner.last.report)
    assert runner.reports[-1].ran == ("invert",)


def failing_chain(count=3):
    """``f0`` to ``f2`` one after another, of which ``f1`` can't do 0, after functions of their own."""

    def invert(x, n):
        return n / x

    chain = {"f0": ("x", "a"), "f1": (("a", "n"), "b"), "f2": ("b", "c"), "beside": ("x", "d")}
    more = {f"g{place}": ("x", f"d{place}") for place in range(count - 3)}
    functions = dict.fromkeys(more | chain, lambda value: value) | {"f1": invert}
    return ep.CompGraph(functions, more | chain)


@pytest.mark.parametrize("count", [3, 450])
def test_a_report_knows_which_function_failed(way, count):
    """Those of graphs above 400 functions are packed, and their runs never compiled."""
    runner = way.runner(failing_chain(count), {"n": 1})
    for _ in range(way.runs):
        assert runner.run(x=1).report.failed is None
    with pytest.raises(ZeroDivisionError):
        runner.run(x=0)
    assert [report.failed for report in runner.reports] == [None] * way.runs + ["f1"]
    assert told(runner.reports[-1]) == told(runner.last.report)
    assert [entry.failed for entry in runner.reports[0].functions] == [False] * (count + 1)
    found = {entry.function: entry for entry in runner.reports[-1].functions}
    assert [name for name, entry in found.items() if entry.failed] == ["f1"]
    assert found["f1"].ran
    assert found["f1"].duration_ns == runner.last.report.durations_ns["f1"] > 0
    assert ", 0 reused, 1 failed>" in repr(runner.reports[-1])
    assert "failed" not in repr(runner.reports[0])


def test_a_rerun_that_failed_says_so_and_the_next_one_does_not(way):
    runner = way.runner(failing_chain(), {"n": 1})
    runner.run(x=1)
    for n in range(2, 2 + way.runs):
        runner.rerun(n=n)
    with way.is_taken(), pytest.raises(TypeError):
        runner.rerun(n="one")
    report = runner.last.report
    assert (report.failed, report.ran, report.reused) == ("f1", ("f1",), ("f0", "beside"))
    assert repr(report) == "<RunReport: 0 functions ran, 2 reused, 1 failed>"
    assert runner.rerun(n=1).report.failed is None
    assert runner.reports[-2].failed == "f1"


def test_what_a_failed_run_never_reached_is_not_said_to_be_reused(way):
    runner = way.runner(failing_chain(), {"n": 1})
    for _ in range(way.runs):
        runner.run(x=1)
    with way.is_taken(), pytest.raises(ZeroDivisionError):
        runner.run(x=0)
    report = runner.last.report
    assert report.reused == ()
    assert set(report.ran) <= {"f0", "f1", "beside"}
    assert "f2" not in [entry.function for entry in report.functions]
    with pytest.raises(ZeroDivisionError):
        runner.run("b", x=0)
    assert [(entry.function, entry.failed) for entry in runner.last.report.functions] == [("f0", False), ("f1", True)]


def test_of_functions_side_by_side_the_first_in_run_order_is_the_one_that_failed(way):
    io = {"slow": ("x", "a"), "quick": ("x", "b")}
    both = threading.Barrier(2)

    def slow(x):
        if x == 0 and way.name == "side by side":
            both.wait(60)
        return 1 / x

    def quick(x):
        if x == 0:
            both.wait(60)
        return 1 / x

    runner = way.runner(ep.CompGraph({"slow": slow, "quick": quick}, io))
    for _ in range(way.runs):
        runner.run(x=1)
    with way.is_taken(), pytest.raises(ZeroDivisionError):
        runner.run(x=0)
    assert (runner.last.report.failed, runner.last.report.ran) == ("slow", ("slow",))


def test_a_pipeline_that_fails_inside_a_graph_has_failed_in_both(way):
    inner = ep.Pipeline("inner", failing_chain(), {"n": 1})
    outer = way.runner(
        ep.CompGraph({"before": abs, "nested": inner}, {"before": ("a", "x"), "nested": ("x", ("c", "d"))})
    )
    for _ in range(way.runs):
        outer.run(a=1)
    with pytest.raises(ZeroDivisionError):
        outer.run(a=0)
    assert (outer.reports[-1].failed, outer.reports[-1].ran) == ("nested", ("before", "nested"))
    assert (inner.runner.reports[-1].failed, inner.runner.reports[-2].failed) == ("f1", None)


def test_tables_of_reports_say_what_failed():
    runner = ep.CompGraphRunner(failing_chain(), {"n": 1})
    runner.run(x=1)
    with pytest.raises(TypeError):
        runner.rerun(n="one")
    table = runner.reports[-1].to_frame()
    assert list(table.columns) == ["function", "ran", "time_ms", "share", "failed", "skipped"]
    assert table[["function", "ran", "failed"]].values.tolist() == [
        ["f0", False, False], ["f1", True, True], ["beside", False, False],
    ]  # fmt: skip
    table = runner.reports.to_frame()
    assert list(table.columns) == ["run", "function", "ran", "time_ms", "share", "failed", "skipped"]
    assert table[table["failed"]][["run", "function"]].values.tolist() == [[1, "f1"]]


@pytest.mark.parametrize("count", [3, 450])
def test_kept_reports_say_what_the_runs_reports_say(count, monkeypatch):
    """Those of graphs above 400 functions are packed."""
    runner = ep.CompGraphRunner(wide_graph(count), {"k": 1})
    runs = [runner.run(x=1), runner.rerun(k=2), runner.run("y0", "z", x=3), runner.rerun(), runner.rerun()]
    assert [told(report) for report in runner.reports] == [told(run.report) for run in runs]
    assert [len(report.ran) for report in runner.reports] == [count + 1, 1, 2, count - 1, 0]


def test_a_packed_report_takes_eight_bytes_per_function():
    runner = ep.CompGraphRunner(wide_graph(1_000), {"k": 1})
    runner.run(x=1)
    durations_ns = runner.reports.kept[0][2]
    assert (durations_ns.itemsize, len(durations_ns)) == (8, 1_001)


def test_reports_are_a_sequence(monkeypatch):
    runner = ep.CompGraphRunner(ep.CompGraph({"f": lambda x: x}, {"f": ("x", "y")}))
    assert (len(runner.reports), list(runner.reports), runner.reports[:]) == (0, [], [])
    with pytest.raises(IndexError):
        runner.reports[0]
    totals = [runner.run(x=x).report.total_ns for x in range(7)]
    reports = runner.reports
    for part in (slice(2), slice(-3, None), slice(1, 6, 2), slice(None, None, -1), slice(9, 20)):
        assert [report.total_ns for report in reports[part]] == totals[part]
    assert (reports[0].total_ns, reports[-1].total_ns) == (totals[0], totals[-1])
    assert [report.total_ns for report in reversed(reports)] == totals[::-1]
    assert all(isinstance(report, ep.RunReport) for report in reports)


def test_reports_can_be_read_while_runs_are_added(monkeypatch):
    monkeypatch.setattr(timing, "KEPT", 50)
    runner = ep.CompGraphRunner(ep.CompGraph({"f": lambda x: x}, {"f": ("x", "y")}))
    assert runner.reports.kept.maxlen == 50
    for x in range(50):
        runner.run(x=x)
    done = threading.Event()

    def run_until_done():
        while not done.is_set():
            runner.run(x=1)

    thread = threading.Thread(target=run_until_done)
    thread.start()
    try:
        before = runner.reports[-1].total_ns, len(runner.reports)
        for _ in range(100):
            reading = iter(runner.reports)
            next(reading)
            runner.run(x=2)  # in the midst of reading, whatever the other thread does
            assert len(list(reading)) == 49
            assert len(runner.reports[-10:]) == 10
            assert ep.summarize(runner.reports).runs == 50
    finally:
        done.set()
        thread.join()
    assert before[1] == len(runner.reports) == 50
