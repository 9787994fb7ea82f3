from __future__ import annotations

import re
import sys
import types
import xml.etree.ElementTree as ET
from html import unescape

import pytest

import epypes as ep
from epypes.display import mimebundle, to_svg, view
from epypes.display.layout import lay_out
from epypes.run.program import Program
from tests.display.test_display import SVG, texts, vertices


def branching(**more) -> ep.CompGraph:
    functions = {"gray": lambda x: x + 1, "canny": lambda g, lo: g * lo, "sobel": lambda g, k: g - k, "wide": abs}
    io = {
        "gray": ("image", "gray_image"),
        "canny": (("gray_image", "lo"), "edges_canny"),
        "sobel": (("gray_image", "k"), "edges_sobel"),
        "wide": ("edges", "end"),
    }
    chooser = ep.switch("choose", {"canny": "edges_canny", "sobel": "edges_sobel"}, by="method", output="edges")
    return ep.CompGraph({**functions, **more}, io) | chooser


def branching_runner(method="canny") -> ep.CompGraphRunner:
    return ep.CompGraphRunner(branching(), {"lo": 2, "k": 3, "method": method})


def function_states(shown) -> dict[str, str]:
    return {function.name: function.state for function in view(shown).functions}


def token_states(shown) -> dict[str, str]:
    return {token.name: token.state for token in view(shown).tokens}


def dead_edges(shown) -> set[tuple[str, str]]:
    seen = view(shown)
    return {
        (seen.functions[edge.function].name, seen.tokens[edge.token].name) for edge in seen.edges if not edge.is_live
    }


def table_of(html: str) -> list[list[str]]:
    """The rows of the table that is seen, not of the one for screen readers."""
    visible = html[html.rindex("<table>") :]
    rows = re.findall(r"<tr>(.*?)</tr>", visible)
    return [[unescape(cell) for cell in re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row)] for row in rows]


# -- plans ------------------------------------------------------------------------------------------------------------


def test_a_plan_shows_what_would_run_and_why():
    runner = branching_runner()
    runner.run(image=1)
    runner["lo"] = 5
    bundle = runner.plan()._repr_mimebundle_()
    assert set(bundle) == {"text/plain", "text/html", "image/svg+xml"}
    assert bundle["text/plain"] == "<Plan: 3 functions to run, 1 reused>"
    assert table_of(bundle["text/html"]) == [
        ["function", "plan", "why"],
        ["gray", "reused", "up to date"],
        ["canny", "runs", "'lo' changed"],
        ["sobel", "left out", "only for a branch that is not chosen"],
        ["choose", "runs", "takes 'edges_canny', made anew"],
        ["wide", "runs", "takes 'edges', made anew"],
    ]
    found = vertices(bundle["image/svg+xml"])
    assert found["function-canny"].get("class") == "function planned"
    assert texts(found["function-canny"]) == ["canny", "to run", "'lo' changed"]
    assert found["function-gray"].get("class") == "function reused"
    assert found["function-sobel"].get("class") == "function left-out"
    assert texts(found["token-lo"]) == ["lo = 5"]
    assert "'lo' changed" in found["function-canny"].find(f"{SVG}title").text


def test_a_plan_names_the_source_tokens_that_are_missing():
    plan = branching_runner().plan()
    bundle = mimebundle(plan)
    assert "missing: image: call run(image=...)" in unescape(bundle["text/html"])
    found = vertices(bundle["image/svg+xml"])
    assert found["token-image"].get("class") == "token payload missing"
    assert texts(found["token-image"]) == ["image", "missing"]


def test_a_plan_for_targets_leaves_out_what_they_do_not_need():
    runner = branching_runner("sobel")
    runner.run(image=1)
    plan = runner.plan("edges_canny")
    states = function_states(plan)
    assert states == {
        "gray": "reused", "canny": "planned", "sobel": "left out", "choose": "left out", "wide": "left out",
    }  # fmt: skip
    assert ["wide", "left out", "not needed for these targets"] in table_of(mimebundle(plan)["text/html"])
    assert token_states(plan)["end"] == "left out"


def test_a_plan_shows_in_text_where_nothing_is_laid_out(monkeypatch, tmp_path):
    lay_out.cache_clear()
    monkeypatch.setitem(sys.modules, "pygraphviz", None)
    monkeypatch.setenv("PATH", str(tmp_path))
    plain = mimebundle(branching_runner().plan())["text/plain"]
    lay_out.cache_clear()
    assert "canny(gray_image, lo) -> edges_canny  [to run]  not computed yet" in plain
    assert "choose(method, edges_canny, edges_sobel) -> edges  [to run]  method = canny" in plain
    assert "sobel(gray_image, k) -> edges_sobel  [left out]" in plain
    assert "missing image" in plain


