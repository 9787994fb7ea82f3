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
from epypes_widgets.places import Tunable
from epypes_widgets.values import said

if TYPE_CHECKING:
    from epypes.batch.optimize import Direction, OptimizeResult, Trial

_LOG: Final = logging.getLogger(__name__)
# The eye follows no more, and each time the whole curve goes to the page.
_TELL_S: Final = 0.2
FIRST_N: Final = 50
MOST_TRIALS: Final = 10_000

State = Literal["idle", "running", "stopping", "done", "refused"]


@dataclass(frozen=True, slots=True)
class Found:
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
        What the metric gave, trial by trial; None for one that failed.
    best
        The place of the best one among them; None if none completed.
    setting
        The values of the hyperparameters in that one, by token.
    importances
        How much each matters, as parts of 1; empty before the end.
    """

    state: State = "idle"
    text: str = ""
    n: int = FIRST_N
    values: tuple[float | None, ...] = ()
    best: int | None = None
    setting: Mapping[str, Any] | None = None
    importances: Mapping[str, float] | None = None


class Searching:
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
    told
        How often something was reported.
    report
        Is called with each ``Found``, on any thread. What it raises is logged.
    """

    def __init__(
        self,
        runner: CompGraphRunner,
        metric: Any,
        direction: Direction,
        cases: Any,
        ranges: Callable[[], Mapping[str, Any]],
    ) -> None:
        self.metric: str = metric if isinstance(metric, str) else getattr(metric, "__name__", "metric")
        self.direction = direction
        self.result: OptimizeResult | None = None
        self.report: Callable[[Found], None] = _tell_nobody
        self._runner, self._measure, self._cases, self._ranges = runner, metric, cases, ranges
        self._lock = threading.Lock()
        self._stop = threading.Event()
        self._ended = threading.Event()
        self._ended.set()
        self._found = Found()
        self.told = 0
        self._trials: list[Trial] = []
        self._told_s = 0.0

    @property
    def found(self) -> Found:
        """What was reported last."""
        return self._found

    @property
    def is_running(self) -> bool:
        """Whether a search has begun and not ended."""
        return not self._ended.is_set()

    def start(self, n: int = FIRST_N) -> bool:
        """Begin a search of so many trials and return at once; False, and nothing else, if one is running."""
        n = min(max(1, n), MOST_TRIALS)
        with self._lock:
            if self.is_running:
                return False
            self._ended.clear()
            self._stop.clear()
            self._trials = []
            self._tell(Found("running", f"Trial 1 of {n} ...", n))
        threading.Thread(target=self._work, args=(n,), name="epypes-search", daemon=True).start()
        return True

    def stop(self) -> None:
        """Have the search end when the case that runs has ended; return at once."""
        with self._lock:
            if not self.is_running or self._stop.is_set():
                return
            self._stop.set()
            self._tell(_so_far(tuple(self._trials), self.direction, self._found.n, "stopping"))

    def wait(self, timeout_s: float) -> OptimizeResult | None:
        """Return the result once nothing is running; TimeoutError if that takes longer."""
        if not self._ended.wait(timeout_s):
            raise TimeoutError(f"The search did not end within {timeout_s:g} s.")
        return self.result

    def close(self, timeout_s: float) -> None:
        """Stop, and wait for that; StillRunning if a function does not return in time."""
        self.stop()
        if not self._ended.wait(timeout_s):
            raise StillRunning("epypes-search", (), timeout_s)

    def _work(self, n: int) -> None:
        from epypes.batch.optimize import optimize

        try:
            self.result = result = optimize(
                self._runner,
                self._measure,
                self._of_last_run() if self._cases is None else self._cases,
                n,
                direction=self.direction,
                ranges={name: param for name, param in self._ranges().items() if isinstance(param, Param)},
                stop=self._stop,
                on_trial=self._tried,
                progress=False,
            )
            found = _at_end(result, n)
        except EpypesError as error:
            found = Found("refused", str(error), n, tuple(trial.value for trial in self._trials))
        except BaseException as error:  # a generator of cases, for example, may raise anything
            _LOG.exception("A search has failed")
            found = Found("refused", f"{type(error).__name__}: {error}", n)
        with self._lock:
            self._tell(found)
            self._ended.set()

    def _of_last_run(self) -> list[Mapping[str, Any]]:
        last = self._runner.last
        if last is None:
            raise ScaleError("Nothing has been run yet, so there is no case. Give some: tune(runner, cases=[...]).")
        return [{token: last[token] for token in self._runner.free_source_tokens}]

    def _tried(self, trial: Trial) -> None:
        self._trials.append(trial)
        now_s = monotonic()
        if now_s - self._told_s < _TELL_S:
            return
        self._told_s = now_s
        with self._lock:
            if not self._stop.is_set():
                self._tell(_so_far(self._trials, self.direction, self._found.n, "running"))

    def _tell(self, found: Found) -> None:
        """Report how far it is; to be called under the lock, so that nothing older comes after something newer."""
        self._found, self.told = found, self.told + 1
        try:
            self.report(found)
        except Exception:
            _LOG.exception("How far a search has come could not be shown")


