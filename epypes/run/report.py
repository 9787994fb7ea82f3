"""Where did the time of a run go?"""

from __future__ import annotations

from array import array
from collections import deque
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, overload

from epypes.optional import optional_import
from epypes.rich_display import mimebundle, to_text
from epypes.run.program import Program, longest_path_ns
from epypes.wording import counted

if TYPE_CHECKING:
    import pandas as pd

# The program, the steps that were wanted, nanoseconds by step that ran, nanoseconds in all, whether side by side, the
# step that failed: -1 if none did.
Times = tuple[Program, bytes | None, Mapping[int, int] | Sequence[int], int, bool, int]

_COLUMNS: Final = ("function", "ran", "time_ms", "share", "failed")
_KEPT: Final = 1_000
# Above so many functions kept times are packed: a thousand reports of a large graph would hold a gigabyte of integers.
_PACKED_ABOVE: Final = 400


@dataclass(frozen=True, slots=True)
class FunctionTime:
    """How long one function took.

    Attributes
    ----------
    duration_ns
        In nanoseconds; of a function that failed until it raised, of one that was reused 0.
    ran
        Whether it was called, to whatever end; if not, it was reused.
    failed
        Whether it raised.
    """

    function: str
    duration_ns: int
    ran: bool
    failed: bool = False


class RunReport:
    """The times of one run; does not change.

    Attributes
    ----------
    total_ns
        From the start of the run to its end, in nanoseconds.
    side_by_side
        Whether functions may have run side by side.
    """

    __slots__ = ("_durations_ns", "_failed_at", "_program", "_wanted", "side_by_side", "total_ns")

    def __init__(
        self,
        program: Program,
        wanted: bytes | None,
        durations_ns: Mapping[int, int] | Sequence[int],
        total_ns: int,
        side_by_side: bool,
        failed_at: int = -1,
    ) -> None:
        # A sequence has an entry for every step; -1 stands for a step that did not run.
        self._program, self._wanted, self.total_ns, self.side_by_side = program, wanted, total_ns, side_by_side
        self._durations_ns, self._failed_at = durations_ns, failed_at

    @property
    def program(self) -> Program:
        """What was run."""
        return self._program

    def _ran_ns(self) -> Mapping[int, int]:
        """Return nanoseconds by step that ran."""
        durations_ns = self._durations_ns
        entries = durations_ns.items() if isinstance(durations_ns, Mapping) else enumerate(durations_ns)
        return {place: duration for place, duration in entries if duration >= 0}

    @property
    def functions(self) -> tuple[FunctionTime, ...]:
        """One entry per function that the run needed, in run order; of a failed run those it came to."""
        ran_ns, wanted, failed_at = self._ran_ns(), self._wanted, self._failed_at
        return tuple(
            FunctionTime(step.name, ran_ns.get(step.place, 0), step.place in ran_ns, step.place == failed_at)
            for step in self._program.steps
            if wanted is None or wanted[step.place] or step.place in ran_ns
        )

    @property
    def durations_ns(self) -> dict[str, int]:
        """Nanoseconds by function that ran, in run order; of one that failed until it raised."""
        ran_ns = self._ran_ns()
        return {self._program.steps[index].name: ran_ns[index] for index in sorted(ran_ns)}

    @property
    def ran(self) -> tuple[str, ...]:
        """The functions that ran, with the one that failed."""
        return tuple(self.durations_ns)

    @property
    def is_whole(self) -> bool:
        """Whether every function of the graph ran, and none failed."""
        durations_ns = self._durations_ns
        return type(durations_ns) is tuple and self._failed_at < 0 and min(durations_ns, default=0) >= 0

    @property
    def failed(self) -> str | None:
        """The function that failed, or None."""
        return None if self._failed_at < 0 else self._program.steps[self._failed_at].name

    @property
    def reused(self) -> tuple[str, ...]:
        """The functions whose outputs were still up to date."""
        return tuple(entry.function for entry in self.functions if not entry.ran)

    @property
    def critical_path_ns(self) -> int:
        """The longest time that functions which need each other's outputs took one after another, in nanoseconds."""
        return longest_path_ns(self._program, self._ran_ns())

    @property
    def overhead_ns(self) -> int:
        """The graph overhead (the paper's o_cg), in nanoseconds.

        The total less the functions' times; where they run side by side, the total less the critical path. That
        includes the waiting for a free worker.
        """
        spent_ns = self.critical_path_ns if self.side_by_side else sum(self._ran_ns().values())
        return self.total_ns - spent_ns

    def to_frame(self) -> pd.DataFrame:
        """Return a table: function, ran, time_ms, share (of the total), failed.

        A function that failed has ``ran`` true as well, and the time until it raised.
        """
        with optional_import():
            import pandas as pd

        return pd.DataFrame(self._rows(), columns=list(_COLUMNS))

    def _rows(self) -> list[tuple[str, bool, float, float, bool]]:
        """Return what ``to_frame`` has as rows."""
        total_ns = max(self.total_ns, 1)
        return [
            (entry.function, entry.ran, entry.duration_ns / 1e6, entry.duration_ns / total_ns, entry.failed)
            for entry in self.functions
        ]

    def __repr__(self) -> str:
        failed = self._failed_at >= 0
        ran = len(self.ran) - failed
        return f"<RunReport: {ran} functions ran, {len(self.reused)} reused{', 1 failed' * failed}>"

    def __str__(self) -> str:
        return to_text(self)

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        return mimebundle(self)


class Reports(Sequence[RunReport]):
    """The reports of a runner's last 1,000 runs, the oldest first; without the values of their tokens."""

    def __init__(self) -> None:
        self.kept: deque[Times] = deque(maxlen=_KEPT)

    def add(self, times: Times) -> None:
        """Keep the times of one more run."""
        if len(times[2]) > _PACKED_ABOVE:
            times = _packed(times)
        self.kept.append(times)

    @overload
    def __getitem__(self, index: int) -> RunReport: ...
    @overload
    def __getitem__(self, index: slice) -> list[RunReport]: ...
    def __getitem__(self, index: int | slice) -> RunReport | list[RunReport]:
        if isinstance(index, slice):
            return [RunReport(*times) for times in list(self.kept)[index]]
        return RunReport(*self.kept[index])

    def __len__(self) -> int:
        return len(self.kept)

    def to_frame(self) -> pd.DataFrame:
        """Return a table: run (0 is the oldest), function, ran, time_ms, share (of that run's total), failed."""
        with optional_import():
            import pandas as pd

        rows = [(place, *row) for place, report in enumerate(self) for row in report._rows()]
        return pd.DataFrame(rows, columns=["run", *_COLUMNS])

    def __iter__(self) -> Iterator[RunReport]:
        return (RunReport(*times) for times in tuple(self.kept))

    def __repr__(self) -> str:
        return f"<Reports of {counted(len(self), 'run')}>"

    def __str__(self) -> str:
        return to_text(self)

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        return mimebundle(self)


def _packed(times: Times) -> Times:
    program, wanted, durations_ns, total_ns, side_by_side, failed_at = times
    if not isinstance(durations_ns, Mapping):
        return times
    packed: Sequence[int] = array("q", [durations_ns.get(step.place, -1) for step in program.steps])
    return program, wanted, packed, total_ns, side_by_side, failed_at
