"""What a notebook has made by calling a function is made again only where that gives the same."""

from __future__ import annotations

import functools
import operator

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.errors import PromotionRefused
from tests.bundle.hostile import in_notebook
from tests.bundle.slicing import slice_graph


def sliced(monkeypatch, *cells, **functions):
    """Return what the slicer makes of functions of a notebook: its definitions, constants and refusals."""
    names = in_notebook(monkeypatch, *cells, functools=functools, cv2=cv2, np=np)
    gathered, _ = slice_graph({name: eval(source, names) for name, source in functions.items()})
    return gathered


FACTORY = "GAIN = 2\ndef make(k):\n    w = k * GAIN\n    def f(a):\n        return a * w + k\n    return f\nf = make(3)"


def test_a_factory_is_called_again_where_that_captures_the_same(monkeypatch):
    found = sliced(monkeypatch, FACTORY, f="f")
    assert found.definitions["f"].text == "f = make(3)\n"
    assert found.refusals == []


def test_a_factory_that_reads_what_has_changed_since_is_not_called_again(monkeypatch):
    found = sliced(monkeypatch, FACTORY, "GAIN = 9", f="f")
    assert found.constants == {"k": "3", "w": "6"}
    assert found.definitions["f"].text.startswith("def f(a)")


def test_two_closures_of_one_factory_may_have_computed_arrays(monkeypatch):
    cell = (
        "def make(size):\n    weights = np.ones(size) / size\n    shape = cv2.getStructuringElement(cv2.MORPH_RECT, (size, size))\n"
        "    def f(a):\n        return cv2.erode(cv2.filter2D(a, -1, weights), shape) + size\n    return f\nf, g = make(3), make(5)"
    )
    found = sliced(monkeypatch, cell, f="f", g="g")
    assert found.refusals == []
    assert (found.definitions["f"].text, found.definitions["g"].text) == ("f = make(3)\n", "g = make(5)\n")


@pytest.mark.parametrize(
    "line",
    [
        "w = np.random.rand()",
        "w = np.fromfile('/proc/version', 'u1').size",
        "w = GAIN if k else 0",
        "w = 0\n    w = GAIN",
        "w = [x for x in (GAIN,)][0]",
    ],
)
def test_a_factory_whose_work_nobody_can_repeat_is_not_called_again(monkeypatch, line):
    cell = f"GAIN = 2\ndef make(k):\n    {line}\n    def f(a):\n        return a * w + k\n    return f\nf = make(3)"
    found = sliced(monkeypatch, cell, f="f")
    assert found.refusals == []
    assert found.constants.keys() == {"k", "w"}


def test_a_factory_that_writes_into_its_argument_is_not_called_again(monkeypatch):
    cell = "def make(t):\n    t.append(1)\n    def f(a):\n        return a + len(t)\n    return f\nf = make([0])"
    assert sliced(monkeypatch, cell, f="f").constants == {"t": "[0, 1]"}


def test_a_factory_that_chooses_what_it_defines_is_not_called_again(monkeypatch):
    cell = (
        "FAST = True\ndef make(k):\n    if FAST:\n        def f(a):\n            return a + k\n    else:\n"
        "        def f(a):\n            return a - k\n    return f\nf = make(3)"
    )
    found = sliced(monkeypatch, cell, "FAST = False", f="f")
    assert found.constants == {"k": "3"}


def test_what_a_list_was_when_a_factory_copied_it_is_kept(monkeypatch):
    cell = "def make(t):\n    w = dict(t)\n    def f(a):\n        return a + w['k'] + t['k']\n    return f\nT = {'k': 1}\nf = make(T)"
    assert sliced(monkeypatch, cell, "T['k'] = 9", f="f").constants == {"w": '{"k": 1}', "t": '{"k": 9}'}


def test_a_closure_keeps_its_own_default(monkeypatch):
    cell = "G = 2\ndef make(k):\n    def f(a, g=G):\n        return a * k + g\n    return f\nf = make(3)"
    assert sliced(monkeypatch, cell, f="f").definitions["f"].text == "f = make(3)\n"
    reasons = sliced(monkeypatch, cell, "G = 5", f="f").refusals
    assert len(reasons) == 1
    assert "default 'G'" in reasons[0]


def test_helpers_inside_of_a_factory_are_made_by_it(monkeypatch):
    cell = (
        "def make(k):\n    twice = k * 2\n    def inner(a):\n        return a * twice\n    def f(a):\n        return inner(a) + k\n"
        "    return f\nf = make(3)"
    )
    found = sliced(monkeypatch, cell, f="f")
    assert found.refusals == []
    assert found.definitions["f"].text == "f = make(3)\n"


@pytest.mark.parametrize(
    ("cell", "known"),
    [
        ("K = [0]\ndef g(k):\n    operator.iadd(k, [1])\ndef f(a):\n    g(K)\n    return a", "K"),
        ("K = np.zeros(3)\ndef f(a):\n    np.ndarray.__iadd__(K, 1)\n    return a", "K"),
        (
            "def make(k):\n    def f(a):\n        operator.iadd(k, [1])\n        return a\n    return f\nf = make([1])",
            "k",
        ),
    ],
)
def test_what_a_function_changes_out_of_sight_is_seen_when_it_is_run_again(monkeypatch, tmp_path, cell, known):
    names = in_notebook(monkeypatch, cell, operator=operator, np=np)
    runner = ep.CompGraphRunner(ep.CompGraph({"f": names["f"]}, {"f": ("a", "b")}))
    runner.run(a=3)
    with pytest.raises(PromotionRefused, match=f"'f' changes '{known}' from run to run.* make it a token"):
        ep.promote(runner, tmp_path / "b")
