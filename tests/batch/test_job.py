"""Jobs of one worker, and their outcomes."""

from __future__ import annotations

import json
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest

import epypes as ep
from epypes.batch.items import Item, items_of
from epypes.batch.job import Job, run_job
from epypes.batch.packaged_graph import packed_job, unpacked_job
from epypes.batch.results import ErrorInfo, Outcome, outcomes_frame
from epypes.batch.thumbnails import Thumbnail


def ran(runner, *jobs):
    """Return the outcomes of jobs."""
    return [outcome for job in jobs for outcome in run_job(runner, job)]


@pytest.fixture
def calls():
    return Counter()


@pytest.fixture
def counted(calls):
    """``image -> doubled -> total``, whose functions count their calls."""

    def double(image):
        calls["double"] += 1
        return image * 2

    def add(doubled, offset, limit):
        calls["add"] += 1
        if offset < 0:
            raise ValueError("offset is negative")
        return int(min(doubled.sum() + offset, limit))

    cg = ep.CompGraph(
        {"double": double, "add": add},
        {"double": ("image", "doubled"), "add": (("doubled", "offset", "limit"), "total")},
    )
    return ep.CompGraphRunner(cg, {"offset": 0, "limit": 1000})


def test_only_what_the_targets_need_is_run(counted, calls):
    job = Job(item(), ({"offset": -1}, {"offset": -2}), keep=("doubled", "total"), targets=("doubled",))
    outcomes = ran(counted, job)
    assert calls == {"double": 1}
    assert [(list(outcome.kept), outcome.values, outcome.error_info) for outcome in outcomes] == [
        (["doubled"], {}, None)
    ] * 2
    assert unpacked_job(packed_job(job), {}).targets == ("doubled",)


def item(number=0):
    return Item(number, f"#{number}", {"image": np.full((2, 2), number + 1)})


def totals(outcomes):
    return [outcome.values.get("total") for outcome in outcomes]


def test_functions_that_do_not_depend_on_what_varies_run_once_per_item(counted, calls):
    settings = tuple({"offset": offset} for offset in range(10))
    outcomes = ran(counted, *(Job(item(number), settings) for number in (0, 1)))
    assert totals(outcomes) == [8 + offset for offset in range(10)] + [16 + offset for offset in range(10)]
    assert calls == {"double": 2, "add": 20}
    assert [set(outcome.times_ns) for outcome in outcomes[:2]] == [{"double", "add"}, {"add"}]


def test_what_a_setting_leaves_out_is_as_the_runner_has_it(counted):
    outcomes = ran(counted, Job(item(), ({"limit": 5}, {"offset": 1}, {"limit": 3})))
    assert totals(outcomes) == [5, 9, 3]
    assert counted.hyperparameters == {"offset": 0, "limit": 1000}


def test_a_setting_that_fails_leaves_the_others_alone(counted, calls):
    good, bad, again = ran(counted, Job(item(), ({}, {"offset": -1}, {"offset": 2})))
    assert bad.error_info == ErrorInfo("add", "ValueError", "offset is negative")
    assert bad.values == {}
    assert totals([good, again]) == [8, 10]
    assert calls["double"] == 1


def test_a_first_setting_that_fails_leaves_the_others_alone(counted):
    bad, good = ran(counted, Job(item(), ({"offset": -1}, {"offset": 2})))
    assert bad.has_failed
    assert totals([good]) == [10]


def test_an_input_that_can_not_be_read_is_a_failure_without_a_function(runner):
    (found,) = items_of(["nowhere.png"], runner)
    first, second = ran(runner, Job(found, ({"canny_lo": 1}, {"canny_lo": 2})))
    assert first.error_info.function == ""
    assert first.error_info.kind == "ImageFileError"
    assert second.setting == {"canny_lo": 2}


def test_a_function_that_leaves_the_interpreter_is_a_failure_of_its_item():
    def leave(image):
        raise SystemExit(3)

    runner = ep.CompGraphRunner(ep.CompGraph({"leave": leave}, {"leave": ("image", "out")}))
    (outcome,) = ran(runner, Job(item()))
    assert outcome.error_info.kind == "SystemExit"


