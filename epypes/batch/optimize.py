"""The search for the values of hyperparameters that give the best results over many cases."""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final

from epypes.batch.cache import (
    NoDigest,
    function_digest,
    graph_fingerprint,
    payload_digest,
    reader_text,
    value_digest,
)
from epypes.batch.cases import Case, cases_of, with_labels_read
from epypes.batch.executors import run_jobs, runs_here, worker_count
from epypes.batch.items import Item, detached_runner, items_of
from epypes.batch.job import Job, SharedStart
from epypes.batch.progress import progress_bar
from epypes.batch.ranges import Axis, ChoiceAxis, axes_of
from epypes.batch.results import Outcome
from epypes.batch.search_result import OptimizeResult
from epypes.batch.study import Direction, Search, Suggestion, Trial
from epypes.bundle.fingerprint import combined_digest
from epypes.errors import EpypesError, ScaleError
from epypes.graph import CompGraph
from epypes.run import CompGraphRunner
from epypes.store import opened_store
from epypes.wording import ended

if TYPE_CHECKING:
    from epypes.store import Store

# Of the values that are held between settings; further cases run from their files or arrays each time.
MOST_BYTES: Final = 2**30
_CASE_FILE: Final = ".toml"
ObjectiveMetric = Callable[[Mapping[str, Any], Case], Any] | str
_REASON_CHARACTERS: Final = 300
_DIRECTIONS: Final = ("maximize", "minimize")


def optimize(
    runner: CompGraphRunner,
    metric: ObjectiveMetric,
    cases: Any,
    n: int = 100,
    *,
    executor: Executor | None = None,
    direction: Direction = "maximize",
    ranges: Mapping[str, Any] | None = None,
    keep: Sequence[str] | None = None,
    seed: int = 0,
    store: str | Path | Store | None = None,
    name: str | None = None,
    stop: threading.Event | None = None,
    on_trial: Callable[[Trial], object] | None = None,
    progress: bool | None = None,
) -> OptimizeResult:
    """Search the values of hyperparameters that make a metric best over a set of cases; the runner is left as it is.

    Parameters
    ----------
    runner
        Its graph is run; hyperparameters that do not vary have the values that it has.
    metric
        ``metric(tokens, case)`` returns a number: how good the values of a run, by token, are for its case. It is
        called in this process, by the thread that calls this. Or the name of a token that is a number itself. What
        counts is the mean over all cases.
    cases
        ``ep.Case``, dicts or inputs alone; the path of a file of cases; or a folder or glob of images. Without labels a
        case is its inputs.
    n
        How many trials there are to be: with a store, those that are in there already count.
    executor
        Runs the cases, as for ``ep.map``; several trials then run at a time, so the settings that are tried depend on
        the order in which trials end. Threads, and the calling thread without, run of each case only what depends on
        what has changed.
    direction
        ``"maximize"`` or ``"minimize"``.
    ranges
        By hyperparameter, which values are tried: an ``ep.Param``, a tuple (low, high[, step]) or a list of choices;
        no others vary. Without, all vary that have a range by an annotation, or by the tables of OpenCV and
        scikit-image.
    keep
        Tokens that a metric is given; the sink tokens without. Only what they need is run.
    seed
        The same one tries the same, if there is no executor.
    store
        Path, URL or ``ep.Store`` of a database that keeps the trials, in Optuna's own tables. A second call goes on.
    name
        Of the study in the store; without, it follows from the graph and its other hyperparameters, from what is
        searched, from what the metric computes, and from the cases: what goes into them, their labels and their
        hyperparameters. A study that has been searched for another one of these is refused.
    stop
        Ends the search once it is set: when the case that runs has ended. So does Ctrl+C, at once. The trials
        that have ended until then are returned.
    on_trial
        Is called with each ``Trial`` that has ended, by the thread that calls this.
    progress
        Whether to show a bar; None: in a terminal or a notebook.

    Returns
    -------
    OptimizeResult
        The first of its trials has the runner's present values, or the nearest ones that may be tried.

    Raises
    ------
    ScaleError
        There are no cases, nothing that may vary, or no trial has completed; or in the first one an input can't be
        read, which ends the search.
    UnknownName
        The graph has no such token, or the runner no such hyperparameter.
    StoreError
        The store can't be used.

    Examples
    --------
    >>> from epypes import CompGraph, CompGraphRunner
    >>> runner = CompGraphRunner(CompGraph({"add": lambda x, y: x + y}, {"add": (("x", "y"), "total")}), {"y": 9})
    >>> result = optimize(runner, "total", [{"x": 1}], 20, direction="minimize", ranges={"y": (0, 10)})
    >>> result.best
    {'y': 0}
    """
    if type(n) is not int or n < 1:
        raise ScaleError(f"n is how many trials there are to be, 1 or more, not {n!r}.")
    if direction not in _DIRECTIONS:
        raise ScaleError(f"direction is 'maximize' or 'minimize', not {direction!r}.")
    # A caller that sets hyperparameters meanwhile, or writes into them, does not change what is searched.
    runner = detached_runner(runner)
    axes = axes_of(runner, ranges)
    objective = Objective(runner.cg, metric, _cases(cases, runner), keep)
    inputs = items_of([case.inputs for case in objective.cases], runner)
    items = tuple(
        Item(number, case.name or item.name, item.payload)
        for number, (case, item) in enumerate(zip(objective.cases, inputs, strict=True))
    )
    work = _Evaluation(runner, objective, items, executor, stop)
    at_once = 1 if executor is None else worker_count(executor)
    with opened_store(store) as opened:
        url, digests, study = None, {}, name or ""
        if opened is not None:
            url, digests = opened.url, search_digests(runner, axes, objective, items, is_named=bool(name))
            study = name or search_name(objective.name, direction, axes, digests)
        search = Search(
            axes, runner.hyperparameters, direction, seed=seed, at_once=at_once, url=url, name=study, digests=digests
        )
        with contextlib.closing(search):
            was_stopped = _searched(search, work, n, on_trial, progress)
            if opened is not None:
                search.forget_changed(code_digests(runner, objective, is_named=True))
    result = OptimizeResult(search.trials, direction, objective.name, axes, search.study, was_stopped)
    if result.trials and not was_stopped and all(trial.value is None for trial in result.trials):
        first = result.trials[0]
        text = f"None of {len(result.trials)} trials completed. The first one failed: {ended(first.failure)}"
        raise ScaleError(f"{text} Its values: {first.setting}.")
    return result


