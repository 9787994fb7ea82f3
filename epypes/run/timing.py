"""Times of runs: the report of one, the reports that a runner keeps, and the summary of many.

Durations are skewed: most are near the shortest possible, a few are much longer. So many of them are described by
log-normal distributions, fitted by maximum likelihood. Semeniuta and Falkman 2019, PeerJ Computer Science 5:e176,
figures 15 and 16.
"""

from __future__ import annotations

import math
from array import array
from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist, fmean
from types import MappingProxyType
from typing import TYPE_CHECKING, Final, overload

from epypes.errors import InvalidType, InvalidValue
from epypes.optional import optional_import
from epypes.rich_display import Displayed
from epypes.run.program import Program
from epypes.wording import counted

if TYPE_CHECKING:
    import pandas as pd

# The program, the steps that were wanted, nanoseconds by step that ran, nanoseconds in all, whether side by side, the
# step that failed (-1 if none did), the steps that were skipped. A RunReport is made of them when it is read. Durations
# of large graphs are packed: one for every step, -1 for those that did not run.
Durations = dict[int, int] | Sequence[int]
Times = tuple[Program, bytes | None, Durations, int, bool, int, tuple[int, ...]]

KEPT: Final = 1_000
_COLUMNS: Final = ("function", "ran", "time_ms", "share", "failed", "skipped")
_SUMMARY_COLUMNS: Final = ("function", "runs", "not_positive", "mode_ms", "median_ms", "p05_ms", "p95_ms")
_STANDARD: Final = NormalDist()
# Fewer durations say nothing of the tails: two that differ by a factor of 3 would get a range of a factor of 6.
_FEWEST_WITH_RANGE: Final = 5


def longest_path_ns(program: Program, durations_ns: Mapping[int, int]) -> int:
    """Return how long those functions take that need each other's outputs one after another, at most."""
    ends_ns: dict[int, int] = {}
    for place in sorted(durations_ns):
        makers = [program.makers[slot] for slot in program.steps[place].inputs]
        ends_ns[place] = durations_ns[place] + max((ends_ns.get(maker, 0) for maker in makers), default=0)
    return max(ends_ns.values(), default=0)


@dataclass(frozen=True, slots=True)
class FunctionTime:
    """How long one function took.

    Attributes
    ----------
    duration_ns
        In nanoseconds; of a function that failed until it raised, of one that was not called 0.
    ran
        Whether it was called, to whatever end; if not, it was reused or skipped.
    failed
        Whether it raised.
    skipped
        Whether it was not called since one of its inputs is Nothing.
    """

    function: str
    duration_ns: int
    ran: bool
    failed: bool = False
    skipped: bool = False

    @property
    def reused(self) -> bool:
        """Whether its outputs were still up to date."""
        return not self.ran and not self.skipped


