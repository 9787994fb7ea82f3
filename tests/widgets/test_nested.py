"""Hyperparameters of a pipeline in the graph have controls in the folder of the pipeline."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated, Any

import numpy as np
import pytest

import epypes as ep
from epypes.errors import UnknownName
from epypes_widgets import Panel, tune
from epypes_widgets.controls.ranges import ranges

IMAGE = np.arange(48 * 64, dtype=np.uint8).reshape(48, 64)


def above(image: Any, level: Annotated[int, ep.Param(0, 255, cuts="image")]) -> Any:
    """Find what is bright.

    Parameters
    ----------
    level
        What is darker is black.
    """
    if level == 13:
        raise ValueError("13 is not a level")
    return np.where(image > level, 255, 0).astype(np.uint8)


def clamp(mask: Any, clip_low: int, clip_high: int) -> Any:
    return mask.clip(clip_low, clip_high)


def gain(image: Any, factor: int) -> Any:
    return image // factor


@pytest.fixture
def runner() -> ep.CompGraphRunner:
    io = {"above": (("image", "level"), "mask"), "clamp": (("mask", "clip_low", "clip_high"), "clamped")}
    hparams = {"level": 100, "clip_low": 10, "clip_high": 200}
    pipe = ep.Pipeline("binary", ep.CompGraph({"above": above, "clamp": clamp}, io), hparams)
    cg = ep.CompGraph({"gain": gain, "cut": pipe}, {"gain": (("image", "factor"), "dim"), "cut": ("dim", "parts")})
    runner = ep.CompGraphRunner(cg, {"factor": 1})
    runner.run(image=IMAGE)
    return runner


@pytest.fixture
def panel(runner: ep.CompGraphRunner) -> Iterator[Panel]:
    panel = tune(runner)
    panel.wait(60)
    yield panel
    panel.close(60)


def test_ranges_pairs_and_thresholds_come_from_the_inner_functions(runner: ep.CompGraphRunner) -> None:
    found = ranges(runner, {})
    assert list(found) == ["factor", "cut__level", "cut__clip_low", "cut__clip_high"]
    assert found["cut__level"] == ep.Param(0, 255, cuts="dim"), "the inner image is this token of the graph"
    assert found["cut__clip_low"].below == "cut__clip_high"  # type: ignore[union-attr]


def test_hints_are_given_by_the_name_in_the_graph(runner: ep.CompGraphRunner) -> None:
    found = ranges(runner, {"cut__level": (50, 150), "cut__clip_low": ep.Param(0, 99)})
    assert (found["cut__level"].low, found["cut__level"].high) == (50, 150)  # type: ignore[union-attr]
    assert found["cut__clip_low"].high == 99  # type: ignore[union-attr]
    with pytest.raises(UnknownName, match="Did you mean 'cut__level'"):
        ranges(runner, {"cut__levels": (0, 1)})
    with pytest.raises(ValueError, match=r"'cut__level' is 100, outside of its hint"):
        ranges(runner, {"cut__level": (0, 9)})


def test_they_stand_in_the_folder_of_the_pipeline(panel: Panel) -> None:
    column = panel._column
    assert [folder["functions"] for folder in column.folders] == [["gain"], ["cut"]]
    assert [row["names"] for row in column.rows] == [["factor"], ["cut__level"], ["cut__clip_low", "cut__clip_high"]]
    control = panel._controls.control("cut__level")
    assert control.widget.description == "level", "the folder has the pipeline's name"
    assert control.tip == "What is darker is black. 0 to 255."


def test_moving_one_runs_what_depends_on_it_and_undo_goes_back(panel: Panel, runner: ep.CompGraphRunner) -> None:
    panel["cut__clip_low"] = 20
    panel.wait(60)
    assert panel.result.nested["cut"].report.ran == ("clamp",)
    assert panel.code() == "runner.rerun(cut__clip_low=20)"
    assert runner["cut__clip_low"] == 20
    assert panel.undo()
    panel.wait(60)
    assert (panel["cut__clip_low"], runner["cut__clip_low"]) == (10, 10)


def test_a_failure_inside_names_the_function_and_marks_its_control(panel: Panel) -> None:
    panel["cut__level"] = 13
    panel.wait(60)
    assert panel.error == "cut: above: ValueError: 13 is not a level"
    run = panel._runner.trial(panel._session.wanted)
    assert panel._tuning._at_fault(run, "cut") == ["cut__level"]
    panel["cut__level"] = 14
    panel.wait(60)
    assert panel.error == ""


def test_what_a_cell_sets_moves_the_control(panel: Panel, runner: ep.CompGraphRunner) -> None:
    runner.rerun(cut__level=77)
    panel.wait(60)
    assert panel["cut__level"] == 77


def test_settings_hold_them(panel: Panel, tmp_path: Any) -> None:
    panel["cut__level"] = 77
    panel.wait(60)
    path = panel.save(tmp_path / "good.toml")
    panel.reset()
    panel.wait(60)
    assert panel["cut__level"] == 100
    panel.load(path)
    panel.wait(60)
    assert panel["cut__level"] == 77
