"""Do the test images of a panel say whether they pass, with the values that count and nothing else?"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from time import monotonic
from typing import Any

import numpy as np
import pytest

import epypes as ep
from epypes.errors import ImageFileError, UnknownName
from epypes_widgets import Panel, tune
from tests.widgets.frontend import FrontEnd

TIMEOUT_S = 60


def above(image: Any, threshold: int) -> Any:
    return image > threshold


def until(condition: Callable[[], bool]) -> None:
    deadline, wait = monotonic() + TIMEOUT_S, threading.Event()
    while not condition():
        assert monotonic() < deadline, "it did not happen"
        wait.wait(0.005)


@pytest.fixture
def images() -> list[Any]:
    return [np.random.default_rng(seed).integers(0, 255, (48, 64), np.uint8) for seed in range(3)]


@pytest.fixture
def cases(images: list[Any]) -> list[ep.Case]:
    """The first passes at 100, the second at 150, the third always runs."""
    first, second, third = images
    return [
        ep.Case(first, {"mask": first > 100}, name="first"),
        ep.Case(second, {"mask": second > 150}, {"iou": 0.95}, name="second"),
        ep.Case(third, name="third"),
    ]


@pytest.fixture
def runner() -> ep.CompGraphRunner:
    return ep.CompGraphRunner(
        ep.CompGraph({"above": above}, {"above": (("image", "threshold"), "mask")}), {"threshold": 100}
    )


@pytest.fixture
def panel(runner: ep.CompGraphRunner, cases: list[ep.Case]) -> Iterator[Panel]:
    panel = tune(runner, cases=cases, threshold=(0, 255))
    yield panel
    panel.close(TIMEOUT_S)


@pytest.fixture
def screen(panel: Panel, monkeypatch: pytest.MonkeyPatch) -> FrontEnd:
    panel.check(TIMEOUT_S)
    return FrontEnd(panel, monkeypatch)


def states(message: dict[str, Any]) -> list[str]:
    return [verdict["state"] for verdict in message["verdicts"]]


def test_the_inputs_of_cases_are_the_test_images(panel: Panel, screen: FrontEnd) -> None:
    assert [film["title"] for film in screen.last("setup")["images"]] == ["first", "second", "third"]
    assert panel.result["mask"].shape == (48, 64)


def test_a_new_view_is_told_which_images_pass_and_why_the_others_do_not(screen: FrontEnd) -> None:
    told = screen.last("cases")
    assert states(told) == ["passed", "failed", "passed"]
    assert told["text"] == "2 of 3 cases pass"
    assert told["verdicts"][1]["text"].startswith("iou of mask: 0.")


@pytest.mark.slow
@pytest.mark.parametrize("how", ["panel", "cell", "front end"])
def test_verdicts_follow_what_is_committed(
    panel: Panel, runner: ep.CompGraphRunner, screen: FrontEnd, how: str
) -> None:
    if how == "panel":
        panel["threshold"] = 150
    elif how == "cell":
        runner["threshold"] = 150
    else:
        screen.tell("set", values={"threshold": 150})
    result = panel.check(TIMEOUT_S)
    assert result is not None
    assert result.cases == {"first": False, "second": True, "third": True}
    assert states(screen.last("cases")) == ["failed", "passed", "passed"]

    assert panel.undo()
    panel.check(TIMEOUT_S)
    assert states(screen.last("cases")) == ["passed", "failed", "passed"]


@pytest.mark.slow
def test_nothing_is_checked_while_a_control_is_held(panel: Panel, screen: FrontEnd) -> None:
    before = len(screen.of("cases"))
    screen.tell("hold", names=["threshold"])
    for value in (120, 140, 150):
        screen.tell("move", values={"threshold": value}, places={})
        panel.wait(TIMEOUT_S)
    assert panel.result.hyperparameters["threshold"] == 150
    assert len(screen.of("cases")) == before
    screen.tell("release", names=["threshold"])
    panel.check(TIMEOUT_S)
    assert states(screen.last("cases")) == ["failed", "passed", "passed"]


def test_looking_at_another_image_checks_nothing_again(panel: Panel, screen: FrontEnd) -> None:
    before = len(screen.of("cases"))
    screen.tell("image", index=1)
    panel.check(TIMEOUT_S)
    assert panel.history["image"].iloc[-1] == 1
    assert len(screen.of("cases")) == before


def test_the_newest_values_win_and_an_older_check_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    begun, go_on = threading.Event(), threading.Event()
    seen: list[tuple[int, int]] = []

    def slow(number: int, k: int) -> int:
        seen.append((number, k))
        if threading.current_thread().name == "epypes-cases" and k == 1:
            begun.set()
            assert go_on.wait(TIMEOUT_S)
        return k

    runner = ep.CompGraphRunner(ep.CompGraph({"slow": slow}, {"slow": (("number", "k"), "y")}), {"k": 0})
    cases = [ep.Case(number, metrics={"value": (2, 2)}) for number in range(20)]
    panel = tune(runner, cases=cases, k=(0, 5))
    try:
        panel.check(TIMEOUT_S)
        panel["k"] = 1
        assert begun.wait(TIMEOUT_S)
        panel["k"] = 2
        panel.wait(TIMEOUT_S)  # the picture does not wait for the check
        assert panel.result["y"] == 2
        go_on.set()
        assert panel.check(TIMEOUT_S)
        # One case of the check that was given up, and one for the picture.
        assert len([k for _, k in seen if k == 1]) == 2
    finally:
        go_on.set()
        panel.close(TIMEOUT_S)


def test_a_panel_whose_view_is_gone_checks_when_it_comes_back(panel: Panel, screen: FrontEnd) -> None:
    screen.tell("closed")
    before = len(screen.of("cases"))
    panel["threshold"] = 150
    assert panel.check(TIMEOUT_S) is None
    assert len(screen.of("cases")) == before
    screen.tell("ready")
    panel.check(TIMEOUT_S)
    assert states(screen.last("cases")) == ["failed", "passed", "passed"]


def test_files_are_read_once_and_one_that_is_missing_fails_its_case(
    runner: ep.CompGraphRunner, images: list[Any], tmp_path: Any
) -> None:
    np.save(tmp_path / "mask.npy", images[0] > 100)
    cases = [ep.Case(images[0], {"mask": tmp_path / name}, {"iou": 0.9}) for name in ("mask.npy", "none.npy")]
    panel = tune(runner, cases=cases)
    try:
        (tmp_path / "mask.npy").unlink()
        result = panel.check(TIMEOUT_S)
        assert result is not None
        assert result.cases == {"#0": True, "#1": False}
        assert "none.npy' can't be read" in result.failures[0].reason
    finally:
        panel.close(TIMEOUT_S)


def test_cases_without_checks_are_test_images_only(
    runner: ep.CompGraphRunner, images: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    panel = tune(runner, cases=images)
    try:
        assert panel.check(TIMEOUT_S) is None
        assert FrontEnd(panel, monkeypatch).of("cases") == []
    finally:
        panel.close(TIMEOUT_S)


def test_closing_ends_the_check(runner: ep.CompGraphRunner, cases: list[ep.Case]) -> None:
    before = frozenset(threading.enumerate())  # also those of other tests' panels
    panel = tune(runner, cases=cases)
    panel.close(TIMEOUT_S)
    panel.close(TIMEOUT_S)
    until(lambda: not [thread for thread in {*threading.enumerate()} - before if thread.name == "epypes-cases"])


def test_what_can_t_be_shown_or_checked_is_refused(
    runner: ep.CompGraphRunner, images: list[Any], cases: list[ep.Case], tmp_path: Any
) -> None:
    with pytest.raises(TypeError, match="takes images or cases, not both"):
        tune(runner, images=images, cases=cases)
    with pytest.raises(ImageFileError, match="none.png"):
        tune(runner, cases=[ep.Case(tmp_path / "none.png", {"mask": images[0]})])
    with pytest.raises(UnknownName, match="Did you mean 'mask'"):
        tune(runner, cases=[ep.Case(images[0], {"maks": images[0]})])
