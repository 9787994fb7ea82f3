"""The ways in which a graph can be run: step by step, compiled, side by side."""

from __future__ import annotations

import contextlib

import pytest

import epypes as ep
from epypes.run import execute

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
        found = []

        def noting(name, function):
            return lambda *args: (found.append(name), function(*args))[1]

        with self._monkeypatch.context() as patch:
            patch.setattr(execute, "run_one_by_one", noting("step by step", execute.run_one_by_one))
            patch.setattr(execute.SideBySide, "run", noting("side by side", execute.SideBySide.run))
            yield
        assert found == [name for name in (self.name,) if name != "compiled"]


@pytest.fixture(params=["step by step", "compiled", "side by side"])
def way(request, monkeypatch):
    """Every run of the test goes this way; of compiled ones, those that were repeated."""
    if request.param == "step by step":
        monkeypatch.setattr(execute, "RUNS_BEFORE", 10_000)
    if request.param == "side by side":
        monkeypatch.setattr(execute, "has_independent_steps", lambda program: True)
        monkeypatch.setattr(execute.Gain, "is_worth_it", lambda self: True)
    return Way(request.param, monkeypatch)
