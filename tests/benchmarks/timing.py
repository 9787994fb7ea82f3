"""How are several ways of doing the same work timed beside each other?"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from statistics import median
from time import perf_counter_ns

import numpy as np

Contenders = Mapping[str, Callable[[], object]]

# Enough for caches, lazy imports and code that is generated after some runs.
_WARM_ROUNDS = 50
_WARM_NS = 200_000_000
_QUICK_ROUNDS = 3
# What is shorter is called once more before it is timed: it shall not pay for caches that its neighbour emptied.
_SHORT_NS = 1_000_000


@dataclass(frozen=True)
class Times:
    """What was measured: nanoseconds by contender and round; slow contenders take part in fewer rounds."""

    durations_ns: Mapping[str, Mapping[int, float]]

    @property
    def medians_ns(self) -> dict[str, float]:
        return {name: median(taken.values()) for name, taken in self.durations_ns.items()}

    def pairwise_ratio(self, limit: str, ours: str) -> float:
        """Return the median of the ratios within a round: a slow moment of the machine hits both sides of each."""
        below, above = self.durations_ns[limit], self.durations_ns[ours]
        return median(above[index] / below[index] for index in above if below.get(index))


@dataclass(frozen=True)
class Effort:
    """How long may measuring take?

    Attributes
    ----------
    quick
        Three rounds and no peers: proves that everything runs, its numbers mean nothing.
    budget_s
        What one contender may spend on one row; the slower it is, the fewer its rounds.
    """

    quick: bool = False
    budget_s: float = 0.7

    def measure(self, contenders: Contenders, rounds: int, *, same: bool = True) -> Times:
        """Run the contenders in turn, after a warm-up, so that the machine's moods hit all of them.

        Unless ``same`` is false, all must return what the first one returns.
        """
        rounds = min(rounds, _QUICK_ROUNDS) if self.quick else rounds
        warm = {name: _warm_up(work, min(rounds, _WARM_ROUNDS)) for name, work in contenders.items()}
        if same:
            _check_same({name: result for name, (_, result) in warm.items()})
        turns = {name: self._affordable(fastest_ns, rounds) for name, (fastest_ns, _) in warm.items()}
        durations_ns: dict[str, dict[int, float]] = {name: {} for name in contenders}
        for index in range(rounds):
            for name, work in contenders.items():
                if _has_turn(index, turns[name], rounds):
                    if warm[name][0] < _SHORT_NS:
                        work()
                    durations_ns[name][index] = _timed(work)[0]
        return Times(durations_ns)

    def _affordable(self, fastest_ns: int, rounds: int) -> int:
        return max(1, min(rounds, int(self.budget_s * 1e9 / fastest_ns)))


def _warm_up(work: Callable[[], object], rounds: int) -> tuple[int, object]:
    """Return the nanoseconds of the fastest of some calls, and what the first one returned."""
    taken_ns, result = _timed(work)
    durations_ns = [taken_ns]
    while len(durations_ns) < rounds and sum(durations_ns) < _WARM_NS:
        durations_ns.append(_timed(work)[0])
    return max(1, min(durations_ns)), result


def _timed(work: Callable[[], object]) -> tuple[int, object]:
    start_ns = perf_counter_ns()
    result = work()
    return perf_counter_ns() - start_ns, result


def _check_same(results: Mapping[str, object]) -> None:
    (first, expected), *others = results.items()
    for name, result in others:
        if not np.array_equal(result, expected):
            raise AssertionError(f"{name!r} computes {result!r:.80}, {first!r} {expected!r:.80}.")


def _has_turn(index: int, turns: int, rounds: int) -> bool:
    """Spread the turns of a slow contender evenly over the rounds."""
    return (index + 1) * turns // rounds > index * turns // rounds
