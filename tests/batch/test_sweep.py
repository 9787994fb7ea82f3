"""A sweep runs what it must, once, and leaves everything else as it was."""

from __future__ import annotations

import math
import re
import threading
from concurrent.futures import ThreadPoolExecutor
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.errors import PayloadError, ScaleError, UnknownName
from tests.batch.conftest import counting_runner
from tests.bundle.cells import cell
from tests.calls import Calls, log_to


def load(image: Any) -> Any:
    return image.astype(np.int32)


def blur(loaded: Any, kernel: int) -> Any:
    return loaded // kernel


def above(blurred: Any, threshold: int) -> Any:
    if threshold == 13:
        raise ValueError("13 is not a threshold")
    return np.where(blurred > threshold, 255, 0).astype(np.uint8)


def area(mask: Any) -> int:
    return int((mask > 0).sum())


IO = {
    "load": ("image", "loaded"),
    "blur": (("loaded", "kernel"), "blurred"),
    "above": (("blurred", "threshold"), "mask"),
    "area": ("mask", "size"),
}


@pytest.fixture
def calls() -> Calls:
    return Calls()


@pytest.fixture
def image() -> Any:
    return np.arange(64 * 48, dtype=np.uint32).reshape(48, 64).astype(np.uint8)


@pytest.fixture
def runner(calls: Calls, image: Any) -> ep.CompGraphRunner:
    cg = ep.CompGraph({name: calls.of(globals()[name]) for name in IO}, IO)
    runner = ep.CompGraphRunner(cg, {"kernel": 1, "threshold": 100})
    runner.run(image=image)
    calls.counts.clear()
    return runner


def by_hand(image: Any, kernel: int, threshold: int) -> int:
    return area(above(blur(load(image), kernel), threshold))


EXECUTORS = [None, 1, 4]


@pytest.mark.slow
@pytest.mark.parametrize("threads", EXECUTORS)
@pytest.mark.parametrize("count", [None, 1, 3, 9])
def test_what_does_not_depend_on_what_varies_runs_once_an_image(
    runner: ep.CompGraphRunner, calls: Calls, image: Any, threads: int | None, count: int | None
) -> None:
    images = None if count is None else [image + place for place in range(count)]
    thresholds = list(range(20, 70))
    result = sweep_on(threads, runner, {"threshold": thresholds}, images)
    once = count or 1
    assert calls.counts == {"load": once, "blur": once, "above": 50 * once, "area": 50 * once}
    found = [(one.number, one.setting["threshold"], one.values["size"]) for one in result]
    every = images or [image]
    assert found == [(at, one, by_hand(every[at], 1, one)) for at in range(once) for one in thresholds]


def sweep_on(threads: int | None, *given: Any, **how: Any) -> ep.SweepResult:
    if threads is None:
        return ep.sweep(*given, **how)
    with ThreadPoolExecutor(threads) as executor:
        return ep.sweep(*given, executor=executor, **how)


def test_what_depends_on_the_slowest_runs_once_for_each_of_its_values_whatever_the_order_of_the_grid(
    runner: ep.CompGraphRunner, calls: Calls, image: Any
) -> None:
    result = ep.sweep(runner, {"threshold": list(range(20, 60)), "kernel": [1, 2, 3]})
    assert calls.counts["load"] == 1
    assert calls.counts["blur"] == 3
    assert [(one.setting["threshold"], one.setting["kernel"]) for one in result][:4] == [
        (20, 1),
        (20, 2),
        (20, 3),
        (21, 1),
    ]
    assert all(one.values["size"] == by_hand(image, one.setting["kernel"], one.setting["threshold"]) for one in result)


def test_threads_compute_what_the_slowest_makes_once_where_it_has_values_for_all_of_them(
    runner: ep.CompGraphRunner, calls: Calls
) -> None:
    sweep_on(2, runner, {"threshold": list(range(20, 60)), "kernel": [1, 2, 3, 4, 5]})
    assert calls.counts["load"] == 1
    assert calls.counts["blur"] == 5


