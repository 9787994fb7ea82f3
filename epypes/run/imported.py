"""Runs of functions that another process executed: their values, times and failure as Runs of this process."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from epypes.graph import CompGraph
from epypes.run.failure import Failure
from epypes.run.hyperparameters import Hyperparameters
from epypes.run.program import Program
from epypes.run.record import Run
from epypes.run.tokens import NOT_COMPUTED, Freshness


class RunImporter:
    """Makes Runs of one graph from values that were computed elsewhere.

    Parameters
    ----------
    cg
        The graph; its functions are not called.
    """

    def __init__(self, cg: CompGraph) -> None:
        self._program = Program(cg, True)

    def run(
        self,
        tokens: Mapping[str, Any],
        hyperparameters: Mapping[str, Any],
        *,
        first_hyperparameters: Mapping[str, Any] | None = None,
        revision: int = 0,
        durations_ns: Mapping[str, int] | None = None,
        total_ns: int = 0,
        failure: Failure | None = None,
    ) -> Run:
        """Return a run in which these tokens are computed and up to date, and all others are not computed.

        Parameters
        ----------
        tokens
            Values by token; what is no token of the graph is left out.
        hyperparameters, first_hyperparameters
            Their values in this run, and when they were frozen.
        revision
            Of the hyperparameters.
        durations_ns
            Nanoseconds by function.
        total_ns
            Of the whole run.
        failure
            Of the function that failed, if one did.
        """
        program, first = self._program, first_hyperparameters or {}
        slots = [NOT_COMPUTED] * len(program.tokens)
        for token, value in {**tokens, **hyperparameters}.items():
            if token in program.slots:
                slots[program.slots[token]] = value
        entries = {token: (value, first.get(token, value)) for token, value in hyperparameters.items()}
        # No function is out of date; but not every token has a value, so the run must not be taken for a whole one.
        freshness = Freshness(program, bytes(len(program.steps)), False, program.revisions())
        known = durations_ns or {}
        by_step = {step.place: known[step.name] for step in program.steps if step.name in known}
        failed_at = next((step.place for step in program.steps if failure and step.name == failure.function), -1)
        times = (program, None, by_step, total_ns, False, failed_at)
        return Run((slots, freshness, Hyperparameters(program, entries, revision), times, failure))
