"""How long does it take from the hand to the screen?"""

from __future__ import annotations

import statistics
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Latency:
    """Times of a panel's last frames, at most 200.

    Attributes
    ----------
    compute_ms
        Of the last run; None before the first.
    to_screen_ms
        From the last value that was set to the picture of it, or of a later one, being painted; None if no view has
        painted one.
    p50_ms, p95_ms
        Half and 95 % of the frames took at most so long; None without frames.
    frames
        How many were painted, at most 200.
    """

    compute_ms: float | None
    to_screen_ms: float | None
    p50_ms: float | None
    p95_ms: float | None
    frames: int


def latency_of(compute_ms: float | None, to_screen_ms: Sequence[float]) -> Latency:
    """Return the times of frames, the last of which is the newest."""
    times = sorted(to_screen_ms)
    if not times:
        return Latency(compute_ms, None, None, None, 0)
    p95_ms = times[min(len(times) - 1, int(0.95 * len(times)))]
    return Latency(compute_ms, to_screen_ms[-1], statistics.median(times), p95_ms, len(times))