def test_the_given_runner_is_left_as_it_was(runner: ep.CompGraphRunner, image: Any) -> None:
    before = (dict(runner.hyperparameters), runner.last, runner.revision, len(runner.reports), runner.stale)
    told: list[None] = []
    runner.watch(lambda: told.append(None))
    ep.sweep(runner, {"threshold": [10, 13, 20]})
    sweep_on(3, runner, {"threshold": [10, 13, 20]}, [image])
    after = (dict(runner.hyperparameters), runner.last, runner.revision, len(runner.reports), runner.stale)
    assert after == before
    assert told == []


@pytest.mark.parametrize("threads", EXECUTORS)
def test_nodes_and_pipelines_of_the_graph_are_left_as_they_were(threads: int | None) -> None:
    def times(x: float, gain: float = 2.0) -> float:
        return x * gain

    deepest = ep.Pipeline("deepest", ep.CompGraph.from_functions(times), {"gain": 3.0})
    nested = ep.CompGraph(
        {"deepest": deepest, "less": lambda b, k: b - k}, {"deepest": ("a", "b"), "less": (("b", "k"), "c")}
    )
    scaled = ep.Pipeline("scaled", nested, {"k": 1})
    plus = ep.Node("plus", lambda c, y: c + y)
    functions = {"scaled": ep.Node("outer", scaled), "plus": plus}
    cg = ep.CompGraph(functions, {"scaled": ("x", "c"), "plus": (("c", "y"), "z")})
    runner = ep.CompGraphRunner(cg, {"y": 1})
    runner.run(x=3)

    def state() -> tuple[Any, ...]:
        nodes = (scaled, deepest, plus, cg.functions["scaled"], *scaled.network.nodes.values())
        return (*((node.run_count, node.traverse_time()) for node in nodes), scaled.runner.last, deepest.runner.last)

    before = state()
    with nullcontext() if threads is None else ThreadPoolExecutor(threads) as executor:
        swept = ep.sweep(runner, {"y": [1, 2]}, [5, 6], executor)
        mapped = ep.map(runner, [7], executor)
        ep.check(runner, [8], executor)
        ep.optimize(runner, "z", [{"x": 9}], 3, ranges={"y": (0, 3)}, executor=executor)
    assert state() == before
    assert (scaled["b"], deepest["times"]) == (9, 9)
    assert [one.values["z"] for one in (*swept, *mapped)] == [15, 16, 18, 19, 21]


@pytest.mark.parametrize("threads", EXECUTORS)
def test_a_failing_setting_is_a_row_with_its_failure_and_the_others_go_on(
    runner: ep.CompGraphRunner, image: Any, threads: int | None
) -> None:
    result = sweep_on(threads, runner, {"threshold": [13, 20, 13, 30], "kernel": [1, 2]})
    frame = result.to_frame()
    assert list(frame["failure"].notna()) == [True, True, False, False, True, True, False, False]
    assert set(frame["failure"].dropna()) == {"above: ValueError: 13 is not a threshold"}
    assert list(frame["threshold"]) == [13, 13, 20, 20, 13, 13, 30, 30]
    assert frame["size"][2] == by_hand(image, 1, 20)
    assert [one.setting["threshold"] for one in result.failures] == [13] * 4


def test_images_of_a_folder_are_swept_and_one_that_can_not_be_read_is_a_row_for_each_setting(
    runner: ep.CompGraphRunner, tmp_path: Path
) -> None:
    cv2.imwrite(str(tmp_path / "a.png"), np.full((20, 20, 3), 90, np.uint8))
    (tmp_path / "b.png").write_bytes(b"no image")
    result = ep.sweep(runner, {"threshold": [50, 100]}, tmp_path)
    assert [(one.name, one.setting["threshold"], one.has_failed) for one in result] == [
        ("a.png", 50, False), ("a.png", 100, False), ("b.png", 50, True), ("b.png", 100, True),
    ]  # fmt: skip
    assert {one.error_info.function for one in result.failures if one.error_info} == {""}


def test_only_thumbnails_and_short_values_are_kept_unless_tokens_are_named(runner: ep.CompGraphRunner) -> None:
    plain = ep.sweep(runner, {"threshold": [50, 100]})[0]
    assert not plain.kept
    assert set(plain.values) == {"size"}
    assert {"image", "mask"} <= set(plain.thumbnails)
    assert all(len(shown.data) <= 5_000 for shown in plain.thumbnails.values())
    kept = ep.sweep(runner, {"threshold": [50, 100]}, keep=["mask"], show=())
    assert not kept[0].thumbnails
    assert [int((one.kept["mask"] > 0).sum()) for one in kept] == [one.values["size"] for one in kept]


