"""The times of one run, and of many, show as bars, as tables and as printed text."""

from __future__ import annotations

import math
import re
import xml.etree.ElementTree as ET
from html import unescape
from urllib.parse import unquote

import pandas
import pytest

import epypes as ep
from epypes.display import mimebundle
from epypes.display.paint.times import report_times
from epypes.run.program import Program
from epypes.run.timing import Reports
from tests.display.test_display import SVG, texts
from tests.display.test_plans import branching_runner, report_of, table_of
from tests.pictures import assert_same_picture

MS = 1_000_000


def report(
    times_ms: dict[str, float | None], total_ms: float, side_by_side: bool = False, failed: str = ""
) -> ep.RunReport:
    """A report of independent functions, None for one that was reused, of which one may have failed."""
    io = {name: ((), f"t{place}") for place, name in enumerate(times_ms)}
    program = Program(ep.CompGraph(dict.fromkeys(io, lambda: 1), io), True)
    names = [step.name for step in program.steps]
    spent = {names.index(name): round(time * MS) for name, time in times_ms.items() if time is not None}
    failed_at = names.index(failed) if failed else -1
    return ep.RunReport(program, None, spent, round(total_ms * MS), side_by_side, failed_at)


def bars(shown) -> dict[str, ET.Element]:
    """The rows of the picture, by the name that stands in them."""
    root = ET.fromstring(mimebundle(shown)["image/svg+xml"])
    return {texts(group)[0]: group for group in root.iter(f"{SVG}g")}


def length(group: ET.Element) -> float:
    bar = group.find(f"{SVG}rect[@class='bar']")
    return 0.0 if bar is None else float(bar.get("width"))


def range_of(group: ET.Element) -> tuple[float, float]:
    return tuple(map(float, re.fullmatch(r"M([\d.]+),\d+H([\d.]+)", group.find(f"{SVG}path").get("d")).groups()))


# -- one run ----------------------------------------------------------------------------------------------------------


def test_a_report_is_a_picture_with_a_bar_for_each_function_and_for_the_overhead():
    bundle = report({"a": 10, "b": None, "c": 5}, 20)._repr_mimebundle_()
    assert set(bundle) == {"text/plain", "text/html", "image/svg+xml"}
    found = bars(report({"a": 10, "b": None, "c": 5}, 20))
    assert list(found) == ["a", "b", "c", "graph overhead", "in all"], "in run order"
    assert [texts(group)[1] for group in found.values()] == ["10 ms, 50%", "reused", "5 ms, 25%", "5 ms, 25%", "20 ms"]
    assert length(found["a"]) == 2 * length(found["c"]) == 2 * length(found["graph overhead"]) > 0
    assert found["graph overhead"].get("class") == "time overhead"
    assert found["b"].get("class") == "time function reused"
    assert length(found["b"]) == 0
    assert found["b"].find(f"{SVG}rect[@class='track']") is not None, "drawn empty"
    assert found["c"].find(f"{SVG}title").text == "function c: 5 ms, 25% of the run"


def test_a_picture_of_times_is_readable_where_scripts_are_stripped_and_where_nothing_is_seen():
    shown = report({"a": 10}, 20)
    bundle = mimebundle(shown)
    source, alt = re.search(r'<img src="data:image/svg\+xml,([^"]*)" alt="([^"]*)"', bundle["text/html"]).groups()
    assert_same_picture(unquote(unescape(source)), bundle["image/svg+xml"])
    root = ET.fromstring(bundle["image/svg+xml"])
    assert (root.get("role"), root.get("aria-label")) == ("figure", unescape(alt))
    assert alt == "Times as bars: 1 function ran, 0 reused; in all: 20 ms"
    assert root.find(f"{SVG}rect").get("class") == "shape", "all lies on one filled shape"
    assert table_of(bundle["text/html"])[1] == ["a", "10 ms", "50%"]
    assert bundle == mimebundle(report({"a": 10}, 20)), "the same times, the same bytes"


