"""How long did each value of a slider wait for its picture?"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import median


@dataclass(frozen=True)
class Seen:
    """What a page saw while a slider was moved: values with the milliseconds at which they came.

    Attributes
    ----------
    moves
        When the slider got which value; no value twice.
    pictures
        When the page showed a picture, and of which value.
    """

    moves: Sequence[tuple[float, float]]
    pictures: Sequence[tuple[float, float]]

    @property
    def latencies_ms(self) -> list[float]:
        """Of each value: until the first picture that shows it or a later one."""
        turn = {value: index for index, (_, value) in enumerate(self.moves)}
        shown = [(at, turn[value]) for at, value in self.pictures if value in turn]
        return [
            next((at for at, index in shown if index >= wanted and at >= moved), math.inf) - moved
            for wanted, (moved, _) in enumerate(self.moves)
        ]

    @property
    def values_shown(self) -> int:
        """How many of the values were seen in a picture."""
        return len({value for _, value in self.moves} & {value for _, value in self.pictures})

    @property
    def last_late_ms(self) -> float:
        """How long after the last move its picture came."""
        return self.latencies_ms[-1]

    @property
    def duration_ms(self) -> float:
        """From the first move to the picture of the last."""
        return self.moves[-1][0] - self.moves[0][0] + self.last_late_ms


def percentile(values: Iterable[float], share: float) -> float:
    """Return the smallest value that at least this share of them does not exceed."""
    ranked = sorted(values)
    return ranked[max(0, math.ceil(share * len(ranked)) - 1)]


def p50(values: Iterable[float]) -> float:
    return median(values)


def p95(values: Iterable[float]) -> float:
    return percentile(values, 0.95)