def test_a_picture_of_what_stays_is_made_once(runner: ep.CompGraphRunner) -> None:
    result = ep.sweep(runner, {"threshold": [50, 100, 150]})
    assert len({id(one.thumbnails["image"]) for one in result}) == 1
    assert len({id(one.thumbnails["mask"]) for one in result}) == 3


def test_a_hyperparameter_that_is_called_like_a_column_has_one_of_its_own() -> None:
    cg = ep.CompGraph({"f": lambda x, name: x + name}, {"f": (("x", "name"), "failure")})
    frame = ep.sweep(ep.CompGraphRunner(cg, {"name": 1}), {"name": [1, 2]}, [10]).to_frame()
    assert list(frame["name (hyperparameter)"]) == [1, 2]
    assert list(frame["failure (token)"]) == [11, 12]
    assert list(frame["name"]) == ["#0", "#0"]


def test_none_in_a_grid_is_none_in_the_table() -> None:
    cg = ep.CompGraph({"f": lambda x, gain, size: x}, {"f": (("x", "gain", "size"), "y")})
    grid = [{"gain": None, "size": 1}, {"gain": 0.5, "size": 2}, {"gain": math.nan, "size": 3}]
    frame = ep.sweep(ep.CompGraphRunner(cg, {"gain": 1, "size": 1}), grid, [10]).to_frame()
    assert frame["gain"].to_list()[:2] == [None, 0.5]
    assert math.isnan(frame["gain"][2])
    assert frame["size"].dtype == np.int64


def test_without_images_nothing_can_be_swept_before_a_run(runner: ep.CompGraphRunner) -> None:
    new = ep.CompGraphRunner(runner.cg, runner.hyperparameters)
    with pytest.raises(PayloadError, match=r"images=\.\.\., or call run\(image=\.\.\.\)"):
        ep.sweep(new, {"threshold": [1]})


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"grid": {"threshold": range(100_001)}}, "100,001 settings.*at most 100,000"),
        ({"grid": {"threshold": range(50_001)}, "images": [0, 0], "show": ()}, "on 2 images: 100,002 outcomes"),
        ({"grid": {"kernel": range(1, 90_000)}}, "up to 269,997 pictures.*show="),
        ({"grid": {"threshold": [1]}, "images": []}, "empty"),
    ],
    ids=["settings", "images", "pictures", "empty"],
)
def test_what_is_too_large_to_hold_or_empty_is_refused_before_anything_runs(
    runner: ep.CompGraphRunner, calls: Calls, given: dict[str, Any], said: str
) -> None:
    with pytest.raises(ScaleError, match=said):
        ep.sweep(runner, **given)
    assert not calls.counts


def test_a_token_that_is_not_there_is_named(runner: ep.CompGraphRunner) -> None:
    for name in ("keep", "show"):
        with pytest.raises(UnknownName, match="Did you mean 'mask'"):
            ep.sweep(runner, {"threshold": [1]}, **{name: ["masc"]})


@pytest.mark.slow
def test_what_is_in_a_store_is_not_run_again(runner: ep.CompGraphRunner, calls: Calls, tmp_path: Path) -> None:
    place = str(tmp_path / "results.sqlite")
    first = ep.sweep(runner, {"threshold": [10, 13, 20], "kernel": [1, 2]}, store=place, name="tried")
    calls.counts.clear()
    more = ep.sweep(runner, {"threshold": [10, 13, 20, 30], "kernel": [1, 2]}, store=place, name="tried")
    assert calls.counts == {"load": 1, "blur": 2, "above": 2, "area": 2}
    assert [one.values for one in more[:6]] == [one.values for one in first]
    assert [str(one.error_info) for one in more[:6]] == [str(one.error_info) for one in first]
    assert [one.thumbnails["mask"] for one in more[:2]] == [one.thumbnails["mask"] for one in first[:2]]
    assert [one.setting["threshold"] for one in more] == [10, 10, 13, 13, 20, 20, 30, 30]
    # What varies is set otherwise when one of the settings has been taken over.
    runner.set(threshold=20)
    calls.counts.clear()
    ep.sweep(runner, {"threshold": [10, 13]}, store=place, name="more")
    ep.sweep(runner, {"threshold": [10, 13], "kernel": [1, 2]}, store=place, name="tried")
    assert calls.counts["load"] == 1


