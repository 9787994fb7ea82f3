"""Is what computes the same each time held to the last bit, noise tolerated, and everything else refused by name?"""

from __future__ import annotations

import re

import cv2
import numpy as np
import pandas as pd
import pytest

import epypes as ep
from epypes.bundle import verify
from epypes.bundle.compare import Tolerance, difference, differences, first_difference
from epypes.bundle.determinism import RUNS, SAFETY, learn, read_tolerances
from epypes.bundle.settings import read_settings
from epypes.errors import BundleError, PromotionRefused
from tests.bundle.test_slicer import notebook

SOURCE = """
import numpy as np
import time

def total(x):
    # As threads do: another order each time, so other last digits.
    rng = np.random.default_rng()
    return np.cumsum(rng.permutation(x))[-1:]

def exact(x):
    return x * 2

def draw(x):
    return x + np.random.standard_normal(x.shape)

def clock(x):
    return np.array([time.time()])

KEPT = []
def count(x):
    KEPT.append(1)
    return float(len(KEPT)) * 1e-12 + 1.0

def grow(x):
    KEPT.append(1)
    return x[: len(KEPT)]

def cut(total):
    return int(total[0] * 1e12) % 1000

def once(x):
    KEPT.append(1)
    if len(KEPT) > 1:
        raise ValueError("only once")
    return x

def seeded(x, seed):
    return x + np.random.default_rng(seed).standard_normal(x.shape)
"""
X = np.random.default_rng(7).random(5000)


def graph(*names, **more):
    functions = notebook(SOURCE)
    return ep.CompGraph.from_functions(*(functions[name] for name in names), **more)


def learnt(cg, outputs, hparams=None, payload=None):
    runner = ep.CompGraphRunner(cg, hparams)
    run = runner.run(**(payload or {"x": X}))
    told = []
    found = learn(cg, runner.hyperparameters, [run], outputs, told.append)
    assert runner.last is run, "the user's runner stays as it is"
    return found, told


def test_what_computes_the_same_has_no_tolerance_and_is_run_three_times():
    found, told = learnt(graph("exact"), ["exact"])
    assert (found.tolerances, found.reasons) == ({}, ())
    assert told == [f"running the functions again to learn what they repeat: {n} of {RUNS}" for n in (1, 2, 3)]


def test_a_seed_that_is_a_token_makes_random_numbers_the_same():
    assert learnt(graph("seeded"), ["seeded"], {"seed": 5})[0].reasons == ()


def test_a_default_that_was_unfrozen_is_taken_from_the_payload():
    cg = ep.CompGraph.from_functions(notebook("def shift(x, by=2.0):\n    return x + by\n")["shift"])
    runner = ep.CompGraphRunner(cg)
    runner.unfreeze("by")
    run = runner.run(x=X, by=5.0)
    assert learn(cg, runner.hyperparameters, [run], ["shift"], print).reasons == ()


def test_noise_is_tolerated_ten_times_as_large_as_it_was():
    found, _ = learnt(graph("total"), ["total"])
    (tolerance,) = found.tolerances.values()
    assert found.reasons == ()
    assert 0 < tolerance.absolute < 1e-9 * SAFETY
    assert tolerance.relative == pytest.approx(tolerance.absolute / X.sum(), rel=0.7)


@pytest.mark.parametrize(
    ("names", "output", "words"),
    [
        (
            ["draw"],
            "draw",
            "Function 'draw' .*token 'draw': 5000 of 5000 values differ.*It draws random numbers without a seed.*seed",
        ),
        (["clock"], "clock", "Function 'clock' .*(looks at a clock).*as a token"),
        (["count"], "count", "Function 'count' .*goes further away from run to run.*as a token"),
        (["grow"], "grow", r"Function 'grow' .*expected float64 \(1,\), got float64 \(2,\)"),
        (["total", "cut"], "cut", "Function 'total' .*token 'total'.*noise.*So 'cut' can't be verified.*Round"),
        (["draw", "cut"], "cut", "Function 'draw' .*So 'cut' can't be verified"),
    ],
)
def test_what_is_no_noise_is_refused_with_the_first_function_that_differs(names, output, words):
    functions = notebook(SOURCE)
    io = {"draw": ("x", "total")} if names == ["draw", "cut"] else {names[0]: ("x", names[0])}
    if "cut" in names:
        io["cut"] = ("total", "cut")
    found, _ = learnt(ep.CompGraph({name: functions[name] for name in names}, io), [output])
    (reason,) = found.reasons
    assert re.search(words, reason), reason
    assert found.tolerances == {}


