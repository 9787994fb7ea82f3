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
import warnings
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from concurrent.futures import Executor
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Literal, get_args

from epypes.acquisition.files import is_video_name
from epypes.batch.cache import SearchKey
from epypes.batch.cases import Case, case_items, cases_of, with_labels_read
from epypes.batch.executors import progress_bar, run_jobs, runs_here, worker_count
from epypes.batch.grid import Axis, ChoiceAxis, axes_of, bounded
from epypes.batch.items import detached_runner, items_of
from epypes.batch.job import Job, SharedStart
from epypes.batch.mapping import tokens_of
from epypes.batch.results import BatchResult, Outcome, failure_column, frame_of, html_table, value_text
from epypes.display.paint.page import paint_page
from epypes.display.text import content, cut, cut_name
from epypes.errors import ScaleError
from epypes.graph import subgraph
from epypes.nothing import Nothing
from epypes.optional import optional_import
from epypes.run import CompGraphRunner
from epypes.store import opened_store
from epypes.wording import counted, ended, error_message

if TYPE_CHECKING:
    import optuna
    import pandas as pd

    from epypes.display.paint.plot import ThemedFigure
    from epypes.store import Store

# Of the values that are held between settings; further cases run from their files or arrays each time.
MOST_BYTES: Final = 2**30
_CASE_FILE: Final = ".toml"
Direction = Literal["maximize", "minimize"]
ObjectiveMetric = Callable[[Mapping[str, Any], Case], Any] | str
_REASON_CHARACTERS: Final = 300
# The attributes of trials and studies in Optuna's tables.
_FAILURE: Final = "failure"
_NANOSECONDS: Final = "total_ns"
_ABOUT: Final = "about"
# On the page.
_MOST_REASONS: Final = 3
_MOST_DOTS: Final = 300


@dataclass(frozen=True, slots=True)
class Trial:
    """One setting that was tried.

    Attributes
    ----------
    number
        Of the trial in its study, from 0.
    setting
        The hyperparameters that vary, by token.
    value
        The metric, averaged over the cases; None if the trial failed.
    failure
        Why it failed; empty if it did not.
    total_ns
        Nanoseconds of the functions that ran, over all cases.
    """

    number: int
    setting: Mapping[str, Any]
    value: float | None
    failure: str = ""
    total_ns: int = 0

    @property
    def has_failed(self) -> bool:
        """Whether there is no value."""
        return self.value is None


