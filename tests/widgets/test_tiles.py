"""Do the numbers beside the picture belong to it, and do they say what has changed and whether they pass?"""

from __future__ import annotations

import enum
import threading
from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import epypes as ep
from epypes.errors import UnknownName
from epypes_widgets import Panel, tune
from epypes_widgets.picture.tiles import change_of, numbers_of
from tests.widgets.frontend import FrontEnd

TIMEOUT_S = 60
Kind = enum.Enum("Kind", "ROUND SQUARE")


def above(image: Any, threshold: int) -> Any:
    return np.where(image > threshold, 255, 0).astype(np.uint8)


def count(mask: Any) -> int:
    return int(np.count_nonzero(mask))


def runner_of(functions: dict[str, Callable[..., Any]], image: Any, **hparams: Any) -> ep.CompGraphRunner:
    """Return a runner of ``above`` and of functions of its mask, each of which makes a token named ``<name>_out``."""
    io = {name: ("mask", f"{name}_out") for name in functions}
    cg = ep.CompGraph({"above": above, **functions}, {"above": (("image", "threshold"), "mask"), **io})
    runner = ep.CompGraphRunner(cg, {"threshold": 100, **hparams})
    runner.run(image=image)
    return runner


@pytest.fixture
def runner(image: Any) -> ep.CompGraphRunner:
    return runner_of({"count": count}, image)


@pytest.fixture
def panel(runner: ep.CompGraphRunner) -> Iterator[Panel]:
    panel = tune(runner, threshold=(0, 255))
    yield panel
    panel.close(TIMEOUT_S)


@pytest.fixture
def screen(panel: Panel, monkeypatch: pytest.MonkeyPatch) -> FrontEnd:
    return FrontEnd(panel, monkeypatch)


@pytest.fixture
def shown(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., tuple[Panel, FrontEnd]]]:
    """Return what shows a panel of a runner; it is closed at the end."""
    panels: list[Panel] = []

    def show(runner: ep.CompGraphRunner, **given: Any) -> tuple[Panel, FrontEnd]:
        panels.append(tune(runner, threshold=(0, 255), **given))
        return panels[-1], FrontEnd(panels[-1], monkeypatch)

    yield show
    for panel in panels:
        panel.close(TIMEOUT_S)


def move(panel: Panel, screen: FrontEnd, threshold: int) -> None:
    """Drag the slider of the threshold to a value."""
    screen.tell("move", values={"threshold": threshold}, places={})
    panel.wait(TIMEOUT_S)


def tile(screen: FrontEnd, token: str = "count_out") -> dict[str, str]:
    """Return a tile of the last frame."""
    (found,) = (tile for tile in screen.frames[-1]["tiles"] if tile["token"] == token)
    return dict(found)


def above_of(image: Any, threshold: int) -> str:
    return str(count(above(image, threshold)))


# -- values -----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("value", "items"),
    [
        (True, (True,)),
        (3, (3,)),
        (0.5, (0.5,)),
        (float("inf"), (float("inf"),)),
        (np.uint8(7), (7,)),
        (np.float32(0.5), (0.5,)),
        (np.bool_(False), (False,)),
        (Fraction(1, 2), (0.5,)),
        (np.array(3), (3,)),
        (np.array([[[2.5]]]), (2.5,)),
        (np.array([[1, 2, 3]]), (1, 2, 3)),
        ((1.5, 2), (1.5, 2)),
        ([1] * 8, (1,) * 8),
        ("OK", ("OK",)),
        (Kind.ROUND, ("ROUND",)),
        ([1] * 9, None),
        (np.zeros((2, 2)), None),
        (np.zeros(9), None),
        (np.zeros(0), None),
        ((), None),
        ([1, "a"], None),
        ("x" * 41, None),
        (1j, None),
        (None, None),
        (np.timedelta64(3, "s"), None),
        ({"a": 1}, None),
    ],
)
def test_a_tile_is_of_one_number_or_a_short_vector(value: Any, items: Any) -> None:
    assert numbers_of(value) == items


