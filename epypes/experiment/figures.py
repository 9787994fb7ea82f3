"""Figures 14, 15 and 16 of the paper, drawn from the times of an experiment.

Semeniuta and Falkman 2019, PeerJ Computer Science 5:e176.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np
from matplotlib import style
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from epypes.display.paint.plot import BLUE, PLOT_STYLE, RED, Plot, plot
from epypes.experiment.results import PAPER, LogNormal, answered, lognormal_fit
from epypes.wording import counted

if TYPE_CHECKING:
    import pandas as pd

_PARTS: Final = {
    "acquisition.t_rp": ("acquisition", BLUE),
    "vision.t_rp": ("vision", "#e69f00"),
    "o_network": ("network", "#009e73"),
}
_MS, _US = 1e3, 1e6
_SHOWN_REQUESTS: Final = 100
# Of a curve, by as many sigmas from mu as there is something to see: a narrow peak on a wide axis has them all.
_POINTS: Final = 160
_SIGMAS: Final = 5.0
# By as many the axis reaches below mu, at least.
_SIGMAS_LEFT: Final = 2.5
_BINS: Final = 60
# What is beside the outermost mark, as a factor.
_MARGIN: Final = 1.5


@style.context(PLOT_STYLE)
def figure_14(table: pd.DataFrame) -> Figure:
    """Draw 100 requests as stacked bars: what acquisition, vision and the network took of each trip.

    Parameters
    ----------
    table
        A row per request, as ``Results.table``. The first 100 rows are drawn; ``table[table.experiment == 2]`` chooses
        others.

    Returns
    -------
    Figure
        It has three containers of bars, in milliseconds. A request that failed is a cross without a bar.

    Raises
    ------
    ValueError
        It is no table of an experiment.
    """
    has_times = answered(table, *_PARTS)[:_SHOWN_REQUESTS]
    figure, axes = plot("Figure 14: where the time of each request goes")
    if not has_times.any():
        return _without_data(figure, axes, has_times)
    shown = table[:_SHOWN_REQUESTS]
    bottom, negative = np.zeros(has_times.sum()), 0
    for column, (name, colour) in _PARTS.items():
        times = shown.loc[has_times, column].to_numpy(dtype=float)
        heights = np.fmax(times, 0) * _MS
        axes.bar(np.flatnonzero(has_times), heights, width=0.84, bottom=bottom, color=colour, label=name)
        bottom = bottom + heights
        negative += int(np.sum(times < 0))
    failed = np.flatnonzero(~has_times)
    if len(failed):
        axes.plot(failed, np.zeros(len(failed)), "kx", label="failed", clip_on=False, zorder=3)
    axes.set(xlabel="request", ylabel="time, ms", xlim=(-1, len(shown)))
    return _with_notes(
        figure,
        axes,
        f"{counted(len(shown), 'request')} of {counted(shown['experiment'].nunique(), 'experiment')}",
        _note(negative, "negative time", "not drawn"),
        _note(len(failed), "request", "failed"),
        columns=4,
    )


@style.context(PLOT_STYLE)
def figure_15(table: pd.DataFrame, *, side_by_side: bool = False) -> Figure:
    """Draw how the graph overhead of the vision component is distributed, beside the paper's.

    Parameters
    ----------
    table
        A row per request, as ``Results.table``.
    side_by_side
        Whether functions ran side by side; graph overhead is then wall time less the critical path, and labelled so.

    Returns
    -------
    Figure
        Log-normal densities on a logarithmic axis of microseconds: a shape per experiment and a curve over all, a thin
        line at its mode, thick lines at the measured range, a dashed line at the mode in the paper, and behind them a
        histogram of what was measured. Values that aren't positive are counted in the text, not fitted.

    Raises
    ------
    ValueError
        It is no table of an experiment.
    """
    less = "the critical path" if side_by_side else "the times of its functions"
    return _densities(table, "vision.o_cg", "Figure 15: graph overhead", f"o_cg: pipeline time less {less}, µs")


@style.context(PLOT_STYLE)
def figure_16(table: pd.DataFrame) -> Figure:
    """Draw how the overhead of the vision component's reactive pipeline is distributed, beside the paper's.

    Parameters, what is returned and what is raised are those of ``figure_15``.
    """
    meaning = "o_epypes: from reaction to publishing, less the times of f_in, pipeline and f_out, µs"
    return _densities(table, "vision.o_epypes", "Figure 16: overhead of the reactive pipeline", meaning)


def _densities(table: pd.DataFrame, column: str, title: str, meaning: str) -> Figure:
    has_times = answered(table, column)
    figure, axes = plot(title)
    if not has_times.any():
        return _without_data(figure, axes, has_times)
    rows = table[has_times]
    whole = lognormal_fit(rows[column])
    if not whole.count:
        text = f"Of {counted(len(rows), 'value')} none is positive, so there is nothing to fit."
        return _with_message(figure, axes, text)
    experiments = [lognormal_fit(values) for _, values in rows.groupby("experiment")[column]]
    flat = sum(not fitted.has_curve for fitted in experiments)
    positive = rows.loc[rows[column] > 0, column] * _US
    _mark(axes, positive, whole, PAPER[column] * _US)
    axes.set_xlabel(meaning)
    if positive.nunique() > 1:
        # In bins that are equally wide on the axis.
        bins = np.geomspace(positive.min(), positive.max(), _BINS).tolist()
        axes.hist(positive, bins=bins, density=True, color="black", alpha=0.16, label="histogram", zorder=0)
    _draw_curves(axes, whole, experiments)
    no_curve = "no curve, since there are no values that differ"
    return _with_notes(
        figure,
        axes,
        f"{counted(whole.count, 'value')} of {counted(len(experiments), 'experiment')}",
        _note(whole.left_out, "value", "not positive, left out"),
        _note(flat, "experiment", "without a curve") if whole.has_curve else no_curve,
        _note(np.sum(~has_times), "request", "failed"),
    )


def _mark(axes: Axes, times: pd.Series[float], whole: LogNormal, paper: float) -> None:
    """Draw what stands on the axis, in microseconds: the measured range, the mode of all data, and the paper's."""
    least, most, mode = times.min(), times.max(), whole.mode * _US
    measured = " to ".join(dict.fromkeys(map(_number, (least, most))))
    axes.axvline(least, color="black", linewidth=3, ymax=0.25, label=f"measured: {measured} µs")
    axes.axvline(most, color="black", linewidth=3, ymax=0.25)
    axes.axvline(mode, color="black", linewidth=0.9, label=f"mode: {_number(mode)} µs")
    axes.axvline(paper, color=RED, linewidth=1.6, linestyle="--", label=f"the paper's mode: {_number(paper)} µs")
    # To the left a fit may reach further than what was measured.
    low = min(least, mode, paper, _US * float(np.exp(whole.mu - _SIGMAS_LEFT * whole.sigma))) / _MARGIN
    high = max(most, mode, paper) * _MARGIN
    axes.set(xscale="log", xlim=(low, high))
    axes.xaxis.set_major_formatter("{x:g}")
    axes.xaxis.set_minor_formatter(LogFormatter())  # 6, not 6 x 10^0


