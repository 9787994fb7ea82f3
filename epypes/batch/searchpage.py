"""How does a search show itself on a page: what was found, and how its trials went?"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any, Final

from epypes.batch.optimized import best_of, best_so_far
from epypes.display.durations import duration_text
from epypes.display.markup import content, cut, cut_name, escape
from epypes.display.paint.rows import Table
from epypes.display.paint.style import STYLE, page_style, paper_style
from epypes.display.paint.tables import paint_table
from epypes.wording import counted

if TYPE_CHECKING:
    from epypes.batch.optimized import OptimizeResult
    from epypes.batch.studying import Trial

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
    line = _line(result, x, y)
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


def _line(result: OptimizeResult, x: Any, y: Any) -> str:
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