@pytest.mark.parametrize(
    ("now", "before", "change"),
    [
        ((5,), (2,), "+3"),
        ((2.25,), (2.5,), "-0.25"),
        ((0.1 + 0.2,), (0.3,), "±0"),
        ((1, 5), (1, 3), "+0, +2"),
        ((float("nan"),), (float("nan"),), "±0"),
        ((float("nan"),), (3,), "was 3"),
        ((True,), (False,), "was False"),
        (("bad",), ("good",), "was good"),
        ((10**400,), (1,), "was 1"),
        ((29849.4,), (46058,), "-16209"),
        ((15099.5,), (15099.9,), "-0.4"),
        ((1,), (1, 2), ""),
        (None, (1,), ""),
        ((1,), None, ""),
    ],
)
def test_a_change_is_a_difference_where_there_is_one(now: Any, before: Any, change: str) -> None:
    assert change_of(now, before) == change


# -- with the picture -------------------------------------------------------------------------------------------


def test_each_frame_has_the_numbers_of_its_own_picture(panel: Panel, screen: FrontEnd, image: Any) -> None:
    for threshold in range(60, 90):
        screen.tell("move", values={"threshold": threshold}, places={})
    screen.wait_for_values(TIMEOUT_S, threshold=89)
    panel.wait(TIMEOUT_S)
    assert len(screen.frames) > 1
    for frame in screen.frames:
        (found,) = frame["tiles"]
        if found["state"] == "fresh":
            assert found["text"] == above_of(image, frame["values"]["threshold"])
    assert tile(screen)["state"] == "fresh"


def test_a_change_is_since_the_last_commit_and_not_since_the_last_step(
    panel: Panel, screen: FrontEnd, image: Any
) -> None:
    before = int(above_of(image, 100))
    screen.tell("hold", names=["threshold"])
    for threshold in (110, 130, 150):
        move(panel, screen, threshold)
        now = int(above_of(image, threshold))
        assert (tile(screen)["text"], tile(screen)["change"]) == (str(now), f"{now - before:+d}")
    assert tile(screen)["title"].splitlines()[1] == f"{now - before:+d} since #1, where it was {before}"
    screen.tell("release", names=["threshold"])
    panel.wait(TIMEOUT_S)

    move(panel, screen, 160)
    assert tile(screen)["change"] == f"{int(above_of(image, 160)) - now:+d}"
    panel.undo()
    panel.wait(TIMEOUT_S)
    assert (tile(screen)["text"], tile(screen)["change"]) == (str(now), f"{now - before:+d}")


def test_numbers_of_another_payload_are_no_change(panel: Panel, runner: ep.CompGraphRunner, screen: FrontEnd) -> None:
    panel["threshold"] = 120
    panel.wait(TIMEOUT_S)
    runner.run(image=np.full((20, 20), 200, np.uint8))
    panel.wait(TIMEOUT_S)
    assert (tile(screen)["text"], tile(screen)["change"]) == ("400", "")
    move(panel, screen, 210)
    assert tile(screen)["change"] == "-400"


@pytest.mark.slow
def test_changes_are_counted_on_one_test_image(shown: Any, image: Any) -> None:
    images = [image, np.full_like(image, 200)]
    panel, screen = shown(runner_of({"count": count}, image), images=images)
    panel["threshold"] = 120
    panel.wait(TIMEOUT_S)
    screen.tell("image", index=1)
    panel.wait(TIMEOUT_S)
    assert (tile(screen)["text"], tile(screen)["change"]) == (str(image.size), "")
    move(panel, screen, 220)
    assert tile(screen)["change"] == f"{-image.size}"


