"""What is known of each request of an experiment? A row of durations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from epypes.experiment.robot import Answer
from epypes.optional import optional_import

if TYPE_CHECKING:
    import pandas as pd

COMPONENTS: Final = ("vision", "acquisition")
_TIMES: Final = ("t_p", "o_cg", "t_fin", "t_fout", "o_epypes")
_WHO: Final = ("experiment", "request", "id")
_NUMBERS: Final = (
    "t_trip",
    "acquisition.t_rp",
    "vision.t_rp",
    "o_network",
    *(f"{name}.{time}" for name in COMPONENTS for time in _TIMES),
)
COLUMNS: Final = (*_WHO, *_NUMBERS, "failure")


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
    """

    layout: str
    table: pd.DataFrame
    counts: Mapping[str, int] = field(default_factory=dict)

    def to_csv(self, path: str | Path) -> None:
        """Write the table to a file, with every digit of the durations."""
        self.table.to_csv(path, index=False)

    def __repr__(self) -> str:
        failed = int((self.table["failure"] != "").sum())
        return f"<Results of layout {self.layout}: {len(self.table)} requests, {failed} failed>"


def table_of(rows: Sequence[Mapping[str, Any]]) -> pd.DataFrame:
    """Return rows as a table with the columns in their order, also of no rows."""
    with optional_import("experiment"):
        import pandas as pd

    return pd.DataFrame(list(rows), columns=list(COLUMNS)).astype(dict.fromkeys(_NUMBERS, float))


def row_of(answer: Answer, experiment: int, request: int) -> dict[str, Any]:
    """Return the row of an answer. Only durations of one clock are combined.

    An answer that lacks a time, as that of another component may, is a failure.
    """
    row: dict[str, Any] = {"experiment": experiment, "request": request, "id": answer.id, "failure": answer.failure}
    if not answer.failure:
        try:
            row |= durations_of(answer.t_trip, answer.attributes)
        except KeyError as error:
            row["failure"] = f"robot: the answer has no attribute {error}"
    return dict.fromkeys(_NUMBERS, float("nan")) | row


def durations_of(t_trip: float, times: Mapping[str, Any]) -> dict[str, float]:
    """Return the durations of a request by column.

    Parameters
    ----------
    t_trip
        By the robot's clock.
    times
        The attributes of the answer: time stamps and durations of each component, by its own clock.
    """
    durations = {"t_trip": t_trip}
    for name in COMPONENTS:
        own = {key: times[f"{name}.{key}"] for key in ("t_react", "t_pub", "t_p", "o_cg")}
        t_rp = own["t_pub"] - own["t_react"]
        t_fin = times[f"{name}.t_fin_end"] - times[f"{name}.t_fin_start"]
        t_fout = times[f"{name}.t_fout_end"] - times[f"{name}.t_fout_start"]
        values = (own["t_p"], own["o_cg"], t_fin, t_fout, t_rp - (own["t_p"] + t_fin + t_fout))
        durations[f"{name}.t_rp"] = t_rp
        durations |= {f"{name}.{time}": value for time, value in zip(_TIMES, values, strict=True)}
    durations["o_network"] = t_trip - sum(durations[f"{name}.t_rp"] for name in COMPONENTS)
    return durations