@dataclass(frozen=True, slots=True, eq=False, repr=False)
class OptimizeResult(BatchResult[Trial]):
    """The trials of a search; made by ``ep.optimize``.

    Attributes
    ----------
    trials
        That have ended, by number; the first has the values that the runner had.
    direction
        ``"maximize"`` or ``"minimize"``.
    metric
        The name of the metric.
    axes
        What was searched.
    study
        Of Optuna, in memory.
    was_stopped
        Whether the search was stopped before all trials were run.
    """

    trials: tuple[Trial, ...]
    direction: Direction
    metric: str
    axes: tuple[Axis, ...]
    study: optuna.Study
    was_stopped: bool = False

    @property
    def best_trial(self) -> Trial:
        """The trial with the best value, the first of several.

        Raises
        ------
        ScaleError
            None has completed.
        """
        best = best_of(self.trials, self.direction)
        if best is None:
            raise ScaleError(f"None of {len(self.trials)} trials has completed, so there is no best one.")
        return best

    @property
    def best(self) -> dict[str, Any]:
        """The hyperparameters that vary, as the best trial had them."""
        return dict(self.best_trial.setting)

    @property
    def best_value(self) -> float:
        """The metric of the best trial, averaged over the cases."""
        return _value(self.best_trial)

    @property
    def importances(self) -> dict[str, float]:
        """How much each hyperparameter matters for good values, as parts of 1, the most important first.

        By PED-ANOVA (Watanabe, Bansal and Hutter 2023, IJCAI), as Optuna has it; empty if fewer than two different
        values were found.
        """
        import optuna

        completed = self.study.get_trials(deepcopy=False, states=(optuna.trial.TrialState.COMPLETE,))
        if len({trial.value for trial in completed}) < 2:
            return {}
        with _quiet_optuna():
            return dict(optuna.importance.get_param_importances(self.study, evaluator=_importance_evaluator()))

    def apply(self, runner: CompGraphRunner) -> None:
        """Set the best values on a runner."""
        runner.set(**self.best)

    def to_frame(self) -> pd.DataFrame:
        """Return a table with a row per trial.

        Returns
        -------
        pandas.DataFrame
            ``trial``, the hyperparameters, the metric by its name, ``state`` (``"complete"`` or ``"failed"``),
            ``failure`` (None, or the reason), and ``ms``: of the functions, over all cases. A hyperparameter that is
            called like one of these has `` (hyperparameter)`` after its name.
        """
        trials = self.trials
        return frame_of([
            ("trial", [trial.number for trial in trials], ""),
            *((axis.token, [trial.setting[axis.token] for trial in trials], "hyperparameter") for axis in self.axes),
            (self.metric, [math.nan if trial.value is None else trial.value for trial in trials], ""),
            ("state", ["failed" if trial.has_failed else "complete" for trial in trials], ""),
            failure_column(trial.failure for trial in trials),
            ("ms", [trial.total_ns / 1e6 for trial in trials], ""),
        ])  # fmt: skip

    def history_plot(self) -> ThemedFigure:
        """Return Optuna's figure of the value of each trial that completed, and of the best one so far."""
        _ = self.best_trial  # without one there is nothing to draw
        return self._figure("plot_optimization_history")

    def importance_plot(self) -> ThemedFigure:
        """Return Optuna's figure of how much each hyperparameter matters.

        Raises
        ------
        ScaleError
            Fewer than two different values were found.
        """
        _ = self.best_trial  # without one there is nothing to draw
        if not self.importances:
            raise ScaleError("The metric had one value in all trials, so there are no importances to draw.")
        return self._figure("plot_param_importances", evaluator=_importance_evaluator())

    def _figure(self, name: str, **options: Any) -> ThemedFigure:
        """Draw one of Optuna's figures. It opens a window of pyplot and sets a style for good: both are undone."""
        with optional_import("scale"):
            from matplotlib import pyplot, style

            from epypes.display.paint.plot import ThemedFigure
        import optuna

        # Loads the backend, which has Jupyter show pyplot's figures: that must outlast the style below.
        pyplot.draw_if_interactive()  # type: ignore[no-untyped-call]
        with _quiet_optuna(), style.context("default"), pyplot.ioff():
            draw = getattr(optuna.visualization.matplotlib, name)
            axes = draw(self.study, target_name=cut_name(self.metric, 30), **options)
            pyplot.close(axes.figure)
        for dots in axes.collections:
            dots.set_rasterized(len(self.trials) > _MOST_DOTS)  # a picture of thousands is smaller
        return ThemedFigure(axes.figure)

    @property
    def _rows(self) -> tuple[Trial, ...]:
        return self.trials

    @property
    def _caption(self) -> str:
        best, failed = best_of(self.trials, self.direction), len(self.failures)
        found = "none completed" if best is None else f"best {self.metric:.30} {best.value:.6g}"
        state = f"{f', {failed} failed' if failed else ''}{', stopped' * self.was_stopped}"
        return f"{counted(len(self.trials), 'trial')}{state}; {found}"

    def _page(self) -> str:
        """Return the plot of the trials, the table of what was found, and why trials failed."""
        best = best_of(self.trials, self.direction)
        parts = [f"<p>{content(self._caption)}</p>"]
        if best is not None:
            parts += [self.history_plot().html(), self._table(best)]
        reasons = list(dict.fromkeys(trial.failure for trial in self.failures))
        if reasons:
            items = "".join(f"<li>{content(cut(reason, 200))}</li>" for reason in reasons[:_MOST_REASONS])
            more = f"<li>and {len(reasons) - _MOST_REASONS} more reasons</li>" if len(reasons) > _MOST_REASONS else ""
            parts.append(f"<details><summary>Why trials failed</summary><ul>{items}{more}</ul></details>")
        return paint_page(*parts)

    def _table(self, best: Trial) -> str:
        first, parts = self.trials[0], self.importances
        tokens = sorted((axis.token for axis in self.axes), key=lambda token: -parts.get(token, 0.0))
        first_value = "failed" if first.value is None else f"{first.value:.6g}"
        columns = [
            ("hyperparameter", [self.metric, *tokens]),
            (f"best (trial {best.number})", [f"{best.value:.6g}", *(value_text(best.setting[t]) for t in tokens)]),
            ("first trial", [first_value, *(value_text(first.setting[token]) for token in tokens)]),
            ("importance", ["", *(f"{parts[token]:.0%}" if token in parts else "" for token in tokens)]),
        ]
        return html_table("", columns)


def _importance_evaluator() -> Any:
    import optuna

    with _quiet_optuna():
        return optuna.importance.PedAnovaImportanceEvaluator()


def best_of(trials: Sequence[Trial], direction: Direction) -> Trial | None:
    """Return the trial with the best value, the first of several; None if none has completed."""
    completed = [trial for trial in trials if trial.value is not None]
    choose = max if direction == "maximize" else min
    return choose(completed, key=_value) if completed else None


def _value(trial: Trial) -> float:
    return float(trial.value or 0.0)