@pytest.mark.slow
def test_the_picture_does_not_wait_for_a_number_that_takes_long(shown: Any, image: Any) -> None:
    go_on, is_slow = threading.Event(), [False]

    def slow(mask: Any) -> int:
        threading.Event().wait(0.1)  # what it takes
        if is_slow[0]:
            assert go_on.wait(TIMEOUT_S)
        return count(mask)

    panel, screen = shown(runner_of({"slow": slow}, image))
    move(panel, screen, 110)
    before = tile(screen, "slow_out")["text"]
    is_slow[0] = True
    screen.tell("move", values={"threshold": 140}, places={})
    screen.wait_for_values(TIMEOUT_S, threshold=140)  # the function has not returned
    found = tile(screen, "slow_out")
    assert (found["text"], found["state"], found["change"]) == (before, "stale", "")
    go_on.set()
    panel.wait(TIMEOUT_S)
    found = tile(screen, "slow_out")
    assert (found["text"], found["state"]) == (above_of(image, 140), "fresh")
    assert screen.frames[-1]["values"]["threshold"] == 140
    assert found["change"] == f"{int(above_of(image, 140)) - int(before):+d}"


# -- failures ---------------------------------------------------------------------------------------------------


def test_when_a_run_fails_the_numbers_are_stale_with_their_picture(shown: Any, image: Any) -> None:
    def positive(mask: Any) -> Any:
        if not mask.any():
            raise ValueError("nothing is above")
        return mask

    cg = ep.CompGraph(
        {"above": above, "positive": positive, "count": count},
        {"above": (("image", "threshold"), "mask"), "positive": ("mask", "good"), "count": ("good", "count_out")},
    )
    runner = ep.CompGraphRunner(cg, {"threshold": 100})
    runner.run(image=image)
    panel, screen = shown(runner, token="good")
    move(panel, screen, 255)
    assert "nothing is above" in panel.error
    found = tile(screen)
    assert (found["text"], found["state"], found["change"]) == (above_of(image, 100), "stale", "")
    assert "the run after it has failed" in found["title"]
    move(panel, screen, 90)
    assert tile(screen)["state"] == "fresh"


def test_a_number_that_fails_leaves_the_picture_alone_and_says_why(shown: Any, image: Any) -> None:
    def share(mask: Any) -> float:
        if not mask.any():
            raise ZeroDivisionError("no pixel is set")
        return 1 / count(mask)

    panel, screen = shown(runner_of({"share": share, "count": count}, image), token="mask")
    before = tile(screen, "share_out")["text"]
    move(panel, screen, 255)
    assert panel.error == ""
    assert panel.result.hyperparameters["threshold"] == 255
    found = tile(screen, "share_out")
    assert (found["text"], found["state"]) == (before, "failed")
    assert "no pixel is set" in found["title"]
    assert tile(screen)["text"] == "0"
    move(panel, screen, 100)
    assert tile(screen, "share_out")["state"] == "fresh"


def test_a_token_may_become_something_else(shown: Any, image: Any) -> None:
    def fickle(mask: Any) -> Any:
        n = count(mask)
        return n if n > 1500 else None if n > 500 else [mask] if n else "none"

    panel, screen = shown(runner_of({"fickle": fickle}, image))
    texts = []
    for threshold in (100, 180, 230, 255, 100):
        move(panel, screen, threshold)
        texts.append((tile(screen, "fickle_out")["text"], tile(screen, "fickle_out")["change"]))
    assert texts[0][0].isdigit()
    assert texts[1] == ("None", "")
    assert texts[2] == ("list of 1", "")
    assert texts[3] == ("none", "")
    assert texts[4][0] == texts[0][0]


# -- verdicts ---------------------------------------------------------------------------------------------------