def test_many_functions_are_summed_up_below_the_longest():
    found = bars(report_of(300))
    assert len(found) == 60 + 3
    assert next(iter(found)) == "f240"
    assert list(found)[-3:] == ["240 functions more, 1 of them reused", "graph overhead", "in all"]


@pytest.mark.parametrize(
    ("times", "total"), [({"a": 5}, 3), ({"a": 0}, 0), ({"a": 0, "b": None}, -1), ({"a": -5}, 1), ({}, 0)]
)
def test_durations_that_can_not_be_do_not_break_the_picture(times, total):
    shown = report(times, total)
    for group in bars(shown).values():
        assert 0 <= length(group) <= 280
    assert all(0 <= bar.length <= 1 for bar in report_times(shown).bars)
    assert "nan" not in mimebundle(shown)["image/svg+xml"]
    assert str(shown)


def test_overhead_of_functions_side_by_side_has_its_own_name_in_the_picture():
    label = "graph overhead (wall time less critical path)"
    found = bars(report({"a": 10, "b": 8}, 12, side_by_side=True))
    assert texts(found[label]) == [label, "2 ms, 17%"]


@pytest.mark.parametrize(
    "name", ["<script>alert(1)</script>", "\ud800", "a\0b\x1b[31m", "two\nlines", "x" * 100_000, "数え"], ids=ascii
)
def test_functions_of_any_name_have_a_bar_and_a_row(name):
    shown = report({name: 5, "b": None}, 10)
    bundle = mimebundle(shown)
    ET.fromstring(bundle["image/svg+xml"])
    assert "<script>alert" not in bundle["text/html"]
    assert len(bundle["text/html"].encode()) <= 30_000 + 2 * 600
    assert "\x1b" not in str(shown)
    assert len(str(shown).splitlines()) == 1 + 2 + 4


@pytest.mark.parametrize("count", [1, 4, 60, 61, 300])
def test_pictures_of_times_stay_small(count):
    long = "a_function_with_quite_a_long_name_{}".format
    shown = report({long(index): 1 + index for index in range(count)}, count**2)
    reports = [shown, shown]
    for each in (shown, ep.summarize(reports)):
        bundle = mimebundle(each)
        for form in ("text/html", "image/svg+xml"):
            assert 0 < len(bundle[form].encode()) <= 30_000 + 600 * count


def test_a_function_that_failed_says_after_how_long():
    shown = report({"a": 10, "b": None, "c": 0.007}, 20, failed="c")
    bundle, found = mimebundle(shown), bars(shown)
    assert "1 function ran, 1 reused, 1 failed" in bundle["text/html"]
    assert [texts(group)[1] for group in found.values()][:3] == ["10 ms, 50%", "reused", "failed after 7 µs"]
    assert [found[name].get("class") for name in "abc"] == [
        "time function",
        "time function reused",
        "time function failed",
    ]
    assert found["c"].find(f"{SVG}title").text == "function c: failed after 7 µs"
    assert 0 < length(found["c"]) < length(found["a"])
    assert table_of(bundle["text/html"])[3] == ["c", "failed after 7 µs", "0%"]
    assert "failed" not in mimebundle(report({"a": 10, "b": None}, 20))["text/plain"]
    assert "1 failed" not in mimebundle(report({"a": 10, "b": None}, 20))["text/html"]


def test_a_function_that_failed_at_once_is_shown_among_many():
    times = {f"f{place}": 5.0 for place in range(300)} | {"f7": 0.0}
    shown = report(times, 2_000, failed="f7")
    assert texts(bars(shown)["f7"]) == ["f7", "failed after 0 ns"]
    assert ["f7", "failed after 0 ns", "0%"] in table_of(mimebundle(shown)["text/html"])


# -- many runs --------------------------------------------------------------------------------------------------------


def summarized(*times_ms: float) -> ep.TimingSummary:
    return ep.summarize([report({"a": time, "b": 1}, time + 2) for time in times_ms])