class RunReport(Displayed):
    """The times of one run; does not change.

    Attributes
    ----------
    program
        What was run.
    total_ns
        From the start of the run to its end, in nanoseconds.
    side_by_side
        Whether functions may have run side by side.
    ran_ns
        Nanoseconds by step that ran.
    """

    __slots__ = ("_failed_at", "_skipped", "_wanted", "program", "ran_ns", "side_by_side", "total_ns")

    def __init__(
        self, program: Program, wanted: bytes | None, durations_ns: Durations, total_ns: int,
        side_by_side: bool = False, failed_at: int = -1, skipped: Sequence[int] = (),
    ) -> None:  # fmt: skip
        self.program, self._wanted, self.total_ns, self.side_by_side = program, wanted, total_ns, side_by_side
        self._failed_at, self._skipped = failed_at, skipped
        if not isinstance(durations_ns, dict):
            durations_ns = {place: duration for place, duration in enumerate(durations_ns) if duration >= 0}
        self.ran_ns = durations_ns

    @property
    def functions(self) -> tuple[FunctionTime, ...]:
        """One entry per function that the run needed, in run order; of a failed run those it came to."""
        ran_ns, wanted, failed_at, skipped = self.ran_ns, self._wanted, self._failed_at, frozenset(self._skipped)
        return tuple(
            FunctionTime(step.name, ran_ns.get(place, 0), place in ran_ns, place == failed_at, place in skipped)
            for place, step in enumerate(self.program.steps)
            if wanted is None or wanted[place] or place in ran_ns
        )

    @property
    def durations_ns(self) -> dict[str, int]:
        """Nanoseconds by function that ran, in run order; of one that failed until it raised."""
        return {self.program.steps[place].name: self.ran_ns[place] for place in sorted(self.ran_ns)}

    @property
    def ran(self) -> tuple[str, ...]:
        """The functions that ran, with the one that failed."""
        return tuple(self.durations_ns)

    @property
    def is_whole(self) -> bool:
        """Whether every function of the graph ran, and none failed."""
        return self._failed_at < 0 and len(self.ran_ns) == len(self.program.steps)

    @property
    def failed(self) -> str | None:
        """The function that failed, or None."""
        return None if self._failed_at < 0 else self.program.steps[self._failed_at].name

    @property
    def reused(self) -> tuple[str, ...]:
        """The functions whose outputs were still up to date."""
        others = {*self.ran_ns, *self._skipped}
        return self._names(place for place in range(len(self.program.steps)) if place not in others)

    @property
    def skipped(self) -> tuple[str, ...]:
        """The functions that were not called since one of their inputs is Nothing."""
        return self._names(sorted({*self._skipped} - self.ran_ns.keys()))

    def _names(self, places: Iterable[int]) -> tuple[str, ...]:
        """Return the names of those of these steps that the run needed."""
        wanted, steps = self._wanted, self.program.steps
        return tuple([steps[place].name for place in places if wanted is None or wanted[place]])

    @property
    def critical_path_ns(self) -> int:
        """The longest time that functions which need each other's outputs took one after another, in nanoseconds."""
        return longest_path_ns(self.program, self.ran_ns)

    @property
    def overhead_ns(self) -> int:
        """The graph overhead (the paper's o_cg), in nanoseconds.

        The total less the functions' times; where they run side by side, the total less the critical path. That
        includes the waiting for a free worker.
        """
        if self.side_by_side:
            return self.total_ns - self.critical_path_ns
        return self.total_ns - sum(self.ran_ns.values())

    def to_frame(self) -> pd.DataFrame:
        """Return a table: function, ran, time_ms, share (of the total), failed, skipped.

        A function that failed has ``ran`` true as well, and the time until it raised.
        """
        with optional_import():
            import pandas as pd

        return pd.DataFrame(self._rows(), columns=list(_COLUMNS))

    def _rows(self) -> list[tuple[str, bool, float, float, bool, bool]]:
        """Return what ``to_frame`` has as rows."""
        total_ns = max(self.total_ns, 1)
        return [
            (each.function, each.ran, each.duration_ns / 1e6, each.duration_ns / total_ns, each.failed, each.skipped)
            for each in self.functions
        ]

    def __repr__(self) -> str:
        failed, skipped = self._failed_at >= 0, len(self.skipped)
        ran, more = len(self.ran) - failed, f", {skipped} skipped" * bool(skipped) + ", 1 failed" * failed
        return f"<RunReport: {ran} functions ran, {len(self.reused)} reused{more}>"


def packed(program: Program, durations_ns: dict[int, int]) -> Durations:
    """Return the durations of a run of a large graph as they are kept; few are kept as they are."""
    if 4 * len(durations_ns) < len(program.steps):
        return durations_ns
    return array("q", [durations_ns.get(step.place, -1) for step in program.steps])


class Reports(Displayed, Sequence[RunReport]):
    """The reports of a runner's last 1,000 runs, the oldest first; without the values of their tokens."""

    def __init__(self) -> None:
        self.kept: deque[Times] = deque(maxlen=KEPT)

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
        """Return a table: run (0 is the oldest), function, ran, time_ms, share (of the run), failed, skipped."""
        with optional_import():
            import pandas as pd

        rows = [(place, *row) for place, report in enumerate(self) for row in report._rows()]
        return pd.DataFrame(rows, columns=["run", *_COLUMNS])

    def __iter__(self) -> Iterator[RunReport]:
        return (RunReport(*times) for times in tuple(self.kept))

    def __repr__(self) -> str:
        return f"<Reports of {counted(len(self), 'run')}>"


