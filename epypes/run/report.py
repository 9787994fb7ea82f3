"""Where did the time of a run go?"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import pandas as pd


@dataclass(frozen=True, slots=True)
class FunctionTime:
    """How long one function took: ``duration_ns`` in nanoseconds; 0, with ``ran`` false, if it was reused."""

    function: str
    duration_ns: int
    ran: bool


@dataclass(frozen=True, slots=True)
class RunReport:
    """The times of one run.

    Attributes
    ----------
    functions
        One entry per function that the run needed, in run order.
    total_ns
        From the start of the run to its end, in nanoseconds.
    """

    functions: tuple[FunctionTime, ...]
    total_ns: int

    @property
    def overhead_ns(self) -> int:
        """The graph overhead: the total less the functions' times (the paper's o_cg), in nanoseconds."""
        return self.total_ns - sum(entry.duration_ns for entry in self.functions)

    @property
    def ran(self) -> tuple[str, ...]:
        """The functions that ran."""
        return tuple(entry.function for entry in self.functions if entry.ran)

    @property
    def reused(self) -> tuple[str, ...]:
        """The functions whose outputs were still up to date."""
        return tuple(entry.function for entry in self.functions if not entry.ran)

    @property
    def durations_ns(self) -> dict[str, int]:
        """Nanoseconds by function that ran."""
        return {entry.function: entry.duration_ns for entry in self.functions if entry.ran}

    def to_frame(self) -> pd.DataFrame:
        """Return a table: function, ran, time_ms, share (of the total)."""
        import pandas as pd

        return pd.DataFrame(
            [
                (
                    entry.function,
                    entry.ran,
                    entry.duration_ns / 1e6,
                    entry.duration_ns / max(self.total_ns, 1),
                )
                for entry in self.functions
            ],
            columns=["function", "ran", "time_ms", "share"],
        )

    def __repr__(self) -> str:
        return f"<RunReport: {len(self.ran)} functions ran, {len(self.reused)} reused>"

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        from epypes.display import mimebundle

        return mimebundle(self)