def test_a_summary_is_a_picture_with_the_median_as_a_bar_and_the_range_as_a_line():
    summary = summarized(8, 9, 10, 11, 12)
    found = bars(summary)
    assert list(found) == ["a", "b", "graph overhead", "in all"]
    assert "Bars: the median time of each function; lines: 5 % to 95 %" in mimebundle(summary)["text/html"]
    assert length(found["a"]) == pytest.approx(length(found["b"]) * summary.functions["a"].median_ns / MS, rel=0.01)
    low, high = range_of(found["a"])
    left = float(found["a"].find(f"{SVG}rect").get("x"))
    assert low - left < length(found["a"]) < high - left
    fitted = summary.functions["a"]
    ratio = fitted.quantile_ns(0.95) / fitted.quantile_ns(0.05)
    assert (high - left) / (low - left) == pytest.approx(ratio, rel=0.02)
    assert re.fullmatch(r"[\d.]+ ms \([\d.]+ ms to [\d.]+ ms\)", texts(found["a"])[1])
    title = found["a"].find(f"{SVG}title").text
    assert title.startswith("function a: median 9.")
    assert title.endswith("in 5 runs")


def test_of_fewer_than_five_runs_no_range_is_told():
    for runs, has_range in ((4, False), (5, True)):
        summary = summarized(*range(8, 8 + runs))
        found, html = bars(summary), mimebundle(summary)["text/html"]
        for name in ("a", "b", "graph overhead"):
            assert (found[name].find(f"{SVG}path") is not None) == has_range
            assert (" to " in found[name].find(f"{SVG}title").text) == has_range
            assert (" to " in texts(found[name])[1]) == has_range
        assert length(found["a"]) > 5 * length(found["b"]) > 0
        assert all(bool(row[-1]) == has_range for row in table_of(html)[1:])


def test_one_run_in_a_thousand_does_not_shrink_all_other_bars():
    found = bars(summarized(1, 1, 1, 1, 10_000))
    assert length(found["b"]) > 5
    assert max(range_of(found["a"])) <= 280 + float(found["a"].find(f"{SVG}rect").get("x"))


def test_a_summary_without_positive_values_says_so_in_the_picture():
    found = bars(ep.summarize([report({"a": 0}, 0)]))
    assert texts(found["a"]) == ["a", "no positive value"]
    assert length(found["a"]) == 0


def test_reports_show_as_their_summary_does():
    runner = branching_runner()
    for image in range(5):
        runner.run(image=image)
    shown = mimebundle(runner.reports)
    summary = mimebundle(ep.summarize(runner.reports))
    assert {form: shown[form] for form in ("text/html", "image/svg+xml")} == {
        form: summary[form] for form in ("text/html", "image/svg+xml")
    }
    assert shown["text/plain"] == repr(runner.reports) == "<Reports of 5 runs>"
    assert str(runner.reports) == str(ep.summarize(runner.reports))


def test_reports_without_a_run_show_a_sentence():
    shown = Reports()._repr_mimebundle_()
    assert shown["text/html"] == "<p>No run has ended yet, so there are no times. Call run(...) first.</p>"
    assert str(Reports()) == "No run has ended yet, so there are no times. Call run(...) first."
    assert repr(Reports()) == "<Reports of 0 runs>"


def test_reports_of_failed_runs_alone_show_a_sentence():
    runner = ep.CompGraphRunner(ep.CompGraph({"f": lambda x: 1 / x}, {"f": ("x", "y")}))
    for said in ("The only run has failed", "All 2 runs have failed"):
        with pytest.raises(ZeroDivisionError):
            runner.run(x=0)
        sentence = f"{said}, so there are no times to summarize. runner.last.failure says why."
        assert mimebundle(runner.reports) == {"text/plain": repr(runner.reports), "text/html": f"<p>{sentence}</p>"}
        assert str(runner.reports) == sentence
    runner.run(x=1)
    assert str(runner.reports).startswith("1 run, 2 failed runs left out; log-normal distributions\n")
    assert "1 run, 2 failed runs left out" in mimebundle(runner.reports)["text/html"]


