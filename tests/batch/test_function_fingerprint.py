"""Are metrics told from each other by what they compute, and those that nobody can tell refused?"""

from __future__ import annotations

import functools
import subprocess
import sys
import textwrap
import threading
import types
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

import epypes as ep
from epypes.batch.cache import NoDigest, function_digest


def made(source: str, **names: Any) -> Any:
    """Return the function that source defines in a notebook where names have these values."""
    notebook = {"__name__": "__main__", **names}
    exec(textwrap.dedent(source), notebook)
    return notebook["metric"]


def within(limit: Any) -> Callable[..., Any]:
    return lambda tokens, case: tokens["y"] < limit


def of_module(text: str) -> types.ModuleType:
    module = types.ModuleType("ours")
    exec(text, vars(module))
    return module


CALLS = "def metric(tokens, case): return helper(tokens)"
READS = "def metric(tokens, case): return tokens['y'] + weights['a'][0].sum()"
ASKS = "def metric(tokens, case): return ours.far(tokens)"
NESTED = "def metric(tokens, case): return sum((lambda y: y * weight)(y) for y in tokens.values())"
CLASS = """
class Scale:
    factor = {factor}
    def apply(self, y): return y * self.factor{sign}2
def metric(tokens, case): return Scale().apply(tokens["y"])
"""
PAIRS = {
    "code": (made("def metric(tokens, case): return 1"), made("def metric(tokens, case): return 2")),
    "kinds of constants": (made("metric = lambda tokens, case: 1"), made("metric = lambda tokens, case: True")),
    "lambdas on one line": (lambda tokens, case: tokens["a"], lambda tokens, case: tokens["b"]),
    "closures": (within(3), within(4)),
    "arrays": (within(np.zeros(10_000)), within(np.eye(100).ravel())),
    "keywords": (functools.partial(max, key=abs), functools.partial(max, key=len)),
    "arguments": (functools.partial(within, 1), functools.partial(within, 2)),
    "defaults": (made("def metric(tokens, case, k=1): return k"), made("def metric(tokens, case, k=2): return k")),
    "functions called": (made(CALLS, helper=within(1)), made(CALLS, helper=within(2))),
    "globals": (made(READS, weights={"a": [np.ones(3)]}), made(READS, weights={"a": [np.zeros(3)]})),
    "globals of nested functions": (made(NESTED, weight=1), made(NESTED, weight=2)),
    "modules of the user": (
        made(ASKS, ours=of_module("def far(tokens): return 1")),
        made(ASKS, ours=of_module("def far(tokens): return 2")),
    ),
    "classes": (made(CLASS.format(factor=1, sign="+")), made(CLASS.format(factor=1, sign="-"))),
    "attributes of classes": (made(CLASS.format(factor=1, sign="+")), made(CLASS.format(factor=2, sign="+"))),
    "installed": (np.mean, np.max),
    "compiled": (cv2.norm, cv2.countNonZero),
    "built in": (max, min),
    "cached": (functools.lru_cache(within(1)), functools.lru_cache(within(2))),
    "methods": ({1: 2}.get, {1: 3}.get),
}


@pytest.mark.parametrize("what", PAIRS)
def test_metrics_that_compute_something_else_are_told_apart_and_one_is_itself(what: str) -> None:
    one, other = PAIRS[what]
    assert function_digest(one) == function_digest(one) != function_digest(other)


def test_metrics_that_are_made_anew_are_the_same() -> None:
    assert function_digest(within(np.arange(5))) == function_digest(within(np.arange(5)))
    assert function_digest(made(READS, weights={"a": [1]}, other=1)) == function_digest(
        made("\n\n" + READS, other=2, weights={"a": [1]})
    )


def test_a_function_that_calls_itself_has_a_digest() -> None:
    calls_itself = "def metric(tokens, case): return metric(tokens, case) if case else 1"
    assert function_digest(made(calls_itself)) == function_digest(made(calls_itself))


class Near:
    limit = 1.0

    def __init__(self, held: Any) -> None:
        self.held = held

    def __call__(self, tokens: Any, case: ep.Case) -> float:
        return self.limit


@pytest.mark.parametrize(
    "metric",
    [
        Near(cv2.ORB_create()),
        within(cv2.ORB_create()),
        within(x for x in ()),
        functools.partial(within, x=(n for n in ())),
        made(READS, weights={"a": [threading.local()]}),
        made("def metric(tokens, case): return eval('tokens')"),
        np.frompyfunc(lambda tokens, case: 1, 2, 1),
    ],
)
def test_what_nobody_can_see_through_is_refused(metric: Any) -> None:
    with pytest.raises(NoDigest):
        function_digest(metric)


def test_objects_are_told_by_what_is_in_them() -> None:
    assert function_digest(Near(1)) == function_digest(Near(1)) != function_digest(Near(2))


@pytest.mark.slow
def test_a_metric_is_the_same_in_another_process(tmp_path: Path) -> None:
    script = tmp_path / "script.py"
    script.write_text(
        "from epypes.batch.cache import function_digest\n"
        "words = {'a', 'b', 'c'}\n"
        "def metric(tokens, case): return case in {'x', 'y', 'z', 'w'} and tokens in words\n"
        "print(function_digest(metric))\n"
    )
    found = {
        subprocess.run(
            [sys.executable, str(script)], env={"PYTHONHASHSEED": seed}, check=True, capture_output=True, text=True
        ).stdout
        for seed in ("1", "2", "3")
    }
    assert len(found) == 1