def test_an_input_that_was_written_into_after_the_run_is_not_blamed_on_random_numbers():
    runner = ep.CompGraphRunner(ep.CompGraph({"add": np.add}, {"add": (("x", "k"), "y")}), {"k": 2.0})
    x = np.ones(4)
    run = runner.run(x=x)
    x[:] = 7
    (reason,) = learn(runner.cg, runner.hyperparameters, [run], ["y"], [].append).reasons
    assert "It computes the same whenever it is run now" in reason
    assert "an array that it takes was written into" in reason
    assert "random" not in reason


def test_a_function_that_fails_the_second_time_is_named():
    with pytest.raises(BundleError, match="function 'once' raised ValueError: only once.*Make that a token"):
        learnt(graph("once"), ["once"])


def test_tokens_between_that_differ_are_no_reason_if_the_outputs_agree():
    cg = ep.CompGraph(
        {"draw": notebook(SOURCE)["draw"], "shape": np.shape}, {"draw": ("x", "noisy"), "shape": ("noisy", "shape")}
    )
    assert learnt(cg, ["shape"])[0] == learnt(cg, ["shape"])[0]
    assert learnt(cg, ["shape"])[0].reasons == ()


def test_the_nodes_and_pipelines_of_the_user_are_not_run_again():
    functions = notebook(SOURCE)
    inner = ep.Pipeline("inner", ep.CompGraph({"exact": functions["exact"]}, {"exact": ("x", "y")}))
    node = ep.Node("node", functions["exact"])
    cg = ep.CompGraph({"inner": inner, "node": node}, {"inner": ("x", "a"), "node": ("a", "b")})
    learnt(cg, ["b"])
    assert node.run_count == 1
    assert inner.run_count == 1


@pytest.mark.slow
@pytest.mark.usefixtures("fresh_interpreter")
def test_a_noisy_token_is_promoted_with_its_tolerance_and_verified_by_it(tmp_path):
    runner = ep.CompGraphRunner(graph("total"))
    runner.run(x=X)
    bundle = ep.promote(runner, tmp_path / "total")
    assert verify(bundle.path).identical
    text = (bundle.path / "pipeline.toml").read_text()
    assert "[tolerance.total]\n# 3 more runs in the notebook gave other last digits" in text
    assert read_settings(bundle.path / "pipeline.toml").tolerances == bundle.settings.tolerances
    assert bundle.settings.tolerances["total"].absolute > 0


def test_promotion_refuses_what_draws_random_numbers_and_writes_nothing(tmp_path):
    runner = ep.CompGraphRunner(graph("draw"))
    runner.run(x=X)
    with pytest.raises(PromotionRefused, match="Function 'draw' does not compute the same again"):
        ep.promote(runner, tmp_path / "draw")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("bound", ["-1.0", "nan", "inf", '"1"', "true"])
def test_a_tolerance_that_is_no_number_is_refused(bound, tmp_path):
    text = '[bundle]\nformat = 1\nname = "x"\n[ports]\ninputs = []\noutputs = ["y"]\n[tolerance.y]\n'
    (tmp_path / "p.toml").write_text(f"{text}absolute = {bound}\nrelative = 0.0\n")
    with pytest.raises(BundleError, match="tolerance of 'y'"):
        read_settings(tmp_path / "p.toml")
    (tmp_path / "p.toml").write_text(f"{text}absolute = 0.0\n")
    with pytest.raises(BundleError, match="lacks 'relative'"):
        read_settings(tmp_path / "p.toml")
    assert read_tolerances({}) == {}


