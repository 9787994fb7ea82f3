"""A search finds good hyperparameters, runs no more than it must, continues from a store, and ends when it is asked to."""

from __future__ import annotations

import contextlib
import enum
import functools
import re
import threading
import xml.etree.ElementTree as ET
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any
from urllib.parse import unquote

import cv2
import matplotlib
import nbclient
import nbformat
import numpy as np
import optuna
import pytest
from matplotlib import pyplot

import epypes as ep
from epypes.batch.grid import ChoiceAxis
from epypes.batch.optimize import OptimizeResult, Trial
from epypes.errors import ScaleError, UnknownName
from tests.store.postgres import PASSWORD, server


class Method(enum.Enum):
    NEAREST = 0
    LINEAR = 1


def shift(x: int, a: Annotated[int, ep.Param(-20, 20)]) -> int:
    return x + a


def bend(shifted: int, b: Annotated[float, ep.Param(0.0, 4.0)], note: str) -> float:
    return -((shifted - 7) ** 2) - (b - 1.5) ** 2


@pytest.fixture
def runner() -> ep.CompGraphRunner:
    """Best for x = 0 at a = 7 and b = 1.5, where score is 0."""
    cg = ep.CompGraph(
        {"shift": shift, "bend": bend}, {"shift": (("x", "a"), "shifted"), "bend": (("shifted", "b", "note"), "score")}
    )
    return ep.CompGraphRunner(cg, {"a": -3, "b": 3.0, "note": "as it is"})


def runner_of(function: Callable[..., Any], **hparams: Any) -> ep.CompGraphRunner:
    return ep.CompGraphRunner(ep.CompGraph({"f": function}, {"f": (("x", *hparams), "y")}), hparams)


def settings_of(result: OptimizeResult) -> list[dict[str, Any]]:
    return [dict(trial.setting) for trial in result]


# -- what is found ----------------------------------------------------------------------------------------------


def test_good_values_are_found_and_the_runner_is_left_as_it_was(runner: ep.CompGraphRunner) -> None:
    before = dict(runner.hyperparameters)
    result = ep.optimize(runner, "score", [{"x": 0}], 60)
    assert len(result) == 60
    assert result.best_value > -2
    assert result.best_value == max(trial.value or -999 for trial in result)
    assert (runner.hyperparameters, runner.last) == (before, None)
    result.apply(runner)
    assert runner.run(x=0)["score"] == result.best_value


@pytest.mark.parametrize("ranges", [None, {"p__k": (0, 20)}, {"p__k": (0, 20), "g": (0, 3)}])
def test_what_is_in_pipelines_is_searched_too(ranges: Any) -> None:
    def inside(x: int, k: Annotated[int, ep.Param(0, 20)]) -> int:
        return x - (k - 7) ** 2

    def around(b: int, g: Annotated[int, ep.Param(0, 3)]) -> int:
        return b + g

    pipe = ep.Pipeline("p", ep.CompGraph({"f": inside}, {"f": (("x", "k"), "y")}), {"k": 19})
    cg = ep.CompGraph({"p": pipe, "h": around}, {"p": ("a", "b"), "h": (("b", "g"), "c")})
    result = ep.optimize(ep.CompGraphRunner(cg, {"g": 0}), "c", [{"a": 0}], 20, ranges=ranges)
    assert [*result.trials[0].setting] == (["p__k"] if ranges and "g" not in ranges else ["g", "p__k"])
    assert len({trial.setting["p__k"] for trial in result.trials}) > 3
    assert result.best_value > -50


def test_the_first_trial_has_the_present_values(runner: ep.CompGraphRunner) -> None:
    assert settings_of(ep.optimize(runner, "score", [0], 1)) == [{"a": -3, "b": 3.0}]


def test_the_same_seed_tries_the_same_and_another_one_does_not(runner: ep.CompGraphRunner) -> None:
    one, same, other = (settings_of(ep.optimize(runner, "score", [0], 12, seed=seed)) for seed in (1, 1, 2))
    assert one == same != other


def test_the_metric_is_averaged_over_the_cases_and_sees_each_with_its_labels(runner: ep.CompGraphRunner) -> None:
    seen = []

    def miss(tokens: Mapping[str, Any], case: ep.Case) -> float:
        seen.append((case.name, dict(tokens)))
        return abs(tokens["score"] - (case.expected or {})["score"])

    cases = [ep.Case({"x": 0}, expected={"score": -100.0}, name="one"), ep.Case({"x": 1}, expected={"score": -60.0})]
    result = ep.optimize(runner, miss, cases, 1, direction="minimize")
    assert seen == [("one", {"score": -102.25}), ("#1", {"score": -83.25})]
    assert result.best_value == (2.25 + 23.25) / 2


