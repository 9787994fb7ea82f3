"""Is a running service tuned by a panel as a runner is, with its line going on and others at it too?"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from time import monotonic
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import epypes as ep
from epypes.errors import PayloadError, ServiceError
from epypes.service.remote.connection import Connection
from epypes_widgets import Panel, tune
from tests.service.standing import Standing, standing
from tests.widgets.frontend import FrontEnd

pytestmark = pytest.mark.slow

TIMEOUT_S = 60.0


class Changes:
    """Wakes who waits for something that another thread does."""

    def until(self, condition: Callable[[], bool]) -> None:
        deadline = monotonic() + TIMEOUT_S
        wait = threading.Event()
        while not condition():
            assert monotonic() < deadline, "it did not happen"
            wait.wait(0.01)


until = Changes().until


@pytest.fixture
def service(runner: ep.CompGraphRunner, image: Any, tmp_path: Any) -> Standing:
    ranges = {"gain": {"low": 1, "high": 5}, "threshold": {"low": 0, "high": 255}}
    service = Standing(runner, tmp_path, ranges, outputs=("mask",))
    service.event(image=image)
    return service


@pytest.fixture
def url(service: Standing) -> Iterator[str]:
    with standing(service) as server:
        yield f"{server.url}#token={server.token}"


@pytest.fixture
def connection(url: str) -> Iterator[Connection]:
    with ep.connect(url) as connection:
        yield connection


@pytest.fixture
def panel(connection: Connection) -> Iterator[Panel]:
    panel = tune(connection)
    panel.wait(TIMEOUT_S)
    yield panel
    panel.close(TIMEOUT_S)


@pytest.fixture
def screen(panel: Panel, monkeypatch: pytest.MonkeyPatch) -> FrontEnd:
    return FrontEnd(panel, monkeypatch)


def followers() -> list[threading.Thread]:
    return [thread for thread in threading.enumerate() if thread.name == "epypes-follower"]


def is_following(panel: Panel, service: Standing) -> None:
    """Return when the panel hears what the service tells, and has taken what it has heard."""
    heard = threading.Event()
    forget = panel._runner.watch(heard.set)

    def has_heard() -> bool:
        service.become(service.state, service.reason)
        return heard.is_set()

    until(has_heard)
    forget()
    panel.wait(TIMEOUT_S)


def test_a_panel_has_the_parameters_ranges_and_tokens_of_the_service(panel: Panel, screen: FrontEnd) -> None:
    setup = screen.last("setup")
    assert {name for row in setup["rows"] for name in row["names"]} == {"gain", "threshold"}
    assert [(row["low"], row["high"]) for row in setup["rows"]] == [([1], [5]), ([0], [255])]
    assert [(s["token"], s["is_picture"]) for s in setup["stages"]] == [
        ("image", True), ("image_bright", True), ("mask", True),
    ]  # fmt: skip
    assert (panel.token, setup["images"], setup["writes_back"]) == ("mask", [], True)
    assert screen.frames[-1]["values"] == {"gain": 2, "threshold": 100}
    assert set(screen.frames[-1]["times_ms"]) == {"brighten", "above"}


def test_a_value_is_set_with_the_revision_known_and_the_run_with_it_is_shown(
    panel: Panel, screen: FrontEnd, service: Standing
) -> None:
    panel["threshold"] = 60
    panel.wait(TIMEOUT_S)
    assert service.asked == [({"threshold": 60}, 0)]
    assert screen.frames[-1]["values"] == {"gain": 2, "threshold": 60}
    assert set(screen.frames[-1]["stages"].values()) == {"fresh"}  # what was not sent is not missing
    assert panel.result.revision == 1
    np.testing.assert_array_equal(panel.result["mask"], service.runner.trial({}, "mask")["mask"])
    assert panel.code() == "service.set(threshold=60)"
    assert panel.latency.frames > 0
    panel["gain"] = 3
    panel.wait(TIMEOUT_S)
    assert service.asked[1:] == [({"gain": 3}, 1)]


def test_of_many_values_the_last_is_set_and_few_are_asked_for(panel: Panel, service: Standing) -> None:
    with service.lock:  # the first of them hangs
        for value in range(60, 100):
            panel["threshold"] = value
    panel.wait(TIMEOUT_S)
    assert service.entries["threshold"]["value"] == panel.result.hyperparameters["threshold"] == 99
    assert len(service.asked) < 10


def test_undo_redo_save_and_load_work(panel: Panel, service: Standing, tmp_path: Any) -> None:
    panel["threshold"] = 60
    panel.wait(TIMEOUT_S)
    panel.save(tmp_path / "good")
    assert panel.undo()
    panel.wait(TIMEOUT_S)
    assert (panel["threshold"], service.entries["threshold"]["value"]) == (100, 100)
    panel.load(tmp_path / "good")
    panel.wait(TIMEOUT_S)
    assert (panel["threshold"], service.entries["threshold"]["value"]) == (60, 60)
    assert list(panel.history["threshold"])[:2] == [100, 60]


def test_the_picture_follows_the_line_when_nobody_moves_anything(
    panel: Panel, screen: FrontEnd, service: Standing, image: Any
) -> None:
    is_following(panel, service)
    before = len(screen.frames)
    service.event(image=255 - image)
    until(lambda: len(screen.frames) > before)
    panel.wait(TIMEOUT_S)
    np.testing.assert_array_equal(panel.result["mask"], service.completed[0]["mask"])
    assert panel.latency.frames == 0  # nobody has moved anything
    assert len(panel.history) == 1


def test_no_more_runs_are_fetched_than_frames_are_painted(
    panel: Panel, service: Standing, image: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    answers: list[Callable[[], None]] = []
    is_slow = threading.Event()

    def up(deliver: Callable[[], None]) -> None:
        answers.append(deliver) if is_slow.is_set() else deliver()

    screen = FrontEnd(panel, monkeypatch, up=up)
    is_following(panel, service)
    panel.wait(TIMEOUT_S)
    is_slow.set()
    before = len(screen.frames)
    service.event(image=image)
    until(lambda: len(answers) == 1)
    for number in range(20):
        service.event(image=np.full_like(image, number))
        panel.wait(TIMEOUT_S)
    assert len(screen.frames) == before + 1
    is_slow.clear()
    answers.pop()()
    until(lambda: len(screen.frames) > before + 1)
    panel.wait(TIMEOUT_S)
    np.testing.assert_array_equal(panel.result["image"] if "image" in panel.result else panel.result["mask"],
                                  service.completed[0]["image" if "image" in panel.result else "mask"])  # fmt: skip


def test_with_live_off_neither_events_nor_values_move_the_picture(
    panel: Panel, screen: FrontEnd, service: Standing, image: Any
) -> None:
    is_following(panel, service)
    screen.tell("live", on=False)
    panel.wait(TIMEOUT_S)
    before = len(screen.frames)
    service.event(image=255 - image)
    panel["threshold"] = 60
    panel.wait(TIMEOUT_S)
    assert (len(screen.frames), service.asked) == (before, [])
    screen.tell("run")
    panel.wait(TIMEOUT_S)
    assert screen.frames[-1]["values"]["threshold"] == service.entries["threshold"]["value"] == 60


def test_a_control_follows_what_somebody_else_sets(panel: Panel, screen: FrontEnd, service: Standing) -> None:
    is_following(panel, service)
    service.set_parameters({"threshold": 33}, None)
    until(lambda: panel["threshold"] == 33)
    panel.wait(TIMEOUT_S)
    assert screen.frames[-1]["values"]["threshold"] == 33
    panel["threshold"] = 34
    panel.wait(TIMEOUT_S)
    assert (service.entries["threshold"]["value"], service.asked[-1][1]) == (34, 1)


def test_what_others_set_under_the_hand_is_told_and_not_overwritten(
    panel: Panel, screen: FrontEnd, service: Standing
) -> None:
    is_following(panel, service)
    screen.tell("hold", names=["threshold"])
    panel._controls.control("threshold").widget.value = 61
    panel.wait(TIMEOUT_S)
    service.set_parameters({"threshold": 33}, None)
    until(lambda: any("Another client has set threshold to 33" in line for line in panel.log))
    panel._controls.control("threshold").widget.value = 62
    panel.wait(TIMEOUT_S)
    assert service.entries["threshold"]["value"] == 33
    assert "Another client has set threshold to 33" in screen.last("note")["text"]
    screen.tell("release")
    panel.wait(TIMEOUT_S)
    assert (panel["threshold"], service.entries["threshold"]["value"]) == (33, 33)
    panel._controls.control("threshold").widget.value = 63
    panel.wait(TIMEOUT_S)
    assert (service.entries["threshold"]["value"], screen.last("note")["text"]) == (63, "")


def test_a_conflict_on_another_parameter_sends_the_value_again(panel: Panel, service: Standing) -> None:
    is_following(panel, service)
    service.tell = lambda kind, **said: None  # type: ignore[method-assign]  # nobody hears of it before
    service.set_parameters({"gain": 4}, None)
    panel["threshold"] = 60
    panel.wait(TIMEOUT_S)
    assert {token: entry["value"] for token, entry in service.entries.items()} == {"gain": 4, "threshold": 60}
    assert service.asked[1:] == [({"threshold": 60}, 0), ({"threshold": 60}, 1)]
    panel.wait(TIMEOUT_S)
    panel.token = "image_bright"
    panel.wait(TIMEOUT_S)
    assert panel.values == {"gain": 4, "threshold": 60}


def test_a_conflict_on_the_same_parameter_is_told_and_the_other_value_stays(panel: Panel, service: Standing) -> None:
    is_following(panel, service)
    service.tell = lambda kind, **said: None  # type: ignore[method-assign]
    service.set_parameters({"threshold": 33}, None)
    panel.set(threshold=60, gain=4)
    panel.wait(TIMEOUT_S)
    assert {token: entry["value"] for token, entry in service.entries.items()} == {"gain": 4, "threshold": 33}
    assert panel.values == {"gain": 4, "threshold": 33}
    assert any("60 was not set" in line for line in panel.log)


def test_a_failure_on_the_line_marks_its_function_until_an_event_completes(
    panel: Panel, screen: FrontEnd, service: Standing, image: Any
) -> None:
    is_following(panel, service)
    picture = panel.result
    service.event(image="no image")
    until(lambda: bool(panel.error))
    error = screen.last("error")
    assert error["function"] == "brighten"
    assert error["text"].startswith("brighten: AttributeError: image is a text, not an image.")
    assert (screen.frames[-1]["stale"], screen.frames[-1]["stages"]["image_bright"]) == (True, "failed")
    assert panel.result is picture
    service.event(image=image)
    until(lambda: not panel.error)


def test_a_value_with_which_a_function_fails_is_told_as_such(panel: Panel, screen: FrontEnd, service: Standing) -> None:
    panel["threshold"] = 13
    panel.wait(TIMEOUT_S)
    assert panel.error == screen.last("error")["text"] == "above: ValueError: 13 is not a threshold"
    assert (screen.last("error")["function"], screen.last("error")["names"]) == ("above", ["threshold"])
    panel["threshold"] = 14
    panel.wait(TIMEOUT_S)
    assert (panel.error, panel.result.hyperparameters["threshold"]) == ("", 14)


def test_a_value_that_the_service_does_not_take_marks_its_control(connection: Connection, service: Standing) -> None:
    panel = tune(connection, threshold=(0, 1000))
    panel["threshold"] = 900
    panel.wait(TIMEOUT_S)
    assert "threshold" in panel.error
    assert service.revision == 0
    asked = len(service.asked)
    panel.token = "image_bright"
    panel.wait(TIMEOUT_S)
    assert len(service.asked) == asked  # what was refused is not asked for again
    panel["threshold"] = 90
    panel.wait(TIMEOUT_S)
    assert (panel.error, service.entries["threshold"]["value"]) == ("", 90)
    panel.close(TIMEOUT_S)


def test_a_service_that_is_gone_leaves_the_last_picture_and_is_found_again(
    service: Standing, monkeypatch: pytest.MonkeyPatch
) -> None:
    with standing(service) as server:
        address, token = server.url, server.token
        connection = ep.connect(address, token=token)
        panel = tune(connection)
        screen = FrontEnd(panel, monkeypatch)
        is_following(panel, service)
        panel.wait(TIMEOUT_S)
        picture = panel.result
    until(lambda: "The picture is the last one" in panel.error)
    assert panel.result is picture
    panel["threshold"] = 60
    panel.wait(TIMEOUT_S)
    assert "It is tried again" in screen.last("error")["text"]
    with standing(service, address):
        until(lambda: not panel.error)
        panel.wait(TIMEOUT_S)
        assert screen.frames[-1]["values"]["threshold"] == service.entries["threshold"]["value"] == 60
        panel.close(TIMEOUT_S)
        connection.close()


def test_a_worker_that_starts_again_is_told(panel: Panel, screen: FrontEnd, service: Standing) -> None:
    is_following(panel, service)
    service.become("LOADING", "The worker was killed by signal 9")
    until(lambda: "LOADING: The worker was killed by signal 9" in panel.error)
    panel["threshold"] = 60
    panel.wait(TIMEOUT_S)
    assert "LOADING" in panel.error
    service.become("READY")
    until(lambda: not panel.error)
    panel.wait(TIMEOUT_S)
    assert screen.frames[-1]["values"]["threshold"] == 60


def test_a_service_without_any_event_yet_shows_its_first_one(
    runner: ep.CompGraphRunner, image: Any, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    service = Standing(runner, tmp_path, outputs=("mask",))
    with standing(service) as server, ep.connect(server.url, token=server.token) as connection:
        panel = tune(connection)
        panel.wait(TIMEOUT_S)
        screen = FrontEnd(panel, monkeypatch)
        said = {"kind": "note", "text": "Waiting for the first event at tcp://127.0.0.1:1", "waits": True}
        assert (panel.error, screen.last("note")) == ("", said)
        assert repr(panel) == "<Panel: 2 hyperparameters; up to date>"
        is_following(panel, service)
        service.event(image=image)
        until(lambda: panel.token == "mask")
        panel.wait(TIMEOUT_S)
        assert (panel.error, panel.result["mask"].shape) == ("", image.shape)
        assert (screen.last("note")["text"], screen.of("error")) == ("", [])
        panel.close(TIMEOUT_S)


def exchange(service: Standing) -> None:
    """Serve another bundle: its parameters are its own, and no event has come since."""
    service.completed = None
    service.set_parameters({"gain": 5, "threshold": 9}, None)


def test_a_panel_says_that_no_event_has_come_since_a_bundle_was_deployed(
    panel: Panel, screen: FrontEnd, service: Standing, image: Any
) -> None:
    is_following(panel, service)
    before = panel.result
    exchange(service)
    until(lambda: "No event since the bundle was deployed" in (screen.of("note") or [{"text": ""}])[-1]["text"])
    panel.wait(TIMEOUT_S)
    assert (panel.error, panel.result is before, screen.frames[-1]["stale"]) == ("", True, False)
    assert panel.values == {"gain": 5, "threshold": 9}
    service.event(image=image)
    until(lambda: screen.last("note")["text"] == "")
    panel.wait(TIMEOUT_S)
    assert screen.frames[-1]["values"] == {"gain": 5, "threshold": 9}


def test_a_panel_that_is_closed_has_the_last_picture_with_its_values_and_asks_for_nothing(
    panel: Panel, screen: FrontEnd, service: Standing, image: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    is_following(panel, service)
    panel["threshold"] = 60
    panel.wait(TIMEOUT_S)
    exchange(service)
    until(lambda: panel.values == {"gain": 5, "threshold": 9})
    panel.close(TIMEOUT_S)
    asked = len(service.asked)
    for view in (screen, FrontEnd(panel, monkeypatch)):  # a view may be mounted when all cells have run
        assert view.last("setup")["closed"]
        assert "This panel is closed" in view.last("note")["text"]
        assert (view.frames[-1]["stale"], view.frames[-1]["values"]) == (False, {"gain": 2, "threshold": 60})
        assert view.last("history")["code"] == "service.set(threshold=60)"
        assert view.of("error") == []
    assert (panel.values, panel.error) == ({"gain": 2, "threshold": 60}, "")
    service.become("STOPPED")
    screen.tell("stage", token="image")
    screen.tell("set", values={"threshold": 70})
    assert (len(service.asked), panel.error) == (asked, "")
    until(lambda: not followers())


def test_a_panel_that_is_closed_leaves_no_thread(panel: Panel, service: Standing) -> None:
    is_following(panel, service)
    assert len(followers()) == 1
    panel.close(TIMEOUT_S)
    until(lambda: not followers())


def test_a_panel_that_is_replaced_listens_no_more_and_shares_its_history(
    connection: Connection, panel: Panel, screen: FrontEnd, service: Standing, monkeypatch: pytest.MonkeyPatch
) -> None:
    panel["threshold"] = 60
    panel.wait(TIMEOUT_S)
    again = tune(connection)
    FrontEnd(again, monkeypatch)
    screen.tell("closed")
    assert list(again.history["threshold"]) == [100, 60]
    assert len(followers()) == 1
    again.close(TIMEOUT_S)
    until(lambda: not followers())
    screen.tell("ready")
    assert len(followers()) == 1


def test_the_picture_is_compared_with_what_was_shown(panel: Panel, screen: FrontEnd, service: Standing) -> None:
    panel["threshold"] = 60
    panel.wait(TIMEOUT_S)
    asked = len(service.asked)
    screen.tell("compare", **{"with": {"kind": "default"}})
    panel.wait(TIMEOUT_S)
    assert (screen.last("reference")["label"], len(service.asked)) == ("default", asked)
    panel.token = "image_bright"
    panel.wait(TIMEOUT_S)
    panel["gain"] = 4
    panel.wait(TIMEOUT_S)
    screen.tell("stage", token="image")
    screen.tell("compare", **{"with": {"kind": "history", "number": 2}})
    panel.wait(TIMEOUT_S)
    assert any("has not shown image with these values" in line for line in panel.log)
    assert service.entries["gain"]["value"] == 4  # nothing was set to find out


def test_what_a_service_can_not_do_is_said(connection: Connection, panel: Panel, screen: FrontEnd, image: Any) -> None:
    with pytest.raises(PayloadError, match="takes its events from its own line"):
        tune(connection, images=[image])
    with pytest.raises(PayloadError, match="makes its own events, so it takes no cases"):
        tune(connection, cases=[ep.Case(image)])
    screen.tell("promote", to="somewhere")
    assert "a running service is a bundle already" in screen.last("promoted")["text"]
    with pytest.raises(ServiceError, match="Function 'above' runs in the service at"):
        panel.result.cg.functions["above"](image, 3)
    with pytest.raises(
        TypeError, match="tune\\(\\) takes a CompGraphRunner, a connection to a service, or functions, not 'str'"
    ):
        tune("http://127.0.0.1:8642")  # type: ignore[arg-type]


def test_what_was_set_just_before_is_written_back(
    connection: Connection, panel: Panel, screen: FrontEnd, service: Standing, monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[Any] = []

    def write_back(dry_run: bool = False) -> Any:
        written.append(service.entries["threshold"]["value"])
        return SimpleNamespace(diff="", digest="3f" * 32)

    monkeypatch.setattr(connection, "write_back", write_back)
    panel.set(threshold=61)
    assert panel.write_back().diff == ""
    screen.tell("set", values={"threshold": 62})
    screen.tell("write_back", dry_run=False)
    until(lambda: screen.of("written")[-1:] != [] and screen.last("written")["state"] == "done")
    screen.tell("live", on=False)
    panel.wait(TIMEOUT_S)
    panel.set(threshold=63)
    panel.write_back()
    assert written == [61, 62, 63]


def test_a_value_that_the_service_refuses_is_not_written_back_as_another(connection: Connection) -> None:
    panel = tune(connection, threshold=(0, 1000))
    panel.set(threshold=900)
    with pytest.raises(ServiceError, match="Not set in the service: threshold 900"):
        panel.write_back()
    panel.close(TIMEOUT_S)


def test_writing_back_is_asked_of_a_service_alone(runner: ep.CompGraphRunner, monkeypatch: pytest.MonkeyPatch) -> None:
    panel = tune(runner)
    screen = FrontEnd(panel, monkeypatch)
    screen.tell("write_back", dry_run=True)
    with pytest.raises(TypeError, match="Promote it"):
        panel.write_back()
    assert screen.last("setup")["writes_back"] is False
    assert screen.last("written")["text"] == "Not written: a runner has no bundle to write to. Promote it."
    panel.close(TIMEOUT_S)


def test_a_service_that_has_found_nothing_shows_what_it_skipped(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    functions = {
        "find": lambda image, least: image if image.max() >= least else ep.Nothing,
        "mark": lambda image: image,
    }
    cg = ep.CompGraph(functions, {"find": (("image", "least"), "found"), "mark": ("found", "marked")})
    service = Standing(ep.CompGraphRunner(cg, {"least": 100}), tmp_path, outputs=("marked",))
    service.event(image=np.full((20, 30), 10, np.uint8))
    with standing(service) as server, ep.connect(f"{server.url}#token={server.token}") as connection:
        panel = tune(connection, token="marked")
        panel.wait(TIMEOUT_S)
        frame = FrontEnd(panel, monkeypatch).last("frame")
        assert frame["pictures"][0]["text"] == "marked: nothing found."
        assert (frame["stages"]["marked"], frame["ran"], frame["skipped"]) == ("nothing", 1, 1)
        assert panel.result["marked"] is ep.Nothing
        panel.close(TIMEOUT_S)


def test_the_numbers_of_a_service_come_with_each_picture(
    image: Any, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    cg = ep.CompGraph(
        {"above": lambda image, threshold: (image > threshold).astype(np.uint8) * 255, "count": np.count_nonzero},
        {"above": (("image", "threshold"), "mask"), "count": ("mask", "n")},
    )
    runner = ep.CompGraphRunner(cg, {"threshold": 100})
    runner.run(image=image)
    service = Standing(runner, tmp_path, {"threshold": {"low": 0, "high": 255}}, outputs=("mask", "n"))
    service.event(image=image)
    with standing(service) as server, ep.connect(f"{server.url}#token={server.token}") as connection:
        panel = tune(connection, token="mask")
        try:
            panel.wait(TIMEOUT_S)
            screen = FrontEnd(panel, monkeypatch)
            for threshold in (100, 60):
                panel["threshold"] = threshold
                panel.wait(TIMEOUT_S)
                (tile,) = screen.frames[-1]["tiles"]
                assert (tile["text"], tile["state"]) == (str(np.count_nonzero(image > threshold)), "fresh")
            assert tile["change"] == f"{np.count_nonzero(image > 60) - np.count_nonzero(image > 100):+d}"
        finally:
            panel.close(TIMEOUT_S)
