"""A picture shows in which state everything is, also while functions run."""

from __future__ import annotations

import contextlib
import gc
import json
import re
import subprocess
import sys
import threading
import types
import weakref

import numpy as np
import pytest

import epypes as ep
from epypes.display import mimebundle, to_svg, view
from epypes.display.layout import lay_out
from epypes.display.views.graphview import from_json, to_json
from epypes.run import execute
from tests.display.test_display import SVG, texts, vertices

TIMEOUT_S = 60.0


class Gate:
    """Functions that wait until they are let through, once it is closed."""

    def __init__(self):
        self.opened, self.arrived = threading.Event(), threading.Semaphore(0)
        self.opened.set()

    def __call__(self, x):
        self.arrived.release()
        assert self.opened.wait(TIMEOUT_S)
        return x

    @contextlib.contextmanager
    def holding(self, run, count=1):
        """Within, ``run`` goes on in a thread of its own and ``count`` functions are waiting."""
        self.arrived = threading.Semaphore(0)
        self.opened.clear()
        thread = threading.Thread(target=run)
        thread.start()
        try:
            for _ in range(count):
                assert self.arrived.acquire(timeout=TIMEOUT_S)
            yield
        finally:
            self.opened.set()
            thread.join(TIMEOUT_S)


@pytest.fixture
def gate():
    return Gate()


def gated(gate, **more) -> ep.CompGraphRunner:
    """A runner of a chain whose middle waits."""
    cg = ep.CompGraph(
        {"first": lambda x, k: x + k, "slow": lambda y: gate(y), "last": abs},
        {"first": (("x", "k"), "y"), "slow": ("y", "z"), "last": ("z", "end")},
    )
    return ep.CompGraphRunner(cg, {"k": 1}, **more)


def states(shown) -> dict[str, str]:
    return {function.name: function.state for function in view(shown).functions}


# -- running ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("runs_before", [0, 1, 8], ids=["first", "loop", "compiled"])
def test_a_function_that_is_being_run_is_told_whichever_way_it_is_run(gate, runs_before):
    runner = gated(gate)
    for _ in range(runs_before):
        runner.run(x=1)
    with gate.holding(lambda: runner.run(x=2)):
        assert runner.running == ("slow",)
        assert states(runner)["slow"] == "running"
        found = vertices(to_svg(runner))["function-slow"]
        assert found.get("class") == "function running"
        assert texts(found) == ["slow", "running"]
        assert "running: slow" in mimebundle(runner)["text/html"]
    assert runner.running == ()
    assert states(runner)["slow"] == "ran"


@pytest.mark.parametrize("reruns_before", [0, 8], ids=["loop", "compiled"])
def test_a_rerun_tells_what_is_being_run_too(gate, reruns_before):
    runner = gated(gate)
    runner.run(x=1)
    for k in range(reruns_before):
        runner.rerun(k=k + 2)
    with gate.holding(lambda: runner.rerun(k=100)):
        assert runner.running == ("slow",)
    assert runner["end"] == 101


def test_functions_side_by_side_are_all_told(gate, monkeypatch):
    monkeypatch.setattr(execute.Gain, "is_worth_it", lambda self: True)
    functions = {"left": lambda x: gate(x), "right": lambda x: gate(x)}
    runner = ep.CompGraphRunner(ep.CompGraph(functions, {"left": ("x", "a"), "right": ("x", "b")}), workers=2)
    with gate.holding(lambda: runner.run(x=1), count=2):
        assert runner.running == ("left", "right")
    assert runner.running == ()


def test_a_run_in_two_threads_tells_each_function_once(gate):
    runner = gated(gate)
    with gate.holding(lambda: runner.run(x=1)):
        other = threading.Thread(target=lambda: runner.run(x=2))
        other.start()
        assert gate.arrived.acquire(timeout=TIMEOUT_S)
        assert runner.running == ("slow",)
    other.join(TIMEOUT_S)