# -- the search -----------------------------------------------------------------------------------------------------


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
        case is its inputs. Of a graph with state these are a sequence, and a folder is one case: the metric is given
        what the last image leaves.
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
        The graph has no such token.
    HyperparameterError
        A range is for a token that is no hyperparameter.
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
    objective = _Objective(runner, metric, _cases(cases, runner), keep)
    at_once = 1 if executor is None else worker_count(executor)
    stop, was_interrupted = stop or threading.Event(), False
    with opened_store(store) as opened, contextlib.ExitStack() as stack:
        key = None if opened is None else _key(objective, axes, direction, name)
        search = _Search(axes, runner.hyperparameters, direction, seed, at_once, opened, key)
        stack.callback(search.close)
        advance = stack.enter_context(progress_bar(progress, n, f"optimize {objective.name}", unit="trial"))
        done = search.trials
        advance(len(done), sum(trial.has_failed for trial in done))
        coming = stack.enter_context(contextlib.closing(_trials(search, objective, executor, stop, n - len(done))))
        try:
            for trial in coming:
                advance(1, int(trial.has_failed))
                if on_trial is not None:
                    on_trial(trial)
        except KeyboardInterrupt:
            was_interrupted = True
        search.forget_changed()
        was_stopped = was_interrupted or stop.is_set()
        result = OptimizeResult(search.trials, direction, objective.name, axes, search.study, was_stopped)
    if result.trials and not was_stopped and len(result.failures) == len(result):
        first = result.trials[0]
        text = f"None of {len(result.trials)} trials completed. The first one failed: {ended(first.failure)}"
        raise ScaleError(f"{text} Its values: {first.setting}.")
    return result


def _key(objective: _Objective, axes: Sequence[Axis], direction: str, name: str | None) -> SearchKey:
    readable = {
        "ranges": ", ".join(f"{axis.token} in {axis}" for axis in axes),
        "direction": direction,
        "tokens": ", ".join(objective.keep),
    }
    choices = {axis.token: axis.choices if isinstance(axis, ChoiceAxis) else None for axis in axes}
    return SearchKey(
        f"optimize {objective.name}", name or "", objective.runner, objective.metric, choices,
        objective.items, objective.cases, readable,
    )  # fmt: skip


def _cases(given: Any, runner: CompGraphRunner) -> tuple[Case, ...]:
    """Return the cases with their labels read."""
    if isinstance(given, str | Path) and Path(given).suffix != _CASE_FILE and not is_video_name(Path(given)):
        if runner.state:
            return (Case(given, name=str(given)),)
        return tuple(Case(item.payload, name=item.name) for item in items_of(given, runner))
    return tuple(with_labels_read(case, runner.cg) for case in cases_of(given, are_series=bool(runner.state)))


def _trials(
    search: _Search, objective: _Objective, executor: Executor | None, stop: threading.Event, count: int
) -> Generator[Trial]:
    """Run the next trials and yield them as they end; fewer if the search is stopped."""
    asked: dict[int, optuna.trial.Trial] = {}
    found: dict[int, dict[int, Outcome]] = {}
    # In this process each case goes on from its last run, as far as memory is for that.
    is_shared = runs_here(executor) and not objective.runner.state
    starts = [SharedStart() if is_shared else None for _ in objective.items]
    held_bytes: dict[int, int] = {}

    def jobs() -> Iterator[Job]:
        """Yield a job for each case of each trial, when there is room; a trial is asked for with its first."""
        for number in range(count):
            asked[number], found[number] = search.ask(), {}
            setting = search.setting(asked[number].params)
            for index, (item, case) in enumerate(zip(objective.items, objective.cases, strict=True)):
                if number not in asked:  # a case before has failed
                    break
                marked = replace(item, number=number * len(objective.items) + index)
                own = {**setting, **(case.hyperparameters or {})}
                yield Job(marked, (own,), keep=objective.keep, start=starts[index], targets=objective.targets)

    ahead = None if executor is None else worker_count(executor)
    has_ended = False
    for outcomes in run_jobs(objective.runner, jobs(), executor, ahead=ahead, stop=stop):
        for outcome in outcomes:
            number, index = divmod(outcome.number, len(objective.items))
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
            if len(found[number]) == len(objective.items) or error is not None:
                has_ended = True
                yield search.tell(asked.pop(number), *objective.score(found.pop(number)))


