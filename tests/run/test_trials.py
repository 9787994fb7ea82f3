"""Values are tried without changing the runner, and then taken over in one step."""

from __future__ import annotations

import gc
import logging
import threading
import weakref
from typing import Any

import numpy as np
import pytest

import epypes as ep
from epypes.errors import HyperparameterError, PayloadError, StaleToken, UnknownName
from epypes.run import execute

RUNS = 6  # enough that the later ones are compiled


@pytest.fixture
def calls() -> list[str]:
    return []


@pytest.fixture
def runner(calls: list[str]) -> ep.CompGraphRunner:
    """x -> double -> a; (a, k) -> add -> b; (b, m) -> scale -> c, run with x=1, k=10, m=3."""

    def double(x: int) -> int:
        calls.append("double")
        return 2 * x

    def add(a: int, k: int) -> int:
        calls.append("add")
        if k == 13:
            raise ValueError("13")
        return a + k

    def scale(b: int, m: int) -> int:
        calls.append("scale")
        return b * m

    cg = ep.CompGraph(
        {"double": double, "add": add, "scale": scale},
        {"double": ("x", "a"), "add": (("a", "k"), "b"), "scale": (("b", "m"), "c")},
    )
    runner = ep.CompGraphRunner(cg, {"k": 10, "m": 3})
    runner.run(x=1)
    calls.clear()
    return runner


def state(runner: ep.CompGraphRunner) -> tuple[Any, ...]:
    return dict(runner.hyperparameters), runner.last, runner.stale, len(runner.reports), runner.revision


def test_a_trial_runs_what_is_stale_and_leaves_the_runner_as_it_is(
    runner: ep.CompGraphRunner, calls: list[str]
) -> None:
    before = state(runner)
    run = runner.trial({"k": 20})
    assert (run["c"], calls, dict(run.hyperparameters)) == (66, ["add", "scale"], {"k": 20, "m": 3})
    assert state(runner) == before
    assert runner["c"] == 36


def test_a_trial_of_a_target_computes_only_what_it_needs(runner: ep.CompGraphRunner, calls: list[str]) -> None:
    run = runner.trial({"k": 20, "m": 5}, "b")
    assert (run["b"], calls) == (22, ["add"])
    with pytest.raises(StaleToken):
        run["c"]


def test_a_run_that_is_adopted_is_the_last_with_its_hyperparameters(
    runner: ep.CompGraphRunner, calls: list[str]
) -> None:
    run = runner.trial({"k": 20}, "b")
    assert runner.adopt(run) is True
    assert (runner.last, runner["k"], runner["b"], runner.stale) == (run, 20, 22, ("scale",))
    assert runner.reports[-1].ran == ("add",)
    calls.clear()
    assert (runner.rerun()["c"], calls) == (66, ["scale"])


def test_trials_on_another_payload_start_from_nothing(runner: ep.CompGraphRunner, calls: list[str]) -> None:
    run = runner.trial({"m": 1}, payload={"x": 5})
    assert (run["c"], calls, runner["c"]) == (20, ["double", "add", "scale"], 36)
    assert runner.adopt(run)
    assert (runner["x"], runner["c"], runner["m"]) == (5, 20, 1)


def test_a_runner_that_was_never_run_can_try_a_payload(runner: ep.CompGraphRunner) -> None:
    fresh = ep.CompGraphRunner(runner.cg, {"k": 1, "m": 1})
    with pytest.raises(PayloadError, match=r"Call run\(x=\.\.\.\) first"):
        fresh.trial({})
    run = fresh.trial({}, payload={"x": 1})
    assert fresh.last is None
    assert fresh.adopt(run)
    assert fresh["c"] == 3


def test_a_trial_that_fails_says_so_and_raises_nothing(runner: ep.CompGraphRunner) -> None:
    run = runner.trial({"k": 13})
    assert run.failure is not None
    assert run.failure.function == "add"
    assert runner["c"] == 36
    assert runner.trial({"k": 14})["b"] == 16


@pytest.mark.parametrize(
    "change",
    [
        lambda runner: runner.__setitem__("m", 7),
        lambda runner: runner.run(x=2),
        lambda runner: runner.rerun(k=11),
        lambda runner: runner.rerun(),
        lambda runner: runner.adopt(runner.trial({"m": 8})),
        lambda runner: runner.freeze(x=3),
        lambda runner: runner.unfreeze("k"),
    ],
    ids=["set", "run", "rerun", "rerun the same", "another trial", "freeze", "unfreeze"],
)
def test_a_run_is_not_adopted_once_the_runner_has_changed(runner: ep.CompGraphRunner, change: Any) -> None:
    run = runner.trial({"k": 20})
    change(runner)
    before = state(runner)
    assert runner.adopt(run) is False
    assert state(runner) == before