@pytest.mark.parametrize("runs_before", [1, 8], ids=["loop", "compiled"])
def test_only_the_runner_that_runs_tells_it(gate, runs_before):
    runner = gated(gate)
    other = ep.CompGraphRunner(runner.cg, {"k": 1})
    for _ in range(runs_before):
        runner.run(x=1)
        other.run(x=1)
    with gate.holding(lambda: runner.run(x=1)):
        assert (runner.running, other.running) == (("slow",), ())


def test_a_pipeline_inside_a_graph_runs_while_its_function_does(gate):
    inner = ep.Pipeline("inner", gated(gate).cg, {"k": 1})
    outer = ep.CompGraphRunner(
        ep.CompGraph({"before": abs, "inside": inner}, {"before": ("x", "y"), "inside": ("y", "z")})
    )
    with gate.holding(lambda: outer.run(x=1)):
        assert (outer.running, inner.runner.running) == (("inside",), ("slow",))
        assert states(outer)["inside"] == states(inner)["slow"] == "running"


def test_a_function_may_look_at_its_own_runner():
    seen = []
    runner = ep.CompGraphRunner(
        ep.CompGraph({"f": lambda x: seen.append((runner.running, states(runner)))}, {"f": ("x", "y")})
    )
    for _ in range(6):
        runner.run(x=1)
    assert seen == [(("f",), {"f": "running"})] * 6


def test_looking_is_safe_while_threads_come_and_go():
    runner = ep.CompGraphRunner(ep.CompGraph({"f": abs, "g": abs}, {"f": ("x", "y"), "g": ("y", "z")}))
    is_over = threading.Event()

    def come_and_go():
        while not is_over.is_set():
            thread = threading.Thread(target=lambda: runner.run(x=1))
            thread.start()
            thread.join()

    threads = [threading.Thread(target=come_and_go) for _ in range(3)]
    for thread in threads:
        thread.start()
    try:
        for _ in range(300):
            assert set(runner.running) <= {"f", "g"}
    finally:
        is_over.set()
        for thread in threads:
            thread.join(TIMEOUT_S)


def test_looking_keeps_nothing_alive(gate):
    class Value:
        pass

    cg = ep.CompGraph({"make": Value, "slow": lambda x: gate(1)}, {"make": ((), "x"), "slow": ("x", "y")})
    runner = ep.CompGraphRunner(cg)
    gc.disable()
    try:
        for _ in range(6):
            with gate.holding(runner.run):
                assert runner.running == ("slow",)
            kept = weakref.ref(runner["x"])
        del runner
        assert kept() is None
    finally:
        gc.enable()


# -- failed -----------------------------------------------------------------------------------------------------------

LONG = "the kernel must be odd and positive, " * 8 + "and that is all"


def failed_runner(message: str) -> ep.CompGraphRunner:
    def fails(y):
        raise ValueError(message)

    cg = ep.CompGraph({"f": abs, "fails": fails, "g": abs}, {"f": ("x", "y"), "fails": ("y", "z"), "g": ("z", "end")})
    runner = ep.CompGraphRunner(cg)
    with contextlib.suppress(ValueError):
        runner.run(x=1)
    assert runner.last.failure.function == "fails"
    return runner


def test_a_failure_is_told_on_the_box_in_three_lines_and_whole_in_its_title():
    runner = failed_runner(LONG)
    for shown in (runner, runner.last):
        found = vertices(to_svg(shown))
        name, state, *lines = texts(found["function-fails"])
        assert (name, state, len(lines)) == ("fails", "failed", 3)
        assert all(len(line) <= 36 for line in lines)
        assert " ".join(lines[:2]) in LONG
        assert lines[2].endswith("…")
        assert LONG.strip() in found["function-fails"].find(f"{SVG}title").text
        tokens = {token.name: token.state for token in view(shown).tokens}
        assert tokens == {"x": "fresh", "y": "fresh", "z": "not computed", "end": "not computed"}
        assert texts(found["function-g"]) == ["g", "not run"]


