"""The search for the values of hyperparameters that give the best results over many cases.

Optuna's tree-structured Parzen estimator suggests settings (Bergstra, Bardenet, Bengio and Kegl 2011, "Algorithms for
hyper-parameter optimization", NeurIPS 24). A study is computed in memory; each trial that has ended is written to a
database, if there is one, in Optuna's own tables, so that its dashboard reads them too. A study that is computed in the
database itself took 179 ms per trial.
"""

from __future__ import annotations

import contextlib
import math
import threading
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, NamedTuple, get_args

from epypes.batch.cache import payload_digest, search_digests
from epypes.batch.cases import Case, cases_of, with_labels_read
from epypes.batch.executors import run_jobs, runs_here, worker_count
from epypes.batch.grid import Axis, axes_of, bounded
from epypes.batch.items import Item, detached_runner, items_of
from epypes.batch.job import Job, SharedStart
from epypes.batch.progress import progress_bar
from epypes.batch.results import Outcome
from epypes.batch.search_result import Direction, OptimizeResult, Trial, quiet_optuna
from epypes.bundle.fingerprint import combined_digest
from epypes.errors import ScaleError
from epypes.graph import CompGraph
from epypes.optional import optional_import
from epypes.run import CompGraphRunner
from epypes.store import opened_store
from epypes.wording import ended

if TYPE_CHECKING:
    import optuna

    from epypes.store import Store

# Of the values that are held between settings; further cases run from their files or arrays each time.
MOST_BYTES: Final = 2**30
_CASE_FILE: Final = ".toml"
ObjectiveMetric = Callable[[Mapping[str, Any], Case], Any] | str
_REASON_CHARACTERS: Final = 300
# The attributes of trials and studies in Optuna's tables.
_FAILURE: Final = "failure"
_NANOSECONDS: Final = "total_ns"
_DIGESTS: Final = "about"


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
    if direction not in get_args(Direction):
        raise ScaleError(f"direction is 'maximize' or 'minimize', not {direction!r}.")
    # A caller that sets hyperparameters meanwhile, or writes into them, does not change what is searched.
    runner = detached_runner(runner)
    axes = axes_of(runner, ranges)
    objective = _Objective(runner.cg, metric, _cases(cases, runner), keep)
    inputs = items_of([case.inputs for case in objective.cases], runner)
    items = [replace(item, name=case.name or item.name) for case, item in zip(objective.cases, inputs, strict=True)]
    at_once = 1 if executor is None else worker_count(executor)
    with opened_store(store) as opened:
        digests, study = dict[str, str](), name or ""
        if opened is not None:
            data = _searched_data(axes, runner.hyperparameters, objective, items)
            digests = search_digests(runner.cg, metric, data, is_named=bool(name))
            text = repr((direction, axes, sorted(digests.items())))
            study = name or f"optimize {objective.name} {combined_digest('search', text).hex()[:12]}"
        search = _Search(axes, runner.hyperparameters, direction, seed, at_once, opened, study, digests)
        with contextlib.closing(search):
            was_stopped = _searched(search, _Work(runner, objective, items, executor, stop), n, on_trial, progress)
            if opened is not None:
                search.forget_changed(search_digests(runner.cg, metric, {}, is_named=True))
    result = OptimizeResult(search.trials, direction, objective.name, axes, search.study, was_stopped)
    if result.trials and not was_stopped and len(result.failures) == len(result):
        first = result.trials[0]
        text = f"None of {len(result.trials)} trials completed. The first one failed: {ended(first.failure)}"
        raise ScaleError(f"{text} Its values: {first.setting}.")
    return result


