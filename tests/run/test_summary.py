from __future__ import annotations

import math
import random
import statistics
from html import unescape

import pytest

import epypes as ep
from epypes.run.program import Program

CHAIN = ep.CompGraph(
    {"first": lambda x: x, "second": lambda x, k: x + k},
    {"first": ("x", "y"), "second": (("y", "k"), "z")},
)


def report_of(durations_ns, total_ns=10_000, cg=CHAIN, side_by_side=False, failed=None):
    """A report with these times by function, of a run in which a function may have failed."""
    places = {name: place for place, name in enumerate(cg.functions)}
    by_step = {places[name]: duration for name, duration in durations_ns.items()}
    return ep.RunReport(Program(cg, True), None, by_step, total_ns, side_by_side, places.get(failed, -1))


def test_the_fit_is_the_one_of_maximum_likelihood():
    drawn = random.Random(1)
    durations = [round(drawn.lognormvariate(13.0, 0.4)) for _ in range(2000)]
    fitted = ep.summarize([report_of({"first": duration}) for duration in durations]).functions["first"]
    logs = [math.log(duration) for duration in durations]
    assert fitted.mu == pytest.approx(statistics.fmean(logs), rel=1e-12)
    assert fitted.sigma == pytest.approx(statistics.pstdev(logs), rel=1e-12)
    assert (fitted.count, fitted.least_ns, fitted.most_ns) == (2000, min(durations), max(durations))
    assert fitted.mu == pytest.approx(13.0, abs=0.05)
    assert fitted.sigma == pytest.approx(0.4, abs=0.05)


def test_the_density_is_the_derivative_of_the_quantiles_and_highest_at_the_mode():
    fitted = ep.LogNormal(count=9, not_positive=0, mu=math.log(3e5), sigma=0.6, least_ns=1, most_ns=2)
    for share in (0.05, 0.3, 0.5, 0.9):
        low, at, high = (fitted.quantile_ns(share + step) for step in (-1e-6, 0, 1e-6))
        assert fitted.pdf(at) == pytest.approx(2e-6 / (high - low), rel=1e-4)
    assert fitted.quantile_ns(0.5) == pytest.approx(fitted.median_ns)
    around = [fitted.pdf(fitted.mode_ns * factor) for factor in (0.99, 1.0, 1.01)]
    assert max(around) == around[1]
    step = 500.0
    mean = sum(step * index * fitted.pdf(step * index) * step for index in range(1, 20_000))
    assert fitted.mean_ns == pytest.approx(mean, rel=1e-3)
    assert fitted.pdf(0) == fitted.pdf(-5) == 0.0


def test_equal_durations_are_all_at_one_place():
    fitted = ep.summarize([report_of({"first": 700})] * 3).functions["first"]
    assert fitted.sigma == 0
    assert [fitted.median_ns, fitted.mode_ns, fitted.mean_ns, fitted.quantile_ns(0.95)] == pytest.approx([700] * 4)
    assert fitted.pdf(600) == 0.0


def test_values_that_are_not_positive_are_counted_and_not_fitted():
    reports = [report_of({"first": duration}) for duration in (0, 0, 1000, 1000)]
    fitted = ep.summarize(reports).functions["first"]
    assert (fitted.count, fitted.not_positive, fitted.least_ns) == (4, 2, 0)
    assert fitted.median_ns == pytest.approx(1000)
    assert "2 not positive" in repr(fitted)
    assert "4, 2 not positive" in ep.summarize(reports)._repr_mimebundle_()["text/html"]


def test_without_a_positive_value_nothing_is_fitted_and_the_texts_say_so():
    summary = ep.summarize([report_of({"first": 0}, total_ns=0)])
    fitted = summary.functions["first"]
    assert math.isnan(fitted.mu)
    assert math.isnan(fitted.sigma)
    assert math.isnan(fitted.pdf(5))
    assert "no positive value" in repr(fitted)
    html = summary._repr_mimebundle_()["text/html"]
    assert html[html.rindex("<table>") :].count("no positive value") == 3
    assert summary.to_frame()["median_ms"].isna().all()


def test_functions_stand_in_run_order_and_count_the_runs_in_which_they_ran():
    runner = ep.CompGraphRunner(CHAIN, {"k": 1})
    runner.run(x=1)
    for k in range(2, 6):
        runner.rerun(k=k)
    summary = ep.summarize(list(runner.reports)[::-1])
    assert {name: fitted.count for name, fitted in summary.functions.items()} == {"first": 1, "second": 5}
    assert list(summary.functions) == ["first", "second"]
    assert summary.runs == summary.total.count == summary.overhead.count == 5
    assert "third" not in summary.functions


def test_a_function_that_never_ran_is_not_in_the_summary():
    assert list(ep.summarize([report_of({"second": 5})]).functions) == ["second"]


def test_reports_of_several_graphs_are_taken_together_by_name():
    other = ep.CompGraph({"first": lambda x: x, "third": lambda x: x}, {"first": ("x", "y"), "third": ("y", "z")})
    summary = ep.summarize([report_of({"first": 10, "second": 20}), report_of({"first": 30, "third": 5}, cg=other)])
    assert {name: fitted.count for name, fitted in summary.functions.items()} == {"first": 2, "second": 1, "third": 1}
    assert (summary.functions["first"].least_ns, summary.functions["first"].most_ns) == (10, 30)