def test_only_a_trial_of_this_runner_can_be_adopted(runner: ep.CompGraphRunner) -> None:
    other = ep.CompGraphRunner(runner.cg, {"k": 1, "m": 1})
    other.run(x=1)
    for run in (runner.last, other.trial({"k": 2})):
        with pytest.raises(ValueError, match=r"this runner's trial\(\)"):
            runner.adopt(run)


def test_names_that_are_wrong_are_refused_as_in_rerun(runner: ep.CompGraphRunner) -> None:
    with pytest.raises(UnknownName):
        runner.trial({"kk": 1})
    with pytest.raises(HyperparameterError):
        runner.trial({"b": 1})
    with pytest.raises(UnknownName):
        runner.trial({}, "cc")
    with pytest.raises(PayloadError):
        runner.trial({}, payload={"a": 1})


@pytest.mark.slow
def test_a_dropped_trial_keeps_nothing_alive(runner: ep.CompGraphRunner) -> None:
    runner.guard = False
    first = weakref.ref(runner.trial({"k": 20}))
    runner.adopt(runner.trial({"k": 21}))
    second = weakref.ref(runner.last)  # type: ignore[arg-type]
    runner.adopt(runner.trial({"k": 22}))
    gc.collect()
    assert first() is None
    assert second() is None


def test_cells_never_see_half_of_a_change() -> None:
    """While runs are adopted in one thread, another never reads values that don't belong together."""
    cg = ep.CompGraph({"f": lambda image, k: image + k}, {"f": (("image", "k"), "y")})
    runner = ep.CompGraphRunner(cg, {"k": 0})
    runner.run(image=np.zeros(4))
    done, wrong = threading.Event(), []

    def read() -> None:
        while not done.is_set():
            try:
                low, y, high = runner["k"], runner["y"], runner["k"]
            except Exception as error:  # a stale token would show a new k with the old run
                wrong.append(error)
                return
            if not low <= y[0] <= high:
                wrong.append((low, y, high))

    reader = threading.Thread(target=read)
    reader.start()
    for k in range(1, 3_000):
        assert runner.adopt(runner.trial({"k": k}))
    done.set()
    reader.join(60)
    assert wrong == []


def test_a_watcher_hears_of_everything_that_changes_a_runner(runner: ep.CompGraphRunner) -> None:
    heard: list[str] = []
    forget = runner.watch(lambda: heard.append(threading.current_thread().name))
    runner["k"] = 11
    runner.rerun(m=4)
    for _ in range(6):
        runner.rerun(k=5)
        runner.rerun(k=6)
        runner.run(x=4)
    assert len(heard) == 2 + 18
    runner.adopt(runner.trial({"k": 1}))
    assert len(heard) == 21
    with pytest.raises(ValueError, match="13"):
        runner.rerun(k=13)
    assert len(heard) == 22
    runner.freeze(x=3)
    runner.unfreeze("x")
    assert len(heard) == 24
    assert set(heard) == {threading.current_thread().name}
    forget()
    forget()
    runner["k"] = 12
    assert len(heard) == 24


def test_a_watcher_that_fails_spoils_no_run(runner: ep.CompGraphRunner, caplog: pytest.LogCaptureFixture) -> None:
    runner.watch(lambda: 1 / 0)
    with caplog.at_level(logging.ERROR):
        assert runner.rerun(k=1)["b"] == 3
    assert "ZeroDivisionError" in caplog.text


@pytest.mark.parametrize("targets", [(), ("b",)], ids=["all", "one target"])
def test_a_trial_that_is_repeated_is_compiled_like_a_rerun(
    runner: ep.CompGraphRunner, targets: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    for k in range(20, 20 + RUNS):
        runner.adopt(runner.trial({"k": k}, *targets))
    monkeypatch.setattr(execute, "run_one_by_one", lambda *args: pytest.fail("was not compiled"))
    trial = runner.trial({"k": 40}, *targets)
    assert trial["b"] == 42
    assert runner.adopt(trial)
    assert runner.rerun(*targets, k=41)["b"] == 43
    failed = runner.trial({"k": 13}, *targets)
    assert failed.failure is not None
    assert failed.failure.function == "add"
    assert "b" not in failed