def _searched_data(
    axes: Sequence[Axis], hyperparameters: Mapping[str, Any], objective: _Objective, items: Sequence[Item]
) -> dict[str, Callable[[], Any]]:
    """Return the data that decide about a trial, by what they are, for their digests."""
    choices = {axis.token: getattr(axis, "choices", None) for axis in axes}
    fixed = {token: value for token, value in hyperparameters.items() if token not in choices}
    return {
        "hyperparameters": lambda: (fixed, choices),
        "inputs of the cases": lambda: [(item.name, payload_digest(item.payload)) for item in items],
        "labels of the cases": lambda: [
            (case.name, dict(case.expected or {}), dict(case.hyperparameters or {})) for case in objective.cases
        ],
        "tokens that are measured": lambda: objective.keep,
    }


def _cases(given: Any, runner: CompGraphRunner) -> tuple[Case, ...]:
    """Return the cases with their labels read."""
    if isinstance(given, str | Path) and Path(given).suffix != _CASE_FILE:
        return tuple(Case(item.payload, name=item.name) for item in items_of(given, runner))
    return tuple(with_labels_read(case, runner.cg) for case in cases_of(given))


def _searched(
    search: _Search, work: _Work, n: int, on_trial: Callable[[Trial], object] | None, progress: bool | None
) -> bool:
    """Run the trials that are still to be run; return whether the search was stopped before its end."""
    done = search.trials
    with progress_bar(progress, n, f"optimize {work.objective.name}", unit="trial") as advance:
        advance(len(done), sum(trial.value is None for trial in done))
        try:
            with contextlib.closing(_trials(search, work, n - len(done))) as coming:
                for trial in coming:
                    advance(1, trial.value is None)
                    if on_trial is not None:
                        on_trial(trial)
        except KeyboardInterrupt:
            return True
    return work.stop is not None and work.stop.is_set()


class _Work(NamedTuple):
    """What the trials of a search run, and where."""

    runner: CompGraphRunner
    objective: _Objective
    items: Sequence[Item]
    executor: Executor | None
    stop: threading.Event | None


def _trials(search: _Search, work: _Work, count: int) -> Generator[Trial]:
    """Run the next trials and yield them as they end; fewer if the search is stopped."""
    asked: dict[int, optuna.trial.Trial] = {}
    found: dict[int, dict[int, Outcome]] = {}
    # In this process each case goes on from its last run, as far as memory is for that.
    starts = [SharedStart() if runs_here(work.executor) else None for _ in work.items]
    held_bytes: dict[int, int] = {}

    def jobs() -> Iterator[Job]:
        """Yield a job for each case of each trial, when there is room; a trial is asked for with its first."""
        for number in range(count):
            asked[number], found[number] = search.ask(), {}
            setting = search.setting(asked[number].params)
            for index, (item, case) in enumerate(zip(work.items, work.objective.cases, strict=True)):
                if number not in asked:  # a case before has failed
                    break
                marked = replace(item, number=number * len(work.items) + index)
                own = {**setting, **(case.hyperparameters or {})}
                yield Job(marked, (own,), keep=work.objective.keep, start=starts[index], targets=work.objective.keep)

    ahead = None if work.executor is None else worker_count(work.executor)
    has_ended = False
    for outcomes in run_jobs(work.runner, jobs(), work.executor, ahead=ahead, stop=work.stop):
        for outcome in outcomes:
            number, index = divmod(outcome.number, len(work.items))
            start, error = starts[index], outcome.error_info
            if start is not None and index not in held_bytes:
                held_bytes[index] = start.nbytes
                if sum(held_bytes.values()) > MOST_BYTES:
                    starts[index], held_bytes[index] = None, 0
            if number not in asked:
                continue
            if error is not None and error.is_unreadable and not has_ended:
                raise ScaleError(f"No trial can complete: {ended(error.message)} Mend the file, or leave it out.")
            found[number][index] = outcome
            if len(found[number]) == len(work.items) or error is not None:
                has_ended = True
                yield search.tell(asked.pop(number), *work.objective.score(found.pop(number)))