@dataclass(frozen=True, slots=True)
class LogNormal:
    """The log-normal distribution that fits some durations best; does not change.

    Attributes
    ----------
    count
        How many durations there are.
    not_positive
        How many of them are zero or negative, which a clock's resolution can cause; they are counted, not fitted.
    mu, sigma
        The mean and the population standard deviation of the logarithms of the positive ones, in nanoseconds; nan if
        there are none.
    least_ns, most_ns
        The range of all of them, in nanoseconds.

    Notes
    -----
    Semeniuta and Falkman 2019, PeerJ Computer Science 5:e176, figures 15 and 16: the curve is ``pdf``, the thin line
    is at ``mode_ns``, the thick lines are at ``least_ns`` and ``most_ns``.

    Examples
    --------
    >>> fitted = LogNormal(count=3, not_positive=0, mu=math.log(2e6), sigma=0.5, least_ns=1_000_000, most_ns=4_000_000)
    >>> round(fitted.median_ns), round(fitted.mode_ns), round(fitted.mean_ns)
    (2000000, 1557602, 2266297)
    """

    count: int
    not_positive: int
    mu: float
    sigma: float
    least_ns: int
    most_ns: int

    @property
    def is_fitted(self) -> bool:
        """Whether there was a positive duration to fit."""
        return self.not_positive < self.count

    @property
    def has_range(self) -> bool:
        """Whether at least 5 durations were fitted; fewer say nothing of the tails, so no range of them is shown."""
        return self.count - self.not_positive >= _FEWEST_WITH_RANGE

    @property
    def median_ns(self) -> float:
        """Half of the durations are shorter, in nanoseconds."""
        return math.exp(self.mu)

    @property
    def mode_ns(self) -> float:
        """The most likely duration, in nanoseconds."""
        return math.exp(self.mu - self.sigma**2)

    @property
    def mean_ns(self) -> float:
        """The mean of the distribution, in nanoseconds."""
        return math.exp(self.mu + self.sigma**2 / 2)

    def quantile_ns(self, share: float) -> float:
        """Return the duration that this share of the distribution stays below, in nanoseconds.

        Always that of the curve; whether the tails can be relied on says ``has_range``.

        Parameters
        ----------
        share
            Between 0 and 1, both excluded.
        """
        return math.exp(self.mu + self.sigma * _STANDARD.inv_cdf(share))

    def pdf(self, duration_ns: float) -> float:
        """Return the probability density at a duration, per nanosecond.

        nan if nothing was fitted. Where all durations are equal, it is infinite there and 0 elsewhere.
        """
        if not self.is_fitted:
            return math.nan
        if duration_ns <= 0:
            return 0.0
        log = math.log(duration_ns)
        if self.sigma == 0:
            return math.inf if log == self.mu else 0.0
        return NormalDist(self.mu, self.sigma).pdf(log) / duration_ns

    def __repr__(self) -> str:
        if not self.is_fitted:
            return f"<LogNormal of {self.count} durations: no positive value>"
        return f"<LogNormal of {self.count} durations{f', {self.not_positive} not positive' * bool(self.not_positive)}>"


@dataclass(frozen=True, slots=True)
class TimingSummary(Displayed):
    """The times of many runs, without those that failed; shows itself as bars and as a table.

    Of fewer than 5 durations no range from 5 % to 95 % is shown: few runs say nothing of the tails.

    Attributes
    ----------
    functions
        By function that ran at least once, in run order, how long it took in the runs in which it ran.
    total
        From the start of a run to its end.
    overhead
        The graph overhead (the paper's o_cg).
    runs
        How many runs were summarized.
    side_by_side
        Whether in one of them functions may have run side by side; graph overhead is then wall time less the critical
        path.
    failed_runs
        How many runs more there were that failed; their times are in no distribution.

    Notes
    -----
    Semeniuta and Falkman 2019, PeerJ Computer Science 5:e176, figures 15 and 16.
    """

    functions: Mapping[str, LogNormal]
    total: LogNormal
    overhead: LogNormal
    runs: int
    side_by_side: bool = False
    failed_runs: int = 0

    def to_frame(self) -> pd.DataFrame:
        """Return a table: function, runs, not_positive, mode_ms, median_ms, p05_ms, p95_ms.

        The last two rows are ``total`` and ``graph overhead``; p05 and p95 are quantiles of the fitted distribution,
        nan where fewer than 5 durations were fitted.
        """
        with optional_import():
            import pandas as pd

        rows = (*self.functions.items(), ("total", self.total), ("graph overhead", self.overhead))
        return pd.DataFrame([_row(name, fitted) for name, fitted in rows], columns=list(_SUMMARY_COLUMNS))

    def __repr__(self) -> str:
        functions = len(self.functions)
        return f"<TimingSummary: {counted(self.runs, 'run')}, {counted(functions, 'function')}>"


