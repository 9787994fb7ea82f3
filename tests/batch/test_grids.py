"""Does a grid stand for the settings that it says, and is one that can't be refused before anything runs?"""

from __future__ import annotations

import itertools
import math
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pytest

import epypes as ep
from epypes.batch.grid import MOST_OUTCOMES, running_order, settings_of
from epypes.errors import HyperparameterError, ScaleError, UnknownName


def shift(
    x: int,
    offset: Annotated[int, ep.Param(0, 8, step=2)],
    scale: Annotated[float, ep.Param(0.1, 10.0, log=True)],
    kernel: Annotated[int, ep.Param(1, 31, odd=True)],
    method: str,
) -> float:
    return (x + offset) * scale * kernel


def add(x: float, k: float) -> float:
    return x + k


@pytest.fixture
def runner() -> ep.CompGraphRunner:
    cg = ep.CompGraph({"shift": shift}, {"shift": (("x", "offset", "scale", "kernel", "method"), "y")})
    return ep.CompGraphRunner(cg, {"offset": 2, "scale": 1.0, "kernel": 3, "method": "near"})


def settings(runner: ep.CompGraphRunner, grid: Any, **how: Any) -> list[dict[str, Any]]:
    return list(map(dict, settings_of(runner, grid, **how)))


def test_a_product_has_each_value_with_each_other_and_the_last_name_varies_fastest(runner: ep.CompGraphRunner) -> None:
    made = settings(runner, {"offset": [1, 2], "method": ["near", "far"]})
    assert [tuple(one.values()) for one in made] == [(1, "near"), (1, "far"), (2, "near"), (2, "far")]


def test_arrays_and_ranges_are_lists_of_plain_numbers(runner: ep.CompGraphRunner) -> None:
    made = settings(runner, {"offset": range(0, 4, 2), "scale": np.linspace(0, 1, 3)})
    assert [one["scale"] for one in made] == [0.0, 0.5, 1.0] * 2
    assert {type(value) for one in made for value in one.values()} == {int, float}


def test_what_a_hint_allows_is_counted(runner: ep.CompGraphRunner) -> None:
    assert [one["offset"] for one in settings(runner, {"offset": None})] == [0, 2, 4, 6, 8]
    assert [one["kernel"] for one in settings(runner, {"kernel": ep.Param(4, 9, odd=True)})] == [5, 7, 9]
    assert [one["scale"] for one in settings(runner, {"scale": ep.Param(0.0, 0.3, step=0.1)})] == [0.0, 0.1, 0.2, 0.3]


def test_zip_takes_values_together_and_refuses_unequal_numbers(runner: ep.CompGraphRunner) -> None:
    made = settings(runner, {"offset": [1, 2], "kernel": [3, 5]}, how="zip")
    assert made == [{"offset": 1, "kernel": 3}, {"offset": 2, "kernel": 5}]
    with pytest.raises(ScaleError, match="offset has 2, kernel has 3"):
        settings_of(runner, {"offset": [1, 2], "kernel": [3, 5, 7]}, how="zip")


def test_a_list_of_settings_is_taken_as_it_is_and_what_one_leaves_out_is_the_runners(
    runner: ep.CompGraphRunner,
) -> None:
    made = settings(runner, [{"offset": 5}, {"kernel": 7}, {"offset": 5}])
    assert made == [{"offset": 5, "kernel": 3}, {"offset": 2, "kernel": 7}, {"offset": 5, "kernel": 3}]


@pytest.mark.parametrize("how", ["random", "latin"])
def test_drawn_settings_are_within_their_ranges_and_the_same_for_a_seed(runner: ep.CompGraphRunner, how: str) -> None:
    grid = {"offset": None, "scale": (0.5, 2.0), "kernel": ep.Param(1, 31, odd=True), "method": ["near", "far"]}
    made = settings(runner, grid, how=how, n=40, seed=7)
    assert len(made) == 40
    assert {one["offset"] for one in made} == {0, 2, 4, 6, 8}
    assert all(0.5 <= one["scale"] <= 2.0 and type(one["scale"]) is float for one in made)
    assert all(one["kernel"] % 2 == 1 and 1 <= one["kernel"] <= 31 and type(one["kernel"]) is int for one in made)
    assert {one["method"] for one in made} == {"near", "far"}
    assert made == settings(runner, grid, how=how, n=40, seed=7)
    assert made != settings(runner, grid, how=how, n=40, seed=8)