def test_a_tile_passes_or_fails_its_case_while_the_hand_drags(shown: Any, image: Any) -> None:
    wanted = int(above_of(image, 100))
    near = {"metric": "close", "token": "count_out", "expected": wanted, "atol": 300}
    cases = [
        ep.Case(image, metrics={"near": near}, name="first"),
        ep.Case(image[:9], {"count_out": 3}, hyperparameters={"threshold": 200}, name="second"),
        ep.Case(image[:5], name="third"),
    ]
    panel, screen = shown(runner_of({"count": count}, image), cases=cases)
    panel.check(TIMEOUT_S)
    move(panel, screen, 105)
    assert tile(screen)["verdict"] == "passed"
    assert tile(screen)["title"].splitlines()[-2:] == [
        "case 'first':",
        f"near: expected {wanted}, atol 300, rtol 1e-05: passed",
    ]
    screen.tell("hold", names=["threshold"])
    move(panel, screen, 200)
    assert tile(screen)["verdict"] == "failed"
    assert "near: expected" in tile(screen)["title"]
    for index in (1, 2):  # one has a value of its own, the other no check
        screen.tell("image", index=index)
        move(panel, screen, 150)
        assert tile(screen)["verdict"] == ""


# -- which there are --------------------------------------------------------------------------------------------


def test_at_first_the_sinks_and_what_a_control_changes_have_tiles_and_at_most_six(shown: Any, image: Any) -> None:
    functions: dict[str, Callable[..., Any]] = {f"n{i}": count for i in range(8)}
    functions["wide"] = lambda mask: np.zeros(100)
    panel, screen = shown(runner_of(functions, image))
    assert panel.tiles == tuple(f"n{i}_out" for i in range(6))
    assert screen.last("setup")["numbers"] == [f"n{i}_out" for i in range(8)]

    screen.tell("pin", token="n7_out", on=True)
    screen.tell("pin", token="n0_out", on=False)
    panel.wait(TIMEOUT_S)
    expected = [f"n{i}_out" for i in (1, 2, 3, 4, 5, 7)]
    assert [found["token"] for found in screen.frames[-1]["tiles"]] == expected
    screen.tell("pin", token="mask", on=True)
    panel.wait(TIMEOUT_S)
    assert panel.tiles == tuple(expected)
    assert [picture["token"] for picture in screen.frames[-1]["pictures"]] == ["mask", "mask"]


def test_tiles_are_remembered_by_the_runner_and_by_saved_settings(
    shown: Any, runner: ep.CompGraphRunner, image: Any, tmp_path: Path
) -> None:
    panel, screen = shown(runner_of({"count": count, "half": lambda mask: count(mask) / 2}, image))
    panel.tiles = ["half_out"]
    panel["threshold"] = 90
    panel.wait(TIMEOUT_S)
    file = panel.save(tmp_path / "good")
    again, _ = shown(panel._runner)
    assert again.tiles == ("half_out",)
    panel.tiles = []
    panel.wait(TIMEOUT_S)
    assert screen.frames[-1]["tiles"] == []
    panel.load(file)
    panel.wait(TIMEOUT_S)
    assert tile(screen, "half_out")["text"] == str(int(above_of(image, 90)) / 2).removesuffix(".0")

    other, _ = shown(runner)  # it has no such token
    other.load(file)
    assert (other.tiles, other["threshold"]) == ((), 90)
    file.write_text(file.read_text().split("[panel]")[0])
    panel.load(file)
    assert panel.tiles == ("half_out",)
    with pytest.raises(UnknownName, match="Did you mean 'half_out'"):
        panel.tiles = ["half_ot"]


def test_a_file_that_names_a_tile_twice_shows_it_once(shown: Any, image: Any, tmp_path: Path) -> None:
    panel, _ = shown(runner_of({"count": count}, image))
    file = panel.save(tmp_path / "good")
    text = file.read_text().split("[panel]")[0]
    file.write_text(f'{text}\n[panel]\ntiles = ["count_out", 3, "gone", "count_out"]\n')
    panel.load(file)
    assert panel.tiles == ("count_out",)


def test_a_tile_is_computed_again_when_it_is_pinned(shown: Any, image: Any) -> None:
    panel, screen = shown(runner_of({"count": count}, image))
    panel.tiles = ()
    move(panel, screen, 150)
    panel.tiles = ["count_out"]
    panel.wait(TIMEOUT_S)
    assert (tile(screen)["text"], tile(screen)["state"]) == (above_of(image, 150), "fresh")
