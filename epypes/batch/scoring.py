"""How good is a run on a case, and how good is a setting on all of them?"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

from epypes.batch.cache import combined_digest, function_digest
from epypes.batch.cases import Case
from epypes.batch.results import Outcome
from epypes.errors import ScaleError
from epypes.graph import CompGraph

Measure = Callable[[Mapping[str, Any], Case], Any]
Metric = Measure | str
_REASON_CHARACTERS = 300


@dataclass(frozen=True, slots=True)
class Score:
    """What a setting gave.

    Attributes
    ----------
    value
        The metric, averaged over the cases; None if one of them failed.
    failure
        Which case failed, and why; empty if none did.
    total_ns
        Nanoseconds of the functions that ran.
    unreadable
        Which file of a case can't be read, in which case no other setting gives anything either; empty if none.
    """

    value: float | None
    failure: str
    total_ns: int
    unreadable: str = ""


class Scoring:
    """Measures outcomes.

    Parameters
    ----------
    cg
        The graph.
    metric
        ``metric(tokens, case)`` is called with the kept tokens of a run and its case, on the thread of the caller; or
        the name of a token that is a number.
    cases
        What is run.
    keep
        The tokens that the metric is given; all sink tokens without.

    Raises
    ------
    ScaleError
        The metric is neither a function nor a name, or looks at nothing.
    UnknownName
        The graph has no such token.
    """

    def __init__(self, cg: CompGraph, metric: Metric, cases: Sequence[Case], keep: Sequence[str] | None = None) -> None:
        if not isinstance(metric, str) and not callable(metric):
            kind = type(metric).__name__
            raise ScaleError(f"metric is a function metric(tokens, case), or the name of a token, not a {kind!r}.")
        self.cases = tuple(cases)
        self.name: str = metric if isinstance(metric, str) else getattr(metric, "__name__", "metric")
        self.keep: tuple[str, ...] = cg.sink_tokens if keep is None else tuple(keep)
        self._measure: Measure
        self._is_token = isinstance(metric, str)
        if isinstance(metric, str):
            self.keep, self._measure = (metric,), _value_of(metric)
        else:
            self._measure = metric
        for token in self.keep:
            cg.require_token(token)

    def digest(self) -> str:
        """Return what tells the metric from others, with what it is given.

        Raises
        ------
        Untold
            Nobody can say what it computes, as of an object that is called.
        """
        measure = "token" if self._is_token else function_digest(self._measure)
        return combined_digest("metric", measure, *self.keep).hex()

    def of_outcomes(self, outcomes: Iterable[Outcome]) -> Score:
        """Return the score of a setting by what it gave, in the order of the cases; after a failure none is taken."""
        values: list[float] = []
        spent_ns = 0
        for case, outcome in zip(self.cases, outcomes, strict=True):
            spent_ns += outcome.total_ns
            value, failure = self.of_one(case, outcome)
            if value is None:
                error_info = outcome.error_info
                unreadable = error_info.message if error_info is not None and error_info.is_unreadable else ""
                return Score(None, failure, spent_ns, unreadable)
            values.append(value)
        return Score(math.fsum(values) / len(values), "", spent_ns)

    def of_one(self, case: Case, outcome: Outcome) -> tuple[float | None, str]:
        """Return the metric of one case, or None and why there is none."""
        if outcome.error_info is not None:
            return None, self._said(case, str(outcome.error_info))
        try:
            given = self._measure(MappingProxyType(dict(outcome.kept)), case)
        except (Exception, SystemExit) as error:
            return None, self._said(case, f"{self.name} raised {type(error).__name__}: {error}")
        try:
            value = float(given)
        except (TypeError, ValueError):
            return None, self._said(case, f"{self.name} gave a {type(given).__name__!r}, no number")
        if not math.isfinite(value):
            return None, self._said(case, f"{self.name} gave {value}")
        return value, ""

    def _said(self, case: Case, reason: str) -> str:
        where = f"{case.name}: " if len(self.cases) > 1 and case.name else ""
        return f"{where}{reason}"[:_REASON_CHARACTERS]


def _value_of(token: str) -> Measure:
    return lambda tokens, _: tokens[token]
