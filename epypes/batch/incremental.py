"""Cases run with one setting after another, each time only what depends on what has changed."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from time import perf_counter_ns
from typing import Any, Final

from epypes.batch.items import Item, payload_of
from epypes.batch.results import ErrorInfo, Outcome
from epypes.bundle.clone import clone_runner
from epypes.run import CompGraphRunner, Run
from epypes.run.stopped import stop_at

# Of the values that runners hold between settings; further cases run from their files or arrays each time.
MOST_BYTES: Final = 2**30


class SearchStopped(Exception):
    """A stop was requested, and the function that ran then has returned."""


class CaseRunners:
    """Runs cases with one setting after another, each case on a runner of its own, as far as memory is for that.

    Parameters
    ----------
    runner
        Its graph and hyperparameters are used; it is left as it is.
    items
        The cases' inputs.
    own
        Hyperparameters of the items that differ from those of the runner.
    keep
        The tokens that are wanted; only what they need is run.
    stop
        Once it is set, the function that runs is the last one.
    """

    def __init__(
        self,
        runner: CompGraphRunner,
        items: Sequence[Item],
        own: Sequence[Mapping[str, Any]],
        keep: Sequence[str],
        stop: threading.Event | None = None,
    ) -> None:
        self._runner, self._stop = runner, stop
        self._items, self._own, self._keep = tuple(items), tuple(own), tuple(keep)
        self._runners: dict[int, CompGraphRunner] = {}
        self._bytes = 0

    def outcomes(self, setting: Mapping[str, Any]) -> Iterator[Outcome]:
        """Yield the outcomes of the items under a setting, one after another.

        Raises
        ------
        SearchStopped
            A stop was requested.
        """
        for index, item in enumerate(self._items):
            yield self._outcome(index, item, setting)

    def _outcome(self, index: int, item: Item, setting: Mapping[str, Any]) -> Outcome:
        begun_ns = perf_counter_ns()
        runner = self._runners.get(index)
        is_new = runner is None
        kept: dict[str, Any] = {}
        error_info: ErrorInfo | None = None
        try:
            if runner is None:
                runner = self._loaded(item)
            begun_ns = perf_counter_ns()  # files are not what is measured
            run = self._run(runner, {**setting, **self._own[index]})
            kept = {token: run[token] for token in self._keep}
        except SearchStopped:
            raise
        except (Exception, SystemExit) as error:  # whatever a function raises
            error_info = _trouble(runner, error)
        spent_ns = perf_counter_ns() - begun_ns
        if is_new and runner is not None:
            self._remember(index, runner)
        return Outcome(item.number, item.name, setting, total_ns=spent_ns, error_info=error_info, kept=kept)

    def _loaded(self, item: Item) -> CompGraphRunner:
        """Return a runner that has an item as payload and has run nothing."""
        runner = clone_runner(self._runner)
        stop_at(runner, payload_of(item, runner.cg))
        return runner

    def _run(self, runner: CompGraphRunner, values: Mapping[str, Any]) -> Run:
        runner.set(**values)
        if self._stop is None:
            return runner.rerun(*self._keep)
        # One function at a time, so that a stop waits for one alone.
        for function in runner.plan(*self._keep).order:
            if self._stop.is_set():
                raise SearchStopped
            runner.rerun(*runner.cg.func_outputs(function))
        return runner.rerun(*self._keep)

    def _remember(self, index: int, runner: CompGraphRunner) -> None:
        """Keep a runner for the next setting, unless its arrays are too large."""
        held = 0 if runner.last is None else _bytes_of(runner.last)
        if self._bytes + held <= MOST_BYTES:
            self._bytes += held
            self._runners[index] = runner


def _bytes_of(run: Run) -> int:
    found = (run[token] for token in run.cg.tokens if run.tokens.is_readable(token))
    return sum(getattr(value, "nbytes", 0) for value in found)


def _trouble(runner: CompGraphRunner | None, error: BaseException) -> ErrorInfo:
    failure = None if runner is None or runner.last is None else runner.last.failure
    where = failure.function if failure is not None and failure.exception is error else ""
    return ErrorInfo(where, type(error).__name__, str(error))