class _Objective:
    """Runs cases and measures their outcomes.

    Parameters
    ----------
    runner
        Its graph is run, with its hyperparameters where nothing varies.
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
        self, runner: CompGraphRunner, metric: ObjectiveMetric, cases: Sequence[Case], keep: Sequence[str] | None
    ) -> None:
        if not isinstance(metric, str) and not callable(metric):
            kind = type(metric).__name__
            raise ScaleError(f"metric is a function metric(tokens, case), or the name of a token, not a {kind!r}.")
        self.runner, self.cases = runner, tuple(cases)
        self.items = list(case_items(self.cases, runner))
        self.metric = metric
        self.name = metric if isinstance(metric, str) else getattr(metric, "__name__", "metric")
        kept = runner.cg.sink_tokens if keep is None else keep
        self.keep = tokens_of(runner, metric if isinstance(metric, str) else kept)
        # What the next frame of a case begins with is needed too.
        delayed = (delay.token for delay in subgraph(runner.cg, self.keep).delays.values())
        self.targets = tuple(dict.fromkeys((*self.keep, *delayed)))

    def score(self, outcomes: Mapping[int, Outcome]) -> tuple[float | None, str, int]:
        """Return the mean of the metric over the cases, or None and the first failure; and the time of the functions.

        ``outcomes`` has them by place of the case.
        """
        values: list[float] = []
        spent_ns = sum(outcome.total_ns for outcome in outcomes.values())
        for index, outcome in sorted(outcomes.items()):
            case = self.cases[index]
            try:
                values.append(self._measure(case, outcome))
            except _NotMeasured as error:
                where = f"{case.name}: " if len(self.cases) > 1 and case.name else ""
                return None, f"{where}{error}"[:_REASON_CHARACTERS], spent_ns
        return math.fsum(values) / len(values), "", spent_ns

    def _measure(self, case: Case, outcome: Outcome) -> float:
        """Return the metric of one case; _NotMeasured says why there is none."""
        if outcome.error_info is not None:
            raise _NotMeasured(outcome.error_info)
        tokens, metric = MappingProxyType(dict(outcome.kept)), self.metric
        try:
            given = tokens[metric] if isinstance(metric, str) else metric(tokens, case)
        except (Exception, SystemExit) as error:
            raise _NotMeasured(f"{self.name} raised {type(error).__name__}: {error_message(error)}") from error
        if given is Nothing:
            raise _NotMeasured(f"{self.name} gave Nothing: nothing was found")
        try:
            value = float(given)
        except (TypeError, ValueError, OverflowError) as error:
            raise _NotMeasured(f"{self.name} gave a {type(given).__name__!r}, no number") from error
        if not math.isfinite(value):
            raise _NotMeasured(f"{self.name} gave {value}")
        return value


class _NotMeasured(Exception):
    """A case has no value; the text says why."""


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
    store, key
        The database that keeps the trials, and the key of the study in there, which goes on; None for none.

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
        key: SearchKey | None,
    ) -> None:
        with optional_import():
            import optuna
        self._axes, self._direction, self._present, self._key = axes, direction, present, key
        self._distributions = {axis.token: axis.distribution for axis in axes}
        self._storage: optuna.storages.RDBStorage | None = None
        self._stored: optuna.Study | None = None
        with _quiet_optuna():
            before = [] if store is None or key is None else self._open(store, key)
            # A search that goes on has another seed: the same numbers again would be the same trials again.
            sampler = optuna.samplers.TPESampler(seed=seed + len(before), constant_liar=at_once > 1)
            self.study: optuna.Study = optuna.create_study(
                sampler=sampler, study_name=key.name if key else None, direction=direction
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

    def forget_changed(self) -> None:
        """Blank the stored digests of what has changed meanwhile, as a function that notes its calls in a list."""
        if self._stored is not None and self._key is not None:
            about = self._stored.user_attrs[_ABOUT]
            self._stored.set_user_attr(_ABOUT, {**about, **dict.fromkeys(self._key.changed(), "")})

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

    def _open(self, store: Store, key: SearchKey) -> list[optuna.trial.FrozenTrial]:
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
                storage=self._storage, study_name=key.name, direction=self._direction, load_if_exists=True
            )
        except refusals as error:
            self.close()
            text = f"The trials can't be stored in {store.place}: {str(error).splitlines()[0]}"
            raise ScaleError(f"{text} Give another store=, or none.") from error
        found = _finished(stored)
        # A study without trials is of nothing yet.
        before: Mapping[str, str] = stored.user_attrs.get(_ABOUT, {}) if found else key.about
        difference = key.difference(before)
        if difference:
            self.close()
            text = f"There is a study {key.name!r} in this store, and it searches something else ({difference})."
            raise ScaleError(f"{text} Give another name=, or search the same.")
        # A digest that is blank once stays blank.
        stored.set_user_attr(_ABOUT, {what: text and before[what] for what, text in key.about.items()})
        self._stored = stored
        return found


def _finished(study: optuna.Study) -> list[optuna.trial.FrozenTrial]:
    return [trial for trial in study.get_trials(deepcopy=False) if trial.state.is_finished()]


@contextlib.contextmanager
def _quiet_optuna() -> Iterator[None]:
    """Keep Optuna from printing, and from warning that a feature used here was once experimental."""
    import optuna

    before = optuna.logging.get_verbosity()
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
            yield
    finally:
        optuna.logging.set_verbosity(before)
