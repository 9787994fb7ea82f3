"""A search of hyperparameters that a button of the panel starts."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from time import monotonic
from typing import TYPE_CHECKING, Any, Final, Literal

from epypes.errors import EpypesError, ScaleError, StillRunning
from epypes.hints import Param
from epypes.run import CompGraphRunner
from epypes.wording import counted
from epypes_widgets.promotion import Job
from epypes_widgets.target import Tunable
from epypes_widgets.values import setting_text

if TYPE_CHECKING:
    from epypes.batch.optimize import Direction, OptimizeResult, Trial

_LOG: Final = logging.getLogger(__name__)
# The eye follows no more, and each time the whole curve goes to the page.
_REPORT_S: Final = 0.2
FIRST_N: Final = 50
MAX_TRIALS: Final = 10_000


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a search has come.

    Attributes
    ----------
    state
        ``"idle"`` before the first one; ``"running"``; ``"stopping"`` when the button was pressed and a function still
        runs; ``"done"``, ended or stopped; ``"refused"`` if it could not be begun or all trials failed.
    text
        For the user.
    n
        How many trials there are to be.
    values
        The metric, trial by trial; None for one that failed.
    best
        The place of the best one among them; None if none completed.
    setting
        The values of the hyperparameters in that one, by token.
    importances
        How much each matters, as parts of 1; empty before the end.
    """

    state: Literal["idle", "running", "stopping", "done", "refused"] = "idle"
    text: str = ""
    n: int = FIRST_N
    values: tuple[float | None, ...] = ()
    best: int | None = None
    setting: Mapping[str, Any] | None = None
    importances: Mapping[str, float] | None = None


class Search(Job):
    """Searches hyperparameters on a thread of its own, one search at a time.

    Parameters
    ----------
    runner
        Its graph and hyperparameters are used; it is left as it is.
    metric, direction, cases
        As for ``ep.optimize``; without cases, the payload of the last run is the one case.
    ranges
        Returns what hyperparameters may be, by token; those vary that are choices, or numbers between two ends.

    Attributes
    ----------
    result
        What ``ep.optimize`` returned last; None before.
    progress
        What was reported last.
    reports
        How often something was reported.
    report
        Is called when there is progress, on any thread. What it raises is logged.
    """

    def __init__(
        self,
        runner: CompGraphRunner,
        metric: Any,
        direction: Direction,
        cases: Any,
        ranges: Callable[[], Mapping[str, Any]],
    ) -> None:
        super().__init__("epypes-search")
        self.metric: str = metric if isinstance(metric, str) else getattr(metric, "__name__", "metric")
        self.direction = direction
        self.result: OptimizeResult | None = None
        self.progress, self.reports = Progress(), 0
        self.report: Callable[[], None] = lambda: None
        self._runner, self._measure, self._cases, self._ranges = runner, metric, cases, ranges
        # Held while reporting, so that nothing older comes after something newer.
        self._reporting = threading.RLock()
        self._stop = threading.Event()
        self._trials: list[Trial] = []
        self._reported_s = 0.0

    def start(self, n: int = FIRST_N) -> bool:
        """Begin a search of so many trials and return at once; False, and nothing else, if one is running."""
        n = min(max(1, n), MAX_TRIALS)
        with self._reporting:
            if self.is_running:
                return False
            self._stop.clear()
            self._trials = []
            self._tell(Progress("running", f"Trial 1 of {n} ...", n))
            return self.run(lambda: self._search(n))

    def stop(self) -> None:
        """Have the search end when the case that runs has ended; return at once."""
        with self._reporting:
            if self.is_running and not self._stop.is_set():
                self._stop.set()
                self._tell(_so_far(self._trials, self.direction, self.progress.n, "stopping"))

    def wait(self, timeout_s: float) -> OptimizeResult | None:
        """Return the result once nothing is running; TimeoutError if that takes longer."""
        self.wait_end(timeout_s)
        return self.result

    def close(self, timeout_s: float) -> None:
        """Stop, and wait for that; StillRunning if a function does not return in time."""
        self.stop()
        if not self._ended.wait(timeout_s):
            raise StillRunning(self._name, (), timeout_s)

    def _search(self, n: int) -> None:
        from epypes.batch.optimize import optimize

        try:
            self.result = optimize(
                self._runner,
                self._measure,
                self._last_payload() if self._cases is None else self._cases,
                n,
                direction=self.direction,
                ranges={name: param for name, param in self._ranges().items() if isinstance(param, Param)},
                stop=self._stop,
                on_trial=self._tried,
                progress=False,
            )
            progress = _at_end(self.result, n)
        except EpypesError as error:
            progress = Progress("refused", str(error), n, tuple(trial.value for trial in self._trials))
        except BaseException as error:  # a generator of cases, for example, may raise anything
            _LOG.exception("A search has failed")
            progress = Progress("refused", f"{type(error).__name__}: {error}", n)
        with self._reporting:
            self._tell(progress)
            self._ended.set()

    def _last_payload(self) -> list[Mapping[str, Any]]:
        last = self._runner.last
        if last is None:
            raise ScaleError("Nothing has been run yet, so there is no case. Give some: tune(runner, cases=[...]).")
        return [{token: last[token] for token in self._runner.free_source_tokens}]

    def _tried(self, trial: Trial) -> None:
        self._trials.append(trial)
        now_s = monotonic()
        if now_s - self._reported_s < _REPORT_S:
            return
        self._reported_s = now_s
        with self._reporting:
            if not self._stop.is_set():
                self._tell(_so_far(self._trials, self.direction, self.progress.n, "running"))

    def _tell(self, progress: Progress) -> None:
        self.progress, self.reports = progress, self.reports + 1
        try:
            self.report()
        except Exception:
            _LOG.exception("How far a search has come could not be shown")