def told(search: Searching | None) -> dict[str, Any] | None:
    """Return what a view is told of a search, ready for JSON; None if there is none."""
    if search is None:
        return None
    found = search.found
    return {
        "state": found.state,
        "text": found.text,
        "n": found.n,
        "values": list(found.values),
        "best": found.best,
        "setting": "" if found.setting is None else _in_words(found.setting),
        "importances": [[name, part] for name, part in (found.importances or {}).items()],
        "metric": search.metric,
        "direction": search.direction,
        "seq": search.told,
    }


def search_of(
    runner: Tunable, metric: Any, direction: Direction, cases: Any, ranges: Callable[[], Mapping[str, Any]]
) -> Searching | None:
    """Return what searches the hyperparameters of a runner; None without a metric.

    Raises
    ------
    TypeError
        It is a running service that is tuned.
    """
    if metric is None:
        return None
    if not isinstance(runner, CompGraphRunner):
        raise TypeError(
            "metric is for a runner: a running service has one image at a time. Optimise where it was made."
        )
    return Searching(runner, metric, direction, cases, ranges)


def _so_far(trials: Sequence[Trial], direction: Direction, n: int, state: State) -> Found:
    from epypes.batch.optimize import best_of

    best = best_of(trials, direction)
    text = (
        f"Trial {min(len(trials) + 1, n)} of {n}" if state == "running" else f"Stopping after {len(trials)} of {n} ..."
    )
    failed = sum(trial.value is None for trial in trials)
    text += f", {failed} failed" if failed else ""
    if best is not None:
        text += f"; best so far {best.value:.6g}"
    return _found(state, text, n, trials, best)


def _at_end(result: OptimizeResult, n: int) -> Found:
    from epypes.batch.optimize import best_of

    best = best_of(result.trials, result.direction)
    failed = f", {len(result.failures)} failed" if result.failures else ""
    begin = f"Stopped after {len(result)} of {n} trials" if result.was_stopped else counted(len(result), "trial")
    found = "; none completed" if best is None else f"; best {best.value:.6g}"
    importances = result.importances if best is not None else {}
    return _found("done", f"{begin}{failed}{found}", n, result.trials, best, importances)


def _found(
    state: State,
    text: str,
    n: int,
    trials: Sequence[Trial],
    best: Trial | None,
    importances: Mapping[str, float] | None = None,
) -> Found:
    values = tuple(trial.value for trial in trials)
    place = None if best is None else next(index for index, trial in enumerate(trials) if trial is best)
    return Found(state, text, n, values, place, None if best is None else best.setting, importances)


def _in_words(setting: Mapping[str, Any]) -> str:
    return ", ".join(f"{token} {said(value)}" for token, value in setting.items())


def _tell_nobody(_found: Found) -> None:
    """Take what nobody looks at yet."""
