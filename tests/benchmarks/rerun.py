"""What does a new result cost after one hyperparameter changed?"""

from __future__ import annotations

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np

from tests.benchmarks import ours, peers
from tests.benchmarks.row import OURS, Goal, Row, row
from tests.benchmarks.timing import Effort
from tests.benchmarks.work import Work, add_one, passed, tuned_chain

_COUNT = 100
_ROUNDS = 2000
_EIGHT_MB = 1_000_000  # float64 values


def _sum(x: int, k: int) -> int:
    return x + k


def _first_value(x: np.ndarray, k: int) -> int:
    return x[0] + k


def rows(effort: Effort) -> list[Row]:
    numbers = tuned_chain(_COUNT, add_one, 0, _sum)
    arrays = tuned_chain(_COUNT, passed, np.zeros(_EIGHT_MB), _first_value)
    uncached = "" if effort.quick else "pipefunc without its cache, which hashes arrays"
    return [
        _row(effort, f"rerun of the last of {_COUNT}", numbers, _COUNT - 1, tuned=True),
        _row(effort, f"rerun of the last of {_COUNT}, 8 MB array", arrays, arrays.payload["t0"], note=uncached),
    ]


def _row(effort: Effort, name: str, work: Work, above: Any, *, tuned: bool = False, note: str = "") -> Row:
    last, runner = work.functions["last"], ours.runner(work)
    runner.run(**work.payload)
    others = peers.built(effort, work, tuned=tuned)
    for peer in others.values():
        peer.run()
    contenders = {
        "by hand": _each_new(lambda k: last(above, k)),
        OURS: _each_new(lambda k: runner.rerun(k=k)["y"]),
        **{name: _each_new(lambda k, peer=peer: peer.rerun("k", k)) for name, peer in others.items()},
    }
    return row(name, effort.measure(contenders, _ROUNDS), goal=Goal("total", 2_000), note=note)


def _each_new(retuned: Callable[[int], Any]) -> Callable[[], Any]:
    """Return a call that gives a value never given before; every contender counts for itself."""
    values = itertools.count(1)
    return lambda: retuned(next(values))
