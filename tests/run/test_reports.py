"""The last reports of a runner are kept, small, and can be read while runs go on."""

from __future__ import annotations

import threading

import pytest

import epypes as ep
from epypes.run import report as report_module


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


@pytest.mark.parametrize("count", [3, 450])
def test_kept_reports_say_what_the_runs_reports_say(count, monkeypatch):
    """Those of graphs above 400 functions are packed."""
    runner = ep.CompGraphRunner(wide_graph(count), {"k": 1})
    runs = [runner.run(x=1), runner.rerun(k=2), runner.run("y0", "z", x=3), runner.rerun(), runner.rerun()]
    assert [told(report) for report in runner.reports] == [told(run.report) for run in runs]
    assert [len(report.ran) for report in runner.reports] == [count + 1, 1, 2, count - 1, 0]
    packed = [not isinstance(times[2], dict) for times in runner.reports.kept]
    assert packed[0] == (count > 400)


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
    monkeypatch.setattr(report_module, "_KEPT", 50)
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