@pytest.mark.slow
@pytest.mark.parametrize("count", [None, 1, 5])
def test_processes_give_the_same(processes: Any, crops: list[Any], count: int | None) -> None:
    runner = counting_runner()
    runner.run(image=crops[0])
    images = None if count is None else crops[:count]
    grid = {"canny_lo": [10, 50, 90], "canny_hi": [60, 120, "no number"]}
    here, there = (ep.sweep(runner, grid, images, executor, keep=["edges"]) for executor in (None, processes))
    assert [(one.number, one.name, dict(one.setting), dict(one.values), one.has_failed) for one in there] == [
        (one.number, one.name, dict(one.setting), dict(one.values), one.has_failed) for one in here
    ]
    assert len(there) == 9 * (count or 1)
    assert len(there.failures) == 3 * (count or 1)
    assert [one.thumbnails for one in there] == [one.thumbnails for one in here]
    assert all(
        np.array_equal(one.kept.get("edges"), other.kept.get("edges")) for one, other in zip(here, there, strict=True)
    )


@pytest.mark.slow
def test_an_interrupted_sweep_goes_on_where_it_was(runner: ep.CompGraphRunner, calls: Calls, tmp_path: Path) -> None:
    place, mended = str(tmp_path / "results.sqlite"), threading.Event()

    def interrupt(threshold: int) -> None:
        if not mended.is_set() and threshold == 90:
            raise KeyboardInterrupt

    logger = log_to(interrupt)

    def interrupted(blurred: Any, threshold: int) -> Any:
        logger.info(threshold)
        return above(blurred, threshold)

    cg = ep.CompGraph({**runner.cg.functions, "above": calls.of(interrupted)}, IO)
    mine = ep.CompGraphRunner(cg, runner.hyperparameters)
    images = [np.full((9, 9), 100, np.uint8)]
    grid = {"threshold": list(range(60, 120))}
    with pytest.raises(KeyboardInterrupt):
        ep.sweep(mine, grid, images, store=place, name="n")
    mended.set()
    calls.counts.clear()
    result = ep.sweep(mine, grid, images, store=place, name="n")
    # It went to 90, and what was done before in whole parts of the grid is there.
    assert 30 <= calls.counts["interrupted"] < 40
    assert [one.values["size"] for one in result] == [81 * (one < 100) for one in grid["threshold"]]


SIGNED = """
import cv2
import numpy as np


def gradient(image, gain):
    return np.float32(gain) * cv2.Sobel(image[..., 0], cv2.CV_32F, 1, 0)


def corners(gradient, quality):
    return cv2.goodFeaturesToTrack(gradient, 20, quality, 5)
"""


@pytest.mark.slow
def test_the_same_value_has_the_same_picture_on_every_executor_and_in_every_order(
    processes: Any, crops: list[Any]
) -> None:
    made = cell(SIGNED)
    cg = ep.CompGraph(
        {"gradient": made["gradient"], "corners": made["corners"]},
        {"gradient": (("image", "gain"), "gradient"), "corners": (("gradient", "quality"), "points")},
    )
    runner = ep.CompGraphRunner(cg, {"gain": 1, "quality": 0.1})
    gains = [1, 4, 40]

    def seen(executor: Any, settings: list[int], order: list[int]) -> dict[Any, Any]:
        result = ep.sweep(runner, {"gain": settings}, [crops[number] for number in order], executor)
        return {(one.setting["gain"], order[one.number]): one.thumbnails for one in result}

    order = list(range(4))
    expected = seen(None, gains, order)
    assert {"image", "gradient", "points"} == set(expected[1, 0])
    assert re.fullmatch(r"float32 100 x 150, shown from -[\d.]+ to [\d.]+", expected[1, 0]["gradient"].caption)
    assert seen(processes, gains, order) == expected
    with ThreadPoolExecutor(3) as threads:
        assert seen(threads, gains, order) == expected
    assert seen(None, gains[::-1], order[::-1]) == expected
    mapped = ep.map(runner, crops[3::-1], show=None)
    assert [one.thumbnails for one in mapped][::-1] == [expected[1, number] for number in order]