@pytest.mark.parametrize("count", [4, 60, 200])
def test_plans_stay_small_and_the_same(count):
    io = {f"function_{index}": ((f"token_{index}",), f"token_{index + 1}") for index in range(count)}
    cg = ep.CompGraph(dict.fromkeys(io, abs), io)
    plan = ep.CompGraphRunner(cg).plan()
    bundle = mimebundle(plan)
    limit = 30_000 + 600 * (count + len(cg.tokens)) + 80_000 * (count > 24)  # groups show tokens twice
    assert 0 < len(bundle["text/html"].encode()) <= limit
    assert 0 < len(bundle["image/svg+xml"].encode()) <= limit
    assert len(table_of(bundle["text/html"])) <= 1 + 100
    assert bundle == mimebundle(plan)
    if count > 100:
        assert table_of(bundle["text/html"])[-1] == [f"{count - 97} functions more", f"{count - 97} runs", ""]


# -- switches ---------------------------------------------------------------------------------------------------------


def test_a_graph_has_not_chosen_a_branch():
    cg = branching()
    assert dead_edges(cg) == {("choose", "edges_canny"), ("choose", "edges_sobel")}
    found = vertices(to_svg(cg))
    assert found["function-choose"].get("class") == "function switch static"
    assert texts(found["function-choose"]) == ["choose", "one of 2 by method"]
    assert found["function-choose"].find(f"{SVG}polygon") is not None, "a switch has a shape of its own"
    assert set(token_states(cg).values()) == {"static"}


def test_the_branch_that_is_chosen_shows_before_and_after_a_run_and_after_a_change():
    runner = branching_runner()
    off_sobel = {
        ("choose", "edges_sobel"), ("sobel", "edges_sobel"), ("sobel", "gray_image"), ("sobel", "k"),
    }  # fmt: skip
    off_canny = {
        ("choose", "edges_canny"), ("canny", "edges_canny"), ("canny", "gray_image"), ("canny", "lo"),
    }  # fmt: skip
    assert dead_edges(runner) == off_sobel
    assert function_states(runner)["sobel"] == "left out"
    run = runner.run(image=1)
    for shown in (runner, run):
        assert dead_edges(shown) == off_sobel
        assert function_states(shown)["canny"] == "ran"
        states = token_states(shown)
        assert {name for name, state in states.items() if state == "left out"} == {"edges_sobel", "k"}
        assert texts(vertices(to_svg(shown))["function-choose"])[1] == "method = canny"
    runner["method"] = "sobel"
    assert dead_edges(runner) == off_canny
    assert function_states(runner) == {
        "gray": "ran", "canny": "left out", "sobel": "not run", "choose": "stale", "wide": "stale",
    }  # fmt: skip
    assert dead_edges(run) == off_sobel, "the run is as it was"


def test_edges_that_no_run_uses_are_dashed():
    root = ET.fromstring(to_svg(branching_runner()))
    classes = {path.get("class"): path.get("d") for path in root.iter(f"{SVG}path")}
    assert set(classes) == {"edge", "tip", "edge off", "tip off"}
    assert [classes[name].count("M") for name in ("edge", "edge off")] == [10, 4]
    assert ".edge.off{stroke-dasharray" in root.find(f"{SVG}style").text
    plain = ET.fromstring(to_svg(ep.CompGraph({"f": abs}, {"f": ("x", "y")})))
    assert {path.get("class") for path in plain.iter(f"{SVG}path")} == {"edge", "tip"}


def test_a_branch_that_was_asked_for_by_name_is_not_left_out_of_its_run():
    run = branching_runner("sobel").run("edges_canny", image=1)
    assert function_states(run)["canny"] == "ran"
    assert token_states(run)["edges_canny"] == "fresh"


def test_a_selector_that_comes_with_the_payload_chooses_too():
    runner = ep.CompGraphRunner(branching(), {"lo": 2, "k": 3})
    assert "left out" not in function_states(runner).values(), "nobody has chosen"
    runner.run(image=1, method="sobel")
    assert function_states(runner)["canny"] == "left out"


def test_a_source_token_of_another_branch_is_left_out():
    cg = ep.switch("pick", {1: "first", 2: "second"}, by="which", output="picked")
    assert token_states(ep.CompGraphRunner(cg, {"which": 2}))["first"] == "left out"
    assert token_states(cg)["first"] == "static"


# -- placeholders and redefined functions -----------------------------------------------------------------------------


def test_a_placeholder_is_dashed_and_says_that_it_is_to_be_written():
    cg = ep.CompGraph({"f": abs, "g": ep.Placeholder()}, {"f": ("x", "y"), "g": ("y", "z")})
    runner = ep.CompGraphRunner(cg)
    plan = runner.plan()
    runner.run("y", x=1)
    for shown in (cg, runner, runner.last, plan):
        group = vertices(to_svg(shown))["function-g"]
        assert "placeholder" in group.get("class").split()
        assert texts(group) == ["g", "to be written"]
    assert ".placeholder .shape{stroke-dasharray" in to_svg(cg)
    assert ["g", "placeholder", "still to be written; ep.extend fills it"] in table_of(mimebundle(plan)["text/html"])


