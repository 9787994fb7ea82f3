"""Who does the jobs: this thread, threads, processes, a cluster?"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable, Iterator
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from typing import Any, Final

from epypes.batch.hands import Bundles, Hands, NotTaken, Threads, own_runner, said
from epypes.batch.job import Job, do
from epypes.batch.outcome import Outcome
from epypes.errors import ExecutorBroken
from epypes.run import CompGraphRunner
from epypes.wording import counted

# How soon a stop that somebody asks for is seen while nothing comes, and a Ctrl+C that another thread was given, which
# does not wake a main thread that waits on a lock.
_LOOK_S: Final = 0.05
_JOBS_PER_WORKER: Final = 2
# How long it is waited, once it was stopped, for what is at work.
_GRACE_S: Final = 2.0


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
        Functions that keep something from one item to the next give other results on threads, which share it and take
        items in any order: a bundle's promotion refuses such functions, threads can't know them.
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
    if ahead is not None and (type(ahead) is not int or ahead < 1):
        raise ValueError(f"ahead is how many jobs are at work or waiting, 1 or more, not {ahead!r}.")
    if executor is None:
        return _done_here(runner, jobs, stop)
    if not isinstance(executor, Executor):
        raise TypeError(f"executor must be a concurrent.futures.Executor, not {type(executor).__name__!r}.")
    over = threading.Event()
    on_threads = isinstance(executor, ThreadPoolExecutor)
    hands = Threads(runner, executor, over, stop) if on_threads else Bundles(runner, executor)
    return _handed_out(hands, jobs, ahead or _JOBS_PER_WORKER * worker_count(executor), over, stop)


def _done_here(runner: CompGraphRunner, jobs: Iterable[Job], stop: threading.Event | None) -> Iterator[list[Outcome]]:
    own = own_runner(runner)
    for job in jobs:
        if stop is not None and stop.is_set():
            return
        yield do(own, job, stop)


# -- executors --------------------------------------------------------------------------------------------------


def _handed_out(
    hands: Hands, jobs: Iterable[Job], most: int, over: threading.Event, stop: threading.Event | None
) -> Iterator[list[Outcome]]:
    """Keep so many jobs at work; give what comes; leave none behind, however it ends."""
    at_work: dict[Future[Any], Job] = {}
    source, done = iter(jobs), 0
    try:
        while stop is None or not stop.is_set():
            # One at a time, so that what has come decides about what is taken next.
            while len(at_work) < most and (job := next(source, None)) is not None:
                at_work[hands.submit(job)] = job
                del job
            if not at_work:
                if (job := hands.suspect()) is None:
                    return
                at_work[hands.submit(job)] = job
            ready, _ = wait(at_work, _LOOK_S, FIRST_COMPLETED)
            for future in ready:
                outcomes, again = hands.read(future, at_work.pop(future))
                at_work |= again
                done += len(outcomes)
                yield outcomes
        over.set()
        yield from _last(hands, at_work)
    except (BrokenExecutor, CancelledError, NotTaken) as error:
        raise ExecutorBroken(done, _why(done, error)) from error
    finally:
        over.set()
        for future in at_work:
            future.cancel()


def _last(hands: Hands, at_work: dict[Future[Any], Job]) -> Iterator[list[Outcome]]:
    """Give what is still being done; what waits is not begun any more."""
    begun = {future for future in at_work if not future.cancel()}
    ready, _ = wait(begun, _GRACE_S)
    for future in ready:
        outcomes, again = hands.read(future, at_work.pop(future))
        at_work |= again
        yield outcomes


def _why(done: int, error: BaseException) -> str:
    if isinstance(error, NotTaken):
        return _closed(done, str(error))
    return (
        f"The executor broke after {counted(done, 'outcome')}, most likely since one of its processes died "
        f"({said(error)}). Make a new one and run again: with store= what was done is taken from there. "
        "A Dask cluster goes on by itself."
    )


def _closed(done: int, why: str) -> str:
    return (
        f"The executor takes no jobs after {counted(done, 'outcome')}: it was shut down, or its client closed ({why}). "
        "Make a new one and run again: with store= what was done is taken from there."
    )


def worker_count(executor: Executor) -> int:
    """Return how many jobs an executor does at once, as far as that can be known.

    Raises
    ------
    ExecutorBroken
        It can't be asked any more, as that of a Dask client that was closed.
    """
    # Neither Python's pools nor Dask's executor say it in public.
    most = getattr(executor, "_max_workers", None)
    if isinstance(most, int):
        return most
    cores = getattr(getattr(executor, "_client", None), "ncores", None)
    if not callable(cores):
        return os.cpu_count() or 1
    try:
        return max(int(sum(cores().values())), 1)
    except Exception as error:  # a client without a scheduler raises whatever comes first
        raise ExecutorBroken(0, _closed(0, said(error))) from error
