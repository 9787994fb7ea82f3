"""Does a panel search hyperparameters beside itself: begin, tell, stop, use what was found, and undo that?"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import epypes as ep
from epypes.errors import StillRunning
from epypes_widgets import Panel, tune
from epypes_widgets.search import Search
from tests.widgets.frontend import FrontEnd

TIMEOUT_S = 60.0


def near(tokens: Any, _case: ep.Case) -> float:
    """Return how near the share of white pixels is to a quarter."""
    return -abs(float((tokens["mask"] > 0).mean()) - 0.25)


@pytest.fixture
def panel(runner: ep.CompGraphRunner) -> Iterator[Panel]:
    panel = tune(runner, metric=near, gain=(1, 4), threshold=(0, 255))
    yield panel
    panel.close()


def search_of(panel: Panel) -> Search:
    assert panel.search is not None
    return panel.search


def test_a_button_searches_within_the_ranges_of_the_controls_and_sets_nothing(
    panel: Panel, runner: ep.CompGraphRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    view, before = FrontEnd(panel, monkeypatch), dict(runner.hyperparameters)
    view.tell("optimise", n=25)
    result = search_of(panel).wait(TIMEOUT_S)
    assert result is not None
    assert len(result) == 25
    assert all(1 <= trial.setting["gain"] <= 4 and 0 <= trial.setting["threshold"] <= 255 for trial in result)
    assert dict(runner.hyperparameters) == before
    told = view.of("optimised")
    assert [message["state"] for message in (told[0], told[-1])] == ["running", "done"]
    assert told[-1]["values"] == [trial.value for trial in result]
    assert told[-1]["values"][told[-1]["best"]] == result.best_value
    assert [message["seq"] for message in told] == sorted(message["seq"] for message in told)


def test_what_was_found_is_used_as_a_hand_would_and_undone(
    panel: Panel, runner: ep.CompGraphRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    view, before = FrontEnd(panel, monkeypatch), dict(runner.hyperparameters)
    view.tell("optimise_use")
    panel.wait(TIMEOUT_S)
    assert dict(runner.hyperparameters) == before, "nothing has been found yet"
    view.tell("optimise", n=25)
    result = search_of(panel).wait(TIMEOUT_S)
    assert result is not None
    view.tell("optimise_use")
    panel.wait(TIMEOUT_S)
    assert result.best == panel.values == dict(runner.hyperparameters) != before
    assert panel.undo()
    panel.wait(TIMEOUT_S)
    assert dict(runner.hyperparameters) == before


def test_a_view_that_comes_later_is_told_how_far_it_is(panel: Panel, monkeypatch: pytest.MonkeyPatch) -> None:
    search_of(panel).start(3)
    search_of(panel).wait(TIMEOUT_S)
    told = FrontEnd(panel, monkeypatch).last("setup")["optimise"]
    assert (told["state"], len(told["values"]), told["metric"], told["direction"]) == ("done", 3, "near", "maximize")


def test_without_a_metric_there_is_no_search(runner: ep.CompGraphRunner, monkeypatch: pytest.MonkeyPatch) -> None:
    panel = tune(runner)
    try:
        view = FrontEnd(panel, monkeypatch)
        for kind in ("optimise", "optimise_stop", "optimise_use"):
            view.tell(kind, n=3)
        assert (panel.search, view.last("setup")["optimise"], panel.log) == (None, None, ())
    finally:
        panel.close()


class Waits:
    """A graph whose function waits until it may go on."""

    def __init__(self) -> None:
        self.entered, self.may_go = threading.Event(), threading.Event()
        self.is_armed = False
        cg = ep.CompGraph({"f": self._wait}, {"f": (("image", "k"), "y")})
        self.runner = ep.CompGraphRunner(cg, {"k": 1})
        self.runner.run(image=np.zeros((8, 8), np.uint8))

    def _wait(self, image: Any, k: int) -> Any:
        if self.is_armed and threading.current_thread().name == "epypes-search":
            self.entered.set()
            assert self.may_go.wait(TIMEOUT_S)
        return image + k


@pytest.fixture
def waits() -> Iterator[Waits]:
    waits = Waits()
    yield waits
    waits.may_go.set()


def mean(tokens: Any, _case: ep.Case) -> float:
    return float(tokens["y"].mean())


def test_the_panel_goes_on_while_it_searches_and_a_stop_is_told_at_once(
    waits: Waits, monkeypatch: pytest.MonkeyPatch
) -> None:
    panel = tune(waits.runner, metric=mean, k=(0, 9))
    view = FrontEnd(panel, monkeypatch)
    waits.is_armed = True
    view.tell("optimise", n=50)
    assert waits.entered.wait(TIMEOUT_S)
    assert not search_of(panel).start(50), "one at a time"
    panel["k"] = 5
    panel.wait(TIMEOUT_S)
    assert panel.result["y"].max() == 5
    view.tell("optimise_stop")
    assert view.last("optimised")["state"] == "stopping"
    waits.may_go.set()
    result = search_of(panel).wait(TIMEOUT_S)
    assert result is not None
    assert result.was_stopped
    assert view.last("optimised")["text"].startswith("Stopped after")
    panel.close()


def test_a_panel_that_is_closed_searches_no_more(waits: Waits) -> None:
    panel = tune(waits.runner, metric=mean, k=(0, 9))
    waits.is_armed = True
    search_of(panel).start(50)
    assert waits.entered.wait(TIMEOUT_S)
    with pytest.raises(StillRunning, match="epypes-search"):
        panel.close(0.05)
    waits.may_go.set()
    panel.close(TIMEOUT_S)
    assert not search_of(panel).is_running


def test_why_nothing_was_found_is_said(runner: ep.CompGraphRunner, monkeypatch: pytest.MonkeyPatch) -> None:
    panel = tune(runner, cases=[{"image": None}], metric=near)
    view = FrontEnd(panel, monkeypatch)
    view.tell("optimise", n=2)
    assert search_of(panel).wait(TIMEOUT_S) is None
    told = view.last("optimised")
    assert (told["state"], told["values"], told["best"]) == ("refused", [None, None], None)
    assert "None of 2 trials completed" in told["text"]
    assert "brighten: AttributeError" in told["text"]
    panel.close()


def test_test_images_are_the_cases_if_none_are_given(runner: ep.CompGraphRunner, image: Any) -> None:
    seen = []

    def metric(tokens: Any, case: ep.Case) -> float:
        seen.append(case.inputs["image"])
        return 0.0

    panel = tune(runner, images=[image, image + 1], metric=metric)
    search_of(panel).start(1)
    search_of(panel).wait(TIMEOUT_S)
    assert seen[0] is image
    assert len(seen) == 2
    panel.close()
