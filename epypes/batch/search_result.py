"""What has a search of hyperparameters found?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Final

from epypes.batch.ranges import Axis
from epypes.batch.results import object_column
from epypes.batch.study import Direction, Trial, importances
from epypes.display.durations import duration_text
from epypes.display.markup import content, cut, cut_name, escape
from epypes.display.paint.rows import Table
from epypes.display.paint.style import STYLE, page_style, paper_style
from epypes.display.paint.tables import paint_table
from epypes.errors import ScaleError
from epypes.optional import optional_import
from epypes.wording import counted

if TYPE_CHECKING:
    import optuna
    import pandas as pd
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from epypes.batch.study import Trial
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
        return history_figure(self)

    def importance_plot(self) -> Figure:
        """Draw how much each hyperparameter matters, with Matplotlib."""
        return importance_figure(self)

    def __repr__(self) -> str:
        best = best_of(self.trials, self.direction)
        found = "none completed" if best is None else f"best {self.metric:.30} {best.value:.6g}"
        stopped = ", stopped" * self.was_stopped
        return f"<OptimizeResult: {counted(len(self.trials), 'trial')}{stopped}; {found}>"

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:

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


_WIDTH: Final = 560
_HEIGHT: Final = 200
_LEFT: Final = 64
_RIGHT: Final = 14
_TOP: Final = 14
_BOTTOM: Final = 34
# More dots than this can't be told apart; the line of the best has all trials.
_MOST_DOTS: Final = 1_000
# What each of them was would make the page large.
_MOST_TOLD: Final = 150
_MOST_ROWS: Final = 30
_MOST_REASONS: Final = 3
_TITLE_CHARACTERS: Final = 160

_SCOPE: Final = ".epypes-graph.epypes-search"
_RULES: Final = {
    " text": "text-anchor:start;font-size:11px;fill:@quiet",
    " .end": "text-anchor:end",
    " .axis": "stroke:@line;stroke-width:1;fill:none",
    " .trial": "fill:@accent;fill-opacity:.55",
    " .trials": "stroke:@accent;stroke-opacity:.55;stroke-width:6;stroke-linecap:round;fill:none",
    " .best": "stroke:@warn;stroke-width:2;fill:none",
    " .top": "fill:@warn;stroke:@ground;stroke-width:1.5",
    " .fault": "stroke:@error;stroke-width:1.4;fill:none",
}
_STYLE: Final = STYLE + paper_style(_SCOPE, _RULES) + page_style(_SCOPE, _RULES)


def search_page(result: OptimizeResult) -> str:
    """Return a search as HTML: in words, its trials as a picture, and the values found as a table."""
    parts = [f"<p>{content(_sentence(result))}</p>"]
    best = best_of(result.trials, result.direction)
    if best is not None:
        parts += [paint_history(result), paint_table(_table(result, best))]
    parts += _reasons(result)
    return f'<div class="epypes-sheet epypes-optimized">{"".join(parts)}</div>'


def paint_history(result: OptimizeResult) -> str:
    """Paint the value of each trial as a dot, the best so far as a line, failed trials as crosses at the foot."""
    trials = result.trials
    values = [trial.value for trial in trials if trial.value is not None]
    low, high = (min(values), max(values)) if values else (0.0, 0.0)
    span = (high - low) or max(abs(high), 1.0)
    last = max(trials[-1].number if trials else 0, 1)

    def x(number: int) -> str:
        return f"{_LEFT + 8 + (_WIDTH - _LEFT - _RIGHT - 16) * number / last:.1f}"

    def y(value: float) -> str:
        share = (value - low) / span if high > low else 0.5
        return f"{_HEIGHT - _BOTTOM - 10 - (_HEIGHT - _TOP - _BOTTOM - 20) * share:.1f}"

    told = f"{_sentence(result)} The line is the best so far."
    head = (
        f'<svg xmlns="http://www.w3.org/2000/svg" class="epypes-graph epypes-search" role="figure" '
        f'aria-label="{escape(told)}" width="{_WIDTH}" height="{_HEIGHT}" viewBox="0 0 {_WIDTH} {_HEIGHT}">'
    )
    paper = f'<rect class="shape" x=".5" y=".5" width="{_WIDTH - 1}" height="{_HEIGHT - 1}" rx="8"/>'
    labels = _labels(result, low, high, y, x, last)
    dots = _dots(trials, x, y)
    line = _paint_line(result, x, y)
    best = best_of(trials, result.direction)
    top = "" if best is None else f'<circle class="top" cx="{x(best.number)}" cy="{y(best.value or 0.0)}" r="5"/>'
    return "\n".join([head, f"<style>{_STYLE}</style>", paper, *labels, *dots, line, top, "</svg>"])


def _labels(result: OptimizeResult, low: float, high: float, y: Any, x: Any, last: int) -> Iterator[str]:
    foot, right = _HEIGHT - _BOTTOM, _WIDTH - _RIGHT
    yield f'<path class="axis" d="M{_LEFT},{_TOP}V{foot}H{right}"/>'
    for value in dict.fromkeys((low, high)):
        yield f'<text class="end" x="{_LEFT - 6}" y="{float(y(value)) + 4:.1f}">{value:.4g}</text>'
    yield f'<text x="{x(0)}" y="{foot + 14}">0</text><text class="end" x="{x(last)}" y="{foot + 14}">{last}</text>'
    words = f"{cut_name(result.metric, 30)} by trial; the line is the best so far"
    yield f'<text x="{_LEFT}" y="{_HEIGHT - 7}">{content(words)}</text>'


def _dots(trials: Sequence[Trial], x: Any, y: Any) -> Iterator[str]:
    """Give a mark for each trial, with what was tried if there are not too many of them."""
    if len(trials) > _MOST_TOLD:
        some = trials[:: -(-len(trials) // _MOST_DOTS)]
        path = "".join(f"M{x(trial.number)} {y(trial.value)}h0" for trial in some if trial.value is not None)
        yield f'<path class="trials" d="{path}"/>'
        failed = (trial for trial in some if trial.value is None)
        yield f'<path class="fault" d="{"".join(_cross(x(trial.number)) for trial in failed)}"/>'
        return
    for trial in trials:
        said = f"<title>{content(_told(trial))}</title>"
        if trial.value is None:
            yield f'<path class="fault" d="{_cross(x(trial.number))}">{said}</path>'
        else:
            yield f'<circle class="trial" cx="{x(trial.number)}" cy="{y(trial.value)}" r="3">{said}</circle>'


def _cross(x: str) -> str:
    return f"M{float(x) - 3:.1f},{_HEIGHT - _BOTTOM - 9}l6,6m0,-6l-6,6"


def _paint_line(result: OptimizeResult, x: Any, y: Any) -> str:
    """Paint the best so far: a step where it gets better, and its end."""
    path = ""
    before: float | None = None
    best = best_so_far(result.trials, result.direction)
    for trial, value in zip(result.trials, best, strict=True):
        if value is not None and value != before:
            path += f"H{x(trial.number)}V{y(value)}" if path else f"M{x(trial.number)},{y(value)}"
            before = value
    end = f"H{x(result.trials[-1].number)}" if path else ""
    return f'<path class="best" d="{path}{end}"/>' if path else ""


def _table(result: OptimizeResult, best: Trial) -> Table:
    first, parts = result.trials[0], result.importances
    rows = [
        (
            axis.token,
            _said(best.setting[axis.token]),
            _said(first.setting[axis.token]),
            f"{parts[axis.token]:.0%}" if axis.token in parts else "",
        )
        for axis in sorted(result.axes, key=lambda axis: -parts.get(axis.token, 0.0))
    ][:_MOST_ROWS]
    values = (result.metric, f"{best.value:.6g}", "failed" if first.value is None else f"{first.value:.6g}", "")
    return Table("", ("hyperparameter", f"best (trial {best.number})", "first trial", "importance"), [*rows, values])


def _said(value: Any) -> str:
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


def _reasons(result: OptimizeResult) -> Iterator[str]:
    reasons = list(dict.fromkeys(trial.failure for trial in result.failures))
    if reasons:
        items = "".join(f"<li>{content(cut(reason, 200))}</li>" for reason in reasons[:_MOST_REASONS])
        more = f"<li>and {len(reasons) - _MOST_REASONS} more reasons</li>" if len(reasons) > _MOST_REASONS else ""
        yield f"<details><summary>Why trials failed</summary><ul>{items}{more}</ul></details>"


def _told(trial: Trial) -> str:
    setting = ", ".join(f"{token}={_said(value)}" for token, value in trial.setting.items())
    value = trial.failure if trial.value is None else f"{trial.value:.6g}"
    return cut(f"trial {trial.number}: {value}; {setting}", _TITLE_CHARACTERS)


# Okabe and Ito's, which people with any colour vision tell apart; a white ground can be read on any page.
_BLUE: Final = "#0072b2"
_ORANGE: Final = "#d55e00"
_GREY: Final = "#525a64"
_INCH_PER_BAR: Final = 0.32


def history_figure(result: OptimizeResult) -> Figure:
    """Draw the value of each trial as a dot, the best so far as a line, and failed trials as crosses below."""
    figure, axes = _blank(7.2, 3.4)
    done = [(trial.number, trial.value) for trial in result.trials if trial.value is not None]
    failed = [trial.number for trial in result.failures]
    axes.plot([number for number, _ in done], [value for _, value in done], "o", ms=4, color=_BLUE, label="trial")
    best = [
        (trial.number, value)
        for trial, value in zip(result.trials, best_so_far(result.trials, result.direction), strict=True)
        if value is not None
    ]
    if best:
        axes.step(*zip(*best, strict=True), where="post", color=_ORANGE, label="best so far")
    if failed:
        at_foot: Any = axes.get_xaxis_transform()
        axes.plot(failed, [0.03] * len(failed), "x", ms=5, color=_GREY, transform=at_foot, label="failed")
    axes.set(xlabel="trial", ylabel=result.metric)
    axes.set_title(f"{result.metric}, to {result.direction}", loc="left", fontsize=10)
    if result.trials:
        axes.legend(frameon=False, fontsize=9)
    return figure


def importance_figure(result: OptimizeResult) -> Figure:
    """Draw how much each hyperparameter matters as bars, the most important above."""
    found = result.importances
    figure, axes = _blank(7.2, 1.1 + _INCH_PER_BAR * max(len(found), 2))
    axes.set_title(f"What matters for {result.metric}", loc="left", fontsize=10)
    if not found:
        axes.set_axis_off()
        axes.text(0.5, 0.5, "Not known: too few different values", ha="center", transform=axes.transAxes)
        return figure
    names, parts = list(found)[::-1], list(found.values())[::-1]
    bars = axes.barh(names, parts, color=_BLUE, height=0.6)
    axes.bar_label(bars, [f"{part:.0%}" for part in parts], padding=4, fontsize=9)
    axes.set(xlim=(0, max(1.0, *parts) * 1.1), xlabel="part of the difference")
    return figure


def _blank(width: float, height: float) -> tuple[Figure, Axes]:
    with optional_import("scale"):
        from matplotlib.figure import Figure
    figure = Figure(figsize=(width, height), dpi=100, layout="constrained", facecolor="white")
    axes = figure.add_subplot()
    axes.spines[["top", "right"]].set_visible(False)
    return figure, axes