@pytest.mark.parametrize("message", ["", "x" * 10**6, "a\nb\n" * 1000, "<script>alert(1)</script>", "\x00\ud800"])
def test_any_message_can_be_shown(message):
    shown = failed_runner(message).last
    bundle = mimebundle(shown)
    assert set(bundle) == {"text/plain", "text/html", "image/svg+xml"}
    lines = texts(vertices(bundle["image/svg+xml"])["function-fails"])
    assert 3 <= len(lines) <= 5
    assert "<script>alert" not in bundle["text/html"]
    assert len(bundle["text/html"].encode()) < 30_000 + 7 * 600


# -- every state has a word -------------------------------------------------------------------------------------------


def test_every_state_of_a_function_is_told_in_words():
    cg = ep.CompGraph(
        {"f": abs, "g": lambda y, k: y, "h": abs}, {"f": ("x", "y"), "g": (("y", "k"), "z"), "h": ("z", "end")}
    )
    runner = ep.CompGraphRunner(cg, {"k": 1})
    told = {}

    def look(shown):
        found = vertices(to_svg(shown))
        for function in view(shown).functions:
            told[function.state] = texts(found[f"function-{function.name}"])[1]

    look(runner)
    runner.run(x=1)
    look(runner)
    runner["k"] = 2
    look(runner)
    look(runner.plan())
    look(runner.plan("y"))
    runner.rerun()
    look(runner)
    assert re.fullmatch(r".* (ns|µs|ms), \d+%", told.pop("ran"))
    assert told == {
        "not run": "not run", "stale": "stale", "planned": "to run", "reused": "reused", "left out": "left out",
    }  # fmt: skip


def test_a_run_for_the_first_time_does_not_move_the_functions():
    lay_out.cache_clear()
    runner = ep.CompGraphRunner(ep.CompGraph({"f": lambda: None}, {"f": ((), None)}))
    to_svg(runner)
    runner.run()
    to_svg(runner)
    assert lay_out.cache_info().misses == 1


def test_a_plan_says_on_the_box_why_a_function_would_run():
    cg = ep.CompGraph(
        {"f": lambda x, a_long_name_of_a_threshold: x, "g": abs},
        {"f": (("x", "a_long_name_of_a_threshold"), "y"), "g": ("y", "z")},
    )
    runner = ep.CompGraphRunner(cg, {"a_long_name_of_a_threshold": 1})
    runner.run(x=1)
    runner["a_long_name_of_a_threshold"] = 2
    found = vertices(to_svg(runner.plan()))
    name, state, *reason = texts(found["function-f"])
    assert (name, state) == ("f", "to run")
    assert " ".join(reason) == "'a_long_name_of_a_threshold' changed"
    assert all(len(line) <= 30 for line in reason)
    assert "'a_long_name_of_a_threshold' changed" in found["function-f"].find(f"{SVG}title").text
    assert texts(found["function-g"])[2] == "takes 'y', made anew"


# -- changed from the first value -------------------------------------------------------------------------------------


def first(shown) -> dict[str, str]:
    return {token.name: token.first for token in view(shown).tokens if token.first}


def test_a_hyperparameter_that_has_another_value_than_its_first_tells_that_one(edge_runner, photograph):
    before = edge_runner.run(image=photograph)
    for value in (90, 95):
        edge_runner["canny_lo"] = value
    run = edge_runner.rerun(canny_hi=210)
    for shown in (edge_runner, run, edge_runner.plan()):
        assert first(shown) == {"canny_lo": "70", "canny_hi": "200"}
        found = vertices(to_svg(shown))
        assert found["token-canny_lo"].get("class") == "token hyperparameter fresh changed"
        assert found["token-canny_lo"].find(f"{SVG}circle[@class='dot']") is not None
        assert found["token-canny_lo"].find(f"{SVG}title").text.endswith("first 70")
        assert found["token-blur_kernel"].find(f"{SVG}circle") is None
    assert first(before) == {}, "the run is as it was"
    edge_runner.rerun(canny_lo=70, canny_hi=200)
    assert first(edge_runner) == {}
    assert first(run) != {}, "so is this one"


