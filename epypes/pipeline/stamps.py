"""When was an event taken, and when did f_in and f_out work on it?"""

from __future__ import annotations

from time import perf_counter_ns, time_ns


class Stamps:
    """The times of one event, in nanoseconds of Unix time; 0 until they are known.

    They are read from one monotonic clock, which is set by the system's clock when the event is taken: so their
    differences hold whatever the system's clock does meanwhile.

    Attributes
    ----------
    react_ns
        When the event was taken from q_in; of a SourcePipeline when the run began.
    f_in_start_ns, f_in_end_ns, f_out_start_ns, f_out_end_ns
        When f_in and f_out were called, and when they had returned.
    offset_ns
        Unix time less the reading of ``time.perf_counter_ns``.
    """

    __slots__ = ("f_in_end_ns", "f_in_start_ns", "f_out_end_ns", "f_out_start_ns", "offset_ns", "react_ns")

    def __init__(self) -> None:
        self.react_ns = time_ns()
        self.offset_ns = self.react_ns - perf_counter_ns()
        self.f_in_start_ns = self.f_in_end_ns = self.f_out_start_ns = self.f_out_end_ns = 0

    def now_ns(self) -> int:
        """Return the time at this moment, by the event's clock."""
        return perf_counter_ns() + self.offset_ns

    def __repr__(self) -> str:
        known = [name for name in ("f_in_start", "f_in_end", "f_out_start", "f_out_end") if getattr(self, f"{name}_ns")]
        return f"<Stamps of an event: {', '.join(known) or 'just taken'}>"
