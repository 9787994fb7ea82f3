"""The objective of a search: a metric, averaged over cases; and the digests that tell one search from another."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

from epypes.batch.cache import (
    NoDigest,
    function_digest,
    graph_fingerprint,
    payload_digest,
    source_of,
    value_digest,
)
from epypes.batch.cases import Case
from epypes.batch.fingerprint import combined_digest
from epypes.batch.items import Item
from epypes.batch.ranges import Axis, ChoiceAxis
from epypes.batch.results import Outcome
from epypes.errors import EpypesError, ScaleError
from epypes.graph import CompGraph
from epypes.run import CompGraphRunner

ObjectiveMetric = Callable[[Mapping[str, Any], Case], Any] | str
_REASON_CHARACTERS: Final = 300


@dataclass(frozen=True, slots=True)
class Score:
    """The result of one setting over all cases.

    Attributes
    ----------
    value
        The metric, averaged over the cases; None if one of them failed.
    failure
        The case that failed, and the reason; empty if none did.
    total_ns
        Nanoseconds of the functions that ran.
    unreadable
        The reason if a file of a case can't be read: no other setting gives anything either. Empty otherwise.
    """

    value: float | None
    failure: str
    total_ns: int
    unreadable: str = ""


class Objective:
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
        The metric is neither a function nor a name.
    UnknownName
        The graph has no such token.
    """

    def __init__(
        self, cg: CompGraph, metric: ObjectiveMetric, cases: Sequence[Case], keep: Sequence[str] | None = None
    ) -> None:
        if not isinstance(metric, str) and not callable(metric):
            kind = type(metric).__name__
            raise ScaleError(f"metric is a function metric(tokens, case), or the name of a token, not a {kind!r}.")
        self.cases = tuple(cases)
        self._metric = metric
        self.keep: tuple[str, ...]
        if isinstance(metric, str):
            self.name, self.keep = metric, (metric,)
        else:
            self.name = getattr(metric, "__name__", "metric")
            self.keep = cg.sink_tokens if keep is None else tuple(keep)
        for token in self.keep:
            cg.require_token(token)

    def score(self, outcomes: Mapping[int, Outcome]) -> Score:
        """Return the score of a setting by its outcomes, by place of the case; it ends at the first failure."""
        values: list[float] = []
        spent_ns = 0
        for index, outcome in sorted(outcomes.items()):
            case = self.cases[index]
            spent_ns += outcome.total_ns
            error = outcome.error_info
            value, failure = self._measured(case, outcome) if error is None else (math.nan, str(error))
            if failure:
                where = f"{case.name}: " if len(self.cases) > 1 and case.name else ""
                unreadable = error.message if error is not None and error.is_unreadable else ""
                return Score(None, f"{where}{failure}"[:_REASON_CHARACTERS], spent_ns, unreadable)
            values.append(value)
        return Score(math.fsum(values) / len(values), "", spent_ns)

    def _measured(self, case: Case, outcome: Outcome) -> tuple[float, str]:
        """Return the metric of one case, and the reason if there is none."""
        tokens, metric = MappingProxyType(dict(outcome.kept)), self._metric
        try:
            given = tokens[metric] if isinstance(metric, str) else metric(tokens, case)
        except (Exception, SystemExit) as error:
            return math.nan, f"{self.name} raised {type(error).__name__}: {error}"
        try:
            value = float(given)
        except (TypeError, ValueError, OverflowError):
            return math.nan, f"{self.name} gave a {type(given).__name__!r}, no number"
        return value, "" if math.isfinite(value) else f"{self.name} gave {value}"

    def digest(self) -> str:
        """Return the digest of the metric and of what it is given.

        Raises
        ------
        NoDigest
            The metric reaches something without a digest, such as a generator.
        """
        metric = "token" if isinstance(self._metric, str) else function_digest(self._metric)
        return combined_digest("metric", metric, *self.keep).hex()


# -- which search it is -----------------------------------------------------------------------------------------


def code_digests(runner: CompGraphRunner, objective: Objective, *, is_named: bool) -> dict[str, str]:
    """Return the digests of the graph and of the metric; see ``search_digests``."""
    return _digests({"graph": lambda: _graph_digest(runner.cg), "metric": objective.digest}, is_named=is_named)


def search_digests(
    runner: CompGraphRunner, axes: Sequence[Axis], objective: Objective, items: Sequence[Item], *, is_named: bool
) -> dict[str, str]:
    """Return digests of all that decides about the trials of a search, by what they are of.

    Parameters
    ----------
    runner
        Its graph and the hyperparameters that do not vary.
    axes
        What varies.
    objective
        The metric and the cases.
    items
        The inputs of the cases.
    is_named
        Whether the user has given the search a name; what has no digest has "" then.

    Raises
    ------
    ScaleError
        Something has no digest, and the search no name.
    """
    varied = {axis.token for axis in axes}
    fixed = {token: value for token, value in runner.hyperparameters.items() if token not in varied}
    choices = {axis.token: axis.choices for axis in axes if isinstance(axis, ChoiceAxis)}
    labels = [(case.name, dict(case.expected or {}), dict(case.hyperparameters or {})) for case in objective.cases]
    data = {
        "hyperparameters": lambda: value_digest(fixed),
        "choices": lambda: value_digest(choices),
        "inputs of the cases": lambda: value_digest([(item.name, payload_digest(item.payload)) for item in items]),
        "labels of the cases": lambda: value_digest(labels),
    }
    return code_digests(runner, objective, is_named=is_named) | _digests(data, is_named=is_named)


def search_name(metric: str, direction: str, axes: Sequence[Axis], digests: Mapping[str, str]) -> str:
    """Return the name of a search that the user has not named: a digest of what it computes."""
    ranges = [axis.labels if isinstance(axis, ChoiceAxis) else repr(axis) for axis in axes]
    text = repr((direction, [axis.token for axis in axes], ranges, sorted(digests.items())))
    return f"optimize {metric} {combined_digest('search', text).hex()[:12]}"


def _digests(ways: Mapping[str, Callable[[], str]], *, is_named: bool) -> dict[str, str]:
    found = {}
    for what, way in ways.items():
        try:
            found[what] = way()
        except (EpypesError, NoDigest) as error:
            if not is_named:
                text = f"What is searched has no name for the store. Nothing tells its {what} from others: {error}"
                raise ScaleError(f"{text}.\nGive one: name='...'.") from error
            found[what] = ""
    return found


def _graph_digest(cg: CompGraph) -> str:
    found = graph_fingerprint(cg, source_of(cg))
    if found.unknown:
        raise NoDigest(found.unknown)
    return combined_digest("graph", found.code, found.state).hex()