def _cases(given: Any, runner: CompGraphRunner) -> tuple[Case, ...]:
    """Return the cases with their labels read."""
    if isinstance(given, str | Path) and Path(given).suffix != _CASE_FILE:
        return tuple(Case(item.payload, name=item.name) for item in items_of(given, runner))
    return tuple(with_labels_read(case, runner.cg) for case in cases_of(given))


@dataclass(frozen=True, slots=True)
class _Evaluation:
    """Runs the cases of one setting after another, and measures them."""

    runner: CompGraphRunner
    objective: Objective
    items: tuple[Item, ...]
    executor: Executor | None
    stop: threading.Event | None

    @property
    def is_stopped(self) -> bool:
        return self.stop is not None and self.stop.is_set()

    def scores(self, search: Search, count: int) -> Generator[tuple[Suggestion, Score]]:
        """Yield the scores of the next settings as they come; fewer if the search is stopped."""
        pending: dict[int, tuple[Suggestion, dict[int, Outcome]]] = {}
        # In this process each case goes on from its last run, as far as memory is for that.
        starts = [SharedStart() if runs_here(self.executor) else None for _ in self.items]
        measured: set[int] = set()
        held_bytes = 0

        def jobs() -> Iterator[Job]:
            """Yield a job for each case of each trial, when there is room; a trial is asked for with its first."""
            keep = self.objective.keep
            for number in range(count):
                one = search.ask()
                pending[number] = one, {}
                for item, case, index in zip(self.items, self.objective.cases, range(len(starts)), strict=True):
                    if number not in pending:  # a case before has failed
                        break
                    marked = replace(item, number=number * len(starts) + index)
                    setting = {**one.setting, **(case.hyperparameters or {})}
                    yield Job(marked, (setting,), keep=keep, start=starts[index], targets=keep)

        ahead = None if self.executor is None else worker_count(self.executor)
        for [outcome] in filter(None, run_jobs(self.runner, jobs(), self.executor, ahead=ahead, stop=self.stop)):
            number, index = divmod(outcome.number, len(starts))
            start = starts[index]
            if start is not None and index not in measured:
                measured.add(index)
                held_bytes += start.nbytes
                if held_bytes > MOST_BYTES:
                    held_bytes -= start.nbytes
                    starts[index] = None
            if number in pending:
                one, found = pending[number]
                found[index] = outcome
                if len(found) == len(starts) or outcome.has_failed:
                    del pending[number]
                    yield one, self.objective.score(found)


def _searched(
    search: Search,
    work: _Evaluation,
    n: int,
    on_trial: Callable[[Trial], object] | None,
    progress: bool | None,
) -> bool:
    """Run the trials that are still to be run; return whether the search was stopped before its end."""
    done = search.trials
    with progress_bar(progress, n, f"optimize {work.objective.name}", unit="trial") as advance:
        if done:
            advance(len(done), sum(trial.value is None for trial in done))
        try:
            with contextlib.closing(work.scores(search, n - len(done))) as coming:
                for number, (asked, score) in enumerate(coming):
                    if number == 0 and score.unreadable:
                        raise ScaleError(
                            f"No trial can complete: {ended(score.unreadable)} Mend the file, or leave it out."
                        )
                    trial = search.tell(asked, score.value, score.failure, score.total_ns)
                    advance(1, trial.value is None)
                    if on_trial is not None:
                        on_trial(trial)
        except KeyboardInterrupt:
            return True
    return work.is_stopped


# -- the objective ----------------------------------------------------------------------------------------------


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
                text = f"The search has no name for the store, and one can't be computed from its {what}: {error}"
                raise ScaleError(f"{text}.\nGive one: name='...'.") from error
            found[what] = ""
    return found


def _graph_digest(cg: CompGraph) -> str:
    found = graph_fingerprint(cg)
    if found.unknown or found.reader:
        raise NoDigest(found.unknown or reader_text(found.reader))
    return combined_digest("graph", found.code, found.state).hex()
