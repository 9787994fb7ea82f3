"""Has every entry of a panel's history its picture, and has the screen the newest history?"""

from __future__ import annotations

import threading

import pytest

from epypes_widgets import Panel
from tests.widgets.frontend import FrontEnd


@pytest.fixture
def screen(panel: Panel, monkeypatch: pytest.MonkeyPatch) -> FrontEnd:
    return FrontEnd(panel, monkeypatch)


def test_undo_before_the_hand_lets_go_adds_an_entry_with_its_picture(panel: Panel, screen: FrontEnd) -> None:
    screen.tell("hold", names=["threshold"])
    screen.tell("move", places={}, values={"threshold": 60})
    screen.wait_for_values(10, threshold=60)
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