def search_content(search: Search | None) -> dict[str, Any] | None:
    """Return what a view gets of a search, ready for JSON; None if there is none."""
    if search is None:
        return None
    progress = search.progress
    return {
        "state": progress.state,
        "text": progress.text,
        "n": progress.n,
        "values": list(progress.values),
        "best": progress.best,
        "setting": setting_text(progress.setting or {}),
        "importances": [[name, part] for name, part in (progress.importances or {}).items()],
        "metric": search.metric,
        "direction": search.direction,
        "seq": search.reports,
    }


def search_of(
    runner: Tunable, metric: Any, direction: Direction, cases: Any, ranges: Callable[[], Mapping[str, Any]]
) -> Search | None:
    """Return the search of a runner's hyperparameters; None without a metric, TypeError for a running service."""
    if metric is None:
        return None
    if not isinstance(runner, CompGraphRunner):
        raise TypeError(
            "metric is for a runner: a running service has one image at a time. Optimise where it was made."
        )
    return Search(runner, metric, direction, cases, ranges)


def _so_far(trials: Sequence[Trial], direction: Direction, n: int, state: Literal["running", "stopping"]) -> Progress:
    count = len(trials)
    text = f"Trial {min(count + 1, n)} of {n}" if state == "running" else f"Stopping after {count} of {n} ..."
    return _progress(state, text, "", n, trials, direction)


def _at_end(result: OptimizeResult, n: int) -> Progress:
    text = f"Stopped after {len(result)} of {n} trials" if result.was_stopped else counted(len(result), "trial")
    return _progress("done", text, "; none completed", n, result.trials, result.direction, lambda: result.importances)


def _progress(
    state: Literal["running", "stopping", "done"],
    text: str,
    without: str,
    n: int,
    trials: Sequence[Trial],
    direction: Direction,
    importances: Callable[[], Mapping[str, float]] = dict,
) -> Progress:
    from epypes.batch.optimize import best_of

    best = best_of(trials, direction)
    values = tuple(trial.value for trial in trials)
    failed = values.count(None)
    text += f", {failed} failed" if failed else ""
    if best is None:
        return Progress(state, text + without, n, values)
    text += f"; {'best' if state == 'done' else 'best so far'} {best.value:.6g}"
    place = next(index for index, trial in enumerate(trials) if trial is best)
    return Progress(state, text, n, values, place, best.setting, importances())
