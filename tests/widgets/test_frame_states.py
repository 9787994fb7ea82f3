"""A panel on a graph with state, on a sequence of frames: each is shown with the state as of that frame."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import epypes as ep
from epypes.errors import ScaleError
from epypes_widgets import Panel, tune
from tests.widgets.frontend import FrontEnd

_WAIT_S = 60


class Smoothing:
    """A graph with state that counts its calls, and the loop that it stands for."""

    def __init__(self, count: int = 40) -> None:
        self.calls: Counter[str] = Counter()
        self.before_call = lambda x: None
        self.frames = [np.full((4, 6), float(number * 7 % 11)) for number in range(count)]
        cg = ep.CompGraph(
            {"smooth": self._smooth, "scale": self._scale},
            {"smooth": (("image", "before", "k"), "smoothed"), "scale": (("smoothed", "gain"), "y")},
        )
        self.runner = ep.CompGraphRunner(ep.delay(cg, "smoothed", "before"), {"k": 0.5, "gain": 1.0})

    def _smooth(self, image: Any, before: Any, k: float) -> Any:
        self.calls["smooth"] += 1
        self.before_call(image[0, 0])
        if image[0, 0] == 5:
            raise ValueError("five")
        return image if before is None else k * image + (1 - k) * before

    def _scale(self, smoothed: Any, gain: float) -> Any:
        self.calls["scale"] += 1
        return smoothed * gain

    def y(self, frame: int, k: float = 0.5, gain: float = 1.0) -> float:
        before = None
        for image in self.frames[: frame + 1]:
            x = float(image[0, 0])
            if x != 5:
                before = x if before is None else k * x + (1 - k) * before
        assert before is not None
        return before * gain


@pytest.fixture
def smoothing() -> Smoothing:
    return Smoothing()


@pytest.fixture
def panel(smoothing: Smoothing) -> Iterator[Panel]:
    made = tune(smoothing.runner, images=smoothing.frames, k=(0.0, 1.0), gain=(0.0, 4.0))
    made.wait(_WAIT_S)
    yield made
    made.close(_WAIT_S)


@pytest.fixture
def screen(panel: Panel, monkeypatch: pytest.MonkeyPatch) -> FrontEnd:
    return FrontEnd(panel, monkeypatch)


def shown(panel: Panel) -> float:
    panel.wait(_WAIT_S)
    return float(panel.result["y"][0, 0])


def test_each_frame_is_shown_with_what_all_frames_before_it_have_left(
    smoothing: Smoothing, panel: Panel, screen: FrontEnd
) -> None:
    for frame in (0, 1, 30, 12, 13, 39, 2):
        screen.tell("image", index=frame)
        assert shown(panel) == pytest.approx(smoothing.y(frame))
        assert screen.frames[-1]["image"] == frame
    assert smoothing.runner.state["before"][0, 0] == pytest.approx(smoothing.y(2))


def test_the_state_follows_the_hyperparameters(smoothing: Smoothing, panel: Panel, screen: FrontEnd) -> None:
    screen.tell("image", index=20)
    for values in ({"k": 0.25}, {"gain": 3.0}, {"k": 1.0, "gain": 2.0}, {"k": 0.25, "gain": 3.0}):
        panel.set(**values)
        now = {"k": 0.5, "gain": 1.0, **panel.values}
        assert shown(panel) == pytest.approx(smoothing.y(20, **now))


def test_only_what_the_state_depends_on_has_the_frames_before_run_again(
    smoothing: Smoothing, panel: Panel, screen: FrontEnd
) -> None:
    screen.tell("image", index=20)
    shown(panel)
    smoothing.calls.clear()
    panel["gain"] = 2.0
    shown(panel)
    assert smoothing.calls == {"scale": 1}
    screen.tell("image", index=21)
    shown(panel)
    assert smoothing.calls["smooth"] == 2  # frame 20, and this one
    panel["k"] = 0.75
    shown(panel)
    assert smoothing.calls["smooth"] == 2 + 22


def test_going_back_starts_from_a_checkpoint() -> None:
    smoothing = Smoothing(300)
    panel = tune(smoothing.runner, images=smoothing.frames)
    panel._tuning.want_image(299)
    assert shown(panel) == pytest.approx(smoothing.y(299))
    for frame in (298, 17, 151):
        smoothing.calls.clear()
        panel._tuning.want_image(frame)
        assert shown(panel) == pytest.approx(smoothing.y(frame))
        assert smoothing.calls["smooth"] <= 10
    panel.close(_WAIT_S)


def test_a_newer_frame_is_not_kept_waiting_by_the_frames_before_an_older_one(
    smoothing: Smoothing, panel: Panel, screen: FrontEnd
) -> None:
    has_begun, may_go_on = threading.Event(), threading.Event()

    def wait(x: float) -> None:
        has_begun.set()
        assert may_go_on.wait(_WAIT_S)

    smoothing.before_call = wait
    smoothing.calls.clear()
    screen.tell("image", index=38)
    assert has_begun.wait(_WAIT_S)
    screen.tell("image", index=3)
    may_go_on.set()
    assert shown(panel) == pytest.approx(smoothing.y(3))
    assert smoothing.calls["smooth"] <= 5
    assert screen.frames[-1]["image"] == 3


def test_what_is_to_be_run_is_not_lost_when_a_cell_changes_the_runner_meanwhile(
    smoothing: Smoothing, panel: Panel, screen: FrontEnd
) -> None:
    has_begun, may_go_on = threading.Event(), threading.Event()

    def wait(x: float) -> None:
        has_begun.set()
        assert may_go_on.wait(_WAIT_S)

    screen.tell("live", on=False)
    panel.wait(_WAIT_S)
    smoothing.before_call = wait
    screen.tell("image", index=12)
    screen.tell("run")
    assert has_begun.wait(_WAIT_S)
    smoothing.runner["gain"] = 2.0
    may_go_on.set()
    assert shown(panel) == pytest.approx(smoothing.y(12, gain=2.0))


def test_the_runner_has_the_state_after_the_frame_whatever_is_looked_at(smoothing: Smoothing) -> None:
    panel = tune(smoothing.runner, images=smoothing.frames, token="image")
    panel._tuning.want_image(9)
    panel.wait(_WAIT_S)
    panel.close(_WAIT_S)
    assert smoothing.runner.run(image=smoothing.frames[10])["y"][0, 0] == pytest.approx(smoothing.y(10))


def test_it_says_how_far_it_has_come(smoothing: Smoothing, panel: Panel, screen: FrontEnd, monkeypatch: Any) -> None:
    monkeypatch.setattr("epypes_widgets.picture.frame_states._REPORT_S", 0.0)
    screen.tell("image", index=30)
    shown(panel)
    texts = [note["text"] for note in screen.of("note")]
    assert "Running the frames before this one: 30 of 30" in texts
    assert texts[-1] == ""


def test_what_it_is_compared_with_has_a_state_of_its_own(smoothing: Smoothing, panel: Panel, screen: FrontEnd) -> None:
    screen.tell("image", index=9)
    panel["k"] = 0.25
    assert shown(panel) == pytest.approx(smoothing.y(9, k=0.25))
    screen.tell("compare", **{"with": {"kind": "default"}})
    panel.wait(_WAIT_S)
    assert screen.last("reference")["label"] == "default"
    run = panel._session.compared({"k": 0.5}, "y")
    assert run["y"][0, 0] == pytest.approx(smoothing.y(9))
    assert shown(panel) == pytest.approx(smoothing.y(9, k=0.25))


def test_a_cell_goes_on_from_the_frame_that_is_shown(smoothing: Smoothing, panel: Panel, screen: FrontEnd) -> None:
    screen.tell("image", index=9)
    shown(panel)
    smoothing.runner.run(image=smoothing.frames[10])
    assert smoothing.runner["y"][0, 0] == pytest.approx(smoothing.y(10))
    assert shown(panel) == pytest.approx(smoothing.y(10))
    panel["k"] = 0.25
    assert shown(panel) == pytest.approx(smoothing.y(10, k=0.25))


def test_an_image_that_is_none_of_the_frames_keeps_the_state_that_its_run_began_with(
    smoothing: Smoothing, panel: Panel, screen: FrontEnd
) -> None:
    screen.tell("image", index=3)
    shown(panel)
    smoothing.runner.run(image=np.full((4, 6), 100.0))
    shown(panel)
    panel["k"] = 0.25
    assert shown(panel) == pytest.approx(0.25 * 100 + 0.75 * smoothing.y(3))


def test_a_panel_without_images_tunes_the_last_run(smoothing: Smoothing) -> None:
    smoothing.runner.run(image=smoothing.frames[0])
    smoothing.runner.run(image=smoothing.frames[1])
    panel = tune(smoothing.runner)
    panel["k"] = 0.25
    assert shown(panel) == pytest.approx(0.25 * 7)
    panel.close(_WAIT_S)


def test_the_state_of_a_nested_pipeline_is_that_of_its_hyperparameters_in_the_graph(smoothing: Smoothing) -> None:
    inner = ep.Pipeline("inner", smoothing.runner.cg, {"k": 0.5, "gain": 1.0})
    runner = ep.CompGraphRunner(ep.CompGraph({"f": inner}, {"f": ("image", "y")}))
    panel = tune(runner, images=smoothing.frames, f__k=(0.0, 1.0), f__gain=(0.0, 4.0))
    try:
        panel._tuning.want_image(20)
        assert shown(panel) == pytest.approx(smoothing.y(20))
        for k in (0.25, 0.75, 0.5):
            panel["f__k"] = k
            assert shown(panel) == pytest.approx(smoothing.y(20, k))
    finally:
        panel.close(_WAIT_S)


def test_the_state_of_a_nested_pipeline_is_that_of_its_frame(smoothing: Smoothing) -> None:
    inner = ep.Pipeline("inner", smoothing.runner.cg, {"k": 0.5, "gain": 1.0})
    runner = ep.CompGraphRunner(
        ep.CompGraph({"inner": inner, "add": lambda y, g: y + g}, {"inner": ("image", "y"), "add": (("y", "g"), "z")}),
        {"g": 0.0},
    )
    panel = tune(runner, images=smoothing.frames, g=(0.0, 5.0))
    panel._tuning.want_image(12)
    assert shown(panel) == pytest.approx(smoothing.y(12))
    inner["k"] = 0.25
    panel["g"] = 1.0
    assert shown(panel) == pytest.approx(smoothing.y(12, k=0.25))
    panel.close(_WAIT_S)


def test_a_search_runs_the_whole_sequence(smoothing: Smoothing) -> None:
    panel = tune(smoothing.runner, images=smoothing.frames[:5], metric=lambda tokens, case: float(tokens["y"][0, 0]))
    assert panel.search is not None
    panel.search.start(1)
    result = panel.search.wait(_WAIT_S)
    assert result is not None
    assert result.best_value == pytest.approx(smoothing.y(4))
    panel.close(_WAIT_S)


def test_cases_are_checked_elsewhere(smoothing: Smoothing) -> None:
    with pytest.raises(ScaleError, match=r"ep\.check"):
        tune(smoothing.runner, cases=[ep.Case(smoothing.frames)])
