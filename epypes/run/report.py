"""Where did the time of a run go?"""

from __future__ import annotations

from array import array
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Final

from epypes.run.program import Program

if TYPE_CHECKING:
    import pandas as pd

# Above so many functions the times are packed: a thousand reports of a large graph would hold gigabytes of integers.
_PACKED_ABOVE: Final = 200


@dataclass(frozen=True, slots=True)
class FunctionTime:
    """How long one function took: ``duration_ns`` in nanoseconds; 0, with ``ran`` false, if it was reused."""

    function: str
    duration_ns: int
    ran: bool


class RunReport:
    """The times of one run; does not change.

    Attributes
    ----------
    total_ns
        From the start of the run to its end, in nanoseconds.
    side_by_side
        Whether functions may have run side by side.
    """

    __slots__ = ("_durations_ns", "_program", "_wanted", "side_by_side", "total_ns")

    def __init__(
        self,
        program: Program,
        wanted: bytes | None,
        durations_ns: dict[int, int],
        total_ns: int,
        side_by_side: bool = False,
    ) -> None:
        # A list has an entry for every step, -1 for those that did not run; a dictionary those that ran.
        self._program, self._wanted, self.total_ns, self.side_by_side = program, wanted, total_ns, side_by_side
        self._durations_ns: Any = durations_ns
        if len(durations_ns) > _PACKED_ABOVE and isinstance(durations_ns, list):
            self._durations_ns = array("q", durations_ns)

    @property
    def program(self) -> Program:
        """What was run."""
        return self._program

    def _ran_ns(self) -> Mapping[int, int]:
        """Return nanoseconds by step that ran."""
        if isinstance(self._durations_ns, dict):
            return self._durations_ns
        return {index: duration for index, duration in enumerate(self._durations_ns) if duration >= 0}

    @property
    def functions(self) -> tuple[FunctionTime, ...]:
        """One entry per function that the run needed, in run order."""
        ran_ns, wanted = self._ran_ns(), self._wanted
        return tuple(
            FunctionTime(step.name, ran_ns.get(step.place, 0), step.place in ran_ns)
            for step in self._program.steps
            if wanted is None or wanted[step.place] or step.place in ran_ns
        )

    @property
    def durations_ns(self) -> dict[str, int]:
        """Nanoseconds by function that ran, in run order."""
        ran_ns = self._ran_ns()
        return {self._program.steps[index].name: ran_ns[index] for index in sorted(ran_ns)}

    @property
    def ran(self) -> tuple[str, ...]:
        """The functions that ran."""
        return tuple(self.durations_ns)

    @property
    def reused(self) -> tuple[str, ...]:
        """The functions whose outputs were still up to date."""
        return tuple(entry.function for entry in self.functions if not entry.ran)

    @property
    def critical_path_ns(self) -> int:
        """The longest time that functions which need each other's outputs took one after another, in nanoseconds."""
        program, ran_ns = self._program, self._ran_ns()
        ends_ns: dict[int, int] = {}
        for index in sorted(ran_ns):
            makers = {program.makers[slot] for slot in program.steps[index].inputs}
            ends_ns[index] = ran_ns[index] + max((ends_ns.get(maker, 0) for maker in makers), default=0)
        return max(ends_ns.values(), default=0)

    @property
    def overhead_ns(self) -> int:
        """The graph overhead (the paper's o_cg), in nanoseconds.

        The total less the functions' times; where they run side by side, the total less the critical path. That
        includes the waiting for a free worker.
        """
        spent_ns = self.critical_path_ns if self.side_by_side else sum(self._ran_ns().values())
        return self.total_ns - spent_ns

    def to_frame(self) -> pd.DataFrame:
        """Return a table: function, ran, time_ms, share (of the total)."""
        import pandas as pd

        return pd.DataFrame(
            [
                (entry.function, entry.ran, entry.duration_ns / 1e6, entry.duration_ns / max(self.total_ns, 1))
                for entry in self.functions
            ],
            columns=["function", "ran", "time_ms", "share"],
        )

    def __repr__(self) -> str:
        return f"<RunReport: {len(self.ran)} functions ran, {len(self.reused)} reused>"

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        from epypes.display import mimebundle

        return mimebundle(self)