STEPPED = [
    (ep.Param(1, 31, odd=True, step=3), 5, [1, 5, 9, 13, 17, 21, 25, 29]),
    (ep.Param(4, 12, odd=True, step=1), 5, [5, 7, 9, 11]),
    (ep.Param(1.0, 9.0, odd=True), 3.0, [1, 3, 5, 7, 9]),
    (ep.Param(0.1, 0.3, step=0.1), 0.3, [0.1, 0.2, 0.3]),
    (ep.Param(-0.3, 0.6, step=0.3), 0.0, [-0.3, 0.0, 0.3, 0.6]),
    (ep.Param(0.0, 2.0, step=2 / 3), 0.0, [0.0, 0.6666666666666666, 1.3333333333333333, 2.0]),
    (ep.Param(0, 4, step=2), 0.0, [0.0, 2.0, 4.0]),
    (ep.Param(0.0, 0.5, step=0.25), 0, [0.0, 0.25, 0.5]),
    (ep.Param(1 / 3, 0.7, step=0.1), 1 / 3, [1 / 3, 0.4333333333333333, 0.5333333333333333, 0.6333333333333333]),
]


@pytest.mark.slow
@pytest.mark.parametrize(("hint", "present", "allowed"), STEPPED)
def test_a_sweep_and_a_search_take_the_same_values_of_a_range_and_its_hint_allows_them(
    hint: ep.Param, present: float, allowed: list[float], tmp_path: Path
) -> None:
    runner = ep.CompGraphRunner(ep.CompGraph.from_functions(add), {"k": present})
    assert list(map(repr, (one["k"] for one in settings(runner, {"k": hint})))) == list(map(repr, allowed))
    assert {one["k"] for one in settings(runner, {"k": hint}, how="random", n=60)} == set(allowed)
    found = ep.optimize(runner, "add", [1], 60, ranges={"k": hint}, store=tmp_path / "trials.sqlite")
    assert {trial.setting["k"] for trial in found} == set(allowed)
    assert len(ep.optimize(runner, "add", [1], 61, ranges={"k": hint}, store=tmp_path / "trials.sqlite")) == 61
    assert all(hint.allows(value) for value in allowed)


@pytest.mark.parametrize("how", ["random", "latin"])
def test_a_drawn_value_never_exceeds_the_one_that_it_is_to_stay_below(how: str) -> None:
    def between(x: float, low: Annotated[int, ep.Param(1, 31, odd=True, below="high")], high: int, top: float) -> int:
        return low

    cg = ep.CompGraph({"between": between}, {"between": (("x", "least", "most", "top"), "y")})
    runner = ep.CompGraphRunner(cg, {"least": 1, "most": 9, "top": 12.5})
    assert max(one["least"] for one in settings(runner, ["least"], how=how, n=40)) == 9
    ranges = {"least": None, "most": ep.Param(1, 31, below="top")}
    made = settings(runner, ranges, how=how, n=40)
    assert all(one["least"] <= one["most"] <= 12 and one["least"] % 2 == 1 for one in made)
    found = ep.optimize(runner, "y", [0.0], 30, ranges={"least": ep.Param(1, 31, below="most"), "most": ranges["most"]})
    assert all(trial.setting["least"] <= trial.setting["most"] <= 12 for trial in found)


def test_latin_hypercubes_take_each_part_of_a_range_once(runner: ep.CompGraphRunner) -> None:
    made = settings(runner, {"scale": (0.0, 10.0), "offset": (0, 9)}, how="latin", n=10)
    assert sorted(math.floor(one["scale"]) for one in made) == list(range(10))
    assert sorted(one["offset"] for one in made) == list(range(10))


def test_a_logarithmic_range_is_drawn_as_often_below_its_geometric_mean_as_above(runner: ep.CompGraphRunner) -> None:
    made = settings(runner, ["scale"], how="latin", n=20)
    assert sum(one["scale"] < 1.0 for one in made) == 10


