"""The trials of a search, and its result: the best of them, its table, page and figures."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final, Literal

from epypes.batch.grid import Axis
from epypes.batch.results import frame_of, html_table, object_column, value_text
from epypes.batch.thumbnails import data_uri, thumbnail_of_value
from epypes.display.durations import duration_text
from epypes.display.markup import content, cut, cut_name, escape
from epypes.errors import ScaleError
from epypes.wording import counted

if TYPE_CHECKING:
    import optuna
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from epypes.run import CompGraphRunner

Direction = Literal["maximize", "minimize"]


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


@dataclass(frozen=True, slots=True, eq=False)
class OptimizeResult:
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

    trials: tuple[Trial, ...] = field(repr=False)
    direction: Direction
    metric: str
    axes: tuple[Axis, ...] = field(repr=False)
    study: optuna.Study = field(repr=False)
    was_stopped: bool = False

    def __len__(self) -> int:
        return len(self.trials)

    def __iter__(self) -> Iterator[Trial]:
        return iter(self.trials)

    def __getitem__(self, index: int) -> Trial:
        return self.trials[index]

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
    def failures(self) -> tuple[Trial, ...]:
        """The trials that failed."""
        return tuple(trial for trial in self.trials if trial.value is None)

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
        with quiet_optuna():
            evaluator = optuna.importance.PedAnovaImportanceEvaluator()
            return dict(optuna.importance.get_param_importances(self.study, evaluator=evaluator))

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
        taken = {"trial", self.metric, "state", "failure", "ms"}
        columns: dict[str, Any] = {"trial": [trial.number for trial in self.trials]}
        for axis in self.axes:
            title = f"{axis.token} (hyperparameter)" if axis.token in taken else axis.token
            columns[title] = [trial.setting[axis.token] for trial in self.trials]
        columns[self.metric] = [float("nan") if trial.value is None else trial.value for trial in self.trials]
        columns["state"] = ["failed" if trial.value is None else "complete" for trial in self.trials]
        columns["failure"] = object_column([trial.failure or None for trial in self.trials])
        columns["ms"] = [trial.total_ns / 1e6 for trial in self.trials]
        return frame_of(columns)

    def history_plot(self) -> Figure:
        """Draw the value of each trial that completed, and the best one so far, as Optuna does with Matplotlib."""
        from optuna.visualization.matplotlib import plot_optimization_history

        _ = self.best_trial  # without one there is nothing to draw
        return _figure(lambda: plot_optimization_history(self.study, target_name=self.metric))

    def importance_plot(self) -> Figure:
        """Draw how much each hyperparameter matters, as Optuna does with Matplotlib."""
        from optuna.importance import PedAnovaImportanceEvaluator
        from optuna.visualization.matplotlib import plot_param_importances

        _ = self.best_trial
        with quiet_optuna():
            # The default one of older versions needs scikit-learn.
            evaluator = PedAnovaImportanceEvaluator()
            return _figure(lambda: plot_param_importances(self.study, evaluator, target_name=self.metric))

    def __repr__(self) -> str:
        best = best_of(self.trials, self.direction)
        found = "none completed" if best is None else f"best {self.metric:.30} {best.value:.6g}"
        stopped = ", stopped" * self.was_stopped
        return f"<OptimizeResult: {counted(len(self.trials), 'trial')}{stopped}; {found}>"

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        return {"text/plain": repr(self), "text/html": _page(self)}


def best_of(trials: Sequence[Trial], direction: Direction) -> Trial | None:
    """Return the trial with the best value, the first of several; None if none has completed."""
    completed = [trial for trial in trials if trial.value is not None]
    choose = max if direction == "maximize" else min
    return choose(completed, key=_value) if completed else None


def _value(trial: Trial) -> float:
    return float(trial.value or 0.0)


# -- figures and page -------------------------------------------------------------------------------------------


def _figure(draw: Callable[[], Axes]) -> Figure:
    """Return a figure that Optuna draws; it leaves no style set, and no figure open in pyplot."""
    from matplotlib import pyplot

    with pyplot.rc_context(), quiet_optuna():
        draw()
        figure = pyplot.gcf()
    pyplot.close(figure)
    return figure


_MOST_REASONS: Final = 3


def _page(result: OptimizeResult) -> str:
    best = best_of(result.trials, result.direction)
    parts = [f"<p>{content(_sentence(result))}</p>"]
    if best is not None:
        parts += [_curve(result), _table(result, best)]
    reasons = list(dict.fromkeys(trial.failure for trial in result.failures))
    if reasons:
        items = "".join(f"<li>{content(cut(reason, 200))}</li>" for reason in reasons[:_MOST_REASONS])
        more = f"<li>and {len(reasons) - _MOST_REASONS} more reasons</li>" if len(reasons) > _MOST_REASONS else ""
        parts.append(f"<details><summary>Why trials failed</summary><ul>{items}{more}</ul></details>")
    return f"<div>{''.join(parts)}</div>"


def _curve(result: OptimizeResult) -> str:
    """Return a picture of the best value so far, by trial that completed."""
    import numpy as np

    values = [trial.value for trial in result.trials if trial.value is not None]
    so_far = np.maximum.accumulate(values) if result.direction == "maximize" else np.minimum.accumulate(values)
    picture = thumbnail_of_value(so_far)
    if picture is None:
        return ""
    alt = escape(f"The best {cut_name(result.metric, 30)} so far, by trial: from {so_far[0]:.6g} to {so_far[-1]:.6g}.")
    return f'<img src="{data_uri(picture)}" width="256" alt="{alt}" title="{alt}">'


def _table(result: OptimizeResult, best: Trial) -> str:
    first, parts = result.trials[0], result.importances
    rows = [
        (
            axis.token,
            value_text(best.setting[axis.token]),
            value_text(first.setting[axis.token]),
            f"{parts[axis.token]:.0%}" if axis.token in parts else "",
        )
        for axis in sorted(result.axes, key=lambda axis: -parts.get(axis.token, 0.0))
    ]
    values = (result.metric, f"{best.value:.6g}", "failed" if first.value is None else f"{first.value:.6g}", "")
    head = ("hyperparameter", f"best (trial {best.number})", "first trial", "importance")
    return html_table("", head, [values, *rows])


def _sentence(result: OptimizeResult) -> str:
    best = best_of(result.trials, result.direction)
    spent_ns = sum(trial.total_ns for trial in result.trials)
    failed = f", {len(result.failures)} failed" if result.failures else ""
    stopped = ", stopped before its end" * result.was_stopped
    trials = f"{counted(len(result.trials), 'trial')}{failed}{stopped}, {duration_text(spent_ns)} of functions."
    if best is None:
        return f"{trials} None has completed."
    what = f"To {result.direction} {cut_name(result.metric, 40)}"
    return f"{trials} {what}: {best.value:.6g} is the best, of trial {best.number}."


@contextmanager
def quiet_optuna() -> Iterator[None]:
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