def test_a_mark_does_not_move_anything(edge_runner):
    lay_out.cache_clear()
    to_svg(edge_runner)
    edge_runner["canny_lo"] = 90
    to_svg(edge_runner)
    assert lay_out.cache_info().misses == 1


def test_first_values_are_those_of_making_and_freezing():
    cg = ep.CompGraph({"f": lambda x, a, b: x}, {"f": (("x", "a", "b"), "y")})
    runner = ep.CompGraphRunner(cg, {"a": 1})
    runner["a"] = 2
    runner.freeze(b=5)
    runner.freeze(a=3, b=6)
    assert dict(runner.first_hyperparameters) == {"a": 1, "b": 5}
    assert dict(runner.run(x=0).first_hyperparameters) == {"a": 1, "b": 5}
    with pytest.raises(TypeError):
        runner.first_hyperparameters["a"] = 7
    runner.unfreeze("a")
    assert dict(runner.first_hyperparameters) == {"b": 5}
    runner.freeze(a=9)
    assert dict(runner.first_hyperparameters) == {"a": 9, "b": 5}
    assert first(runner) == {"b": "5"}


def test_first_values_are_kept_through_many_reruns():
    runner = ep.CompGraphRunner(ep.CompGraph({"f": lambda x, k: x * k}, {"f": (("x", "k"), "y")}), {"k": 1})
    runner.run(x=1)
    for k in range(2, 12):
        run = runner.rerun(k=k)
    assert dict(run.first_hyperparameters) == {"k": 1}
    assert first(run) == first(runner) == {"k": "1"}


def test_an_array_that_stays_is_not_told_as_changed():
    cg = ep.CompGraph({"f": lambda x, kernel, k: x}, {"f": (("x", "kernel", "k"), "y")})
    runner = ep.CompGraphRunner(cg, {"kernel": np.ones((3, 3)), "k": 1})
    runner.run(x=1)
    runner.rerun(k=2)
    assert first(runner) == {"k": "1"}
    runner.rerun(kernel=np.zeros((3, 3)))
    assert set(first(runner)) == {"k", "kernel"}


def test_a_first_value_is_escaped():
    evil = "<img src=x onerror=1>"
    runner = ep.CompGraphRunner(ep.CompGraph({"f": lambda x: x}, {"f": ("x", "y")}), {"x": evil})
    runner["x"] = "good"
    bundle = mimebundle(runner)
    assert "<img src=x" not in bundle["text/html"]
    assert "first" in vertices(bundle["image/svg+xml"])["token-x"].find(f"{SVG}title").text


def test_what_runs_can_be_asked_for_while_garbage_is_collected():
    code = """
import gc, threading
import epypes as ep

runner = ep.CompGraphRunner(ep.CompGraph({"f": abs}, {"f": ("x", "y")}))
# Python before 3.11.9 waited forever when it freed a thread-local object while it made the frames of many threads.
for threshold in range(1, 80):
    begun, end = threading.Barrier(21), threading.Event()
    threads = [threading.Thread(target=lambda: begun.wait() is end.wait()) for _ in range(20)]
    for thread in threads:
        thread.start()
    begun.wait()
    gc.disable()
    gc.collect()
    cycle = [threading.local()]
    cycle[0].cycle = cycle
    cycle.append(cycle)
    del cycle
    gc.set_threshold(threshold)
    gc.enable()
    assert runner.running == ()
    assert gc.isenabled()
    end.set()
    for thread in threads:
        thread.join()
"""
    subprocess.run([sys.executable, "-c", code], check=True, timeout=TIMEOUT_S)


# -- redefined --------------------------------------------------------------------------------------------------------


def test_a_redefined_function_is_told_on_a_reactive_pipeline_too():
    module = types.ModuleType("cells_of_states")
    sys.modules[module.__name__] = module
    try:
        exec("def blur(x):\n    return x + 1\n", module.__dict__)
        cg = ep.CompGraph({"blur": module.blur}, {"blur": ("x", "y")})
        pipe = ep.SinkPipeline("pipe", cg, None, dict)
        exec("def blur(x):\n    return x + 2\n", module.__dict__)
        for shown in (pipe, pipe.runner.plan()):
            assert "redefined" in vertices(mimebundle(shown)["image/svg+xml"])["function-blur"].get("class").split()
    finally:
        del sys.modules[module.__name__]