def test_the_table_has_a_row_per_function_and_two_for_the_whole():
    durations = (1_000_000, 1_000_000, 2_000_000, 4_000_000, 4_000_000)
    frame = ep.summarize(
        report_of({"first": value, "second": 500_000}, total_ns=5_000_000) for value in durations
    ).to_frame()
    assert list(frame.columns) == ["function", "runs", "not_positive", "mode_ms", "median_ms", "p05_ms", "p95_ms"]
    assert list(frame["function"]) == ["first", "second", "total", "graph overhead"]
    row = frame.set_index("function").loc["first"]
    assert row["median_ms"] == pytest.approx(2.0)
    sigma = statistics.pstdev(map(math.log, durations))
    assert row["mode_ms"] == pytest.approx(2.0 * math.exp(-(sigma**2)))
    assert row["p95_ms"] == pytest.approx(2.0 * math.exp(1.6448536269514722 * sigma))
    assert row["p05_ms"] == pytest.approx(2.0 * math.exp(-1.6448536269514722 * sigma))


def test_a_summary_shows_itself_small_and_names_the_overhead_for_what_it_is():
    summary = ep.summarize([report_of({"first": 2_000_000, "second": 3}, total_ns=5_000_000)] * 7)
    bundle = summary._repr_mimebundle_()
    assert bundle["text/plain"] == "<TimingSummary: 7 runs, 2 functions>"
    assert ">first</td><td>7</td><td>2 ms</td><td>2 ms</td><td>2 ms to 2 ms</td>" in bundle["text/html"]
    assert ">graph overhead</td>" in bundle["text/html"]
    summary = ep.summarize([report_of({"first": 2}), report_of({"first": 2}, side_by_side=True)])
    assert "graph overhead (wall time less critical path)" in summary._repr_mimebundle_()["text/html"]


def test_a_summary_of_a_large_graph_keeps_a_hundred_rows():
    names = [f"f{index}" for index in range(300)]
    cg = ep.CompGraph(dict.fromkeys(names, lambda: 1), {name: ((), f"of_{name}") for name in names})
    times = {name: 1000 + index for index, name in enumerate(names)}
    html = ep.summarize([report_of(times, cg=cg)])._repr_mimebundle_()["text/html"]
    assert html.count("<tr>") == 1 + 100
    assert ">f299</td>" in html
    assert ">f0</td>" not in html
    assert "203 functions more" in unescape(html)


def test_failed_runs_are_counted_and_left_out_of_every_distribution():
    ended = [report_of({"first": 50_000_000, "second": 3_000}, 51_000_000)] * 4
    failed = report_of({"first": 7_000}, 9_000, failed="first")
    summary = ep.summarize(
        [failed, *ended[:2], report_of({"first": 60_000_000, "second": 2}, failed="second"), *ended[2:]]
    )
    assert (summary.runs, summary.failed_runs) == (4, 2)
    without = ep.summarize(ended)
    assert (without.runs, without.failed_runs) == (4, 0)
    assert (summary.functions, summary.total, summary.overhead) == (without.functions, without.total, without.overhead)
    assert summary.functions["first"].median_ns == pytest.approx(50_000_000)
    html = summary._repr_mimebundle_()["text/html"]
    assert "4 runs, 2 failed runs left out; log-normal distributions" in html
    assert (
        "4 runs, 1 failed run left out; log-normal" in ep.summarize([failed, *ended])._repr_mimebundle_()["text/html"]
    )


def test_what_only_failed_runs_did_is_not_in_a_summary():
    other = ep.CompGraph({"third": lambda x: x}, {"third": ("x", "y")})
    failed = report_of({"third": 5}, cg=other, side_by_side=True, failed="third")
    summary = ep.summarize([report_of({"first": 5}), failed])
    assert list(summary.functions) == ["first"]
    assert not summary.side_by_side


@pytest.mark.parametrize(("count", "said"), [(1, "The only run has failed"), (3, "All 3 runs have failed")])
def test_where_all_runs_have_failed_nothing_can_be_summarized(count, said):
    with pytest.raises(ValueError, match=rf"{said}, so there are no times.*runner\.last\.failure says why\."):
        ep.summarize([report_of({"first": 5}, failed="first")] * count)


def test_fewer_than_five_durations_have_no_range():
    reports = [report_of({"first": duration, "second": duration}) for duration in (1_000, 2_000, 3_000, 4_000)]
    few = ep.summarize([*reports, report_of({"first": 5_000, "second": 0})])
    assert {name: fitted.has_range for name, fitted in few.functions.items()} == {"first": True, "second": False}
    assert few.total.has_range, "equal durations are durations too"
    frame = few.to_frame().set_index("function")
    assert frame["p05_ms"].isna().to_dict() == frame["p95_ms"].isna().to_dict()
    assert frame["p05_ms"].isna().to_dict() == {"first": False, "second": True, "total": False, "graph overhead": False}
    assert frame["median_ms"].notna().all()


def test_nothing_to_summarize_is_refused_with_the_way_out():
    with pytest.raises(ValueError, match=r"runner\.run\(\.\.\.\)"):
        ep.summarize([])
    with pytest.raises(TypeError, match="RunReports, such as runner.reports, not 'str'"):
        ep.summarize(["report"])