def _draw_curves(axes: Axes, whole: LogNormal, experiments: list[LogNormal]) -> None:
    if not whole.has_curve:
        axes.yaxis.set_visible(False)
        return
    low, high = axes.get_xlim()

    def density(fitted: LogNormal) -> tuple[np.ndarray, np.ndarray]:
        """Return microseconds, and how dense the distribution is there, per microsecond."""
        times = np.exp(fitted.mu + fitted.sigma * np.linspace(-_SIGMAS, _SIGMAS, _POINTS)) * _US
        times = np.array([low, *times[(times > low) & (times < high)], high])
        return times, fitted.pdf(times / _US) / _US

    label = "each experiment"
    for fitted in experiments:
        if fitted.has_curve:
            axes.fill_between(*density(fitted), color=BLUE, alpha=0.2, linewidth=0, label=label)
            label = ""
    axes.plot(*density(whole), color=BLUE, linewidth=2.8, label="all data")
    axes.set(ylabel="probability density, per µs")
    axes.set_ylim(bottom=0)


def _with_notes(figure: Plot, axes: Axes, *notes: str, columns: int = 3) -> Plot:
    """Return the figure with notes above its axes, and with its legend in so many columns below them."""
    axes.set_title("; ".join(filter(None, notes)), loc="left", fontsize=9)
    figure.legend(loc="outside lower left", ncols=columns, fontsize=9)
    return figure


def _with_message(figure: Plot, axes: Axes, text: str) -> Plot:
    """Return the figure with a sentence instead of axes, where there is nothing to draw."""
    axes.set_axis_off()
    axes.text(0.5, 0.5, text, ha="center", va="center", transform=axes.transAxes)
    return figure


def _without_data(figure: Plot, axes: Axes, has_times: np.ndarray) -> Plot:
    texts = {0: "There is no request.", 1: "The only request failed."}
    return _with_message(figure, axes, texts.get(len(has_times), f"All {len(has_times)} requests failed."))


def _note(count: int, noun: str, text: str) -> str:
    """Return a note on how many there are; empty if there is none."""
    return f"{counted(int(count), noun)} {text}" if count else ""


def _number(time: float) -> str:
    return f"{time:,.0f}" if time >= 100 else f"{time:.3g}"
