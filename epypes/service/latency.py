"""How long do events take, from their acceptance to their answer?"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Final

# Upper ends in seconds: from what a trivial graph takes to what nobody waits for.
BOUNDS_S: Final = (0.001, 0.0025, 0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0)


@dataclass(frozen=True, slots=True)
class Latency:
    """Durations, as many as were observed.

    Attributes
    ----------
    bounds_s
        Upper ends of the buckets, in seconds.
    counts
        How many durations are in each bucket, one more for those beyond the last end.
    count, total_s
        How many there are, and their sum in seconds.
    computing_s
        How much of it the graph took.
    functions_s
        How much of that each function took.
    """

    bounds_s: tuple[float, ...]
    counts: tuple[int, ...]
    count: int
    total_s: float
    computing_s: float
    functions_s: Mapping[str, float]


@dataclass(slots=True)
class Stopwatch:
    """Counts durations by bucket."""

    _counts: list[int] = field(default_factory=lambda: [0] * (len(BOUNDS_S) + 1))
    _total_ns: int = 0
    _computing_ns: int = 0
    _functions_ns: dict[str, int] = field(default_factory=dict)

    def observe(self, duration_ns: int, computing_ns: int, functions_ns: Mapping[str, int]) -> None:
        """Count a duration, and how much of it the graph and each function took, in nanoseconds."""
        self._counts[bisect_left(BOUNDS_S, duration_ns / 1e9)] += 1
        self._total_ns += duration_ns
        self._computing_ns += computing_ns
        for function, spent_ns in functions_ns.items():
            self._functions_ns[function] = self._functions_ns.get(function, 0) + spent_ns

    def read(self) -> Latency:
        """Return what was observed."""
        counts = tuple(self._counts)
        # Another thread may add a function meanwhile; a copy is made in one step.
        functions_s = {function: spent_ns / 1e9 for function, spent_ns in self._functions_ns.copy().items()}
        return Latency(BOUNDS_S, counts, sum(counts), self._total_ns / 1e9, self._computing_ns / 1e9, functions_s)
