"""What has a search of hyperparameters found?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from epypes.batch.ranging import Axis
from epypes.batch.results import object_column
from epypes.batch.studying import Direction, Trial, importances
from epypes.errors import ScaleError
from epypes.optional import optional_import
from epypes.wording import counted

if TYPE_CHECKING:
    import optuna
    import pandas as pd
    from matplotlib.figure import Figure

    from epypes.run import CompGraphRunner


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
        What the metric is called.
    axes
        What was searched.
    study
        Of Optuna, in memory.
    was_stopped
        Whether somebody ended it before all trials were run.
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
        return float(self.best_trial.value or 0.0)

    @property
    def failures(self) -> tuple[Trial, ...]:
        """The trials that failed."""
        return tuple(trial for trial in self.trials if trial.value is None)

    @property
    def importances(self) -> dict[str, float]:
        """How much each hyperparameter matters for good values, as parts of 1, the most important first.

        By PED-ANOVA, as Optuna has it; empty if fewer than two different values were found.
        """
        return importances(self.study)

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
        with optional_import():
            import pandas as pd
        return pd.DataFrame(columns)

    def history_plot(self) -> Figure:
        """Draw the value of each trial, and the best one so far, with Matplotlib."""
        from epypes.batch.searchfigures import history_figure

        return history_figure(self)

    def importance_plot(self) -> Figure:
        """Draw how much each hyperparameter matters, with Matplotlib."""
        from epypes.batch.searchfigures import importance_figure

        return importance_figure(self)

    def __repr__(self) -> str:
        best = best_of(self.trials, self.direction)
        found = "none completed" if best is None else f"best {self.metric:.30} {best.value:.6g}"
        stopped = ", stopped" * self.was_stopped
        return f"<OptimizeResult: {counted(len(self.trials), 'trial')}{stopped}; {found}>"

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        from epypes.batch.searchpage import search_page

        return {"text/plain": repr(self), "text/html": search_page(self)}


def best_of(trials: Sequence[Trial], direction: Direction) -> Trial | None:
    """Return the trial with the best value, the first of several; None if none has completed."""
    done = [trial for trial in trials if trial.value is not None]
    if not done:
        return None
    choose = max if direction == "maximize" else min
    return choose(done, key=_value)


def best_so_far(trials: Sequence[Trial], direction: Direction) -> list[float | None]:
    """Return, trial by trial, the best value up to it; None before the first that has completed."""
    best: list[float | None] = []
    for trial in trials:
        before = best[-1] if best else None
        known = [value for value in (before, trial.value) if value is not None]
        best.append((max(known) if direction == "maximize" else min(known)) if known else None)
    return best


def _value(trial: Trial) -> float:
    return float(trial.value or 0.0)
