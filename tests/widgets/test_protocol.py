"""Is the final picture that of the final value, whatever happens between the kernel and the browser?"""

from __future__ import annotations

import itertools
import json
import threading
from typing import Any

import numpy as np
import pytest

import epypes as ep
from epypes.errors import StillRunning
from epypes_widgets import Panel, tune, view
from tests.widgets.frontend import BadLine, FrontEnd


@pytest.fixture
def front_end(panel: Panel, monkeypatch: pytest.MonkeyPatch) -> FrontEnd:
    return FrontEnd(panel, monkeypatch)


def move(panel: Panel, name: str, value: Any) -> None:
    """Move a slider as the front end does."""
    panel._controls.control(name).widget.value = value


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 1, 2, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(3, 24))])
def test_the_last_value_is_shown_over_a_line_that_loses_doubles_delays_and_exchanges(
    panel: Panel, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    monkeypatch.setattr(view, "FIRST_TIMEOUT_S", 0.01)
    monkeypatch.setattr(view, "LAST_TIMEOUT_S", 0.02)
    down, up = BadLine(seed), BadLine(seed + 100)
    try:
        front_end = FrontEnd(panel, monkeypatch, down, up)
        front_end.tell("ready")
        for value in range(101, 220):
            move(panel, "threshold", value)
        # How many messages that makes depends on how busy the machine is.
        for value in itertools.cycle((101, 102)):
            if down.lost + up.lost:
                break
            move(panel, "threshold", value)
            panel.wait(60)
        move(panel, "threshold", 220)
        panel.wait(60)
        # The browser says "ready" until it is heard: the page of a notebook is mounted for good.
        while not front_end.painted:
            front_end.tell("ready")
            panel._tuning.worker.wait(60)
        front_end.wait_for_values(60, threshold=220)
        seqs = [frame["seq"] for frame in front_end.painted]
        assert seqs == sorted(seqs)
    finally:
        down.close()
        up.close()


def test_values_from_another_thread_than_the_answers_are_all_shown_in_the_end(
    panel: Panel, monkeypatch: pytest.MonkeyPatch
) -> None:
    """ipykernel answers the first message on the main thread and the rest on another."""
    line = BadLine(0)
    line.mend()
    try:
        front_end = FrontEnd(panel, monkeypatch, line, line)
        hands = [
            threading.Thread(target=lambda: [move(panel, "threshold", value) for value in range(101, 181)]),
            threading.Thread(target=lambda: [move(panel, "gain", value % 5 + 1) for value in range(83)]),
        ]
        for hand in hands:
            hand.start()
        for hand in hands:
            hand.join(60)
        front_end.wait_for_values(60, threshold=180, gain=3)
    finally:
        line.close()


@pytest.mark.slow
def test_one_frame_is_in_flight_however_many_values_come(panel: Panel, monkeypatch: pytest.MonkeyPatch) -> None:
    answers: list[Any] = []
    front_end = FrontEnd(panel, monkeypatch)
    front_end._up = answers.append
    for value in range(101, 121):
        panel["threshold"] = value
        panel.wait(60)
    assert len(front_end.frames) == 2
    # The worker's thread sends the newest one when the first is on the screen.
    while len(front_end.frames) < 3 or answers:
        if answers:
            answers.pop(0)()
    assert [frame["values"]["threshold"] for frame in front_end.frames] == [100, 101, 120]


def test_a_view_that_is_mounted_later_hears_everything(panel: Panel, monkeypatch: pytest.MonkeyPatch) -> None:
    panel["threshold"] = 13
    panel.wait(60)
    front_end = FrontEnd(panel, monkeypatch)
    kinds = [message["kind"] for message in front_end.messages]
    assert kinds == ["setup", "history", "frame", "error"]
    assert front_end.last("setup")["token"] == "mask"
    assert [row["names"] for row in front_end.last("setup")["rows"]] == [["gain"], ["threshold"]]
    assert front_end.last("setup")["rows"][1]["value"] == [13]


def test_a_drag_is_computed_and_committed_when_it_is_let_go(
    panel: Panel, front_end: FrontEnd, runner: ep.CompGraphRunner
) -> None:
    before = len(panel.history)
    front_end.tell("hold", names=["threshold"])
    for value in (110, 120, 130):
        move(panel, "threshold", value)
        front_end.wait_for_values(60, threshold=value)
    front_end.tell("release", names=["threshold"])
    panel.wait(60)
    assert list(panel.history["threshold"])[before:] == [130]
    assert runner["threshold"] == 130


@pytest.mark.slow
def test_a_hand_that_rests_commits(panel: Panel, front_end: FrontEnd) -> None:
    move(panel, "threshold", 110)
    move(panel, "threshold", 111)
    panel.wait(60)
    move(panel, "threshold", 112)
    panel.wait(60)
    assert list(panel.history["threshold"]) == [100, 111, 112]


@pytest.mark.slow
def test_a_control_that_is_held_is_never_written_to(
    panel: Panel, front_end: FrontEnd, runner: ep.CompGraphRunner
) -> None:
    front_end.tell("hold", names=["threshold"])
    move(panel, "threshold", 110)
    panel.wait(60)
    runner["threshold"] = 50
    runner["gain"] = 3
    panel.wait(60)
    assert panel.values == {"gain": 3, "threshold": 110}
    front_end.tell("release", names=["threshold"])
    panel.wait(60)
    assert panel.values == {"gain": 3, "threshold": 50} == dict(runner.hyperparameters)


@pytest.mark.slow
def test_what_the_hand_does_after_a_cell_wins(panel: Panel, front_end: FrontEnd, runner: ep.CompGraphRunner) -> None:
    front_end.tell("hold", names=["threshold"])
    runner["threshold"] = 50
    panel.wait(60)
    move(panel, "threshold", 111)
    front_end.tell("release", names=["threshold"])
    panel.wait(60)
    assert (panel["threshold"], runner["threshold"]) == (111, 111)


@pytest.mark.slow
def test_a_cell_that_sets_a_hyperparameter_moves_the_control_and_the_picture(
    panel: Panel, front_end: FrontEnd, runner: ep.CompGraphRunner, calls: Any
) -> None:
    runner["threshold"] = 60
    panel.wait(60)
    front_end.wait_for_values(60, threshold=60)
    assert panel["threshold"] == 60
    assert calls.counts == {"above": 1}
    runner.rerun(gain=3)
    panel.wait(60)
    front_end.wait_for_values(60, gain=3)
    assert calls.counts == {"above": 2, "brighten": 1}


@pytest.mark.slow
def test_a_value_that_a_cell_sets_out_of_range_is_shown_and_said(
    panel: Panel, front_end: FrontEnd, runner: ep.CompGraphRunner
) -> None:
    runner["threshold"] = 300
    panel.wait(60)
    front_end.wait_for_values(60, threshold=300)
    assert panel["threshold"] == 100
    assert "can't be 300" in panel.log[-1]


def test_typed_values_are_checked_by_the_kernel(panel: Panel, front_end: FrontEnd) -> None:
    front_end.tell("set", values={"threshold": 300})
    assert front_end.last("error")["names"] == ["threshold"]
    assert "can't be 300" in front_end.last("error")["text"]
    front_end.tell("set", values={"threshold": 77})
    panel.wait(60)
    front_end.wait_for_values(60, threshold=77)
    assert panel.error == ""
    front_end.tell("reset", names=[])
    panel.wait(60)
    assert panel.values == {"gain": 2, "threshold": 100}


def test_only_what_is_visible_is_computed(panel: Panel, front_end: FrontEnd, calls: Any) -> None:
    front_end.tell("stage", token="image_bright")
    panel["threshold"] = 50
    panel["gain"] = 4
    panel.wait(60)
    assert calls.counts == {"brighten": 1}
    front_end.tell("pin", token="mask", on=True)
    panel.wait(60)
    assert calls.counts == {"brighten": 1, "above": 1}
    assert [picture["token"] for picture in front_end.frames[-1]["pictures"]] == ["image_bright", "mask"]
    panel["threshold"] = 51
    panel.wait(60)
    assert calls.counts == {"brighten": 1, "above": 2}


def test_with_live_off_values_wait_until_they_are_run(panel: Panel, front_end: FrontEnd, calls: Any) -> None:
    front_end.tell("live", on=False)
    panel.wait(60)
    panel["threshold"] = 50
    panel["gain"] = 3
    panel.wait(60)
    front_end.tell("stage", token="image_bright")
    panel.wait(60)
    assert (calls.counts, front_end.frames[-1]["token"]) == ({}, "image_bright")
    assert front_end.frames[-1]["values"] == {"gain": 2, "threshold": 100}
    front_end.tell("stage", token="mask")
    front_end.tell("run")
    panel.wait(60)
    front_end.wait_for_values(60, threshold=50, gain=3)
    assert calls.counts == {"brighten": 1, "above": 1}


def test_undo_and_redo_walk_through_what_was_committed(
    panel: Panel, front_end: FrontEnd, runner: ep.CompGraphRunner
) -> None:
    for threshold in (110, 120):
        panel["threshold"] = threshold
        panel.wait(60)
    front_end.tell("undo")
    panel.wait(60)
    assert (panel["threshold"], runner["threshold"]) == (110, 110)
    assert (front_end.last("history")["undo"], front_end.last("history")["redo"]) == (True, True)
    front_end.tell("undo")
    front_end.tell("undo")
    panel.wait(60)
    front_end.wait_for_values(60, threshold=100)
    front_end.tell("redo")
    panel.wait(60)
    assert runner["threshold"] == 110
    front_end.tell("goto", number=3)
    panel.wait(60)
    assert runner["threshold"] == 120
    assert len(panel.history) == 3


def test_thumbnails_of_the_history_are_sent_once(panel: Panel, front_end: FrontEnd) -> None:
    for threshold in (110, 120):
        panel["threshold"] = threshold
        panel.wait(60)
    front_end.tell("ready")
    sizes = [
        [bool(data) for data in buffers]
        for message, buffers in zip(front_end.messages, front_end.buffers, strict=True)
        if message["kind"] == "history"
    ]
    assert sizes == [[True], [False, True], [False, False, True], [True, True, True]]


def test_the_picture_is_compared_with_the_first_values_and_with_those_of_the_history(
    panel: Panel, front_end: FrontEnd, runner: ep.CompGraphRunner, calls: Any
) -> None:
    panel["threshold"] = 110
    panel.wait(60)
    panel["threshold"] = 120
    panel.wait(60)
    calls.clear()
    front_end.tell("compare", **{"with": {"kind": "default"}})
    panel.wait(60)
    assert front_end.last("reference")["label"] == "default"
    assert calls.counts == {"above": 1}
    front_end.tell("compare", **{"with": {"kind": "history", "number": 2}})
    panel.wait(60)
    assert front_end.last("reference")["label"] == "history 2"
    panel["threshold"] = 130
    panel.wait(60)
    assert len(front_end.of("reference")) == 2
    assert runner["threshold"] == 130
    front_end.tell("stage", token="image_bright")
    panel.wait(60)
    assert front_end.last("reference")["picture"]["token"] == "image_bright"
    front_end.tell("compare", **{"with": {"kind": "stage", "token": "image"}})
    panel.wait(60)
    assert [picture["role"] for picture in front_end.frames[-1]["pictures"]] == ["main", "other"]


def test_a_pixel_is_told_through_all_stages(panel: Panel, front_end: FrontEnd) -> None:
    front_end.tell("probe", id=7, x=3.5, y=2.5)
    told = front_end.last("probe")
    assert (told["id"], [row["token"] for row in told["rows"]]) == (7, ["image", "image_bright", "mask"])
    front_end.tell("probe", id=8, x=-1, y=0)
    assert front_end.last("probe")["rows"] == []


def test_a_function_that_fails_keeps_the_picture_and_names_what_was_set(panel: Panel, front_end: FrontEnd) -> None:
    before = front_end.painted[-1]["values"]
    panel["threshold"] = 13
    panel.wait(60)
    error = front_end.last("error")
    assert (error["text"], error["function"]) == ("above: ValueError: 13 is not a threshold", "above")
    assert error["names"] == ["threshold"]
    assert (front_end.painted[-1]["stale"], front_end.painted[-1]["values"]) == (True, before)
    assert front_end.painted[-1]["stages"]["mask"] == "failed"
    assert front_end.painted[-1]["seq"] < error["seq"]
    panel["threshold"] = 14
    panel.wait(60)
    assert (front_end.painted[-1]["stale"], front_end.painted[-1]["values"]["threshold"]) == (False, 14)


def test_a_message_that_makes_no_sense_is_logged_and_harms_nothing(panel: Panel, front_end: FrontEnd) -> None:
    for kind, content in (
        ("stage", {"token": "nothing"}),
        ("goto", {"number": 99}),
        ("image", {"index": 3}),
        ("set", {}),
        ("set", {"values": {"nothing": 1}}),
        ("compare", {"with": {"kind": "stage", "token": 5}}),
        ("probe", {"id": 1, "x": "a", "y": None}),
        ("unheard of", {}),
    ):
        front_end.tell(kind, **content)
    panel["threshold"] = 60
    panel.wait(60)
    front_end.wait_for_values(60, threshold=60)
    assert len(panel.log) == 7
    assert front_end.last("log")["lines"]


@pytest.mark.slow
def test_what_a_cell_sets_on_a_panel_waits_for_the_hand(
    panel: Panel, front_end: FrontEnd, runner: ep.CompGraphRunner
) -> None:
    front_end.tell("hold", names=["threshold"])
    panel["threshold"] = 90
    with pytest.raises(ValueError, match="can't be 300"):
        panel["threshold"] = 300
    panel.wait(60)
    assert (panel["threshold"], runner["threshold"]) == (100, 100)
    front_end.tell("move", values={"threshold": 95}, places={})
    panel.wait(60)
    assert (panel["threshold"], runner["threshold"]) == (95, 95)
    panel["threshold"] = 90
    front_end.tell("release", names=["threshold"])
    panel.wait(60)
    assert (panel["threshold"], runner["threshold"]) == (90, 90)


@pytest.mark.slow
def test_places_of_a_slider_that_is_dragged_come_with_acknowledgements(
    panel: Panel, front_end: FrontEnd, runner: ep.CompGraphRunner
) -> None:
    slider = panel._controls.control("threshold").widget
    front_end.tell("hold", names=["threshold"])
    front_end.tell("move", values={}, places={slider.model_id: 110})
    panel.wait(60)
    front_end.tell("painted", seq=0, move={"values": {}, "places": {slider.model_id: 120, "gone": 1}})
    panel.wait(60)
    front_end.wait_for_values(60, threshold=120)
    assert (panel["threshold"], runner["threshold"], slider.value) == (120, 120, 120)
    front_end.tell("release", names=["threshold"])
    panel.wait(60)
    assert list(panel.history["threshold"]) == [100, 120]


def slowed(panel: Panel, monkeypatch: pytest.MonkeyPatch) -> tuple[threading.Event, threading.Event]:
    """Have the next trial of a panel's runner wait: return when it has begun, and what lets it go on."""
    begun, go_on = threading.Event(), threading.Event()
    trial = panel._session.runner.trial

    def slow(*arguments: Any, **payload: Any) -> Any:
        run = trial(*arguments, **payload)
        begun.set()
        assert go_on.wait(60)
        return run

    monkeypatch.setattr(panel._session.runner, "trial", slow)
    return begun, go_on


@pytest.mark.slow
def test_of_a_panel_and_a_cell_the_one_that_set_last_wins(
    panel: Panel, front_end: FrontEnd, runner: ep.CompGraphRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, go_on = slowed(panel, monkeypatch)
    panel["gain"] = 3
    assert begun.wait(60)
    runner["gain"] = 5
    go_on.set()
    panel.wait(60)
    assert (runner["gain"], panel["gain"]) == (5, 5)
    begun.clear()
    go_on.clear()
    panel["threshold"] = 50
    assert begun.wait(60)
    runner["gain"] = 4
    panel["gain"] = 2
    go_on.set()
    panel.wait(60)
    assert (runner["gain"], panel["gain"], runner["threshold"]) == (2, 2, 50)


def test_a_panel_that_was_closed_changes_the_runner_no_more(
    panel: Panel, runner: ep.CompGraphRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, go_on = slowed(panel, monkeypatch)
    panel["gain"] = 3
    assert begun.wait(60)
    with pytest.raises(StillRunning):
        panel.close(0.01)
    go_on.set()
    panel.close(10)
    assert runner["gain"] == 2


def test_a_stream_of_runs_does_not_keep_values_from_counting(
    panel: Panel, front_end: FrontEnd, runner: ep.CompGraphRunner, image: Any
) -> None:
    done = threading.Event()

    def stream() -> None:
        while not done.is_set():
            runner.run(image=image)

    thread = threading.Thread(target=stream)
    thread.start()
    try:
        panel["threshold"] = 50
        front_end.wait_for_values(60, threshold=50)
        panel._tuning.worker.post("probe", lambda: None)
    finally:
        done.set()
        thread.join(60)
    panel.wait(60)
    assert (runner["threshold"], panel["threshold"]) == (50, 50)


def test_a_hyperparameter_that_is_one_no_more_blocks_nothing(panel: Panel, runner: ep.CompGraphRunner) -> None:
    runner.unfreeze("gain")
    panel["gain"] = 3
    panel.wait(60)
    runner.run(image=runner.last["image"], gain=2)
    panel["threshold"] = 51
    panel.wait(60)
    assert (panel.error, runner["threshold"]) == ("", 51)


def test_a_page_that_is_loaded_anew_holds_nothing(
    panel: Panel, front_end: FrontEnd, monkeypatch: pytest.MonkeyPatch
) -> None:
    front_end.tell("hold", names=["threshold"])
    FrontEnd(panel, monkeypatch)
    panel["threshold"] = 44
    panel.wait(60)
    assert panel["threshold"] == 44


def test_a_payload_that_is_run_anew_is_compared_anew(
    panel: Panel, front_end: FrontEnd, runner: ep.CompGraphRunner, image: Any
) -> None:
    front_end.tell("compare", **{"with": {"kind": "default"}})
    panel.wait(60)
    image[:] = 255 - image
    runner.run(image=image)
    panel.wait(60)
    assert len(front_end.of("reference")) == 2
    front_end.tell("compare", **{"with": {"kind": "history", "number": 77}})
    panel.wait(60)
    for threshold in (50, 51, 52):
        panel["threshold"] = threshold
        panel.wait(60)
    assert sum("No entry 77" in line for line in panel.log) == 1


def test_undo_leads_from_values_that_failed_to_the_last_that_completed(
    panel: Panel, front_end: FrontEnd, runner: ep.CompGraphRunner
) -> None:
    panel["threshold"] = 60
    panel.wait(60)
    panel["threshold"] = 13
    panel.wait(60)
    for value in (60, 100):
        assert panel.undo()
        panel.wait(60)
        assert (runner["threshold"], panel["threshold"]) == (value, value)
    assert (panel.error, list(panel.history["threshold"])) == ("", [100, 60])
    assert panel.redo()
    assert not panel.redo()


def test_the_first_values_can_be_gone_back_to_from_what_fails_on_them(panel: Panel, front_end: FrontEnd) -> None:
    panel.wait(60)
    assert not front_end.last("history")["undo"]
    panel["threshold"] = 13
    panel.wait(60)
    assert front_end.last("history")["undo"]
    front_end.tell("undo")
    panel.wait(60)
    front_end.wait_for_values(60, threshold=100)
    assert (panel["threshold"], front_end.last("history")["undo"]) == (100, False)
    for threshold in (13, 100):
        front_end.tell("set", values={"threshold": threshold})
        panel.wait(60)
    assert not front_end.last("history")["undo"]


def test_what_is_compared_with_follows_the_stage_while_a_run_fails(panel: Panel, front_end: FrontEnd) -> None:
    panel.wait(60)
    front_end.tell("compare", **{"with": {"kind": "default"}})
    front_end.tell("pin", token="mask", on=True)
    panel["threshold"] = 13
    panel.wait(60)
    front_end.tell("stage", token="image_bright")
    panel.wait(60)
    assert front_end.last("frame")["stale"]
    assert front_end.last("reference")["picture"]["token"] == "image_bright"


def test_whatever_a_hyperparameter_is_a_frame_stays_small() -> None:
    values = {"text": "x" * 5_000_000, "many": list(range(300_000)), "deep": [], "huge": 10**6000}
    for _ in range(3000):
        values["deep"] = [values["deep"]]
    cg = ep.CompGraph({"f": lambda image, *_: image}, {"f": (("image", *values), "y")})
    runner = ep.CompGraphRunner(cg, values)
    runner.run(image=np.zeros((8, 8), np.uint8))
    panel = tune(runner)
    with pytest.MonkeyPatch.context() as monkeypatch:
        front_end = FrontEnd(panel, monkeypatch)
        assert len(json.dumps(front_end.messages)) < 60_000
        assert front_end.painted
    panel.close(10)
