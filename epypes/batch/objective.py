"""How good is a run on a case, and how good is a setting on all of them?"""

from __future__ import annotations

import math
import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Final

from epypes.batch.cache import (
    NoDigest,
    combined_digest,
    function_digest,
    graph_fingerprint,
    payload_digest,
    value_digest,
)
from epypes.batch.cases import Case
from epypes.batch.items import Item
from epypes.batch.ranges import Axis, Choices
from epypes.batch.results import Outcome
from epypes.bundle import to_source
from epypes.errors import EpypesError, PlaceholderNeeded, ScaleError, SourceRefused
from epypes.graph import CompGraph
from epypes.run import CompGraphRunner

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


GRAPH: Final = "graph"
METRIC: Final = "metric"
_PYTHON: Final = "Python"


def about_search(
    runner: CompGraphRunner, axes: Sequence[Axis], scoring: Scoring, items: Sequence[Item], *, is_named: bool
) -> dict[str, str]:
    """Return digests of all that decides about the trials of a search, by what they are of.

    Parameters
    ----------
    runner
        Its graph and the hyperparameters that do not vary.
    axes
        What varies.
    scoring
        The metric and the cases.
    items
        What goes into the cases.
    is_named
        Whether the user tells searches apart by a name; what has no digest has "" then.

    Raises
    ------
    ScaleError
        Something has no digest, and the search no name.
    """
    varied = {axis.token for axis in axes}
    fixed = {token: value for token, value in runner.hyperparameters.items() if token not in varied}
    choices = {axis.token: axis.values for axis in axes if isinstance(axis, Choices)}
    labels = [(case.name, case.expected, case.hyperparameters) for case in scoring.cases]
    ways: dict[str, Callable[[], str]] = {
        GRAPH: lambda: _graph_digest(runner, is_named),
        "hyperparameters": lambda: value_digest(fixed),
        "choices": lambda: value_digest(choices),
        METRIC: scoring.digest,
        "inputs of the cases": lambda: value_digest([(item.name, payload_digest(item.payload)) for item in items]),
        "labels of the cases": lambda: value_digest(
            [[part if part is None or isinstance(part, str) else dict(part) for part in label] for label in labels]
        ),
    }
    found = {_PYTHON: ".".join(platform.python_version_tuple()[:2])}
    for what, way in ways.items():
        try:
            found[what] = way()
        except (EpypesError, NoDigest) as error:
            if not is_named:
                text = f"What is searched has no name for the store. Nothing tells its {what} from others: {error}"
                raise ScaleError(f"{text}.\nGive one: name='...'.") from error
            found[what] = ""
    return found


def _graph_digest(runner: CompGraphRunner, is_named: bool) -> str:
    try:
        source = to_source(runner.cg)
    except (SourceRefused, PlaceholderNeeded):
        if not is_named:
            raise
        source = None
    found = graph_fingerprint(runner.cg, source)
    if found.unknown:
        raise NoDigest(found.unknown)
    return combined_digest("graph", found.code, found.state).hex()


def name_of(metric: str, direction: str, axes: Sequence[Axis], about: Mapping[str, str]) -> str:
    """Return what a search is called in a store if the user does not say: a digest of what it computes."""
    said = [axis.labels if isinstance(axis, Choices) else repr(axis) for axis in axes]
    digest = combined_digest("search", repr((direction, [axis.token for axis in axes], said, sorted(about.items()))))
    return f"optimize {metric} {digest.hex()[:12]}"


def changed_meanwhile(runner: CompGraphRunner, scoring: Scoring, about: Mapping[str, str]) -> list[str]:
    """Return what is another one now than before the search, as a function is that takes notes in a list."""
    ways = {GRAPH: lambda: _graph_digest(runner, True), METRIC: scoring.digest}
    return [what for what, way in ways.items() if about.get(what) and _or_none(way) != about[what]]


def _or_none(way: Callable[[], str]) -> str | None:
    try:
        return way()
    except (EpypesError, NoDigest):
        return None


def changed_in(before: Mapping[str, str], about: Mapping[str, str]) -> str:
    """Return what is another one than before, in words; "" if nothing is, as far as that can be told."""
    # Another Python has other code for the same function.
    untold = {_PYTHON} if before.get(_PYTHON) == about.get(_PYTHON) else {_PYTHON, METRIC}
    changed = [what for what in about if what not in untold and before.get(what) and about[what]]
    changed = [what for what in changed if before[what] != about[what]]
    return f"other {' and '.join(changed)}" if changed else ""
