"""Does a panel follow its controls, keep its picture when a function fails, and say what it did?"""

from __future__ import annotations

import subprocess
import sys
import threading
from typing import Any

import numpy as np
import pytest

import epypes as ep
from epypes.errors import NotComputed, PayloadError, UnknownName
from epypes_widgets import Panel, tune
from tests.widgets.frontend import FrontEnd


@pytest.fixture
def screen(panel: Panel, monkeypatch: pytest.MonkeyPatch) -> FrontEnd:
    return FrontEnd(panel, monkeypatch)


def test_a_new_view_gets_the_picture_of_the_last_run(panel: Panel, screen: FrontEnd, calls: Any) -> None:
    assert [frame["token"] for frame in screen.frames] == ["mask"]
    assert screen.frames[0]["values"] == {"gain": 2, "threshold": 100}
    assert calls.counts == {}


def test_moving_a_control_runs_the_stale_functions_only(panel: Panel, screen: FrontEnd, calls: Any) -> None:
    panel["threshold"] = 60
    panel.wait(60)
    assert calls.counts == {"above": 1}
    assert screen.frames[-1]["values"] == {"gain": 2, "threshold": 60}
    assert screen.frames[-1]["seq"] > screen.frames[0]["seq"]
    assert panel.result.hyperparameters["threshold"] == 60
    np.testing.assert_array_equal(panel.result["mask"] == 255, panel.result["image_bright"] > 60)


@pytest.mark.slow
def test_the_front_end_moving_a_slider_does_the_same(panel: Panel, runner: ep.CompGraphRunner) -> None:
    panel._controls.control("threshold").widget.value = 61
    panel.wait(60)
    assert (panel["threshold"], runner["threshold"]) == (61, 61)


def test_a_function_that_fails_keeps_the_result_and_says_so(panel: Panel, screen: FrontEnd) -> None:
    panel["threshold"] = 13
    panel.wait(60)
    assert panel.error == screen.last("error")["text"] == "above: ValueError: 13 is not a threshold"
    assert panel.result.hyperparameters["threshold"] == 100
    assert "failed" in repr(panel)
    panel["threshold"] = 14
    panel.wait(60)
    assert (panel.error, screen.frames[-1]["stale"]) == ("", False)


def test_cells_read_the_last_run_that_completed(panel: Panel, runner: ep.CompGraphRunner) -> None:
    before = runner["mask"].copy()
    panel["threshold"] = 13
    panel.wait(60)
    np.testing.assert_array_equal(runner["mask"], before)
    assert (runner["threshold"], panel["threshold"], runner.last and runner.last.failure) == (100, 13, None)


def test_a_stage_that_does_not_need_what_fails_can_be_looked_at(panel: Panel, screen: FrontEnd) -> None:
    panel["threshold"] = 13
    panel.wait(60)
    panel.token = "image_bright"
    panel.wait(60)
    assert (screen.frames[-1]["token"], screen.frames[-1]["stale"], panel.error) == ("image_bright", False, "")
    panel.token = "mask"
    panel.wait(60)
    assert panel.error == "above: ValueError: 13 is not a threshold"
    assert "not been computed" in screen.frames[-1]["pictures"][0]["text"]


def test_choosing_a_token_shows_it_without_running_anything(
    panel: Panel, screen: FrontEnd, runner: ep.CompGraphRunner
) -> None:
    reports = len(runner.reports)
    assert [stage["token"] for stage in screen.last("setup")["stages"]] == ["image", "image_bright", "mask"]
    panel.token = "image"
    panel.wait(60)
    assert (screen.frames[-1]["token"], len(runner.reports)) == ("image", reports)
    with pytest.raises(LookupError, match="'gain' has no picture"):
        panel.token = "gain"


def test_test_images_can_be_switched_between(
    image: Any, runner: ep.CompGraphRunner, monkeypatch: pytest.MonkeyPatch
) -> None:
    fresh = ep.CompGraphRunner(runner.cg, {"gain": 1, "threshold": 100})
    panel = tune(fresh, images=[image, 255 - image], threshold=(0, 255))
    panel.wait(60)
    screen = FrontEnd(panel, monkeypatch)
    assert [film["title"] for film in screen.last("setup")["images"]] == ["image 1", "image 2"]
    assert screen.frames[-1]["image"] == 0
    screen.tell("image", index=1)
    panel["threshold"] = 90
    panel.wait(60)
    assert screen.frames[-1]["image"] == 1
    np.testing.assert_array_equal(fresh["image"], 255 - image)
    np.testing.assert_array_equal(fresh["mask"] == 255, 255 - image > 90)
    screen.tell("undo")
    screen.tell("undo")
    panel.wait(60)
    assert screen.frames[-1]["image"] == 0
    panel.close(10)


