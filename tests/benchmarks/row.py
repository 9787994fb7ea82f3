"""What is one line of the table, and has it reached its goal?"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

from tests.benchmarks.timing import Times

OURS = "EPypes"


@dataclass(frozen=True)
class Goal:
    """What EPypes must not exceed, or must have at least.

    Attributes
    ----------
    of
        ``ratio`` to the limit (the medians' and the median of the rounds'), ``total`` time, time ``above`` the
        limit, time above the limit ``per function``, or ``least``: the number that must be reached.
    most
        The ratio, or nanoseconds; of ``least`` the number.
    """

    of: Literal["ratio", "total", "above", "per function", "least"]
    most: float

    def __str__(self) -> str:
        if self.of == "least":
            return f">= {self.most:g}"
        if self.of == "ratio":
            return f"<= {self.most:g} times"
        return f"<= {_plain_duration(self.most)}" + ("" if self.of == "total" else f" {self.of}")


@dataclass(frozen=True)
class Row:
    """One piece of work: medians in nanoseconds by contender, of which one is the limit and one is ours.

    Where ``unit`` is ``count`` they are no times, but how many there were of something.
    """

    work: str
    medians_ns: Mapping[str, float]
    functions: int = 1
    goal: Goal | None = None
    limit: str = "by hand"
    ours: str = OURS
    pairwise_ratio: float | None = None
    note: str = ""
    unit: Literal["ns", "count"] = "ns"

    @property
    def limit_ns(self) -> float:
        return self.medians_ns[self.limit]

    @property
    def ours_ns(self) -> float:
        return self.medians_ns[self.ours]

    def ratio(self, name: str) -> float | None:
        """Return how many times as long as the limit a contender took."""
        return self.medians_ns[name] / self.limit_ns if self.limit_ns else None

    def us_per_function(self, name: str) -> float:
        """Return a contender's microseconds per function above the limit."""
        return (self.medians_ns[name] - self.limit_ns) / self.functions / 1e3

    @property
    def reached(self) -> bool | None:
        """Whether the goal is reached; None without a goal."""
        if self.goal is None:
            return None
        if self.goal.of == "least":
            return self.ours_ns >= self.goal.most
        value = {
            "ratio": max(self.ratio(self.ours) or 0, self.pairwise_ratio or 0),
            "total": self.ours_ns,
            "above": self.ours_ns - self.limit_ns,
            "per function": self.us_per_function(self.ours) * 1e3,
        }[self.goal.of]
        return value <= self.goal.most

    def as_dict(self) -> dict[str, Any]:
        """Return what the JSON file says of it."""
        return {
            "work": self.work,
            "functions": self.functions,
            "limit": self.limit,
            "ours": self.ours,
            f"medians_{self.unit}": dict(self.medians_ns),
            "ratio": self.ratio(self.ours),
            "pairwise_ratio": self.pairwise_ratio,
            "us_per_function_above": self.us_per_function(self.ours),
            "goal": str(self.goal) if self.goal else None,
            "reached": self.reached,
            "note": self.note,
        }


def row(
    work: str,
    times: Times,
    *,
    functions: int = 1,
    goal: Goal | None = None,
    limit: str = "by hand",
    ours: str = OURS,
    note: str = "",
) -> Row:
    """Make a line of what was measured."""
    pairwise = times.pairwise_ratio(limit, ours)
    return Row(work, times.medians_ns, functions, goal, limit, ours, pairwise, note)


def amount_text(amount: float, unit: Literal["ns", "count"]) -> str:
    """Return a duration, or a number, as the table shows it."""
    return duration_text(amount) if unit == "ns" else f"{amount:.3g}"


def duration_text(duration_ns: float) -> str:
    """Return a duration with three digits or so and its unit."""
    if duration_ns >= 1e9:
        return f"{duration_ns / 1e9:.2f} s"
    return f"{duration_ns / 1e6:.2f} ms" if duration_ns >= 1e6 else f"{duration_ns / 1e3:.2f} us"


def _plain_duration(duration_ns: float) -> str:
    return f"{duration_ns / 1e6:g} ms" if duration_ns >= 1e6 else f"{duration_ns / 1e3:g} us"
