"""Has every entry of a panel's history its picture, and has the screen the newest history?"""

from __future__ import annotations

import threading
from typing import Any

import pytest

import epypes as ep
from epypes_widgets import Panel, tune
from tests.widgets.frontend import FrontEnd


@pytest.fixture
def screen(panel: Panel, monkeypatch: pytest.MonkeyPatch) -> FrontEnd:
    return FrontEnd(panel, monkeypatch)


def test_undo_before_the_hand_lets_go_adds_an_entry_with_its_picture(panel: Panel, screen: FrontEnd) -> None:
    screen.tell("hold", names=["threshold"])
    screen.tell("move", places={}, values={"threshold": 60})
    screen.wait_for_values(60, threshold=60)
    screen.tell("undo")
    panel.wait(60)
    assert [entry.values["threshold"] for entry in panel._history.entries] == [100, 60]
    assert [entry.token for entry in panel._history.entries if entry.picture] == ["mask", "mask"]


def test_what_the_screen_is_told_last_is_the_newest_history(
    panel: Panel, screen: FrontEnd, monkeypatch: pytest.MonkeyPatch
) -> None:
    panel.wait(60)
    told, code = [], panel._screen.code

    def slow_code() -> str:
        """While one thread has looked at the history and not told it yet, have another add an entry and tell it."""
        if not told:
            other = threading.Thread(target=panel._screen.send_history)
            told.append(other)
            panel._history.commit({"gain": 2, "threshold": 61})
            other.start()
            other.join(0.2)
        return code()

    monkeypatch.setattr(panel._screen, "code", slow_code)
    panel._screen.send_history()
    told[0].join(60)
    assert [entry["values"]["threshold"] for entry in screen.last("history")["entries"]] == [100, 61]


def test_an_entry_says_what_it_changed_of_the_one_that_was_left(panel: Panel, screen: FrontEnd) -> None:
    for threshold in (110, 120):
        panel["threshold"] = threshold
        panel.wait(60)
    for _ in range(2):
        panel.undo()
    panel.wait(60)
    panel["gain"] = 3
    panel.wait(60)
    entries = screen.last("history")["entries"]
    assert [entry["changed"] for entry in entries] == [
        "", "threshold 100 -> 110", "threshold 110 -> 120", "gain 2 -> 3"
    ]  # fmt: skip
    assert entries[3]["about"] == "gain 2 -> 3"


def test_an_image_that_is_chosen_while_another_value_is_computed_has_an_entry_of_its_own(
    image: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, go_on = threading.Event(), threading.Event()

    def slow(image: Any, threshold: int) -> Any:
        begun.set()
        assert go_on.wait(60)
        return image > threshold

    go_on.set()
    runner = ep.CompGraphRunner(ep.CompGraph.from_functions(slow), {"threshold": 100})
    panel = tune(runner, images=[image, 255 - image], threshold=(0, 255))
    screen = FrontEnd(panel, monkeypatch)
    panel.wait(60)
    for first, second in (("image", "set"), ("set", "image")):
        threshold = 100 + len(panel.history)
        given = {"image": {"index": 1 - (panel._session.image or 0)}, "set": {"values": {"threshold": threshold}}}
        go_on.clear()
        begun.clear()
        screen.tell(first, **given[first])
        assert begun.wait(60)
        screen.tell(second, **given[second])
        go_on.set()
        panel.wait(60)
    changes = [entry["changed"] for entry in screen.last("history")["entries"]]
    assert changes == ["", "image 1 -> 2", "threshold 100 -> 101", "threshold 101 -> 103", "image 2 -> 1"]
    panel.close(10)
