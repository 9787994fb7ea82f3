"""Is it worth while to run functions side by side?

Threads pay where functions release the interpreter's lock and take longer than waking a thread. Nobody can know that
beforehand, so it is tried: the first runs go one after another and are timed, the next ones side by side if there is
something to be gained at best, and from then on the faster way is taken. Now and then the other way is tried again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Hashable, Mapping, Sequence
from typing import Final

from epypes.run.compiled import CompiledRerun, CompiledRun, CompiledRuns
from epypes.run.program import Program, longest_path_ns

# What must be gained at best: the waking of two threads, and a tenth of the whole.
_LEAST_GAIN_NS: Final = 100_000
_LEAST_SHARE: Final = 0.1
_TRIALS: Final = 3
_TRY_AGAIN_AFTER: Final = 201
_LOOK_AGAIN_AFTER: Final = 100
_MOST_KEPT: Final = 64


class Gain:
    """The experience with one set of steps."""

    def __init__(self, program: Program, workers: int) -> None:
        self._program, self._workers = program, workers
        self._one_by_one_ns: deque[int] = deque(maxlen=_TRIALS)
        self._side_by_side_ns: deque[int] = deque(maxlen=_TRIALS)
        self._is_promising = False
        self._asked = 0

    @property
    def is_known(self) -> bool:
        """Whether the functions have been timed one after another."""
        return len(self._one_by_one_ns) >= _TRIALS

    @property
    def is_hopeless(self) -> bool:
        """Whether there is nothing to be gained, as far as is known, so that nothing is tried."""
        return self.is_known and not self._is_promising

    def is_worth_it(self) -> bool:
        """Whether the next run should go side by side."""
        if not self.is_known or not self._is_promising:
            return False
        if len(self._side_by_side_ns) < _TRIALS:
            return True
        self._asked += 1
        is_faster = min(self._side_by_side_ns) < min(self._one_by_one_ns)
        return is_faster != (self._asked % _TRY_AGAIN_AFTER == 0)

    def learn(self, durations: Mapping[int, int] | Sequence[int], total_ns: int, side_by_side: bool) -> None:
        """Take note of a run that has ended without a failure: nanoseconds by step, and in all."""
        if side_by_side:
            self._side_by_side_ns.append(total_ns)
            return
        self._one_by_one_ns.append(total_ns)
        durations_ns = durations if isinstance(durations, Mapping) else dict(enumerate(durations))
        work_ns = sum(durations_ns.values())
        best_ns = max(longest_path_ns(self._program, durations_ns), work_ns // self._workers)
        self._is_promising = work_ns - best_ns > max(_LEAST_GAIN_NS, _LEAST_SHARE * total_ns)


class Gains:
    """The experience with a program, by the steps that were to be run."""

    def __init__(self, program: Program, workers: int) -> None:
        self._program, self._workers = program, workers
        self._known: dict[Hashable, Gain] = {}

    def of_steps(self, wanted: bytes | None) -> Gain:
        """Return the experience with runs of these steps."""
        return self._of(wanted)

    def of_dirty(self, dirty: bytes, wanted: bytes | None) -> Gain:
        """Return the experience with reruns that began with these steps."""
        return self._of((dirty, wanted))

    def of_changes(self, tokens: Collection[str]) -> Gain:
        """Return the experience with reruns after these source tokens had changed, all else being up to date."""
        program = self._program
        readers = {place for token in tokens for place in program.consumers[program.slots[token]]}
        return self._of((bytes(step.place in readers for step in program.steps), None))

    def _of(self, key: Hashable) -> Gain:
        if len(self._known) >= _MOST_KEPT:
            self._known.clear()
        return self._known.setdefault(key, Gain(self._program, self._workers))


class GuardedWay:
    """The compiled runs that may be taken, since nothing is to be gained by running side by side."""

    def __init__(self, compiled: CompiledRuns, gains: Gains) -> None:
        self._compiled, self._gains = compiled, gains
        self._left = 0

    @property
    def whole(self) -> CompiledRun | None:
        """As in CompiledRuns."""
        if self._left:
            self._left -= 1
            return self._compiled.whole
        # Now and then a run goes the long way, and is learnt from: images may be larger than the first ones were.
        self._left = _LOOK_AGAIN_AFTER if self._gains.of_steps(None).is_hopeless else 0
        return None

    def of_changes(self, tokens: Collection[str]) -> CompiledRerun | None:
        """As in CompiledRuns."""
        return self._compiled.of_changes(tokens) if self._is_free(self._gains.of_changes(tokens)) else None

    def _is_free(self, gain: Gain) -> bool:
        return gain.is_known and not gain.is_worth_it()


def has_independent_steps(program: Program) -> bool:
    """Whether any two functions could run side by side."""
    return longest_path_ns(program, {step.place: 1 for step in program.steps}) < len(program.steps)