def test_tokens_that_are_named_are_kept_for_the_metric(runner: ep.CompGraphRunner) -> None:
    result = ep.optimize(runner, lambda tokens, _: tokens["shifted"], [0], 20, keep=["shifted"])
    assert result.best_value > 15


@pytest.mark.parametrize("has_executor", [False, True])
def test_a_case_may_have_hyperparameters_of_its_own_which_vary_for_the_others_alone(
    runner: ep.CompGraphRunner, has_executor: bool
) -> None:
    cases = [ep.Case(0, hyperparameters={"a": 7, "b": 1.5}), ep.Case(0)]
    with ThreadPoolExecutor(1) as threads:
        result = ep.optimize(
            runner, "score", cases, 3, executor=threads if has_executor else None, ranges={"a": (-9, 9)}
        )
    assert [trial.value for trial in result] == [(0 - (trial.setting["a"] - 7) ** 2 - 2.25) / 2 for trial in result]


def test_who_sets_values_meanwhile_does_not_change_what_is_searched(runner: ep.CompGraphRunner) -> None:
    def metric(tokens: Mapping[str, Any], _case: ep.Case) -> float:
        runner["b"] = 100.0
        return float(tokens["score"])

    assert ep.optimize(runner, metric, [0, 0], 1, ranges={"a": (7, 7)}).best_value == -2.25


# -- which values are tried -------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "hint", "allowed"),
    [
        (5, ep.Param(2, 12, odd=True), {3, 5, 7, 9, 11}),
        (5, (0, 10, 5), {0, 5, 10}),
        (4, ep.Param(0, 9, step=4), {0, 4, 8}),
        (9, ep.Param(1, 9, odd=True, log=True), {1, 3, 5, 7, 9}),
        ("b", ["a", "b"], {"a", "b"}),
        (Method.LINEAR, [Method.NEAREST, Method.LINEAR], set(Method)),
        (True, [False, True], {False, True}),
        (None, [None, 1, (2, 3)], {None, 1, (2, 3)}),
        (0.25, ep.Param(0.0, 1.0, step=0.25), {0.0, 0.25, 0.5, 0.75, 1.0}),
    ],
)
def test_all_values_that_a_hint_allows_are_tried_and_no_others(value: Any, hint: Any, allowed: set[Any]) -> None:
    tried = [
        trial.setting["k"]
        for trial in ep.optimize(runner_of(lambda x, k: 0.0, k=value), "y", [0], 60, ranges={"k": hint})
    ]
    assert set(tried) == allowed
    assert {type(found) for found in tried} == {type(found) for found in allowed}
    assert tried[0] == value


def test_a_logarithmic_range_is_searched_evenly_on_its_scale() -> None:
    result = ep.optimize(
        runner_of(lambda x, k: 0.0, k=1.0), "y", [0], 40, ranges={"k": ep.Param(0.001, 1000.0, log=True)}
    )
    small = sum(trial.setting["k"] < 1 for trial in result)
    assert 10 < small < 30


def test_without_ranges_those_vary_of_which_a_hint_tells_both_ends() -> None:
    def f(
        x: int,
        ends: Annotated[int, ep.Param(0, 5)],
        usual: Annotated[int, ep.Param(0, soft=(1, 3))],
        is_open: Annotated[int, ep.Param(0)],
        method: Method,
        flag: bool,
        number: float,
    ) -> float:
        return 0.0

    runner = runner_of(f, ends=2, usual=9, is_open=1, method=Method.LINEAR, flag=True, number=1.0)
    result = ep.optimize(runner, "y", [0], 1)
    assert [axis.token for axis in result.axes] == ["ends", "usual", "method", "flag"]
    assert settings_of(result) == [{"ends": 2, "usual": 9, "method": Method.LINEAR, "flag": True}]


def test_one_that_is_below_another_never_exceeds_it() -> None:
    def f(x: int, low: Annotated[int, ep.Param(0, 9, below="upper")], upper: Annotated[int, ep.Param(0, 9)]) -> int:
        return low

    cg = ep.CompGraph({"f": f}, {"f": (("x", "lo", "hi"), "y")})
    result = ep.optimize(ep.CompGraphRunner(cg, {"lo": 1, "hi": 2}), "y", [0], 40)
    assert all(trial.setting["lo"] <= trial.setting["hi"] for trial in result)
    assert len({trial.setting["lo"] for trial in result}) > 3