def test_settings_go_to_a_file_and_come_back(panel: Panel, screen: FrontEnd, tmp_path: Any, monkeypatch: Any) -> None:
    monkeypatch.chdir(tmp_path)
    panel["threshold"] = 77
    panel.wait(60)
    assert panel.save("good").name == "good.toml"
    panel.reset()
    panel.load("good.toml")
    panel.wait(60)
    assert panel.values == {"gain": 2, "threshold": 77}
    screen.tell("save", name="better")
    assert screen.last("settings") == {
        "kind": "settings",
        "names": ["better", "good"],
        "text": "Saved better.toml.",
        "ok": True,
    }
    (tmp_path / "my").mkdir()
    screen.tell("save", name="my/../worse")
    assert screen.last("settings")["text"].startswith("'my/../worse' has '..' in it")
    assert not (tmp_path / "worse.toml").exists()
    screen.tell("load", name="bettr")
    assert "in this folder" in screen.last("settings")["text"]
    assert screen.last("settings")["ok"] is False
    assert "better" in screen.last("settings")["text"]
    (tmp_path / "good.toml").write_text((tmp_path / "good.toml").read_text().replace("77", "777"))
    with pytest.raises(ValueError, match="can't be 777"):
        panel.load("good")
    assert panel["threshold"] == 77


def test_a_panel_made_again_goes_on_with_values_history_and_undo(panel: Panel, runner: ep.CompGraphRunner) -> None:
    for threshold in (60, 70):
        panel["threshold"] = threshold
        panel.wait(60)
    panel.token = "image_bright"
    panel.wait(60)
    again = tune(runner, gain=(1, 5), threshold=(0, 255))
    assert (again["threshold"], again.token) == (70, "image_bright")
    assert list(again.history["threshold"]) == [100, 60, 70]
    again.undo()
    again.wait(60)
    assert (again["threshold"], runner["threshold"]) == (60, 60)
    again.close(10)


@pytest.mark.slow
def test_a_panel_whose_view_is_gone_computes_nothing_for_cells(
    panel: Panel, screen: FrontEnd, runner: ep.CompGraphRunner, calls: Any
) -> None:
    screen.tell("closed")
    runner["threshold"] = 60
    panel.wait(60)
    assert (calls.counts, panel["threshold"]) == ({}, 60)
    panel["threshold"] = 61
    panel.wait(60)
    assert calls.counts == {"above": 1}


def test_several_values_are_set_all_or_none(panel: Panel) -> None:
    with pytest.raises(ValueError, match="can't be 300"):
        panel.set(gain=3, threshold=300)
    assert panel.values == {"gain": 2, "threshold": 100}
    panel.set(gain=3, threshold=30)
    panel.wait(60)
    assert dict(panel.result.hyperparameters) == {"gain": 3, "threshold": 30}
    assert len(panel.history) == 2


def test_the_time_to_the_screen_is_told(panel: Panel, screen: FrontEnd) -> None:
    assert panel.latency.frames == 0
    panel["threshold"] = 60
    panel.wait(60)
    latency = panel.latency
    assert latency.frames == 1
    assert latency.to_screen_ms == latency.p50_ms == latency.p95_ms
    assert latency.to_screen_ms is not None
    assert latency.compute_ms is not None
    assert latency.to_screen_ms > latency.compute_ms


def test_many_values_while_a_function_is_busy_make_few_runs_and_the_last_one_counts(image: Any) -> None:
    started, go_on, seen = threading.Event(), threading.Event(), []

    def slow(image: Any, x: int) -> Any:
        seen.append(x)
        if len(seen) > 1:
            started.set()
            assert go_on.wait(60)
        return image + x

    runner = ep.CompGraphRunner(ep.CompGraph({"slow": slow}, {"slow": (("image", "x"), "y")}), {"x": 0})
    runner.run(image=image)
    panel = tune(runner, x=(0, 200))
    panel["x"] = 1
    assert started.wait(60)
    for x in range(2, 121):
        panel["x"] = x
    assert "computing" in repr(panel)
    go_on.set()
    panel.wait(60)
    assert seen == [0, 1, 120]
    assert (panel["x"], runner["x"], panel.result.hyperparameters["x"]) == (120, 120, 120)
    panel.close(10)


