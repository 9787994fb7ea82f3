"""Does a tile that is clicked set the runner to its setting, and nothing else?"""

from __future__ import annotations

import gc
import json
import threading
import weakref
from collections.abc import Callable, Iterator
from typing import Any

import pytest

import epypes as ep
from epypes_widgets import Panel, Picker, pick


class Clicks:
    """A view of a picker: keeps what arrives, and clicks."""

    def __init__(self, picker: Picker, monkeypatch: pytest.MonkeyPatch) -> None:
        self.messages: list[dict[str, Any]] = []
        self.buffers: list[list[bytes]] = []
        self.view = picker.widget
        monkeypatch.setattr(self.view, "send", self._sent)
        self.say("ready")

    def say(self, kind: str, **content: Any) -> None:
        self.view._msg_callbacks(self.view, {"kind": kind, **content}, [])

    def last(self, kind: str) -> dict[str, Any]:
        return [message for message in self.messages if message["kind"] == kind][-1]

    def _sent(self, content: dict[str, Any], buffers: list[bytes]) -> None:
        self.messages.append(json.loads(json.dumps(content, allow_nan=False)))
        self.buffers.append(buffers)


@pytest.fixture
def result(runner: ep.CompGraphRunner) -> ep.SweepResult:
    return ep.sweep(runner, {"gain": [1, 2, 3], "threshold": [13, 100, 200]})


@pytest.fixture
def picker(result: ep.SweepResult) -> Iterator[Picker]:
    picker = pick(result)
    yield picker
    picker.close(10)


@pytest.fixture
def clicks(picker: Picker, monkeypatch: pytest.MonkeyPatch) -> Clicks:
    return Clicks(picker, monkeypatch)


def test_a_click_sets_the_runner_and_runs_what_is_stale(
    runner: ep.CompGraphRunner, picker: Picker, clicks: Clicks, calls: Any
) -> None:
    calls.clear()
    clicks.say("pick", place=5)
    picker.wait(60)
    assert dict(runner.hyperparameters) == {"gain": 2, "threshold": 200}
    assert calls.counts == {"above": 1}
    assert runner.last is not None
    assert runner.stale == ()
    assert int((runner["mask"] > 0).sum()) == int((runner["image_bright"] > 200).sum())
    assert clicks.last("state") == {"kind": "state", "chosen": 5, "busy": False, "text": "Set: gain 2, threshold 200"}


def test_the_tile_of_the_present_setting_is_marked_and_follows_what_cells_do(
    runner: ep.CompGraphRunner, picker: Picker, clicks: Clicks
) -> None:
    assert picker.chosen == 4
    assert clicks.last("state")["chosen"] == 4
    for values, chosen in (({"gain": 3}, 7), ({"gain": 5}, None)):
        runner.set(**values)
        picker.wait(60)
        assert clicks.last("state")["chosen"] == chosen


def test_a_setting_that_fails_leaves_the_runner_as_it_was(
    runner: ep.CompGraphRunner, picker: Picker, clicks: Clicks
) -> None:
    before = dict(runner.hyperparameters), runner.last
    clicks.say("pick", place=0)
    picker.wait(60)
    assert (dict(runner.hyperparameters), runner.last) == before
    assert clicks.last("state")["chosen"] == 4
    assert "13 is not a threshold" in clicks.last("state")["text"]


@pytest.mark.slow
def test_an_open_panel_follows(panel: Panel, runner: ep.CompGraphRunner) -> None:
    picker = pick(ep.sweep(runner, {"gain": [1, 3], "threshold": [50, 60]}))
    picker.choose(3)
    picker.wait(60)
    panel.wait(60)
    assert panel.values == {"gain": 3, "threshold": 60}
    picker.close(10)


def test_a_runner_that_has_run_nothing_is_only_set(runner: ep.CompGraphRunner, image: Any) -> None:
    new = ep.CompGraphRunner(runner.cg, {"gain": 1, "threshold": 1})
    picker = pick(ep.sweep(new, {"threshold": [50, 60]}, [image]))
    assert picker.chosen is None
    picker.choose(1)
    picker.wait(60)
    assert new.hyperparameters["threshold"] == 60
    assert new.last is None
    assert "Nothing has been run yet" in picker.text
    picker.close(10)


def test_the_view_gets_each_picture_once_and_any_token(clicks: Clicks) -> None:
    sheet = clicks.last("sheet")
    assert (sheet["rows"], sheet["columns"], sheet["token"]) == ("gain", "threshold", "mask")
    tiles = [tile for row in sheet["blocks"][0]["rows"] for cell in row for tile in cell]
    assert [tile["place"] for tile in tiles] == list(range(9))
    assert [tile["failed"] for tile in tiles] == [True, False, False] * 3
    pictures = clicks.buffers[clicks.messages.index(sheet)]
    assert {tile["picture"] for tile in tiles if not tile["failed"]} == set(range(len(set(pictures))))
    clicks.say("show", token="image")
    assert clicks.last("sheet")["token"] == "image"
    assert len(clicks.buffers[clicks.messages.index(clicks.last("sheet"))]) == 1


def test_of_several_settings_that_are_clicked_the_last_one_counts(picker: Picker, runner: ep.CompGraphRunner) -> None:
    for place in (1, 2, 4, 5, 8):
        picker.choose(place)
    picker.wait(60)
    assert dict(runner.hyperparameters) == {"gain": 3, "threshold": 200}


def test_what_is_not_there_can_not_be_picked(picker: Picker) -> None:
    with pytest.raises(IndexError, match="no outcome 9; the sweep has 9"):
        picker.choose(9)
    with pytest.raises(TypeError, match=r"pick\(ep.sweep\(...\)\)"):
        pick([1, 2])  # type: ignore[arg-type]


def test_a_closed_picker_follows_nothing_and_leaves_no_thread(
    picker: Picker, clicks: Clicks, runner: ep.CompGraphRunner
) -> None:
    picker.choose(1)
    picker.wait(60)
    picker.close(10)
    picker.close(10)
    before = len(clicks.messages)
    clicks.say("pick", place=2)
    runner.set(gain=3)
    assert len(clicks.messages) == before
    assert runner.hyperparameters["threshold"] == 100
    assert not any(thread.name == "epypes-pick" for thread in threading.enumerate())


@pytest.mark.slow
def test_the_runner_keeps_no_picker_alive(result: ep.SweepResult) -> None:
    picker = pick(result)
    picker.widget.close()
    found: Callable[[], Picker | None] = weakref.ref(picker)
    del picker
    gc.collect()
    assert found() is None


def test_a_saved_notebook_shows_the_sheet_with_the_chosen_tile_marked(picker: Picker) -> None:
    picker.choose(5)
    picker.wait(60)
    page = picker._static.html()
    assert page.count("✓ chosen") == 1
    assert page.count("<img ") == 6