class _Objective:
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
        self, cg: CompGraph, metric: ObjectiveMetric, cases: Sequence[Case], keep: Sequence[str] | None
    ) -> None:
        if not isinstance(metric, str) and not callable(metric):
            kind = type(metric).__name__
            raise ScaleError(f"metric is a function metric(tokens, case), or the name of a token, not a {kind!r}.")
        self.cases = tuple(cases)
        self._metric = metric
        self.name = metric if isinstance(metric, str) else getattr(metric, "__name__", "metric")
        self.keep = (metric,) if isinstance(metric, str) else tuple(cg.sink_tokens if keep is None else keep)
        for token in self.keep:
            cg.require_token(token)

    def score(self, outcomes: Mapping[int, Outcome]) -> tuple[float | None, str, int]:
        """Return the mean of the metric over the cases, or None and the first failure; and the time of the functions.

        ``outcomes`` has them by place of the case.
        """
        values: list[float] = []
        spent_ns = sum(outcome.total_ns for outcome in outcomes.values())
        for index, outcome in sorted(outcomes.items()):
            case = self.cases[index]
            value, failure = self._measured(case, outcome)
            if failure:
                where = f"{case.name}: " if len(self.cases) > 1 and case.name else ""
                return None, f"{where}{failure}"[:_REASON_CHARACTERS], spent_ns
            values.append(value)
        return math.fsum(values) / len(values), "", spent_ns

    def _measured(self, case: Case, outcome: Outcome) -> tuple[float, str]:
        """Return the metric of one case, and the reason if there is none."""
        if outcome.error_info is not None:
            return math.nan, str(outcome.error_info)
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


