"""How are times written?"""

from __future__ import annotations


def overhead_text(side_by_side: bool) -> str:
    """Return what graph overhead is called; where functions ran side by side it is another quantity."""
    return "graph overhead (wall time less critical path)" if side_by_side else "graph overhead"


def duration_text(duration_ns: int) -> str:
    """Return a duration with its unit, to three digits.

    Examples
    --------
    >>> duration_text(5_230_000), duration_text(740)
    ('5.23 ms', '740 ns')
    """
    for limit, unit in ((1e9, "s"), (1e6, "ms"), (1e3, "µs")):
        if abs(duration_ns) >= limit:
            return f"{duration_ns / limit:.3g} {unit}"
    return f"{duration_ns} ns"