# -- nothing found ----------------------------------------------------------------------------------------------------


def searched(minimum):
    cg = ep.CompGraph(
        {"find": lambda x, minimum: x if x >= minimum else ep.Nothing, "mark": abs, "count": abs},
        {"find": (("x", "minimum"), "place"), "mark": ("place", "marked"), "count": ("x", "n")},
    )
    runner = ep.CompGraphRunner(cg, {"minimum": minimum})
    runner.run(x=3)
    return runner


def test_what_was_skipped_is_faint_as_a_branch_that_is_not_chosen_and_says_why():
    runner = searched(5)
    for shown in (runner, runner.last):
        found = vertices(to_svg(shown))
        assert found["function-mark"].get("class") == "function left-out skipped"
        assert texts(found["function-mark"]) == ["mark", "skipped"]
        assert found["function-mark"].find(f"{SVG}title").text == "function mark: skipped; 'place': nothing found"
        for token in ("place", "marked"):
            assert found[f"token-{token}"].get("class") == "token payload left-out nothing-found"
            assert texts(found[f"token-{token}"]) == [token, "nothing found"]
            assert found[f"token-{token}"].find(f"{SVG}title").text == f"token {token}: Nothing, nothing found"
        graph = view(shown)
        dead = {
            (graph.functions[edge.function].name, graph.tokens[edge.token].name)
            for edge in graph.edges
            if not edge.is_live
        }
        assert dead == {("mark", "place"), ("mark", "marked")}
        assert found["function-count"].get("class") == "function ran"


def test_what_comes_back_is_drawn_as_ever():
    runner = searched(5)
    runner.rerun(minimum=2)
    found = vertices(to_svg(runner))
    assert found["function-mark"].get("class") == "function ran"
    assert texts(found["token-marked"]) == ["marked", "3"]
    runner["minimum"] = 7
    assert vertices(to_svg(runner))["function-mark"].get("class") == "function stale"
    runner.rerun()
    runner["minimum"] = 1
    assert texts(vertices(to_svg(runner))["token-place"]) == ["place", "nothing found"]
    assert vertices(to_svg(runner))["token-place"].get("class") == "token payload stale"


def test_a_view_with_skipped_functions_goes_through_json():
    graph = view(searched(5))
    assert from_json(json.loads(json.dumps(to_json(graph)))) == graph


def test_a_group_of_skipped_functions_is_skipped():
    runner = searched(5)
    cg = ep.group(runner.cg, "marking", functions=["mark"])
    grouped = ep.CompGraphRunner(cg, {"minimum": 5})
    grouped.run(x=3)
    assert {each.name: each.state for each in view(grouped).functions}["marking"] == "skipped"


# -- state between runs ---------------------------------------------------------------------------------------------


def test_a_delayed_token_says_whose_value_it_has_in_its_title_and_for_screen_readers():
    cg = ep.CompGraph({"add": lambda x, t: x + t}, {"add": (("x", "before"), "total")})
    runner = ep.CompGraphRunner(ep.delay(cg, "total", "before", 5))
    runner.run(x=1)
    for shown in (runner.cg, runner.plan(), runner.last):
        bundle = mimebundle(shown)
        assert "token before, the value of 'total' in the run before" in bundle["image/svg+xml"]
        assert "<td>value of 'total' in the run before, " in bundle["text/html"]
    assert "in the run before: int 5, fresh" in to_svg(runner.last)


def test_a_delay_within_a_group_is_drawn_when_the_group_is_opened():
    cg = ep.CompGraph(
        {"add": lambda x, t: x + t, "double": lambda t: 2 * t},
        {"add": (("x", "before"), "total"), "double": ("total", "y")},
    )
    grouped = ep.group(ep.delay(cg, "total", "before", 5), "sum", functions=["add", "double"])
    (inside,) = view(grouped).groups
    assert inside.graph.delays == (("total", "before"),)
