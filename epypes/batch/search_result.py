"""The result of a search: its trials, the best of them, its table, page and figures."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from epypes.batch.ranges import Axis
from epypes.batch.results import frame_of, object_column
from epypes.batch.study import Direction, Trial, importances, quiet_optuna
from epypes.display.durations import duration_text
from epypes.display.markup import content, cut, cut_name, escape
from epypes.display.paint.rows import Table
from epypes.display.paint.style import STYLE, page_style, paper_style
from epypes.display.paint.tables import paint_table
from epypes.errors import ScaleError
from epypes.wording import counted

if TYPE_CHECKING:
    import optuna
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from epypes.run import CompGraphRunner

_WIDTH: Final = 560
_HEIGHT: Final = 200
_LEFT, _RIGHT, _TOP, _BOTTOM = 76, 14, 14, 34
# More dots than this can't be told apart; the line of the best has all trials.
_MOST_DOTS: Final = 1_000
_MOST_ROWS: Final = 30
_MOST_REASONS: Final = 3

_SCOPE: Final = ".epypes-graph.epypes-search"
_RULES: Final = {
    " text": "text-anchor:start;font-size:11px;fill:@quiet",
    " .end": "text-anchor:end",
    " .axis": "stroke:@line;stroke-width:1;fill:none",
    " .trials": "stroke:@accent;stroke-opacity:.55;stroke-width:6;stroke-linecap:round;fill:none",
    " .best": "stroke:@warn;stroke-width:2;fill:none",
    " .top": "fill:@warn;stroke:@ground;stroke-width:1.5",
    " .failed": "stroke:@error;stroke-width:1.4;fill:none",
}
_STYLE: Final = STYLE + paper_style(_SCOPE, _RULES) + page_style(_SCOPE, _RULES)


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


def _page(result: OptimizeResult) -> str:
    """Return a search as HTML: a sentence, its trials as a picture, the values found as a table, and its failures."""
    parts = [f"<p>{content(_sentence(result))}</p>"]
    best = best_of(result.trials, result.direction)
    if best is not None:
        parts += [_history(result, best), paint_table(_table(result, best))]
    reasons = list(dict.fromkeys(trial.failure for trial in result.failures))
    if reasons:
        items = "".join(f"<li>{content(cut(reason, 200))}</li>" for reason in reasons[:_MOST_REASONS])
        more = f"<li>and {len(reasons) - _MOST_REASONS} more reasons</li>" if len(reasons) > _MOST_REASONS else ""
        parts.append(f"<details><summary>Why trials failed</summary><ul>{items}{more}</ul></details>")
    return f'<div class="epypes-sheet">{"".join(parts)}</div>'


def _history(result: OptimizeResult, best: Trial) -> str:
    """Paint the value of each trial as a dot, the best so far as a line, failed trials as crosses at the foot."""
    trials = result.trials
    values = [trial.value for trial in trials if trial.value is not None]
    low, high, last = min(values), max(values), max(trials[-1].number, 1)
    foot, right = _HEIGHT - _BOTTOM, _WIDTH - _RIGHT

    def x(number: int) -> str:
        return f"{_LEFT + 8 + (right - _LEFT - 16) * number / last:.1f}"

    def y(value: float) -> str:
        share = (value - low) / (high - low) if high > low else 0.5
        return f"{foot - 10 - (foot - _TOP - 20) * share:.1f}"

    line, so_far = "", None
    for trial in trials:
        so_far = best_of([one for one in (so_far, trial) if one is not None], result.direction)
        if so_far is trial:
            at = x(trial.number), y(_value(trial))
            line += "H{}V{}".format(*at) if line else "M{},{}".format(*at)
    some = trials[:: -(-len(trials) // _MOST_DOTS)]
    dots = "".join(f"M{x(trial.number)} {y(trial.value)}h0" for trial in some if trial.value is not None)
    crosses = "".join(
        f"M{float(x(trial.number)) - 3:.1f},{foot - 9}l6,6m0,-6l-6,6" for trial in some if trial.value is None
    )
    ends = "".join(
        f'<text class="end" x="{_LEFT - 6}" y="{float(y(value)) + 4:.1f}">{value:.4g}</text>'
        for value in dict.fromkeys((low, high))
    )
    caption = f"{cut_name(result.metric, 30)} by trial; the line is the best so far"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="epypes-graph epypes-search" role="figure" '
        f'aria-label="{escape(f"{_sentence(result)} The line is the best so far.")}" '
        f'width="{_WIDTH}" height="{_HEIGHT}" viewBox="0 0 {_WIDTH} {_HEIGHT}">\n<style>{_STYLE}</style>\n'
        f'<rect class="shape" x=".5" y=".5" width="{_WIDTH - 1}" height="{_HEIGHT - 1}" rx="8"/>'
        f'<path class="axis" d="M{_LEFT},{_TOP}V{foot}H{right}"/>{ends}'
        f'<text x="{x(0)}" y="{foot + 14}">0</text><text class="end" x="{x(last)}" y="{foot + 14}">{last}</text>'
        f'<text x="{_LEFT}" y="{_HEIGHT - 7}">{content(caption)}</text>\n'
        f'<path class="trials" d="{dots}"/><path class="failed" d="{crosses}"/>'
        f'<path class="best" d="{line}H{x(last)}"/>'
        f'<circle class="top" cx="{x(best.number)}" cy="{y(_value(best))}" r="5"/>\n</svg>'
    )


def _table(result: OptimizeResult, best: Trial) -> Table:
    first, parts = result.trials[0], result.importances
    rows = [
        (
            axis.token,
            _text(best.setting[axis.token]),
            _text(first.setting[axis.token]),
            f"{parts[axis.token]:.0%}" if axis.token in parts else "",
        )
        for axis in sorted(result.axes, key=lambda axis: -parts.get(axis.token, 0.0))
    ][:_MOST_ROWS]
    values = (result.metric, f"{best.value:.6g}", "failed" if first.value is None else f"{first.value:.6g}", "")
    return Table("", ("hyperparameter", f"best (trial {best.number})", "first trial", "importance"), [*rows, values])


def _text(value: Any) -> str:
    return f"{value:.6g}" if isinstance(value, float) else cut(str(getattr(value, "name", value)), 40)


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
