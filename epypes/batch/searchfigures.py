"""How does a search look as figures of Matplotlib?

Drawn here, since Optuna's own change pyplot's style for the whole notebook and leave figures open in it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

from epypes.batch.optimized import best_so_far
from epypes.optional import optional_import

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from epypes.batch.optimized import OptimizeResult

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