CELL = "def blur(x):\n    return x + {}\n"


@pytest.fixture
def cells():
    """A module that is filled like a notebook's."""
    module = types.ModuleType("cells_of_a_notebook")
    sys.modules[module.__name__] = module
    exec(CELL.format(1), module.__dict__)
    yield module
    del sys.modules[module.__name__]


def test_a_function_that_was_redefined_is_marked_everywhere(cells):
    runner = ep.CompGraphRunner(ep.CompGraph({"blur": cells.blur, "f": abs}, {"blur": ("x", "y"), "f": ("y", "z")}))
    run = runner.run(x=1)
    assert "redefined" not in to_svg(run).partition("</style>")[2]
    exec(CELL.format(2), cells.__dict__)
    for shown in (runner.cg, runner, run, runner.plan()):
        bundle = mimebundle(shown)
        found = vertices(bundle["image/svg+xml"])
        assert "redefined" in found["function-blur"].get("class").split()
        assert "redefined" not in found["function-f"].get("class").split()
        assert "redefined since: build the graph again" in texts(found["function-blur"])
        assert "'blur' was redefined since the graph was built: run the cell" in unescape(bundle["text/html"])
    assert repr(runner) == "<CompGraphRunner: 2 functions (1 redefined), 0 hyperparameters; up to date>"
    assert repr(run) == "<Run: completed; 3 of 3 tokens; 1 function redefined>"


def test_pipelines_and_the_graphs_around_them_are_marked_too(cells):
    inner = ep.Pipeline("inner", ep.CompGraph({"blur": cells.blur}, {"blur": ("x", "y")}))
    outer = ep.Pipeline("outer", ep.CompGraph({"smooth": inner, "f": abs}, {"smooth": ("a", "b"), "f": ("b", "c")}))
    exec(CELL.format(2), cells.__dict__)
    for pipe, name, note, said in (
        (inner, "blur", "redefined since: build the graph again", "'blur'"),
        (outer, "smooth", "a function inside was redefined: build again", "A function inside 'smooth'"),
    ):
        bundle = mimebundle(pipe)
        found = vertices(bundle["image/svg+xml"])
        assert {note, "redefined"} <= {
            *texts(found[f"function-{name}"]),
            *found[f"function-{name}"].get("class").split(),
        }
        assert f"{said} was redefined since the graph was built: run the cell" in unescape(bundle["text/html"])
    assert "redefined" not in vertices(mimebundle(outer)["image/svg+xml"])["function-f"].get("class")


def test_reprs_stay_short_when_a_redefined_function_fails_and_the_names_are_long(cells):
    name = "a_name_of_a_function_that_is_much_too_long_to_be_shown"
    cg = ep.CompGraph({name: cells.blur, **dict.fromkeys(map(str, range(999)), abs)},
                      {name: ("x", "y"), **{str(index): ("y", f"z{index}") for index in range(999)}})  # fmt: skip
    runner = ep.CompGraphRunner(cg, {})
    with pytest.raises(TypeError):
        runner.run(x="text")
    exec(CELL.format(3), cells.__dict__)
    for shown in (cg, runner, runner.last):
        assert "redefined" in repr(shown)
        assert len(repr(shown)) < 100


# -- reports ----------------------------------------------------------------------------------------------------------


def report_of(count: int, side_by_side: bool = False) -> ep.RunReport:
    io = {f"f{index}": ((), f"t{index}") for index in range(count)}
    program = Program(ep.CompGraph(dict.fromkeys(io, lambda: 1), io), True)
    times = {index: 1_000_000 + index for index in range(1, count)}
    return ep.RunReport(program, None, times, 2_000_000_000, side_by_side)


def test_the_table_of_a_report_counts_what_ran_and_ends_with_the_overhead():
    html = report_of(4)._repr_mimebundle_()["text/html"]
    assert "3 functions ran, 1 reused" in html
    rows = table_of(html)
    assert rows[1] == ["f0", "reused", ""]
    assert rows[-2:] == [["in all", "2 s", ""], ["graph overhead", "2 s", "100%"]]


def test_overhead_of_functions_side_by_side_is_labelled_for_what_it_is():
    label = "graph overhead (wall time less critical path)"
    assert table_of(report_of(4, side_by_side=True)._repr_mimebundle_()["text/html"])[-1][0] == label
    run = branching_runner().run(image=1)
    assert label not in view(run).caption
    run = ep.Run(run.tokens, run.hparams, (*run.times[:4], True, -1, ()), None)
    assert label in view(run).caption
    assert label in unescape(mimebundle(run)["text/html"])


def test_a_long_report_keeps_the_longest_times_and_sums_up_the_rest():
    rows = table_of(report_of(300)._repr_mimebundle_()["text/html"])
    assert len(rows) == 1 + 100
    assert [rows[1][0], rows[97][0]] == ["f203", "f299"], "in run order"
    assert rows[98][:2] == ["203 functions more, 1 of them reused", "202 ms"]
