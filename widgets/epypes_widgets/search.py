"""A search of hyperparameters that a button of the panel starts."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from time import monotonic
from typing import TYPE_CHECKING, Any, Final, Literal

from epypes.errors import EpypesError, InvalidType, ScaleError
from epypes.hints import Param
from epypes.run import CompGraphRunner
from epypes.wording import counted
from epypes_widgets.session import Tunable
from epypes_widgets.values import setting_text
from epypes_widgets.worker import Worker

if TYPE_CHECKING:
    from epypes.batch.optimize import Direction, OptimizeResult, Trial

_LOG: Final = logging.getLogger(__name__)
# The eye follows no more, and each time the whole curve goes to the page.
_REPORT_S: Final = 0.2
FIRST_N: Final = 50
MAX_TRIALS: Final = 10_000


State = Literal["idle", "running", "stopping", "done", "refused"]


class Search:
    """Searches hyperparameters on a thread of its own, one search at a time.

    Parameters
    ----------
    runner
        Its graph and hyperparameters are used; it is left as it is.
    metric, direction, cases
        As for ``ep.optimize``; without cases, the payload of the last run is the one case.
    ranges
        What hyperparameters may be, by token; those vary that are choices, or numbers between two ends.

    Raises
    ------
    TypeError
        It is a running service.

    Attributes
    ----------
    result
        What ``ep.optimize`` returned last; None before.
    report
        Is called when there is progress, on any thread. What it raises is logged.
    """

    def __init__(
        self,
        runner: Tunable,
        metric: Any,
        direction: Direction,
        cases: Any,
        ranges: Mapping[str, Any],
    ) -> None:
        if not isinstance(runner, CompGraphRunner):
            text = "metric is for a runner: a running service has one image at a time. Optimise where it was made."
            raise InvalidType(text)
        self.result: OptimizeResult | None = None
        self.report: Callable[[], None] = lambda: None
        self._runner, self._metric, self._direction = runner, metric, direction
        self._cases = cases
        self._ranges = {name: param for name, param in ranges.items() if isinstance(param, Param)}
        self._worker = Worker("epypes-search")
        # Held while reporting, so that nothing older comes after something newer.
        self._reporting = threading.RLock()
        self._stop = threading.Event()
        # "stopping" when the button was pressed and a function still runs, "refused" if all failed.
        self._state: State = "idle"
        self._n, self._refusal, self._reports, self._reported_s = FIRST_N, "", 0, 0.0
        self._trials: list[Trial] = []
        self._importances: Mapping[str, float] = {}

    @property
    def is_running(self) -> bool:
        """Whether a search has begun and not ended."""
        return self._state in ("running", "stopping")

    @property
    def best(self) -> Trial | None:
        """The best trial until now; None if none completed."""
        from epypes.batch.optimize import best_of

        return best_of(self._trials, self._direction)

    def start(self, n: int = FIRST_N) -> bool:
        """Begin a search of so many trials and return at once; False, and nothing else, if one is running."""
        with self._reporting:
            if self.is_running or self._worker.closed:
                return False
            self._stop.clear()
            self._n, self._trials, self._importances = min(max(1, n), MAX_TRIALS), [], {}
            self._tell("running")
            self._worker.post("search", self._search)
            return True

    def stop(self) -> None:
        """Have the search end when the case that runs has ended; return at once."""
        with self._reporting:
            if self._state == "running":
                self._stop.set()
                self._tell("stopping")

    def wait(self, timeout_s: float) -> OptimizeResult | None:
        """Return the result once nothing is running; TimeoutError if that takes longer."""
        self._worker.wait(timeout_s)
        return self.result

    def close(self, timeout_s: float) -> None:
        """Stop, and wait for that; StillRunning if a function does not return in time."""
        self.stop()
        self._worker.close(timeout_s)

    def content(self) -> dict[str, Any]:
        """Return what a view gets, ready for JSON."""
        with self._reporting:
            best = self.best if self._trials else None
            metric = self._metric if isinstance(self._metric, str) else getattr(self._metric, "__name__", "metric")
            values = [trial.value for trial in self._trials]
            return {
                "state": self._state,
                "text": self._refusal if self._state == "refused" else self._text(best, values.count(None)),
                "n": self._n,
                "values": values,
                "best": next((place for place, trial in enumerate(self._trials) if trial is best), None),
                "setting": "" if best is None else setting_text(best.setting),
                "importances": [[name, part] for name, part in self._importances.items()],
                "metric": metric,
                "direction": self._direction,
                "seq": self._reports,
            }

    def _text(self, best: Trial | None, failed: int) -> str:
        count, is_done = len(self._trials), self._state == "done"
        text = {
            "idle": "",
            "running": f"Trial {min(count + 1, self._n)} of {self._n}",
            "stopping": f"Stopping after {count} of {self._n} ...",
            "done": f"Stopped after {count} of {self._n} trials" if self._stop.is_set() else counted(count, "trial"),
        }[self._state]
        text += f", {failed} failed" if failed else ""
        if best is None:
            return text + "; none completed" * is_done
        return f"{text}; {'best' if is_done else 'best so far'} {best.value:.6g}"

    def _search(self) -> None:
        from epypes.batch.optimize import optimize

        state: State = "refused"
        try:
            self.result = optimize(
                self._runner,
                self._metric,
                self._last_payload() if self._cases is None else self._cases,
                self._n,
                direction=self._direction,
                ranges=self._ranges,
                stop=self._stop,
                on_trial=self._tried,
                progress=False,
            )
            self._trials, state = list(self.result.trials), "done"
            self._importances = self.result.importances if self.best is not None else {}
        except EpypesError as error:
            self._refusal = str(error)
        except BaseException as error:  # a generator of cases, for example, may raise anything
            _LOG.exception("A search has failed")
            self._refusal = f"{type(error).__name__}: {error}"
        with self._reporting:
            self._tell(state)

    def _last_payload(self) -> list[Mapping[str, Any]]:
        last = self._runner.last
        if last is None:
            raise ScaleError("Nothing has been run yet, so there is no case. Give some: tune(runner, cases=[...]).")
        if self._runner.state:
            raise ScaleError(
                "The graph has state between runs: give the frames to search on, tune(runner, images=[...])."
            )
        return [{token: last[token] for token in self._runner.free_source_tokens}]

    def _tried(self, trial: Trial) -> None:
        with self._reporting:
            self._trials.append(trial)
            if monotonic() - self._reported_s >= _REPORT_S and self._state == "running":
                self._reported_s = monotonic()
                self._tell("running")

    def _tell(self, state: State) -> None:
        self._state, self._reports = state, self._reports + 1
        try:
            self.report()
        except Exception:
            _LOG.exception("How far a search has come could not be shown")
