"""What computes the same each time is compared to the last bit, noise is tolerated, everything else is refused by name."""

from __future__ import annotations

import gc

import cv2
import numpy as np
import pandas as pd
import pytest

import epypes as ep
from epypes.bundle import verify
from epypes.bundle.proof.compare import SAFETY, Tolerance, difference, differences, first_difference, read_tolerances
from epypes.bundle.settings import read_settings
from epypes.errors import BundleError, PromotionRefused
from tests.bundle.hostile import in_notebook
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

def tick(x):
    return time.monotonic_ns() * 1e-16 + 1.0

def cut(total):
    return int(total[0] * 1e12) % 1000

def seeded(x, seed):
    return x + np.random.default_rng(seed).standard_normal(x.shape)
"""
X = np.random.default_rng(7).random(5000)


def graph(*names, **more):
    functions = notebook(SOURCE)
    return ep.CompGraph.from_functions(*(functions[name] for name in names), **more)


def promoted(cg, to, hparams=None, outputs=None):
    """Run a graph and promote it; the user's runner stays as it is."""
    runner = ep.CompGraphRunner(cg, hparams)
    run = runner.run(x=X)
    bundle = ep.promote(runner, to / "bundle", outputs)
    assert runner.last is run
    return bundle


def test_a_draw_without_a_seed_on_a_branch_that_no_sample_takes_is_noted(tmp_path):
    source = (
        "import random\nfrom skimage.util import random_noise\ndef sample(x):\n"
        "    return random_noise(x) * random.choice([1, 2]) if x.mean() > 1 else 0\n"
    )
    runner, notes = ep.CompGraphRunner(ep.CompGraph.from_functions(notebook(source)["sample"])), []
    runner.run(x=X)
    ep.promote(runner, tmp_path / "bundle", on_progress=notes.append)
    draws = ["'choice' from the random generator of random, which nothing seeds"]
    draws.append("'random_noise' from the random generator of the operating system: each answer is another one")
    assert all(any(f"'sample' draws by {draw}" in note for note in notes) for draw in draws)


def test_what_computes_the_same_has_no_tolerance(tmp_path):
    assert promoted(graph("exact"), tmp_path).settings.tolerances == {}


def test_a_seed_that_is_a_token_makes_random_numbers_the_same(tmp_path):
    assert promoted(graph("seeded"), tmp_path, {"seed": 5}).settings.tolerances == {}


def test_a_default_that_was_unfrozen_is_taken_from_the_payload(tmp_path):
    cg = ep.CompGraph.from_functions(notebook("def shift(x, by=2.0):\n    return x + by\n")["shift"])
    runner = ep.CompGraphRunner(cg)
    runner.unfreeze("by")
    runner.run(x=X, by=5.0)
    assert ep.promote(runner, tmp_path / "bundle").settings.inputs == ("x", "by")


@pytest.mark.parametrize(
    ("names", "words"),
    [
        (["draw"], "token 'draw': 5000 of 5000 values differ.*function 'draw' is called.*default_rng"),
        (["clock"], "token 'clock': .*function 'clock' is called.*Pass a time"),
        (["tick"], "token 'tick': .*function 'tick' is called"),
        (["total", "cut"], "token 'cut': .*function 'total' is called.*noise"),
        (["draw", "cut"], "token 'cut': .*function 'draw' is called"),
    ],
)
def test_what_is_no_noise_is_refused_with_the_first_function_that_differs(names, words, tmp_path):
    functions = notebook(SOURCE)
    io = {"draw": ("x", "total")} if names == ["draw", "cut"] else {names[0]: ("x", names[0])}
    if "cut" in names:
        io["cut"] = ("total", "cut")
    with pytest.raises(PromotionRefused, match=words):
        promoted(ep.CompGraph({name: functions[name] for name in names}, io), tmp_path)
    assert list(tmp_path.iterdir()) == []


# By name: what a cell does, how a function draws on a branch that no sample takes, and what the reason says of it.
SEEDED_ELSEWHERE = {
    "cell": ("np.random.seed(3)", "np.random.normal()", r"'draw' draws by 'normal' from .* of numpy\.random, which the notebook seeds \(.*line 2\)"),
    "another function": ("", "np.random.normal()", r"'draw' draws by 'normal' .*, which function 'scaled' seeds; .* Seed it in 'draw', or"),
    "a library": ("np.random.seed(3)", "vq.kmeans2(scaled, 2)[0] + vq.kmeans2(scaled, 2, seed=1)[0]", r"'draw' draws by 'kmeans2' from .* of numpy\.random, which the notebook seeds"),
}  # fmt: skip