def test_numbers_texts_and_truth_values_stay_and_others_become_a_short_text(crops):
    kinds = {
        "count": np.int64(3),
        "share": np.float32(0.5),
        "is_good": np.True_,
        "text": "ok",
        "none": None,
        "pixels": crops[0],
    }
    cg = ep.CompGraph(
        {f"make_{name}": lambda image, value=value: value for name, value in kinds.items()},
        {f"make_{name}": (("image",), name) for name in kinds},
    )
    (outcome,) = ran(ep.CompGraphRunner(cg), Job(item()))
    assert outcome.values == {
        "count": 3, "share": 0.5, "is_good": True, "text": "ok", "none": None, "pixels": "uint8 100 x 150 x 3 bgr",
    }  # fmt: skip
    assert [type(outcome.values[name]) for name in ("count", "share", "is_good")] == [int, float, bool]


def test_only_tokens_that_are_asked_for_are_kept_and_shown(runner, crops):
    (plain,) = ran(runner, Job(Item(0, "#0", {"image": crops[0]})))
    assert plain.kept == {}
    assert plain.thumbnails == {}
    (seen,) = ran(runner, Job(Item(0, "#0", {"image": crops[0]}), keep=("edges",), show=None))
    assert seen.kept["edges"].shape == (100, 150)
    assert {"image", "image_gray", "edges", "keypoints"} == set(seen.thumbnails)
    assert all(len(shown.data) <= 5 * 1024 for shown in seen.thumbnails.values())


def test_a_chart_is_kept_as_a_picture_that_stands_alone():
    cg = ep.CompGraph({"profile": lambda image: np.linspace(0, 1, 50)}, {"profile": ("image", "curve")})
    (outcome,) = ran(ep.CompGraphRunner(cg), Job(item(), show=("curve",)))
    shown = outcome.thumbnails["curve"]
    assert shown.media_type == "image/svg+xml"
    assert b"<svg xmlns" in shown.data
    assert b"<polyline" in shown.data


def test_an_outcome_comes_back_from_json_as_it_was():
    outcome = Outcome(
        3, "a.png", {"ksize": (3, 3), "points": [1, 2], "method": "canny"}, {"n": 1, "share": 0.5, "text": "x", "none": None},
        {"f": 12}, 15, ErrorInfo("f", "ValueError", "no"), {"edges": Thumbnail("image/png", b"\x89PNG", "uint8 2 x 2")},
        {"edges": np.zeros((2, 2))},
    )  # fmt: skip
    again = Outcome.from_json(json.loads(json.dumps(outcome.to_json())), Item(4, "b.png", {}), outcome.setting)
    assert again == replace(outcome, number=4, name="b.png", kept={})


def test_the_table_has_failures_as_rows_and_whole_numbers_stay_whole(counted):
    frame = outcomes_frame(ran(counted, Job(item(), ({}, {"offset": -1}))), counted.cg, {"offset": [0, -1]})
    assert list(frame.columns) == ["name", "offset", "failure", "total", "total_ms", "double ms", "add ms"]
    assert frame["total"].tolist()[0] == 8
    assert frame["total"].isna().tolist() == [False, True]
    assert frame["failure"].isna().tolist() == [True, False]
    assert frame["failure"][1] == "add: ValueError: offset is negative"


def test_a_token_that_is_called_like_a_column_has_another_name():
    cg = ep.CompGraph({"f": lambda image: 1}, {"f": ("image", "name")})
    frame = outcomes_frame(ran(ep.CompGraphRunner(cg), Job(item())), cg)
    assert frame["name (token)"].tolist() == [1]
    assert frame["name"].tolist() == ["#0"]


def test_a_default_that_was_unfrozen_is_an_input_of_each_item() -> None:
    def times(x: float, gain: float = 2.0) -> float:
        return x * gain

    runner = ep.CompGraphRunner(ep.CompGraph.from_functions(times))
    runner.unfreeze("gain")
    with ThreadPoolExecutor(2) as pool:
        for executor in (None, pool):
            assert [one.values["times"] for one in ep.map(runner, [{"x": 3, "gain": 5}], executor)] == [15]
