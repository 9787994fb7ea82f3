"""The results of an experiment: durations by request, their summary, and the log-normal distributions that fit them.

Semeniuta and Falkman 2019, PeerJ Computer Science 5:e176.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, cast

import numpy as np
import pandas as pd

from epypes.errors import InvalidValue

if TYPE_CHECKING:
    from epypes.experiment.run import Answer

# Seconds, by column of the table: where the curves over all data of the paper's figures 15 and 16 are highest.
PAPER: Final[Mapping[str, float]] = MappingProxyType({"vision.o_cg": 0.3e-3, "vision.o_epypes": 0.02e-3})
_COMPONENTS: Final = ("vision", "acquisition")
_TIMES: Final = ("t_p", "o_cg", "t_fin", "t_fout", "o_epypes")
_STAMPS: Final = ("t_react", "t_fin_start", "t_fin_end", "t_p", "o_cg", "t_fout_start", "t_fout_end", "t_pub")
_DURATIONS: Final = (
    "t_trip",
    "acquisition.t_rp",
    "vision.t_rp",
    "o_network",
    *(f"{name}.{time}" for name in _COMPONENTS for time in _TIMES),
)
COLUMNS: Final = ("experiment", "request", "id", *_DURATIONS, "failure")
_MS: Final = 1e3


@dataclass(frozen=True, slots=True, eq=False)
class Results:
    """The results of an experiment.

    Attributes
    ----------
    layout
        How its nodes were spread over processes.
    table
        A row per request; durations are in seconds, and nan where ``failure`` says what failed.
    counts
        What else came to the robot: late answers, failures of no request, messages that are no answers.
    transport
        What carried the messages.
    cpu_s
        The CPU time of all processes during the requests, with that of the cameras, in seconds.
    """

    layout: str
    table: pd.DataFrame
    counts: Mapping[str, int] = field(default_factory=dict)
    transport: str = "zeromq"
    cpu_s: float = math.nan

    def __add__(self, later: Results) -> Results:
        """Return the results of one experiment and of others that followed it, alike in layout and transport."""
        table = later.table.assign(experiment=later.table["experiment"] + self.table["experiment"].nunique())
        counts = Counter(self.counts) + Counter(later.counts)
        whole = pd.concat([self.table, table], ignore_index=True)
        return Results(self.layout, whole, counts, self.transport, self.cpu_s + later.cpu_s)

    def to_csv(self, path: str | Path) -> None:
        """Write the table to a file, with every digit of the durations."""
        self.table.to_csv(path, index=False)

    def __repr__(self) -> str:
        failed = int((self.table["failure"] != "").sum())
        return f"<Results of layout {self.layout}: {len(self.table)} requests, {failed} failed>"


def table_of(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return rows as a table with the columns in their order, also of no rows."""
    return pd.DataFrame(list(rows), columns=list(COLUMNS)).astype(dict.fromkeys(_DURATIONS, float))


def row_of(answer: Answer, experiment: int, request: int) -> dict[str, Any]:
    """Return the row of an answer. An answer that lacks a time, as that of another component may, is a failure."""
    row: dict[str, Any] = {"experiment": experiment, "request": request, "id": answer.id, "failure": answer.failure}
    if not answer.failure:
        try:
            row |= durations_of(answer.t_trip, answer.attributes)
        except KeyError as error:
            row["failure"] = f"robot: the answer has no attribute {error}"
    return dict.fromkeys(_DURATIONS, math.nan) | row


def durations_of(t_trip: float, times: Mapping[str, Any]) -> dict[str, float]:
    """Return the durations of a request by column. Only times of one clock are combined.

    Parameters
    ----------
    t_trip
        By the robot's clock.
    times
        The attributes of the answer: time stamps and durations of each component, by its own clock.
    """
    durations = {"t_trip": t_trip}
    for name in _COMPONENTS:
        time = {stamp: times[f"{name}.{stamp}"] for stamp in _STAMPS}
        t_rp, t_fin = time["t_pub"] - time["t_react"], time["t_fin_end"] - time["t_fin_start"]
        t_fout = time["t_fout_end"] - time["t_fout_start"]
        values = (time["t_p"], time["o_cg"], t_fin, t_fout, t_rp - (time["t_p"] + t_fin + t_fout))
        durations[f"{name}.t_rp"] = t_rp
        durations |= {f"{name}.{key}": value for key, value in zip(_TIMES, values, strict=True)}
    durations["o_network"] = t_trip - sum(durations[f"{name}.t_rp"] for name in _COMPONENTS)
    return durations


