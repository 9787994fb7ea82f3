"""How does one run go, from values of source tokens to tokens, times and perhaps a failure?"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from time import perf_counter_ns
from typing import Any

from epypes.run.call import StepFailed
from epypes.run.compiled import CompiledRuns
from epypes.run.draft import Draft
from epypes.run.engine import execute
from epypes.run.failure import Failure, failure_of
from epypes.run.need import check_ready, wanted_steps
from epypes.run.program import Program
from epypes.run.report import Times
from epypes.run.tokens import Freshness

# What Run is made of, but for the hyperparameters.
Outcome = tuple[list[Any], Freshness, Times, Failure | None]

_INVERTED = bytes((1, 0)).ljust(256)


class Attempts:
    """Runs a program; knows which runs have been repeated.

    Every method takes ``start_ns``, when the run began on the clock of ``perf_counter_ns``.

    Attributes
    ----------
    compiled
        The runs that have been repeated.
    clean
        What is up to date after a run of everything.
    """

    def __init__(self, program: Program) -> None:
        self._program = program
        self.compiled = CompiledRuns(program)
        self.clean = Freshness(program, bytes(len(program.steps)), True)

    def whole(self, values: list[Any], has_payload: bool, targets: Sequence[str], start_ns: int) -> Outcome:
        """Run all that the targets need, everything without, from values of source tokens, which are changed.

        Raises
        ------
        PayloadError, PlaceholderNeeded
            Something is needed that is not there.
        """
        program = self._program
        wanted = wanted_steps(program, values, targets) if targets or program.switches else None
        if program.placeholders or not has_payload:
            check_ready(program, values, wanted)
        compiled = self.compiled.of_steps(wanted)
        if compiled is None:
            return _step_by_step(Draft.of_sources(program, values, has_payload), wanted, start_ns)
        try:
            durations_ns = compiled(values)
        except StepFailed as failed:
            return self.run_broken_off(values, failed, wanted, has_payload, start_ns)
        freshness = self.clean
        if wanted is not None or not has_payload:
            dirty = bytes(len(program.steps)) if wanted is None else wanted.translate(_INVERTED)
            freshness = Freshness(program, dirty, has_payload)
        return values, freshness, (program, wanted, durations_ns, perf_counter_ns() - start_ns, False), None

    def stale(self, draft: Draft, targets: Sequence[str], start_ns: int) -> Outcome:
        """Run the dirty steps that the targets need, all without.

        Raises
        ------
        PayloadError, PlaceholderNeeded
            Something is needed that is not there.
        """
        program = self._program
        wanted = wanted_steps(program, draft.values, targets) if targets or program.switches else None
        if program.placeholders or not draft.has_payload:
            check_ready(program, draft.values, wanted)
        return _step_by_step(draft, wanted, start_ns)

    def run_broken_off(
        self, values: list[Any], failed: StepFailed, wanted: bytes | None, has_payload: bool, start_ns: int
    ) -> Outcome:
        """Return what is left of a compiled run in which a function failed."""
        draft = Draft.of_sources(self._program, values, has_payload)
        for place in failed.done_ns:
            draft.dirty[place] = 0
        return _ended(draft, failed, wanted, failed.done_ns, start_ns)

    def rerun_broken_off(
        self, values: list[Any], old: list[Any], failed: StepFailed, changed: Iterable[str], start_ns: int
    ) -> Outcome:
        """Return what is left of a compiled rerun in which a function failed; ``old`` are the values before it."""
        program = self._program
        new = {program.slots[token] for token in changed}
        new |= {slot for slot, value in enumerate(values) if value is not old[slot]}
        dirty = bytearray(
            failed.done_ns.get(step.place, -1) < 0 and not new.isdisjoint(step.inputs) for step in program.steps
        )
        return _ended(Draft(program, values, dirty, True), failed, None, failed.done_ns, start_ns)


def _step_by_step(draft: Draft, wanted: bytes | None, start_ns: int) -> Outcome:
    durations_ns: dict[int, int] = {}
    try:
        execute(draft, wanted, durations_ns)
    except StepFailed as failed:
        return _ended(draft, failed, wanted, durations_ns, start_ns)
    return _ended(draft, None, wanted, durations_ns, start_ns)


def _ended(
    draft: Draft, failed: StepFailed | None, wanted: bytes | None, durations_ns: dict[int, int], start_ns: int
) -> Outcome:
    failure = None
    if failed is not None:
        durations_ns[failed.place] = failed.duration_ns
        failure = failure_of(draft, failed.place, failed.exception)
        draft.forget(draft.program.downstream([failed.place], draft.values))
    times = (draft.program, wanted, durations_ns, perf_counter_ns() - start_ns, False)
    return draft.values, draft.freshness(), times, failure