def test_both_bounds_of_a_tolerance_hold():
    expected, near, far = np.array([1.0, 1000.0]), np.array([1.0, 1000.5]), np.array([1.0, 1002.0])
    tolerance = Tolerance(1.0, 1e-3)
    assert first_difference(expected, near, tolerance) is None
    assert "1 of 2 values differ, first at [1]" in str(first_difference(expected, far, tolerance))
    assert first_difference(expected, near, Tolerance(1.0, 1e-4)) is not None
    assert first_difference(expected, near, Tolerance(0.1, 1.0)) is not None


@pytest.mark.parametrize(
    ("expected", "got"),
    [
        (np.array([1.0, np.nan]), np.array([1.0, 2.0])),
        (np.array([np.inf]), np.array([1e300])),
        (np.array([1], "i4"), np.array([2], "i4")),
        (1.0, float("nan")),
        (1, 2),
        ("a", "b"),
        (np.zeros(2), np.zeros(3)),
        ([1.0], [1.0, 1.0]),
        ({1}, {2}),
        (1.0, 1),
    ],
)
def test_no_tolerance_covers_other_kinds_of_difference(expected, got):
    assert next(differences(expected, got, Tolerance(1e9, 1e9))).text


def test_a_small_number_beside_a_large_one_has_a_tolerance_of_its_own():
    expected, tolerance = np.array([1e5, 0.5]), Tolerance(10.0, 1e-4)
    assert first_difference(expected, np.array([1e5 + 9, 0.50004]), tolerance) is None
    assert "first at [1]" in str(first_difference(expected, np.array([1e5, 0.5001]), tolerance))
    assert first_difference(expected, np.array([1e5 + 11, 0.5]), tolerance) is not None


def test_random_numbers_beside_a_large_one_are_no_noise():
    functions = notebook(
        "def beside(x):\n    return np.r_[1e5, np.random.default_rng().choice([0.5, 1.5, 2.5, 3.5, 4.5], 20)].astype('f4')\n"
        "def cancelled(x):\n    return np.r_[1e9, np.random.default_rng().choice([1e-8, 2e-8], 20)]\n"
    )
    beside, cancelled = (ep.CompGraph.from_functions(functions[name]) for name in ("beside", "cancelled"))
    assert "draws random numbers" in learnt(beside, ["beside"])[0].reasons[0]
    found, _ = learnt(cancelled, ["cancelled"])
    assert found.reasons == ()
    assert found.tolerances["cancelled"].relative < 1e-6


def test_infinities_and_nans_that_stay_are_covered():
    expected = np.array([np.nan, np.inf, 1.0, 0.0])
    assert first_difference(expected, np.array([np.nan, np.inf, 1.0 + 1e-15, -0.0]), Tolerance(1e-12, 1e-12)) is None


POINT = cv2.KeyPoint(1, 2, 3, 4, 5, 6, 7)


@pytest.mark.parametrize(
    ("left", "right", "where"),
    [
        ([POINT], [cv2.KeyPoint(1, 2, 3, 4, 5.5, 6, 7)], "[0].response"),
        ((cv2.DMatch(1, 2, 0, 0.5),), (cv2.DMatch(1, 3, 0, 0.5),), "[0].trainIdx"),
        (pd.DataFrame({"a": [1.0, 2.0]}), pd.DataFrame({"a": [1.0, 2.5]}), "['a'][1]"),
        ({"k": [np.zeros((2, 2)), 1]}, {"k": [np.eye(2), 1]}, "['k'][0][0, 0]"),
    ],
)
def test_a_difference_says_where_it_is_how_many_there_are_and_how_large(left, right, where):
    found = difference("000", "t", differences(left, right))
    assert (found.index, found.count >= 1, found.largest > 0) == (where, True, True)
    assert difference("000", "t", differences(left, left)) is None