def summarize(reports: Iterable[RunReport]) -> TimingSummary:
    """Summarize the times of many runs by log-normal distributions.

    Parameters
    ----------
    reports
        Such as ``runner.reports``. Those of failed runs are counted and left out, since a function that raised did
        not take the time that it takes. Functions of one name in several graphs are taken together.

    Raises
    ------
    ValueError
        There is no report, or all are of failed runs.

    Notes
    -----
    Semeniuta and Falkman 2019, PeerJ Computer Science 5:e176, figures 15 and 16: maximum likelihood, so mu and sigma
    are the mean and the population standard deviation of the logarithms.

    Examples
    --------
    >>> import epypes as ep
    >>> runner = ep.CompGraphRunner(ep.CompGraph({"double": lambda x: 2 * x}, {"double": ("x", "y")}))
    >>> for x in range(5):
    ...     _ = runner.run(x=x)
    >>> ep.summarize(runner.reports)
    <TimingSummary: 5 runs, 1 function>
    """
    # A copy, since a run in another thread may add to the runner's reports meanwhile.
    given = tuple(reports) if isinstance(reports, Iterable) else (reports,)
    if not given:
        raise InvalidValue("There is no report to summarize. Run something: runner.run(...), then runner.reports.")
    for report in given:
        if not isinstance(report, RunReport):
            kind = type(report).__name__
            raise InvalidType(f"summarize takes RunReports, such as runner.reports, not {kind!r}.")
    ended = [report for report in given if report.failed is None]
    if not ended:
        failed = "The only run has failed" if len(given) == 1 else f"All {len(given)} runs have failed"
        raise InvalidValue(f"{failed}, so there are no times to summarize. runner.last.failure says why.")
    durations = _by_function(ended)
    return TimingSummary(
        functions=MappingProxyType({name: _fit(values) for name, values in durations.items() if values}),
        total=_fit([report.total_ns for report in ended]),
        overhead=_fit([report.overhead_ns for report in ended]),
        runs=len(ended),
        side_by_side=any(report.side_by_side for report in ended),
        failed_runs=len(given) - len(ended),
    )


def _by_function(reports: Sequence[RunReport]) -> dict[str, list[int]]:
    """Return the durations by function of the graphs that were run, in run order."""
    programs = dict.fromkeys(report.program for report in reports)
    found: dict[str, list[int]] = {step.name: [] for program in programs for step in program.steps}
    for report in reports:
        for name, duration_ns in report.durations_ns.items():
            found[name].append(duration_ns)
    return found


def _fit(durations_ns: Sequence[int]) -> LogNormal:
    """Fit the positive durations by maximum likelihood."""
    logs = [math.log(duration) for duration in durations_ns if duration > 0]
    mu = sigma = math.nan
    if logs:
        mu = fmean(logs)
        sigma = math.sqrt(fmean([(log - mu) ** 2 for log in logs]))
    count = len(durations_ns)
    return LogNormal(count, count - len(logs), mu, sigma, min(durations_ns), max(durations_ns))


def _row(name: str, fitted: LogNormal) -> tuple[str | int | float, ...]:
    low_ns, high_ns = (fitted.quantile_ns(share) if fitted.has_range else math.nan for share in (0.05, 0.95))
    times_ns = (fitted.mode_ns, fitted.median_ns, low_ns, high_ns)
    return name, fitted.count, fitted.not_positive, *(time / 1e6 for time in times_ns)
