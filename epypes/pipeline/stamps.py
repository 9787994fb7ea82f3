"""The times at which an event was taken, and at which f_in and f_out began and ended."""

from __future__ import annotations

from time import perf_counter_ns, time_ns


class Stamps:
    """The times of one event, in nanoseconds of Unix time; 0 until they are known.

    They are read from one monotonic clock, which is set by the system's clock once per event: so their differences hold
    whatever the system's clock does meanwhile.
    """

    # The clock's own readings. Unix times are made of them when somebody asks: most events are never asked.
    __slots__ = ("_offset_ns", "f_in_end", "f_in_start", "f_out_end", "f_out_start", "react")

    react: int
    f_in_start: int
    f_in_end: int
    f_out_start: int
    f_out_end: int

    def __init__(self) -> None:
        self.react = perf_counter_ns()

    @property
    def react_ns(self) -> int:
        """When the event was taken from q_in; of a SourcePipeline when the run began."""
        return self._unix_ns("react")

    @property
    def f_in_start_ns(self) -> int:
        """When f_in was called."""
        return self._unix_ns("f_in_start")

    @property
    def f_in_end_ns(self) -> int:
        """When f_in had returned."""
        return self._unix_ns("f_in_end")

    @property
    def f_out_start_ns(self) -> int:
        """When f_out was called."""
        return self._unix_ns("f_out_start")

    @property
    def f_out_end_ns(self) -> int:
        """When f_out had returned."""
        return self._unix_ns("f_out_end")

    def now_ns(self) -> int:
        """Return the time at this moment, by the event's clock."""
        try:
            return self._offset_ns + perf_counter_ns()
        except AttributeError:
            return self._offset() + perf_counter_ns()

    def _unix_ns(self, name: str) -> int:
        reading: int = getattr(self, name, 0)
        return self._offset() + reading if reading else 0

    def _offset(self) -> int:
        """Return Unix time less the clock's reading: that of the first time somebody asked."""
        try:
            return self._offset_ns
        except AttributeError:
            self._offset_ns: int = time_ns() - perf_counter_ns()
            return self._offset_ns

    def __repr__(self) -> str:
        known = [name for name in ("f_in_start", "f_in_end", "f_out_start", "f_out_end") if hasattr(self, name)]
        return f"<Stamps of an event: {', '.join(known) or 'just taken'}>"
