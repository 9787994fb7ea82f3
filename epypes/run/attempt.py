"""How does one run go, from values to tokens, times and perhaps a failure?"""

from __future__ import annotations

from collections.abc import Sequence
from time import perf_counter_ns
from typing import Any

from epypes.run.call import StepFailed
from epypes.run.compiled import CompiledRuns
from epypes.run.draft import Draft
from epypes.run.engine import execute
from epypes.run.failure import Failure, failure_of
from epypes.run.need import check_ready, wanted_steps
from epypes.run.program import Program
from epypes.run.report import RunReport
from epypes.run.tokens import Freshness, TokenManager

Outcome = tuple[TokenManager, RunReport, Failure | None]

_INVERTED = bytes((1, 0))


class Attempts:
    """Runs a program; knows which runs have been repeated.

    Every method takes ``start_ns``, when the run began on the clock of ``perf_counter_ns``.
    """

    def __init__(self, program: Program) -> None:
        self._program = program
        self._compiled = CompiledRuns(program)
        self._clean = Freshness(program, bytes(len(program.steps)), True)

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
        compiled = self._compiled.of_steps(wanted)
        if compiled is None:
            return self._step_by_step(Draft.of_sources(program, values, has_payload), wanted, start_ns)
        durations_ns: dict[int, int] = {}
        try:
            compiled(values, durations_ns)
        except StepFailed as failed:
            draft = Draft.of_sources(program, values, has_payload)
            for index in durations_ns:
                draft.dirty[index] = 0
            return _ended(draft, failed, wanted, durations_ns, start_ns)
        report = RunReport(program, wanted, durations_ns, perf_counter_ns() - start_ns)
        if wanted is None and has_payload:
            return TokenManager(values, self._clean), report, None
        dirty = bytes(len(program.steps)) if wanted is None else wanted.translate(_INVERTED.ljust(256))
        return TokenManager(values, Freshness(program, dirty, has_payload)), report, None

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
        return self._step_by_step(draft, wanted, start_ns)

    def changed(self, last: TokenManager, changes: dict[str, Any], start_ns: int) -> Outcome | None:
        """Run what depends on source tokens with new values, where everything was up to date.

        Returns None if that has not been repeated enough to be compiled; nothing has been done then.
        """
        compiled = self._compiled.of_changes(tuple(changes))
        if compiled is None:
            return None
        program = self._program
        values = last.values.copy()
        for token in changes:
            values[program.slots[token]] = changes[token]
        durations_ns: dict[int, int] = {}
        try:
            compiled(values, durations_ns)
        except StepFailed as failed:
            new = {program.slots[token] for token in changes}
            new |= {slot for slot, value in enumerate(values) if value is not last.values[slot]}
            dirty = bytearray(
                step.place not in durations_ns and not new.isdisjoint(step.inputs) for step in program.steps
            )
            return _ended(Draft(program, values, dirty, True), failed, None, durations_ns, start_ns)
        return (
            TokenManager(values, last.freshness),
            RunReport(program, None, durations_ns, perf_counter_ns() - start_ns),
            None,
        )

    def _step_by_step(self, draft: Draft, wanted: bytes | None, start_ns: int) -> Outcome:
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
        durations_ns[failed.index] = failed.duration_ns
        failure = failure_of(draft, failed.index, failed.exception)
        draft.forget(draft.program.downstream([failed.index], draft.values))
    return draft.ended(), RunReport(draft.program, wanted, durations_ns, perf_counter_ns() - start_ns), failure