def test_values_set_from_several_threads_are_all_in_the_last_run(panel: Panel) -> None:
    def move(name: str, values: range) -> None:
        for value in values:
            panel[name] = value

    threads = [
        threading.Thread(target=move, args=("gain", range(1, 6))),
        threading.Thread(target=move, args=("threshold", range(100, 140))),
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
    panel.wait(60)
    assert panel.values == {"gain": 5, "threshold": 139} == dict(panel.result.hyperparameters)


def test_the_code_names_what_has_changed(panel: Panel) -> None:
    assert panel.code() == "runner.rerun()"
    panel["threshold"] = 60
    assert panel.code() == "runner.rerun(threshold=60)"
    panel["threshold"] = 100
    assert panel.code() == "runner.rerun()"
    panel.wait(60)


def test_a_runner_that_was_not_run_is_refused_with_the_way_out(runner: ep.CompGraphRunner) -> None:
    with pytest.raises(PayloadError, match=r"Call run\(image=\.\.\.\) first"):
        tune(ep.CompGraphRunner(runner.cg, {"gain": 1, "threshold": 1}))


def test_names_that_are_not_there_are_refused(runner: ep.CompGraphRunner, panel: Panel) -> None:
    with pytest.raises(UnknownName, match="Did you mean 'mask'"):
        tune(runner, token="maks")
    with pytest.raises(UnknownName, match="Did you mean 'gain'"):
        panel["gian"]
    with pytest.raises(ValueError, match="can't be 300"):
        panel["threshold"] = 300
    assert panel["threshold"] == 100


def test_a_runner_with_stale_functions_is_brought_up_to_date(runner: ep.CompGraphRunner) -> None:
    runner["threshold"] = 50
    panel = tune(runner)
    panel.wait(60)
    assert panel.result.hyperparameters["threshold"] == 50
    panel.close(10)


def test_a_panel_on_a_run_that_failed_opens_and_recovers(runner: ep.CompGraphRunner) -> None:
    with pytest.raises(ValueError, match="13"):
        runner.rerun(threshold=13)
    panel = tune(runner, threshold=(0, 255))
    panel.wait(60)
    assert panel.error
    with pytest.raises(NotComputed, match="13 is not a threshold"):
        panel.result["mask"]
    panel["threshold"] = 20
    panel.wait(60)
    assert (panel.error, panel.token) == ("", "mask")
    panel.close(10)


def test_a_graph_without_images_is_shown_as_text(monkeypatch: pytest.MonkeyPatch) -> None:
    runner = ep.CompGraphRunner(ep.CompGraph({"add": lambda x, y: x + y}, {"add": (("x", "y"), "total")}), {"y": 1})
    runner.run(x=2)
    panel = tune(runner)
    screen = FrontEnd(panel, monkeypatch)
    picture = screen.frames[-1]["pictures"][0]
    assert (picture["media_type"], picture["text"]) == ("text/plain", "3")
    panel.close(10)


def test_a_value_that_nothing_moves_can_be_set_from_code(image: Any) -> None:
    cg = ep.CompGraph({"f": lambda image, mask: image & mask}, {"f": (("image", "mask"), "y")})
    runner = ep.CompGraphRunner(cg, {"mask": np.zeros((48, 64), np.uint8)})
    runner.run(image=image)
    panel = tune(runner)
    panel["mask"] = np.full((48, 64), 255, np.uint8)
    panel.wait(60)
    np.testing.assert_array_equal(panel.result["y"], image)
    panel.close(10)


def test_the_repr_is_short_and_the_bundle_shows_the_widgets(panel: Panel) -> None:
    bundle = panel._repr_mimebundle_()
    assert bundle["text/plain"] == repr(panel) == "<Panel: 2 hyperparameters, shows 'mask'; up to date>"
    assert bundle["application/vnd.jupyter.widget-view+json"]["model_id"] == panel.widget.model_id


def test_a_closed_panel_takes_no_values_and_its_controls_are_off(panel: Panel, calls: Any) -> None:
    panel.close(10)
    panel.close(10)
    with pytest.raises(RuntimeError, match="closed"):
        panel["threshold"] = 60
    assert all(entry.widget.disabled for entry in panel._controls.controls)
    assert calls.counts == {}


@pytest.mark.slow
def test_two_panels_on_one_runner_both_work(runner: ep.CompGraphRunner) -> None:
    first, second = tune(runner), tune(runner)
    first["threshold"] = 60
    first.wait(60)
    second["gain"] = 3
    second.wait(60)
    assert dict(second.result.hyperparameters) == {"gain": 3, "threshold": 60}
    first.close(10)
    second.close(10)


@pytest.mark.slow
def test_the_interpreter_ends_while_a_panel_is_open() -> None:
    code = (
        "import epypes as ep; from epypes_widgets import tune\n"
        "r = ep.CompGraphRunner(ep.CompGraph({'f': lambda x, y: x + y}, {'f': (('x', 'y'), 'z')}), {'y': 1})\n"
        "r.run(x=2); p = tune(r); p['y'] = 2; p.wait(60); assert p.result['z'] == 4"
    )
    subprocess.run([sys.executable, "-W", "error", "-c", code], check=True, timeout=120)


def test_values_set_from_many_threads_leave_panel_and_runner_agreed(runner: ep.CompGraphRunner) -> None:
    panel = tune(runner)
    name = next(name for name, value in runner.hyperparameters.items() if isinstance(value, int))
    for _ in range(20):
        start = threading.Barrier(4)

        def move(values: range, start: threading.Barrier = start) -> None:
            start.wait(60)
            for value in values:
                panel[name] = value

        threads = [threading.Thread(target=move, args=(range(first, 11, 4),)) for first in range(1, 5)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        panel.wait(60)
        assert runner[name] == panel[name]
    panel.close()


def test_a_value_that_is_set_is_asked_for_once(panel: Panel, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[dict[str, Any]] = []
    monkeypatch.setattr(panel._worker, "post", lambda key, *_: key == "compute" and asked.append(panel._session.wanted))
    panel["threshold"] = 60
    panel["threshold"] = 60
    panel._controls.control("threshold").widget.value = 61
    assert asked == [{"threshold": 60}, {"threshold": 60}, {"threshold": 61}]


def test_what_was_set_is_at_fault_for_a_failure_that_it_causes_further_on(monkeypatch: pytest.MonkeyPatch) -> None:
    cg = ep.CompGraph.from_functions(halved, checked)
    runner = ep.CompGraphRunner(cg, {"start": 2, "other": 1})
    runner.run(image=np.ones((4, 4)))
    panel = tune(runner)
    screen = FrontEnd(panel, monkeypatch)
    panel.set(start=0)
    panel.wait(60)
    assert screen.last("error")["names"] == ["start"]
    panel.close()


@ep.outputs("half")
def halved(image: Any, start: int) -> Any:
    return image[start:]


@ep.outputs("result")
def checked(half: Any, other: int) -> Any:
    if half.shape[0] == 4:
        raise ValueError("nothing is cut off")
    return half * other


def test_a_panel_on_a_run_of_one_of_its_images_knows_which() -> None:
    images = [np.zeros((4, 4)), np.ones((4, 4))]
    runner = ep.CompGraphRunner(ep.CompGraph.from_functions(halved), {"start": 2})
    runner.run(image=images[1])
    panel = tune(runner, images=images)
    assert panel._session.image == 1
    panel.close()


def test_a_panel_on_what_has_been_run_computes_nothing(runner: ep.CompGraphRunner, image: Any, calls: Any) -> None:
    panel = tune(runner, images=[255 - image, image.copy()])
    assert "up to date" in repr(panel)
    panel.wait(60)
    assert (calls.counts, panel._session.image, list(panel.history["image"])) == ({}, 1, [1])
    panel["threshold"] = 90
    panel.wait(60)
    runner.rerun(threshold=91)
    panel.wait(60)
    assert panel._session.image == 1, "also when it is run again"
    panel.close(10)


@pytest.mark.slow
def test_two_panels_on_one_runner_add_no_rows_for_each_other(image: Any) -> None:
    cg = ep.CompGraph({"f": lambda image, k: image + np.uint8(k)}, {"f": (("image", "k"), "y")})
    runner = ep.CompGraphRunner(cg, {"k": 1})
    first, second = tune(runner, images=[image, 255 - image]), tune(runner)
    for k in (2, 3):
        first["k"] = k
        first.wait(60)
        second.wait(60)
    assert list(second.history["k"]) == [1, 2, 3]
    assert list(second.history["image"]) == [0, 0, 0]
    first.close(10)
    second.close(10)
