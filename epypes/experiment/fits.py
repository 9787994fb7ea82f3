"""Which log-normal distribution fits measured times best, and what did the paper measure?

Semeniuta and Falkman 2019, PeerJ Computer Science 5:e176, figures 15 and 16.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from epypes.optional import optional_import

if TYPE_CHECKING:
    import numpy as np
    import pandas as pd

# Seconds, by column of the table: where the curves over all data of figures 15 and 16 are highest.
PAPER: Final[Mapping[str, float]] = MappingProxyType({"vision.o_cg": 0.3e-3, "vision.o_epypes": 0.02e-3})

# The columns of numbers that are no times.
_PLACES: Final = ("experiment", "request")
_MS: Final = 1e3


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
        """Return the probability density at some times.

        Parameters
        ----------
        times
            Positive, in seconds; float, of any shape.

        Returns
        -------
        array
            Per second, of that shape; nan where there is no curve.
        """
        import numpy as np

        if not self.has_curve:
            return np.full_like(times, np.nan)
        away = (np.log(times) - self.mu) / self.sigma
        return np.asarray(np.exp(-(away**2) / 2) / (times * self.sigma * math.sqrt(2 * math.pi)))


def lognormal_fit(values: Iterable[float]) -> LogNormal:
    """Fit a log-normal distribution to times by maximum likelihood.

    Values that aren't positive numbers are counted, not fitted. Where all times are equal, ``sigma`` is 0.

    Examples
    --------
    >>> fitted = lognormal_fit([1e-3, 4e-3, 0.0])
    >>> round(math.exp(fitted.mu), 6), round(fitted.mode, 6), fitted.count, fitted.left_out
    (0.002, 0.001237, 2, 1)
    """
    import numpy as np

    given = np.fromiter(values, float)
    times = given[np.isfinite(given) & (given > 0)]
    if not len(times):
        return LogNormal(math.nan, math.nan, 0, len(given))
    logs = np.log(times)
    # The mean of equal logarithms can be off by its last bit, which would look like a spread.
    sigma = 0.0 if np.ptp(times) == 0 else float(np.std(logs))
    return LogNormal(float(np.mean(logs)), sigma, len(times), len(given) - len(times))


def answered(table: pd.DataFrame, *columns: str) -> np.ndarray:
    """Return whether each request was answered, a bool per row; those that failed have no times.

    Raises
    ------
    ValueError
        It is no table of an experiment, or lacks some of the columns that are needed.
    """
    with optional_import("experiment"):
        import pandas as pd

    if not isinstance(table, pd.DataFrame):
        kind = type(table).__name__
        raise ValueError(f"A table of an experiment is needed, as run_experiment(...).table, not {kind!r}.")
    missing = [column for column in ("experiment", "failure", *columns) if column not in table]
    if missing and len(table):
        names = ", ".join(map(repr, missing))
        raise ValueError(
            f"The table has no column {names}. It must be that of an experiment: run_experiment(...).table."
        )
    # What was an empty text is missing once the table has been read from a file.
    failures = table["failure"].fillna("") if len(table) else pd.Series(dtype=str)
    return (failures == "").to_numpy(dtype=bool)


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
    with optional_import("experiment"):
        import pandas as pd

    rows = table[answered(table)]
    times = [str(time) for time in rows.select_dtypes("number") if time not in _PLACES]
    described = [_described(time, rows[time].dropna()) for time in times]
    columns = ["requests", "not_positive", "median_ms", "mode_ms", "least_ms", "most_ms", "paper_mode_ms"]
    return pd.DataFrame(described, index=times, columns=columns)


def _described(time: str, values: pd.Series[Any]) -> list[float]:
    fitted = lognormal_fit(values)
    in_s = (values.median(), fitted.mode, values.min(), values.max(), PAPER.get(time, math.nan))
    return [len(values), fitted.left_out, *(_MS * value for value in in_s)]