class _Search:
    """Asks the sampler for settings, and reports what they gave. Not for several threads at once.

    Parameters
    ----------
    axes
        What is searched.
    present
        All hyperparameters; the first trial has these values, or the nearest ones within the axes.
    direction
        ``"maximize"`` or ``"minimize"``.
    seed
        Of the sampler: the same one suggests the same again, if one trial is run at a time.
    at_once
        How many trials are run at a time; with several, those that still run count as bad ones.
    store
        The database that keeps the trials; None for none.
    name
        Of the study in there. If it is there, it goes on.
    digests
        What is searched: digests by what they are of, "" where there is none. They are stored with the study.

    Raises
    ------
    ScaleError
        The study that is there searches something else, or the database can't be used.
    """

    def __init__(
        self,
        axes: Sequence[Axis],
        present: Mapping[str, Any],
        direction: Direction,
        seed: int,
        at_once: int,
        store: Store | None,
        name: str,
        digests: Mapping[str, str],
    ) -> None:
        with optional_import():
            import optuna
        self._axes, self._direction = axes, direction
        self._present, self._digests = present, digests
        self._distributions = {axis.token: axis.distribution for axis in axes}
        self._storage: optuna.storages.RDBStorage | None = None
        self._stored: optuna.Study | None = None
        with quiet_optuna():
            before = [] if store is None else self._open(store, name)
            # A search that goes on has another seed: the same numbers again would be the same trials again.
            sampler = optuna.samplers.TPESampler(seed=seed + len(before), constant_liar=at_once > 1)
            self.study: optuna.Study = optuna.create_study(
                sampler=sampler, study_name=name or None, direction=direction
            )
        if before:
            self.study.add_trials(before)
        else:
            self.study.enqueue_trial({axis.token: axis.suggestion(present[axis.token]) for axis in axes})

    @property
    def trials(self) -> tuple[Trial, ...]:
        """Those that have ended, by number."""
        return tuple(map(self._trial, _finished(self.study)))

    def ask(self) -> optuna.trial.Trial:
        """Return the next trial."""
        return self.study.ask(self._distributions)

    def setting(self, suggested: Mapping[str, Any]) -> dict[str, Any]:
        """Return the values of hyperparameters for what the sampler has suggested."""
        values = {axis.token: axis.value(suggested[axis.token]) for axis in self._axes}
        return bounded(self._axes, values, self._present)

    def tell(self, asked: optuna.trial.Trial, value: float | None, failure: str, total_ns: int) -> Trial:
        """Store what a trial gave, and return that; without a value it has failed."""
        import optuna

        asked.set_user_attr(_NANOSECONDS, total_ns)
        if value is None:
            asked.set_user_attr(_FAILURE, failure)
        state = optuna.trial.TrialState.FAIL if value is None else optuna.trial.TrialState.COMPLETE
        frozen = self.study.tell(asked, value, state)
        if self._stored is not None:
            self._stored.add_trial(frozen)
        return self._trial(frozen)

    def forget_changed(self, digests: Mapping[str, str]) -> None:
        """Blank the stored digests that are others by now, as of a function that notes its calls in a list."""
        changed = {what: "" for what, digest in digests.items() if digest != self._digests[what]}
        if changed and self._stored is not None:
            self._stored.set_user_attr(_DIGESTS, {**self._digests, **changed})

    def close(self) -> None:
        """Close the database. May be called twice."""
        storage, self._storage, self._stored = self._storage, None, None
        if storage is not None:
            storage.scoped_session.remove()
            storage.engine.dispose()

    def _trial(self, frozen: optuna.trial.FrozenTrial) -> Trial:
        noted = frozen.user_attrs
        failure = noted.get(_FAILURE, "") or ("" if frozen.value is not None else "no reason is stored")
        return Trial(frozen.number, self.setting(frozen.params), frozen.value, failure, noted.get(_NANOSECONDS, 0))

    def _open(self, store: Store, name: str) -> list[optuna.trial.FrozenTrial]:
        """Open the study in the database and return the trials that have ended, if it searches the same."""
        import optuna
        import sqlalchemy.exc

        from epypes.store.database import connect_options

        refusals = (RuntimeError, sqlalchemy.exc.SQLAlchemyError, optuna.exceptions.StorageInternalError)
        given = store.url.render_as_string(hide_password=False)
        try:
            options = {"connect_args": connect_options(store.url)}
            self._storage = optuna.storages.RDBStorage(given, engine_kwargs=options)
            stored = optuna.create_study(
                storage=self._storage, study_name=name, direction=self._direction, load_if_exists=True
            )
        except refusals as error:
            self.close()
            text = f"The trials can't be stored in {store.place}: {str(error).splitlines()[0]}"
            raise ScaleError(f"{text} Give another store=, or none.") from error
        found = _finished(stored)
        # A study without trials is of nothing yet.
        difference = self._difference(stored, found) if found else ""
        if difference:
            self.close()
            text = f"There is a study {name!r} in this store, and it searches something else ({difference})."
            raise ScaleError(f"{text} Give another name=, or search the same.")
        # A digest that is blank once stays blank.
        before = stored.user_attrs.get(_DIGESTS, {}) if found else {}
        self._digests = {what: digest and before.get(what, digest) for what, digest in self._digests.items()}
        stored.set_user_attr(_DIGESTS, self._digests)
        self._stored = stored
        return found

    def _difference(self, stored: optuna.Study, found: Sequence[optuna.trial.FrozenTrial]) -> str:
        """Return what a study in a database searches that this search does not; empty if it is the same search."""
        others = next((trial.distributions for trial in found if trial.distributions != self._distributions), None)
        if others is not None:
            return f"{', '.join(f'{token} in {_range_text(other)}' for token, other in others.items()):.200}"
        before = stored.user_attrs.get(_DIGESTS, {})
        changed = [
            what for what, digest in self._digests.items() if digest and before.get(what) and digest != before[what]
        ]
        if changed:
            return f"other {' and '.join(changed)}"
        direction = stored.direction.name.lower()
        return f"to {direction}" if direction != self._direction else ""


def _finished(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    return [trial for trial in study.get_trials(deepcopy=False) if trial.state.is_finished()]


def _range_text(distribution: Any) -> str:
    choices = getattr(distribution, "choices", None)
    return ", ".join(map(str, choices)) if choices else f"{distribution.low:g} to {distribution.high:g}"
