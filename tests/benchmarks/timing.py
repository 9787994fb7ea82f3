"""How are two ways of doing the same work timed against each other?"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from statistics import median
from time import perf_counter_ns
from typing import Any


@dataclass(frozen=True)
class Row:
    """One line of the table; times in nanoseconds."""

    work: str
    limit_ns: float
    ours_ns: float
    goal: str = ""

    def cells(self) -> tuple[str, ...]:
        ratio = f"{self.ours_ns / self.limit_ns:.2f}" if self.limit_ns else ""
        return self.work, _us(self.limit_ns), _us(self.ours_ns), ratio, self.goal

    def as_dict(self) -> dict[str, Any]:
        return asdict(self)


def _us(duration_ns: float) -> str:
    return f"{duration_ns / 1e6:.2f} ms" if duration_ns >= 1e6 else f"{duration_ns / 1e3:.2f} us"


def interleaved(limit: Callable[[], object], ours: Callable[[], object], rounds: int = 50) -> tuple[float, float]:
    """Return the medians of both, run in turn so that the machine's moods hit both."""
    times: tuple[list[int], list[int]] = ([], [])
    for _ in range(rounds):
        for kept, work in zip(times, (limit, ours), strict=True):
            start_ns = perf_counter_ns()
            work()
            kept.append(perf_counter_ns() - start_ns)
    return median(times[0]), median(times[1])