def test_present_values_out_of_range_are_tried_as_the_nearest(runner: ep.CompGraphRunner) -> None:
    assert settings_of(ep.optimize(runner, "score", [0], 1, ranges={"a": (0, 9)})) == [{"a": 0}]


# -- what runs --------------------------------------------------------------------------------------------------


@pytest.fixture
def counted() -> tuple[ep.CompGraphRunner, dict[str, int]]:
    """Two functions that count their calls."""
    calls = {"heavy": 0, "light": 0}

    def heavy(x: Any) -> Any:
        calls["heavy"] += 1
        return x * 2

    def light(h: Any, k: int) -> Any:
        calls["light"] += 1
        return float(np.mean(h)) - (k - 4) ** 2

    cg = ep.CompGraph({"heavy": heavy, "light": light}, {"heavy": ("x", "h"), "light": (("h", "k"), "y")})
    return ep.CompGraphRunner(cg, {"k": 0}), calls


@pytest.mark.parametrize("has_stop", [False, True])
def test_what_does_not_depend_on_what_varies_runs_once_for_each_case(
    counted: tuple[ep.CompGraphRunner, dict[str, int]], has_stop: bool
) -> None:
    runner, calls = counted
    cases = [np.full((3, 3), 1), np.full((2, 2), 5)]
    stop = threading.Event() if has_stop else None
    result = ep.optimize(runner, "y", cases, 30, ranges={"k": (0, 1000)}, stop=stop)
    assert calls["heavy"] == 2
    assert calls["light"] <= 60
    assert result.best_value <= 6.0