@pytest.mark.parametrize(
    ("grid", "how", "said"),
    [
        ({}, {}, "is a mapping of hyperparameters to values"),
        ({"offset": []}, {}, r"offset=\[\] has no values. Give at least one"),
        ({"offset": (1, 9)}, {}, r"is a range.*offset=\[1, 9\].*how='random'"),
        ({"offset": 3}, {}, r"offset=3 is neither a range, .* nor a list of values. Write offset=\[...\]"),
        ({"offset": np.array(5)}, {}, r"nor a list of values. Write offset=\[...\]"),
        ({"offset": np.int64(5)}, {"how": "zip"}, r"nor a list of values"),
        ({"offset": np.array(5)}, {"how": "random", "n": 3}, r"offset=array\(5\) is neither a range"),
        ({"method": "near"}, {}, r"method='near' is neither a range, .* Write method=\[...\]"),
        ({"method": None}, {}, "No hint gives the values that 'method' may take"),
        ({"scale": None}, {}, "no end of values for 'scale'"),
        ({"offset": (0, 4)}, {"how": "random"}, "Say how many"),
        ({"offset": [1]}, {"n": 5}, "goes with how='random'"),
        ({"offset": ep.Param(0)}, {"how": "random", "n": 3}, "range of 'offset' is open"),
        ({"offset": (4, 0)}, {"how": "random", "n": 3}, "Exchange them"),
        ([{}], {}, "names a hyperparameter"),
    ],
)
def test_a_grid_that_does_not_say_what_is_meant_is_refused(
    runner: ep.CompGraphRunner, grid: Any, how: dict[str, Any], said: str
) -> None:
    with pytest.raises(ScaleError, match=said):
        settings_of(runner, grid, **how)


@pytest.mark.parametrize("grid", [{"x": [1]}, {"x": None}, [{"x": 1}]])
def test_a_free_source_token_is_refused_as_the_runner_does(runner: ep.CompGraphRunner, grid: Any) -> None:
    with pytest.raises(HyperparameterError, match="'x' is a free source token.*freeze"):
        settings_of(runner, grid)


@pytest.mark.parametrize("grid", [{"ofset": [1]}, [{"ofset": 1}], ["ofset"]])
def test_a_misspelt_hyperparameter_is_named_with_the_nearest_one(runner: ep.CompGraphRunner, grid: Any) -> None:
    with pytest.raises(UnknownName, match="Did you mean 'offset'"):
        settings_of(runner, grid)


def test_a_branch_that_a_switch_does_not_have_is_refused_before_anything_runs() -> None:
    cg = ep.CompGraph({"a": abs, "b": abs}, {"a": ("x", "p"), "b": ("x", "q")}) | ep.switch(
        "choose", {"first": "p", "second": "q"}, by="which", output="y"
    )
    runner = ep.CompGraphRunner(cg, {"which": "first"})
    with pytest.raises(UnknownName, match="Did you mean 'second'"):
        settings_of(runner, {"which": ["first", "secnd"]})
    assert settings(runner, {"which": None}) == [{"which": "first"}, {"which": "second"}]


@pytest.mark.parametrize(
    "values", [range(10**9), itertools.count(), iter(range(10**7)), ep.Param(0, 10**9)], ids=["range", "endless", "iterator", "param"]
)  # fmt: skip
def test_a_grid_too_large_to_hold_is_refused_with_its_size_and_never_written_out(
    runner: ep.CompGraphRunner, values: Any
) -> None:
    with pytest.raises(ScaleError, match="settings of offset, kernel.*at most 100,000") as refused:
        settings_of(runner, {"offset": values, "kernel": [1, 3]})
    assert int(str(refused.value).split()[3].replace(",", "")) > 2 * MOST_OUTCOMES


def test_what_most_functions_depend_on_changes_least_often() -> None:
    cg = ep.CompGraph(
        {"first": lambda x, a: x, "second": lambda p, b: p, "third": lambda q, c: q},
        {"first": (("x", "a"), "p"), "second": (("p", "b"), "q"), "third": (("q", "c"), "y")},
    )
    grid = [dict(zip("cab", row, strict=True)) for row in itertools.product([1, 2], repeat=3)]
    in_order = [grid[place] for place in running_order(cg, grid)]
    assert [(one["a"], one["b"], one["c"]) for one in in_order] == list(itertools.product([1, 2], repeat=3))
