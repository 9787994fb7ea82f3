"""Who does the jobs: this thread, threads, processes, a cluster?"""

from __future__ import annotations

import os
import queue
import threading
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import FIRST_COMPLETED, Executor, Future, ThreadPoolExecutor, wait
from itertools import islice
from typing import Final

from epypes.run import CompGraphRunner
from epypes.scale.job import Job, do
from epypes.scale.outcome import Outcome

# How soon a stop that somebody asks for is seen while nothing is done.
_LOOK_S: Final = 0.05
_JOBS_PER_WORKER: Final = 2

Submit = Callable[[Executor, Job], "Future[list[Outcome]]"]


def spread(
    runner: CompGraphRunner,
    jobs: Iterable[Job],
    executor: Executor | None = None,
    *,
    ahead: int | None = None,
    stop: threading.Event | None = None,
) -> Iterator[list[Outcome]]:
    """Give the outcomes of jobs, as they come.

    Parameters
    ----------
    runner
        Its graph and hyperparameters are used, on runners of its own; it is left as it is.
    jobs
        Taken one by one, when there is room for another.
    executor
        None: this thread does them. A ThreadPoolExecutor runs the graph itself; any other one a bundle of it.
    ahead
        How many jobs are at work or waiting at most; twice as many as there are workers without.
    stop
        Ends it in bounded time, once it is set; what was done until then is given.

    Raises
    ------
    ExecutorBroken
        The executor can't do them any more.
    ScaleError, PromotionRefused
        The graph can't travel to another process.
    """
    if executor is None:
        return _done_here(runner, jobs, stop)
    if not isinstance(executor, Executor):
        raise TypeError(f"executor must be a concurrent.futures.Executor, not {type(executor).__name__!r}.")
    return _handed_out(jobs, executor, _on_threads(runner), ahead, stop)


def own_runner(runner: CompGraphRunner) -> CompGraphRunner:
    """Return another runner of the same graph, with the same hyperparameters."""
    return CompGraphRunner(runner.cg, runner.hyperparameters, workers=runner.workers, guard=runner.guard)


def _done_here(runner: CompGraphRunner, jobs: Iterable[Job], stop: threading.Event | None) -> Iterator[list[Outcome]]:
    own = own_runner(runner)
    for job in jobs:
        if stop is not None and stop.is_set():
            return
        yield do(own, job, stop)


# -- executors --------------------------------------------------------------------------------------------------


class _Threads:
    """Does jobs on threads, each on a runner that no other thread uses meanwhile."""

    def __init__(self, runner: CompGraphRunner, stop: threading.Event) -> None:
        self._runner, self._stop = runner, stop
        self._idle: queue.SimpleQueue[CompGraphRunner] = queue.SimpleQueue()

    def do(self, job: Job) -> list[Outcome]:
        """Do a job on the thread that calls this."""
        if self._stop.is_set():
            return []
        try:
            own = self._idle.get_nowait()
        except queue.Empty:
            own = own_runner(self._runner)
        try:
            return do(own, job, self._stop)
        finally:
            self._idle.put(own)


def _on_threads(runner: CompGraphRunner) -> Callable[[threading.Event], Submit]:
    def begin(over: threading.Event) -> Submit:
        threads = _Threads(runner, over)
        return lambda executor, job: executor.submit(threads.do, job)

    return begin


def _handed_out(
    jobs: Iterable[Job],
    executor: Executor,
    begin: Callable[[threading.Event], Submit],
    ahead: int | None,
    stop: threading.Event | None,
) -> Iterator[list[Outcome]]:
    """Keep so many jobs at work; give what comes; leave none behind, however it ends."""
    over, source = threading.Event(), iter(jobs)
    submit = begin(over)
    most = ahead or _JOBS_PER_WORKER * worker_count(executor)
    at_work: set[Future[list[Outcome]]] = set()
    try:
        while stop is None or not stop.is_set():
            # One at a time, so that what has come decides about what is taken next.
            at_work |= {submit(executor, job) for job in islice(source, most - len(at_work))}
            if not at_work:
                return
            done, at_work = wait(at_work, None if stop is None else _LOOK_S, FIRST_COMPLETED)
            for future in done:
                yield future.result()
    finally:
        over.set()
        for future in at_work:
            future.cancel()


def worker_count(executor: Executor) -> int:
    """Return how many jobs an executor does at once, as far as that can be known."""
    if isinstance(executor, ThreadPoolExecutor):
        return executor._max_workers
    return os.cpu_count() or 1
