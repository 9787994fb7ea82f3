"""In which ways can a graph be run?"""

from __future__ import annotations

import contextlib

import pytest

import epypes as ep
from epypes.run import attempt, compiled, gain

# Enough that the later ones are compiled.
RUNS = 6


class Way:
    """One way to run: step by step, compiled once it was repeated, or side by side in threads."""

    def __init__(self, name, monkeypatch):
        self.name, self.runs, self._monkeypatch = name, RUNS, monkeypatch

    def runner(self, cg, hparams=None, **more):
        workers = 2 if self.name == "side by side" else 1
        return ep.CompGraphRunner(cg, hparams, workers=workers, **more)

    @contextlib.contextmanager
    def is_taken(self):
        """What is run within goes this way."""
        names = {
            "execute": "step by step",
            "execute_from_scratch": "step by step",
            "execute_side_by_side": "side by side",
        }
        found = []

        def noting(function):
            return lambda *args: (found.append(names[function.__name__]), function(*args))[1]

        with self._monkeypatch.context() as patch:
            for name in names:
                patch.setattr(attempt, name, noting(getattr(attempt, name)))
            yield
        assert found == [name for name in (self.name,) if name != "compiled"]


@pytest.fixture(params=["step by step", "compiled", "side by side"])
def way(request, monkeypatch):
    """Every run of the test goes this way; of compiled ones, those that were repeated."""
    if request.param == "step by step":
        monkeypatch.setattr(compiled, "_RUNS_BEFORE", 10_000)
    if request.param == "side by side":
        monkeypatch.setattr(attempt, "has_independent_steps", lambda program: True)
        monkeypatch.setattr(gain.Gain, "is_worth_it", lambda self: True)
    return Way(request.param, monkeypatch)