def test_cases_that_do_not_fit_into_memory_are_run_anew(
    counted: tuple[ep.CompGraphRunner, dict[str, int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    runner, calls = counted
    cases, ranges = [np.full((30, 30), 1), np.full((2, 2), 5)], {"k": (0, 9)}
    kept = ep.optimize(runner, "y", cases, 8, ranges=ranges)
    calls["heavy"] = 0
    monkeypatch.setattr("epypes.batch.optimize.MOST_BYTES", 1_000)
    anew = ep.optimize(runner, "y", cases, 8, ranges=ranges)
    assert calls["heavy"] == 8 + 1, "the small one is kept"
    assert [trial.value for trial in anew] == [trial.value for trial in kept]


def test_a_trial_ends_at_the_first_case_that_fails() -> None:
    called = []

    def divide(x: int, k: int) -> float:
        called.append((x, k))
        return x / k

    cg = ep.CompGraph({"divide": divide}, {"divide": (("x", "k"), "y")})
    result = ep.optimize(ep.CompGraphRunner(cg, {"k": 0}), "y", [1, 2, 3], 8, ranges={"k": (0, 1)})
    assert set(called) == {(1, 0), (1, 1), (2, 1), (3, 1)}
    assert "ZeroDivisionError" in result[0].failure


def test_threads_give_the_values_that_one_thread_gives(runner: ep.CompGraphRunner) -> None:
    cases = [{"x": 0}, {"x": 2}, {"x": 3}]
    with ThreadPoolExecutor(2) as threads:
        result = ep.optimize(runner, "score", cases, 15, executor=threads)
    assert len(result) == 15
    for trial in result:
        expected = [bend(shift(case["x"], trial.setting["a"]), trial.setting["b"], "") for case in cases]
        assert trial.value == pytest.approx(sum(expected) / 3)


@pytest.mark.parametrize("asked", [["score"], ["score", "y"], ["odds"], ["y"]])
def test_an_executor_runs_what_this_thread_runs_and_that_is_what_the_metric_needs(asked: list[str]) -> None:
    called = set()

    def score(x: int, k: int) -> float:
        called.add("score")
        return float(x * k)

    def odds(x: int, k: int) -> float:
        called.add("odds")
        return float(k % 2)

    def overlay(x: int, k: int) -> None:
        raise ValueError("nobody has asked for it")

    def total(tokens: Mapping[str, Any], _case: ep.Case) -> float:
        return float(sum(tokens.values()))

    chosen = ep.switch("choose", {"one": "score", "other": "odds"}, by="which", output="y")
    cg = ep.CompGraph.from_functions(score, odds, overlay) | chosen
    runner = ep.CompGraphRunner(cg, {"k": 3, "which": "one"})
    with ThreadPoolExecutor(1) as threads:
        found = []
        for executor in (None, threads):
            called.clear()
            result = ep.optimize(runner, total, [2], 1, ranges={"k": (0, 10)}, keep=asked, executor=executor)
            found.append((result.best_value, set(called)))
    # What is not chosen is run if it is asked for.
    values = {"score": 6.0, "odds": 1.0, "y": 6.0}
    assert found == [(sum(values[token] for token in asked), {"odds"} if asked == ["odds"] else {"score"})] * 2


@pytest.mark.slow
def test_processes_run_trials_and_the_metric_stays_here(tmp_path: Path) -> None:
    cg = ep.CompGraph({"canny": cv2.Canny}, {"canny": (("image", "lo", "hi"), "edges")})
    runner = ep.CompGraphRunner(cg, {"lo": 200, "hi": 250})
    image = np.random.default_rng(0).integers(0, 255, (40, 50), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), image)
    threads = set()

    def share(tokens: Mapping[str, Any], _case: ep.Case) -> float:
        threads.add(threading.current_thread())
        return float((tokens["edges"] > 0).mean())

    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as processes:
        result = ep.optimize(runner, share, tmp_path, 8, executor=processes, ranges={"lo": (0, 255)})
    assert threads == {threading.current_thread()}
    assert [trial.value for trial in result] == [
        (cv2.Canny(image, trial.setting["lo"], 250) > 0).mean() for trial in result
    ]


# -- failures ---------------------------------------------------------------------------------------------------


def test_a_trial_that_fails_says_why_and_the_others_go_on() -> None:
    def f(x: int, k: int) -> int:
        if k == 0:
            raise ValueError("no kernel")
        return k

    def metric(tokens: Mapping[str, Any], _case: ep.Case) -> Any:
        if tokens["y"] == 1:
            raise RuntimeError("no label")
        return {2: float("nan"), 3: "much", 4: 10**400}.get(tokens["y"], tokens["y"])

    result = ep.optimize(runner_of(f, k=0), metric, [1, 2], 40, ranges={"k": (0, 5)})
    frame = result.to_frame()
    reasons = {row.k: row.failure for row in frame[frame.state == "failed"].itertuples()}
    assert reasons == {
        0: "#0: f: ValueError: no kernel",
        1: "#0: metric raised RuntimeError: no label",
        2: "#0: metric gave nan",
        3: "#0: metric gave a 'str', no number",
        4: "#0: metric gave a 'int', no number",
    }
    assert (result.best, result.best_value) == ({"k": 5}, 5.0)
    assert set(frame.failure[frame.state == "complete"]) == {None}
    assert len(result.failures) + sum(frame.state == "complete") == 40


def test_if_all_trials_fail_the_reason_of_the_first_is_raised() -> None:
    def f(x: int, k: int) -> int:
        raise ValueError("There is no kernel." if k == 3 else "another")

    with pytest.raises(ScaleError) as told:
        ep.optimize(runner_of(f, k=3), "y", [1], 4, ranges={"k": (0, 5)})
    said = "None of 4 trials completed. The first one failed: f: ValueError: There is no kernel. Its values: {'k': 3}."
    assert str(told.value) == said


@pytest.mark.slow
@pytest.mark.parametrize("workers", [0, 2])
def test_a_file_that_can_not_be_read_ends_the_search_before_the_second_trial(tmp_path: Path, workers: int) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((5, 5, 3), np.uint8))
    (tmp_path / "broken.png").write_bytes(b"no image")
    tried: set[int] = set()
    kept: dict[str, Any] = {"ranges": {"k": (0, 500)}, "store": tmp_path / "s.db", "name": "n"}

    def f(x: Any, k: int) -> int:
        tried.add(k)
        return k

    with contextlib.ExitStack() as stack:
        executor = stack.enter_context(ThreadPoolExecutor(workers)) if workers else None
        with pytest.raises(ScaleError, match=r"No trial can complete: .*broken\.png.*[^.]\. Mend the file"):
            ep.optimize(runner_of(f, k=3), "y", tmp_path, 50, executor=executor, **kept)
    assert len(tried) <= 1 + workers
    # Once the file is mended, the search begins: that it could not be read is not kept.
    cv2.imwrite(str(tmp_path / "broken.png"), np.zeros((5, 5, 3), np.uint8))
    assert not ep.optimize(runner_of(f, k=3), "y", tmp_path, 3, **kept).failures


@pytest.mark.parametrize(
    ("options", "error", "said"),
    [
        ({"n": 0}, ScaleError, "1 or more, not 0"),
        ({"direction": "up"}, ScaleError, "'maximize' or 'minimize', not 'up'"),
        ({"ranges": {"bb": (0, 1)}}, UnknownName, "Did you mean 'b'?"),
        ({"ranges": {}}, ScaleError, "ranges is empty"),
        ({"ranges": {"a": ep.Param(0)}}, ScaleError, "range of 'a' is open"),
        ({"ranges": {"a": 3}}, ScaleError, r"a=3 is neither a range, as \(low, high\), nor a list"),
        ({"ranges": {"a": (9, 0)}}, ScaleError, "low .9. is above high"),
        ({"ranges": {"note": (0, 1)}}, ScaleError, "'note' is 'as it is', so it has no range of numbers"),
        ({"metric": 3}, ScaleError, "not a 'int'"),
        ({"metric": "scor"}, UnknownName, "Did you mean 'score'?"),
        ({"keep": ["scor"], "metric": len}, UnknownName, "Did you mean 'score'?"),
        ({"cases": []}, ScaleError, "There are no cases"),
        ({"cases": [{"y": 1}]}, ScaleError, "y"),
    ],
)
def test_what_can_not_be_searched_is_refused(
    runner: ep.CompGraphRunner, options: dict[str, Any], error: type[Exception], said: str
) -> None:
    with pytest.raises(error, match=said):
        ep.optimize(runner, **{"metric": "score", "cases": [0], **options})


def test_a_runner_without_ranges_is_refused_with_the_way_out() -> None:
    with pytest.raises(ScaleError, match=r"No hint gives a range for 'k'.*ranges="):
        ep.optimize(runner_of(lambda x, k: x, k=3), "y", [0])
    with pytest.raises(ScaleError, match="no hyperparameters"):
        ep.optimize(runner_of(lambda x: x), "y", [0])


# -- stopping ---------------------------------------------------------------------------------------------------


def test_a_stop_waits_for_no_more_than_the_case_that_runs() -> None:
    stop, called = threading.Event(), []

    def first(x: int, k: int) -> int:
        called.append("first")
        if len(called) > 6:
            stop.set()
        return x + k

    def second(f: int) -> int:
        called.append("second")
        return f

    cg = ep.CompGraph({"first": first, "second": second}, {"first": (("x", "k"), "f"), "second": ("f", "y")})
    result = ep.optimize(ep.CompGraphRunner(cg, {"k": 0}), "y", [0], 1_000, ranges={"k": (0, 10**6)}, stop=stop)
    assert (len(called), len(result), result.was_stopped) == (8, 4, True)


def test_a_stop_reaches_threads_too(runner: ep.CompGraphRunner) -> None:
    stop = threading.Event()
    with ThreadPoolExecutor(2) as threads:
        result = ep.optimize(
            runner, "score", [0], 10_000, executor=threads, stop=stop, on_trial=lambda trial: stop.set()
        )
    assert 1 <= len(result) < 10
    assert result.was_stopped


def test_an_interrupt_returns_what_there_is(runner: ep.CompGraphRunner) -> None:
    told = []

    def metric(tokens: Mapping[str, Any], _case: ep.Case) -> float:
        if len(told) == 3:
            raise KeyboardInterrupt
        return float(tokens["score"])

    result = ep.optimize(runner, metric, [0], 100, on_trial=told.append)
    assert (len(result), list(result), result.was_stopped) == (3, told, True)


def test_stopped_before_it_began_there_is_no_best(runner: ep.CompGraphRunner) -> None:
    stop = threading.Event()
    stop.set()
    result = ep.optimize(runner, "score", [0], stop=stop)
    assert repr(result) == "<OptimizeResult: 0 trials, stopped; none completed>"
    assert "none completed" in result._repr_mimebundle_()["text/html"]
    for asked in (lambda: result.best, result.history_plot, result.importance_plot):
        with pytest.raises(ScaleError, match="no best one"):
            asked()


# -- stores -----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_a_search_goes_on_where_it_was_stopped(runner: ep.CompGraphRunner, tmp_path: Path) -> None:
    store = tmp_path / "trials.sqlite"
    told: list[Any] = []
    first = ep.optimize(runner, "score", [0], 3, store=store, name="s")
    more = ep.optimize(runner, "score", [0], 5, store=store, name="s", on_trial=told.append)
    assert list(more)[:3] == list(first)
    assert [trial.number for trial in told] == [3, 4]
    assert settings_of(more)[3:] != settings_of(first)[1:], "chance does not begin anew"
    again = ep.optimize(runner, "score", [0], 5, store=store, name="s", on_trial=told.append)
    assert (list(again), len(told)) == (list(more), 2)
    assert again.to_frame().equals(more.to_frame())


@pytest.mark.slow
def test_failures_are_stored_too_and_a_store_may_be_shared(tmp_path: Path) -> None:
    runner = runner_of(lambda x, k: 1 / k, k=0)
    with ep.Store(tmp_path / "s.sqlite") as store:
        for _ in range(2):
            result = ep.optimize(runner, "y", [0], 3, ranges={"k": [0, 1]}, store=store, name="s")
        assert "ZeroDivisionError" in result[0].failure
        ep.optimize(runner, "y", [0], 1, ranges={"k": [1, 2]}, store=store, name="another")
        assert store.kinds() == ()


@pytest.mark.slow
def test_without_a_name_it_follows_from_what_is_searched(tmp_path: Path) -> None:
    cg = ep.CompGraph({"f": cv2.subtract}, {"f": (("x", "k"), "y")})
    runner, options = ep.CompGraphRunner(cg, {"k": 1.0}), {"store": tmp_path / "s.sqlite", "ranges": {"k": (0.0, 5.0)}}

    def metric(tokens: Mapping[str, Any], _case: ep.Case) -> float:
        return float(tokens["y"].mean())

    image = np.zeros((2, 2), np.uint8)
    first = ep.optimize(runner, metric, [image], 2, **options)
    first.apply(runner)
    assert len(ep.optimize(runner, metric, [image], 1, **options)) == 2, "what varies is no part of the name"
    assert len(ep.optimize(runner, metric, [image], 1, **{**options, "ranges": {"k": (0.0, 6.0)}})) == 1

    def another(tokens: Mapping[str, Any], _case: ep.Case) -> float:
        return float(tokens["y"].max())

    levels = iter_levels()
    another.__name__ = metric.__name__
    assert len(ep.optimize(runner, another, [image], 1, **options)) == 1
    with pytest.raises(ScaleError, match="can't be computed from its graph: a 'generator'.*\\n.*name='...'"):
        ep.optimize(
            runner_of(lambda x, k: (levels, k), k=1), "y", [0], 1, store=tmp_path / "s.sqlite", ranges={"k": [1]}
        )


@pytest.mark.slow
def test_a_study_of_something_else_is_left_alone(runner: ep.CompGraphRunner, tmp_path: Path) -> None:
    options: dict[str, Any] = {"store": tmp_path / "s.sqlite", "name": "s"}
    ep.optimize(runner, "score", [0], 1, **options)
    ranges = r"ranges: a in -20 to 20 step 1, b in 0\.0 to 4\.0, other hyperparameters"
    with pytest.raises(ScaleError, match=rf"'s' .* something else \({ranges}\)\. Give another name="):
        ep.optimize(runner, "score", [0], 2, ranges={"a": (0, 1)}, **options)
    with pytest.raises(ScaleError, match=r"something else \(direction: maximize\)"):
        ep.optimize(runner, "score", [0], 2, direction="minimize", **options)
    assert len(ep.optimize(runner, "score", [0], 1, **options)) == 1


def near(tokens: Mapping[str, Any], case: ep.Case) -> float:
    return -abs(float(tokens["y"]) - case.expected["y"])


def away(tokens: Mapping[str, Any], case: ep.Case, *, target: float = 1.0) -> float:
    return -abs(float(tokens["y"]) - target)


class Nearest:
    """Holds something that can't be seen through."""

    def __init__(self) -> None:
        self._levels = iter_levels()

    def __call__(self, tokens: Mapping[str, Any], case: ep.Case) -> float:
        return near(tokens, case)


def iter_levels() -> Iterator[int]:
    yield 1


CASE = ep.Case({"x": 1}, {"y": 3})
OTHERS = {
    "metric": (functools.partial(away, target=2.0), [CASE]),
    "inputs of the cases": (near, [ep.Case({"x": 2}, {"y": 3})]),
    "labels of the cases": (near, [ep.Case({"x": 1}, {"y": 9})]),
    "own hyperparameters": (near, [ep.Case({"x": 1}, {"y": 3}, hyperparameters={"j": 1})]),
}


@pytest.mark.slow
@pytest.mark.parametrize("what", OTHERS)
def test_trials_of_other_cases_and_of_another_metric_are_not_taken_for_its_own(what: str, tmp_path: Path) -> None:
    runner = runner_of(lambda x, k, j: x + k + j, k=1, j=0)
    options: dict[str, Any] = {"store": tmp_path / "s.sqlite", "ranges": {"k": (0, 9)}}
    ep.optimize(runner, near, [CASE], 2, **options)
    ep.optimize(runner, near, [CASE], 2, name="s", **options)
    assert len(ep.optimize(runner, near, [ep.Case({"x": 1}, {"y": 3})], 3, **options)) == 3
    metric, cases = OTHERS[what]
    found = ep.optimize(runner, metric, cases, 1, **options)
    assert len(found) == 1, "it has trials of another search"
    said = what if what != "own hyperparameters" else "labels of the cases"
    with pytest.raises(ScaleError, match=rf"something else \(other {said}\)\. Give another name="):
        ep.optimize(runner, metric, cases, 3, name="s", **options)
    assert len(ep.optimize(runner, near, [CASE], 1, name="s", **options)) == 2


@pytest.mark.slow
def test_another_graph_and_other_hyperparameters_are_refused_under_a_name(tmp_path: Path) -> None:
    options: dict[str, Any] = {"store": tmp_path / "s.sqlite", "ranges": {"k": (0, 9)}, "name": "s"}
    ep.optimize(runner_of(lambda x, k, j: x + k + j, k=1, j=0), "y", [1], 1, **options)
    with pytest.raises(ScaleError, match="other hyperparameters"):
        ep.optimize(runner_of(lambda x, k, j: x + k + j, k=1, j=5), "y", [1], 2, **options)
    with pytest.raises(ScaleError, match="other graph"):
        ep.optimize(runner_of(lambda x, k, j: x - k + j, k=1, j=0), "y", [1], 2, **options)


@pytest.mark.slow
def test_a_metric_that_nobody_can_tell_apart_needs_a_name(tmp_path: Path) -> None:
    runner = runner_of(lambda x, k: x + k, k=1)
    options: dict[str, Any] = {"store": tmp_path / "s.sqlite", "ranges": {"k": (0, 9)}}
    with pytest.raises(ScaleError, match="can't be computed from its metric: a 'generator'"):
        ep.optimize(runner, Nearest(), [CASE], 1, **options)
    for count in (1, 2):
        assert len(ep.optimize(runner, Nearest(), [CASE], count, name="s", **options)) == count


@pytest.mark.slow
def test_a_metric_that_changes_what_it_reads_goes_on_under_a_name(tmp_path: Path) -> None:
    seen: list[float] = []

    def noted(tokens: Mapping[str, Any], case: ep.Case) -> float:
        seen.append(float(tokens["y"]))
        return seen[-1]

    runner, options = runner_of(lambda x, k: x + k, k=1), {"store": tmp_path / "s.sqlite", "ranges": {"k": (0, 9)}}
    for count in (1, 2, 3):
        assert len(ep.optimize(runner, noted, [1], count, name="s", **options)) == count


@pytest.mark.slow
def test_trials_are_kept_in_postgresql_whatever_the_password(runner: ep.CompGraphRunner) -> None:
    with server() as postgres:
        url = postgres.url("trials")
        first = ep.optimize(runner, "score", [0], 3, store=url, name="s")
        assert list(ep.optimize(runner, "score", [0], 4, store=url, name="s"))[:3] == list(first)
        with pytest.raises(ScaleError) as refused:
            ep.optimize(runner, "score", [0], 4, store=url, name="s", direction="minimize")
        assert PASSWORD not in str(refused.value)


# -- how it is seen ---------------------------------------------------------------------------------------------


def test_a_table_has_a_row_for_each_trial(runner: ep.CompGraphRunner) -> None:
    frame = ep.optimize(runner, "score", [0], 4).to_frame()
    assert list(frame) == ["trial", "a", "b", "score", "state", "failure", "ms"]
    assert list(frame.trial) == [0, 1, 2, 3]
    assert (frame.ms > 0).all()


def test_a_hyperparameter_called_like_a_column_keeps_its_own() -> None:
    frame = ep.optimize(runner_of(lambda x, state: state, state=1), "y", [0], 2, ranges={"state": (1, 1)}).to_frame()
    assert list(frame) == ["trial", "state (hyperparameter)", "y", "state", "failure", "ms"]


def plot_of(page: str) -> ET.Element:
    """The plot on a page, which is an image for pages that are not trusted."""
    data = re.search('<img src="data:image/svg[+]xml,([^"]*)"', page)
    assert data is not None
    return ET.fromstring(unquote(data[1]))


def test_it_shows_itself_as_a_plot_and_the_values_found() -> None:
    def f(x: int, k: int) -> float:
        if k == 2:
            raise ValueError("<b>2</b>")
        return -abs(k - 4)

    result = ep.optimize(runner_of(f, k=2), "y", [0], 30, ranges={"k": (0, 9)})
    page = result._repr_mimebundle_()["text/html"]
    plot = plot_of(page)
    texts = ["".join(each.itertext()) for each in plot.iter("{http://www.w3.org/2000/svg}text")]
    assert {"Trial", "y", "Best Value", "0", "10"} <= set(texts)
    dots = [each for each in plot.iter("{http://www.w3.org/2000/svg}use") if "--epypes-accent" in each.get("style", "")]
    assert len(dots) == 1 + 30 - len(result.failures), "and one in the legend"
    assert "--epypes-text" in page, "in the colours of the page"
    assert result.failures
    assert ("best (trial" in page, "&lt;b&gt;2" in page, "<b>2" in page) == (True, True, False)
    assert len(page) < 40_000


def test_the_page_of_a_long_search_stays_small() -> None:
    trials = tuple(Trial(number, {"k": number}, None if number % 7 == 0 else number % 50) for number in range(5_000))
    axes = (ChoiceAxis("k", (0, 1), ("0", "1")),)
    study = optuna.create_study(direction="maximize")
    state = {True: optuna.trial.TrialState.FAIL, False: optuna.trial.TrialState.COMPLETE}
    study.add_trials(optuna.trial.create_trial(state=state[each.has_failed], value=each.value) for each in trials)
    result = OptimizeResult(trials, "maximize", "metric", axes, study)
    page = result._repr_mimebundle_()["text/html"]
    assert len(page) < 80_000
    assert plot_of(page).find(".//{http://www.w3.org/2000/svg}image") is not None, "thousands of dots are one picture"


def test_figures_can_be_had_and_leave_pyplot_as_it_was(runner: ep.CompGraphRunner) -> None:
    result = ep.optimize(runner, "score", [0], 30)
    before = dict(matplotlib.rcParams)
    history, importance = result.history_plot(), result.importance_plot()
    drawn, bars = history.figure.axes[0], importance.figure.axes[0].patches
    assert [value for _, value in drawn.collections[0].get_offsets()] == [trial.value for trial in result]
    assert max(drawn.lines[0].get_ydata()) == result.best_value
    assert [bar.get_width() for bar in bars] == list(result.importances.values())[::-1]
    assert sum(result.importances.values()) == pytest.approx(1)
    assert (pyplot.get_fignums(), dict(matplotlib.rcParams)) == ([], before)
    with pytest.raises(ScaleError, match="one value in all trials"):
        ep.optimize(runner_of(lambda x, k: 1.0, k=2), "y", [0], 4, ranges={"k": (0, 9)}).importance_plot()


@pytest.mark.slow
def test_in_a_notebook_a_figure_is_shown_once_and_those_of_pyplot_are_shown_after_it() -> None:
    cells = [
        "import epypes as ep\n"
        "cg = ep.CompGraph({'f': lambda x, k: -abs(k - 4)}, {'f': (('x', 'k'), 'y')})\n"
        "ep.optimize(ep.CompGraphRunner(cg, {'k': 9}), 'y', [0], 5, ranges={'k': (0, 9)}).history_plot()",
        "from matplotlib import pyplot\npyplot.plot([1, 2])\nNone",
    ]
    notebook = nbformat.v4.new_notebook(cells=list(map(nbformat.v4.new_code_cell, cells)))
    nbclient.NotebookClient(notebook, timeout=120).execute()
    shown = [[each.output_type for each in cell.outputs if "data" in each] for cell in notebook.cells]
    assert shown == [["execute_result"], ["display_data"]]


@pytest.mark.slow
def test_nothing_is_printed_and_optunas_logging_is_as_it_was(
    runner: ep.CompGraphRunner, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    before = optuna.logging.get_verbosity()
    _ = ep.optimize(runner, "score", [0], 12, store=tmp_path / "s.sqlite", name="s").importances
    assert optuna.logging.get_verbosity() == before
    assert capfd.readouterr() == ("", "")


def test_progress_is_shown_if_it_is_wanted(runner: ep.CompGraphRunner, capfd: pytest.CaptureFixture[str]) -> None:
    ep.optimize(runner, "score", [0], 3, progress=True)
    shown = capfd.readouterr().err
    assert "optimize score" in shown
    assert "3/3" in shown


def peak_above(image, least):
    return float(image.max()) if image.max() >= least else ep.Nothing


def test_a_trial_for_which_nothing_was_found_has_failed_and_says_so():
    cg = ep.CompGraph({"peak": peak_above}, {"peak": (("image", "least"), "top")})
    runner = ep.CompGraphRunner(cg, {"least": 100})
    result = ep.optimize(runner, "top", [np.full((4, 4), 50, np.uint8)], n=4, ranges={"least": (0, 255)}, seed=1)
    failed = [trial for trial in result if trial.setting["least"] > 50]
    assert {trial.failure for trial in failed} == {"top gave Nothing: nothing was found"}
    assert all(trial.value == 50 for trial in result if trial not in failed)
