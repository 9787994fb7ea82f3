"""How does one run go, from values of source tokens to tokens, times and perhaps a failure?"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Sequence
from time import perf_counter_ns
from typing import Any, Final

from epypes.run.call import StepFailed
from epypes.run.compiled import CompiledRuns
from epypes.run.draft import Draft
from epypes.run.engine import execute, execute_from_scratch
from epypes.run.failure import Failure, failure_of
from epypes.run.gain import Gain, Gains, GuardedWay, has_independent_steps
from epypes.run.need import check_ready, wanted_steps
from epypes.run.parallel import execute_side_by_side
from epypes.run.program import Program
from epypes.run.report import Times
from epypes.run.tokens import Freshness

# What Run is made of, but for the hyperparameters.
Outcome = tuple[list[Any], Freshness, Times, Failure | None]

Engine = Callable[[Draft, bytes | None, dict[int, int]], None]

_MOST_KINDS: Final = 16
_INVERTED = bytes((1, 0)).ljust(256)


class Attempts:
    """Runs a program whose ``plain`` tokens hold no arrays; knows which runs have been repeated.

    Every method takes ``start_ns``, when the run began on the clock of ``perf_counter_ns``.

    Attributes
    ----------
    short_way
        The compiled runs, as far as they are to be taken without asking here.
    clean
        What is up to date after a run of everything.
    """

    def __init__(self, program: Program, workers: int, plain: Iterable[str]) -> None:
        self._program, self._workers = program, workers
        self._compiled = CompiledRuns(program, plain)
        # Checked for changes to their inputs, functions that share one run one after another.
        may_spread = workers > 1 and not program.check_mutation
        self._gains = Gains(program, workers) if may_spread and has_independent_steps(program) else None
        self.short_way = self._compiled if self._gains is None else GuardedWay(self._compiled, self._gains)
        self.clean = Freshness(program, bytes(len(program.steps)), True)

    def whole(
        self, values: list[Any], payload: Collection[str], has_payload: bool, targets: Sequence[str], start_ns: int
    ) -> Outcome:
        """Run all that the targets need, everything without, from values of source tokens, which are changed.

        ``payload`` are the tokens that were given, ``has_payload`` is whether they are all.

        Raises
        ------
        PayloadError, PlaceholderNeeded
            Something is needed that is not there.
        """
        wanted = self._wanted(values, targets, has_payload, payload)
        gain = None if self._gains is None else self._gains.of_steps(wanted)
        compiled = None if gain is not None and not gain.is_known else self._compiled.of_steps(wanted)
        if compiled is None or (gain is not None and gain.is_worth_it()):
            draft = Draft.of_sources(self._program, values, has_payload)
            return self._step_by_step(execute_from_scratch, draft, wanted, gain, start_ns)
        revisions = self._program.revisions()
        try:
            durations_ns = compiled(values)
        except StepFailed as failed:
            return self.run_broken_off(values, failed, wanted, has_payload, start_ns, revisions)
        total_ns = perf_counter_ns() - start_ns
        if gain is not None:
            gain.learn(durations_ns, total_ns, False)
        freshness = self.clean
        if wanted is not None or not has_payload or self._program.revised:
            dirty = bytes(len(self._program.steps)) if wanted is None else wanted.translate(_INVERTED)
            freshness = Freshness(self._program, dirty, has_payload, revisions)
        return values, freshness, (self._program, wanted, durations_ns, total_ns, False, -1), None

    def stale(self, draft: Draft, targets: Sequence[str], start_ns: int) -> Outcome:
        """Run the dirty steps that the targets need, all without.

        Raises
        ------
        PayloadError, PlaceholderNeeded
            Something is needed that is not there.
        """
        wanted = self._wanted(draft.values, targets, draft.has_payload, ())
        gain = None if self._gains is None else self._gains.of_dirty(bytes(draft.dirty), wanted)
        return self._step_by_step(execute, draft, wanted, gain, start_ns)

    def _wanted(
        self, values: list[Any], targets: Sequence[str], has_payload: bool, payload: Collection[str]
    ) -> bytes | None:
        program = self._program
        wanted = wanted_steps(program, values, targets) if targets or program.switches else None
        if program.placeholders or not has_payload:
            check_ready(program, values, wanted, payload)
        return wanted

    def _step_by_step(
        self, one_by_one: Engine, draft: Draft, wanted: bytes | None, gain: Gain | None, start_ns: int
    ) -> Outcome:
        durations_ns: dict[int, int] = {}
        side_by_side = gain is not None and gain.is_worth_it()
        try:
            if side_by_side:
                execute_side_by_side(draft, wanted, durations_ns, self._workers)
            else:
                one_by_one(draft, wanted, durations_ns)
        except StepFailed as failed:
            return ended(draft, failed, wanted, durations_ns, start_ns, side_by_side)
        outcome = ended(draft, None, wanted, durations_ns, start_ns, side_by_side)
        if gain is not None:
            gain.learn(durations_ns, outcome[2][3], side_by_side)
        return outcome

    def run_broken_off(
        self,
        values: list[Any],
        failed: StepFailed,
        wanted: bytes | None,
        has_payload: bool,
        start_ns: int,
        revisions: tuple[Any, ...] = (),
    ) -> Outcome:
        """Return what is left of a compiled run in which a function failed."""
        draft = Draft.of_sources(self._program, values, has_payload)
        draft.revisions = revisions
        for place in failed.done_ns:
            draft.dirty[place] = 0
        return ended(draft, failed, wanted, failed.done_ns, start_ns, False)

    def rerun_broken_off(self, values: list[Any], failed: StepFailed, changed: Iterable[str], start_ns: int) -> Outcome:
        """Return what is left of a compiled rerun in which a function failed."""
        program = self._program
        new = failed.new.union(program.slots[token] for token in changed)
        dirty = bytearray(
            failed.done_ns.get(step.place, -1) < 0 and not new.isdisjoint(step.inputs) for step in program.steps
        )
        return ended(Draft(program, values, dirty, True), failed, None, failed.done_ns, start_ns, False)


class AttemptsByKind(dict[frozenset[str], Attempts]):
    """The attempts by plain tokens; those of another set of them are made when they are asked for."""

    def __init__(self, program: Program, workers: int) -> None:
        super().__init__()
        self._program, self._workers = program, workers

    def __missing__(self, plain: frozenset[str]) -> Attempts:
        if len(self) >= _MOST_KINDS:
            self.clear()
        self[plain] = made = Attempts(self._program, self._workers, plain)
        return made


def ended(
    draft: Draft,
    failed: StepFailed | None,
    wanted: bytes | None,
    durations_ns: dict[int, int],
    start_ns: int,
    side_by_side: bool,
) -> Outcome:
    """Return what is left of a run that came this far: to its end, or to a step that failed."""
    failure, failed_at = None, -1
    if failed is not None:
        failed_at = failed.place
        durations_ns[failed_at] = failed.duration_ns
        failure = failure_of(draft, failed_at, failed.exception)
        draft.forget(draft.program.downstream([failed_at], draft.values))
        wanted = _reached(draft, wanted)
    times = (draft.program, wanted, durations_ns, perf_counter_ns() - start_ns, side_by_side, failed_at)
    return draft.values, draft.freshness(), times, failure


def _reached(draft: Draft, wanted: bytes | None) -> bytes:
    """Return which of the wanted steps are up to date after a failure: of the others none was reused."""
    dirty = [place for place, is_dirty in enumerate(draft.dirty) if is_dirty]
    reached = bytearray(wanted or b"\1" * len(draft.dirty))
    for place in draft.program.downstream(dirty, draft.values):
        reached[place] = 0
    return bytes(reached)