def test_reports_become_a_table_of_one_row_per_run_and_function():
    runner = ep.CompGraphRunner(
        ep.CompGraph({"f": abs, "g": lambda y, k: y}, {"f": ("x", "y"), "g": (("y", "k"), "z")}), {"k": 1}
    )
    columns = ["run", "function", "ran", "time_ms", "share", "failed", "skipped"]
    assert list(runner.reports.to_frame().columns) == columns
    assert len(runner.reports.to_frame()) == 0
    runner.run(x=1)
    runner.rerun(k=2)
    table = runner.reports.to_frame()
    assert isinstance(table, pandas.DataFrame)
    assert list(table.columns) == columns
    assert [tuple(row) for row in table[["run", "function", "ran"]].values] == [
        (0, "f", True), (0, "g", True), (1, "f", False), (1, "g", True),
    ]  # fmt: skip
    assert table["time_ms"][0] == runner.reports[0].durations_ns["f"] / 1e6
    own = runner.reports[1].to_frame()
    assert own.equals(table[table["run"] == 1].drop(columns="run").reset_index(drop=True))


# -- printed ----------------------------------------------------------------------------------------------------------


def cells_of(text: str) -> list[list[str]]:
    """The cells of a printed table, parted where the line below its head is."""
    rule = next(place for place, line in enumerate(text.splitlines()) if set(line) == {"-", " "})
    ends = [(match.start(), match.end()) for match in re.finditer("-+", text.splitlines()[rule])]
    lines = text.splitlines()[rule - 1 : rule] + text.splitlines()[rule + 1 :]
    return [[line[start:end].strip() for start, end in ends] for line in lines]


def plan_with_all() -> ep.Plan:
    runner = branching_runner()
    runner.run(image=1)
    runner["lo"] = 5
    return runner.plan()


@pytest.mark.parametrize(
    "shown",
    [
        report({"a": 10, "a longer name": None, "c": 5}, 20),
        report_of(300),
        report({"a": 10, "b": None, "c": 0.007}, 20, failed="c"),
        ep.summarize([report({"a": 1, "b": 2}, 4)] * 5 + [report({"a": 1}, 4, failed="a")]),
        ep.summarize([report({"a": 1, "b": 0}, 4), report({"a": 2, "b": 0}, 4)]),
        plan_with_all(),
        branching_runner().plan(),
    ],
    ids=["report", "long report", "failed", "summary with failed", "summary", "plan", "plan with missing"],
)
def test_what_is_printed_says_what_the_page_says(shown):
    text, html = str(shown), mimebundle(shown)["text/html"]
    assert cells_of(text) == table_of(html)
    assert text.splitlines()[0] in unescape(html), "the caption"
    assert len(text.splitlines()) <= 1 + 2 + 100
    assert all(line == line.rstrip() for line in text.splitlines())
    assert len(repr(shown)) < 100
    assert "\n" not in repr(shown)
    assert not re.search(r"\d (ns|µs|ms|s)\b", repr(shown))


def test_quantities_stand_to_the_right_and_words_to_the_left():
    lines = str(report({"a": 10, "long": 0.5}, 20)).splitlines()
    assert lines == [
        "2 functions ran, 0 reused",
        "function          time  share",
        "--------------  ------  -----",
        "a                10 ms    50%",
        "long            500 µs     2%",
        "in all           20 ms",
        "graph overhead  9.5 ms    48%",
    ]


def test_the_run_shows_times_that_its_report_has():
    run = branching_runner().run(image=1)
    assert list(bars(run.report))[:-2] == [entry.function for entry in run.report.functions]
    assert math.isclose(sum(run.report.to_frame()["share"]) + run.report.overhead_ns / run.report.total_ns, 1)


def test_a_report_says_which_functions_were_skipped():
    cg = ep.CompGraph({"find": lambda x: ep.Nothing, "mark": abs}, {"find": ("x", "y"), "mark": ("y", "z")})
    report = ep.CompGraphRunner(cg).run(x=1).report
    assert "1 function ran, 0 reused, 1 skipped" in mimebundle(report)["text/html"]
    assert [line.split()[:2] for line in str(report).splitlines() if line.startswith("mark")] == [["mark", "skipped"]]
    row = report.to_frame().set_index("function").loc["mark"]
    assert (bool(row["ran"]), float(row["time_ms"]), bool(row["skipped"])) == (False, 0.0, True)