def answered(table: pd.DataFrame, *columns: str) -> np.ndarray:
    """Return whether each request was answered, a bool per row; those that failed have no times.

    Raises
    ------
    ValueError
        It is no table of an experiment, or lacks some of the columns that are needed.
    """
    if not isinstance(table, pd.DataFrame):
        kind = type(table).__name__
        raise InvalidValue(f"A table of an experiment is needed, as run_experiment(...).table, not {kind!r}.")
    if table.empty:
        return np.zeros(0, dtype=bool)
    missing = [column for column in ("experiment", "failure", *columns) if column not in table]
    if missing:
        names = ", ".join(map(repr, missing))
        raise InvalidValue(
            f"The table has no column {names}. It must be that of an experiment: run_experiment(...).table."
        )
    # An empty text is missing once the table has been read from a file.
    return (table["failure"].fillna("") == "").to_numpy(dtype=bool)


def summary(table: pd.DataFrame) -> pd.DataFrame:
    """Summarize the times of an experiment beside the paper's own.

    Parameters
    ----------
    table
        A row per request, as ``Results.table``.

    Returns
    -------
    DataFrame
        A row per time, in milliseconds: ``requests`` that were answered, ``not_positive`` values among them,
        ``median_ms``, ``mode_ms`` of the log-normal distribution, the range from ``least_ms`` to ``most_ms``, and
        ``paper_mode_ms``, nan where the paper names none.
    """
    rows = table[answered(table)]
    found = {}
    for time in rows.select_dtypes("number").columns.difference(["experiment", "request"], sort=False):
        values = rows[time].dropna()
        fitted = lognormal_fit(values)
        in_s = (values.median(), fitted.mode, values.min(), values.max(), PAPER.get(time, math.nan))
        found[time] = [len(values), fitted.left_out, *(_MS * value for value in in_s)]
    columns = ["requests", "not_positive", "median_ms", "mode_ms", "least_ms", "most_ms", "paper_mode_ms"]
    return pd.DataFrame.from_dict(found, orient="index", columns=columns)


def comparison(results: Iterable[Results]) -> pd.DataFrame:
    """Compare transports, a row for each, in milliseconds: trips, the network's part of them, and CPU per request."""
    rows = {}
    for each in results:
        found = each.table[answered(each.table)]
        times = [found[name] for name in ("t_trip", "o_network")]
        in_s = [value for time in times for value in (lognormal_fit(time).mode, time.quantile(0.99))]
        rows[each.transport] = [len(found), *(_MS * value for value in (*in_s, each.cpu_s / len(each.table)))]
    columns = ["requests", "trip_mode_ms", "trip_p99_ms", "network_mode_ms", "network_p99_ms", "cpu_ms"]
    return pd.DataFrame.from_dict(rows, orient="index", columns=columns)


@dataclass(frozen=True, slots=True)
class LogNormal:
    """The log-normal distribution that fits some times best; does not change.

    Attributes
    ----------
    mu, sigma
        The mean and the population standard deviation of the times' logarithms, in seconds; nan if there is no time.
    count
        How many times were fitted.
    left_out
        How many more there were that no log-normal distribution has: zero, negative, infinite or missing.
    """

    mu: float
    sigma: float
    count: int
    left_out: int

    @property
    def mode(self) -> float:
        """The most likely time, in seconds; nan if nothing was fitted."""
        return math.exp(self.mu - self.sigma**2)

    @property
    def has_curve(self) -> bool:
        """Whether there is a density to draw: times that differ."""
        return self.count > 1 and self.sigma > 0

    def pdf(self, times: np.ndarray) -> np.ndarray:
        """Return the probability density at positive times in seconds, per second; nan where there is no curve."""
        from scipy import stats

        return cast("np.ndarray", stats.lognorm.pdf(times, self.sigma or math.nan, scale=math.exp(self.mu)))


def lognormal_fit(values: Iterable[float]) -> LogNormal:
    """Fit a log-normal distribution to times by maximum likelihood.

    Values that aren't positive numbers are counted, not fitted. Where all times are equal, ``sigma`` is 0.

    Examples
    --------
    >>> fitted = lognormal_fit([1e-3, 4e-3, 0.0])
    >>> round(math.exp(fitted.mu), 6), round(fitted.mode, 6), fitted.count, fitted.left_out
    (0.002, 0.001237, 2, 1)
    """
    given = np.fromiter(values, float)
    times = given[np.isfinite(given) & (given > 0)]
    if not len(times):
        return LogNormal(math.nan, math.nan, 0, len(given))
    logs = np.log(times)
    # The mean of equal logarithms can be off by its last bit, which would look like a spread.
    sigma = 0.0 if np.ptp(times) == 0 else float(np.std(logs))
    return LogNormal(float(np.mean(logs)), sigma, len(times), len(given) - len(times))