@pytest.mark.parametrize("case", SEEDED_ELSEWHERE)
def test_a_draw_after_a_seed_of_a_cell_or_another_function_is_refused(case, monkeypatch, tmp_path):
    cell, draw, words = SEEDED_ELSEWHERE[case]
    seed = "    np.random.seed(3)\n" * (not cell)
    source = (
        f"import numpy as np\n{cell}\nfrom scipy.cluster import vq\ndef scaled(x):\n{seed}    return x * 2\n"
        f"def draw(scaled):\n    return {draw} if scaled.mean() > 100 else np.random.default_rng(1).random()"
    )
    names = in_notebook(monkeypatch, source)
    with pytest.raises(PromotionRefused, match=words):
        promoted(ep.CompGraph.from_functions(names["scaled"], names["draw"]), tmp_path)


def test_a_service_has_not_the_environment_that_a_cell_has_set(monkeypatch, tmp_path):
    cell = (
        "import os, subprocess\nos.environ['EPYPES_CELL'] = '1'\ndef said(x):\n"
        "    return subprocess.run(['printenv', 'EPYPES_CELL'], capture_output=True).stdout"
    )
    monkeypatch.setenv("EPYPES_CELL", "0")  # is put back in the end
    names = in_notebook(monkeypatch, cell)
    with pytest.raises(
        PromotionRefused, match=r"changed the environment \(cell \[1\], line 2\); a service has its own"
    ):
        promoted(ep.CompGraph.from_functions(names["said"]), tmp_path)


def test_an_input_that_was_written_into_after_the_run_is_not_blamed_on_random_numbers(tmp_path):
    runner = ep.CompGraphRunner(ep.CompGraph({"add": np.add}, {"add": (("x", "k"), "y")}), {"k": 2.0})
    x = np.ones(4)
    runner.run(x=x)
    x[:] = 7
    with pytest.raises(
        PromotionRefused, match="If an array was written into after the run, run the graph again"
    ) as caught:
        ep.promote(runner, tmp_path / "bundle")
    assert "random" not in str(caught.value)


def test_a_function_that_fails_the_second_time_is_named(tmp_path):
    source = (
        "import gc\ndef once(x):\n    if gc.get_threshold()[0] == 1717:\n        raise ValueError('only once')\n"
        "    gc.set_threshold(1717)\n    return x\n"
    )
    threshold = gc.get_threshold()
    runner = ep.CompGraphRunner(ep.CompGraph.from_functions(notebook(source)["once"]))
    try:
        runner.run(x=X)
    finally:
        gc.set_threshold(*threshold)
    with pytest.raises(PromotionRefused, match=r"pipeline.py, line \d+: raise ValueError.*only once"):
        ep.promote(runner, tmp_path / "bundle")


def test_tokens_between_that_differ_are_no_reason_if_the_outputs_agree(tmp_path):
    cg = ep.CompGraph(
        {"draw": notebook(SOURCE)["draw"], "shape": np.shape}, {"draw": ("x", "noisy"), "shape": ("noisy", "shape")}
    )
    assert promoted(cg, tmp_path).settings.tolerances == {}


def test_the_nodes_and_pipelines_of_the_user_are_not_run_again(tmp_path):
    functions = notebook(SOURCE)
    inner = ep.Pipeline("inner", ep.CompGraph({"exact": functions["exact"]}, {"exact": ("x", "y")}))
    node = ep.Node("node", functions["exact"])
    promoted(ep.CompGraph({"inner": inner, "node": node}, {"inner": ("x", "a"), "node": ("a", "b")}), tmp_path)
    assert node.run_count == 1
    assert inner.run_count == 1


@pytest.mark.slow
@pytest.mark.usefixtures("fresh_interpreter")
def test_a_noisy_token_is_promoted_with_a_tolerance_and_verified_by_it(tmp_path):
    bundle = promoted(graph("total"), tmp_path)
    tolerance = bundle.settings.tolerances["total"]
    assert 0 < tolerance.absolute < 1e-9 * SAFETY
    assert tolerance.relative == pytest.approx(tolerance.absolute / X.sum(), rel=0.7)
    assert verify(bundle.path).identical
    text = (bundle.path / "pipeline.toml").read_text()
    assert "[tolerance.total]\n# Replays of the samples gave other last digits" in text
    assert read_settings(bundle.path / "pipeline.toml").tolerances == bundle.settings.tolerances


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


def test_random_numbers_beside_a_large_one_are_no_noise(tmp_path):
    functions = notebook(
        "import numpy as np\n"
        "def beside(x):\n    return np.r_[1e5, np.random.default_rng().choice([0.5, 1.5, 2.5, 3.5, 4.5], 20)].astype('f4')\n"
        "def cancelled(x):\n    return np.r_[1e9, np.random.default_rng().choice([1e-8, 2e-8], 20)]\n"
    )
    beside, cancelled = (ep.CompGraph.from_functions(functions[name]) for name in ("beside", "cancelled"))
    with pytest.raises(PromotionRefused, match="function 'beside' is called"):
        promoted(beside, tmp_path)
    assert promoted(cancelled, tmp_path).settings.tolerances["cancelled"].relative < 1e-6


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
