"""Executor backends: this thread, threads, processes or a cluster run the jobs, and progress bars.

This thread and threads run the graph itself, on runners of their own. Any other executor gets a package of it. Progress
is shown as lines of text on standard error, no widgets, so that a saved notebook shows how they ended.
"""

from __future__ import annotations

import abc
import contextlib
import os
import sys
import threading
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import (
    FIRST_COMPLETED,
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ThreadPoolExecutor,
    wait,
)
from dataclasses import replace
from importlib.util import find_spec
from typing import Any, Final

from epypes.batch.job import Job, failed_outcome, read_frames, run_job
from epypes.batch.packaged_graph import (
    PackagedGraph,
    PackagedJob,
    package_of,
    packed_job,
    packed_values,
    run_packaged_job,
    unpacked_outcomes,
)
from epypes.batch.results import ErrorInfo, Outcome
from epypes.bundle.source.clone import clone_runner
from epypes.errors import EpypesError, ExecutorBroken, ImageFileError, InvalidType, InvalidValue, ScaleError
from epypes.optional import optional_import
from epypes.run import CompGraphRunner
from epypes.run.runner import branched
from epypes.wording import counted, ended

# How soon a stop is noticed while nothing comes, and a Ctrl+C that another thread was given, which does not wake a main
# thread that waits on a lock.
_LOOK_S: Final = 0.05
_JOBS_PER_WORKER: Final = 2
_KILLED: Final = ErrorInfo("", "KilledWorker", "every worker that ran it died")
# How long a stop waits for the jobs that have begun.
_GRACE_S: Final = 2.0


def run_jobs(
    runner: CompGraphRunner,
    jobs: Iterable[Job | None],
    executor: Executor | None = None,
    *,
    ahead: int | None = None,
    stop: threading.Event | None = None,
) -> Iterator[list[Outcome]]:
    """Yield the outcomes of jobs, as they come.

    Parameters
    ----------
    runner
        Its graph and hyperparameters are used, on runners of its own; it is left as it is.
    jobs
        Taken one by one, when there is room for another. None: there is none before one that runs has ended.
    executor
        None: this thread runs them. A ThreadPoolExecutor runs the graph itself; any other executor a bundle of it.
        Functions that keep something from one item to the next give other results on threads, which share it and take
        items in any order: a bundle's promotion refuses such functions, threads can't notice them.
    ahead
        How many jobs are in flight at most; twice as many as there are workers without.
    stop
        Ends it in bounded time, once it is set; what was done until then is given.

    Raises
    ------
    ExecutorBroken
        The executor can't run them any more.
    ScaleError, PromotionRefused
        The graph can't travel to another process.
    """
    if ahead is not None and (type(ahead) is not int or ahead < 1):
        raise InvalidValue(f"ahead is how many jobs are at work or waiting, 1 or more, not {ahead!r}.")
    stop = stop or threading.Event()
    if executor is None:
        return _run_here(runner, jobs, stop)
    if not isinstance(executor, Executor):
        raise InvalidType(f"executor must be a concurrent.futures.Executor, not {type(executor).__name__!r}.")
    most, over = ahead or _JOBS_PER_WORKER * worker_count(executor), threading.Event()
    backend = _Threads(runner, executor, (stop, over)) if runs_here(executor) else _Processes(runner, executor)
    return _run_in_flight(backend, jobs, most, over, stop)


def runs_here(executor: Executor | None) -> bool:
    """Whether an executor runs the jobs in this process, where they can share an item's run."""
    return executor is None or isinstance(executor, ThreadPoolExecutor)


def _run_here(runner: CompGraphRunner, jobs: Iterable[Job | None], stop: threading.Event) -> Iterator[list[Outcome]]:
    own = clone_runner(runner)
    for job in () if stop.is_set() else jobs:
        for outcome in run_job(own, job, stop.is_set) if job is not None else ():
            yield [outcome]
            if stop.is_set():
                return


# -- jobs in flight -------------------------------------------------------------------------------------------------


class _SubmitRefused(Exception):
    """The executor takes no jobs any more: it was shut down, or its client closed."""


class _FilesMissing(Exception):
    """The worker process that got a job has not unpacked the package yet."""


class _RunHere(Exception):
    """The executor's processes can't get the graph before an item could be run."""


class _WorkersKilled(Exception):
    """Every worker process that ran a job died, and the cluster has given it up."""


def _run_in_flight(
    backend: _Backend, jobs: Iterable[Job | None], most: int, over: threading.Event, stop: threading.Event
) -> Iterator[list[Outcome]]:
    """Keep so many jobs in flight; yield what comes; leave none behind, however it ends."""
    in_flight: dict[Future[Any], Job] = {}
    # Jobs whose workers were killed run again one at a time: then only the one that kills them is blamed.
    isolated: deque[Job] = deque()
    alone: Job | None = None
    source, done = iter(jobs), 0
    try:
        while not stop.is_set():
            while len(in_flight) < most and (job := next(source, None)) is not None:
                in_flight[backend.submit(job)] = job
                del job
            if not in_flight:
                if not isolated:
                    return
                alone = isolated.popleft()
                in_flight[backend.submit(alone)] = alone
            ready, _ = wait(in_flight, _LOOK_S, FIRST_COMPLETED)
            for future in ready:
                job = in_flight.pop(future)
                try:
                    outcomes = backend.outcomes_of(future, job)
                except _FilesMissing:
                    in_flight[backend.submit(job, with_files=True)] = job
                    continue
                except _WorkersKilled:
                    if job is not alone:
                        isolated.append(job)
                        continue
                    outcomes = [failed_outcome(job.item, setting, _KILLED) for setting in job.settings]
                done += len(outcomes)
                yield outcomes
        over.set()
        yield from _last_outcomes(backend, in_flight)
    except (BrokenExecutor, CancelledError, _SubmitRefused) as error:
        raise ExecutorBroken(done, _broken_text(done, error)) from error
    finally:
        over.set()
        for future in in_flight:
            future.cancel()


def _last_outcomes(backend: _Backend, in_flight: dict[Future[Any], Job]) -> Iterator[list[Outcome]]:
    """Yield the outcomes of jobs that have begun; no other begins any more."""
    ready, _ = wait({future for future in in_flight if not future.cancel()}, _GRACE_S)
    for future in ready:
        with contextlib.suppress(_FilesMissing, _WorkersKilled):
            yield backend.outcomes_of(future, in_flight.pop(future))


def _broken_text(done: int, error: BaseException) -> str:
    done_text = counted(done, "outcome")
    if isinstance(error, _SubmitRefused):
        cause = f"takes no jobs after {done_text}: it was shut down, or its client closed ({error})"
    else:
        cause = f"broke after {done_text}, most likely since one of its processes died ({_error_text(error)})"
    return (
        f"The executor {cause}. Make a new one and run "
        "again: with store= what was done is taken from there. A Dask cluster replaces its processes itself."
    )


def _error_text(error: BaseException) -> str:
    return f"{type(error).__name__}: {error!s:.500}" if str(error) else type(error).__name__


def worker_count(executor: Executor) -> int:
    """Return how many jobs an executor runs at once, as far as that can be known.

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
        raise ExecutorBroken(0, _broken_text(0, _SubmitRefused(_error_text(error)))) from error


# -- backends -------------------------------------------------------------------------------------------------------


class _Backend(abc.ABC):
    """Where jobs are run that are in flight.

    Parameters
    ----------
    runner
        Its graph and hyperparameters are used.
    executor
        Runs the jobs.
    """

    def __init__(self, runner: CompGraphRunner, executor: Executor) -> None:
        self.runner, self._executor = clone_runner(runner), executor

    def submit(self, job: Job, *, with_files: bool = False) -> Future[Any]:
        """Give a job to the executor; one whose frames can't be read, or that can't go there yet, is run here."""
        try:
            call, argument = self.call_of(job, with_files)
        except (ImageFileError, _RunHere):
            done: Future[Any] = Future()
            done.set_result(list(run_job(branched(self.runner), job)))
            return done
        try:
            return self._executor.submit(call, argument)
        except BrokenExecutor:
            raise
        except Exception as error:  # Python's pools raise RuntimeError, others what they like
            raise _SubmitRefused(_error_text(error)) from error

    @abc.abstractmethod
    def call_of(self, job: Job, with_files: bool) -> tuple[Callable[[Any], Any], Any]:
        """Return what the executor calls, and with which argument."""

    @abc.abstractmethod
    def outcomes_of(self, future: Future[Any], job: Job) -> list[Outcome]:
        """Return the outcomes of a job that has ended."""


class _Threads(_Backend):
    """Threads of this process: each job on a runner that no other thread uses meanwhile.

    ``stops``: once one of them is set, no job is begun any more, and jobs that were begun end with the item that is
    being run.
    """

    def __init__(self, runner: CompGraphRunner, executor: Executor, stops: Sequence[threading.Event]) -> None:
        super().__init__(runner, executor)
        self._stops = stops

    def call_of(self, job: Job, with_files: bool) -> tuple[Callable[[Any], Any], Any]:
        return self._run, read_frames(job, self.runner.cg)

    def _run(self, job: Job) -> list[Outcome]:
        outcomes: list[Outcome] = []
        waiting = run_job(branched(self.runner), job, self._is_over)
        while not self._is_over() and (outcome := next(waiting, None)) is not None:
            outcomes.append(outcome)
        return outcomes

    def _is_over(self) -> bool:
        return any(stop.is_set() for stop in self._stops)

    def outcomes_of(self, future: Future[Any], job: Job) -> list[Outcome]:
        outcomes: list[Outcome] = future.result()
        return outcomes


class _Processes(_Backend):
    """Other processes, on this machine or others, which get a package of the graph.

    Until an item could be run, whose values prove the package, jobs run in this thread.
    """

    def __init__(self, runner: CompGraphRunner, executor: Executor) -> None:
        super().__init__(runner, executor)
        self._hyperparameters = packed_values(self.runner.current.own, "Hyperparameter")
        self._options = tuple((name, getattr(runner, name)) for name in ("workers", "guard", "check_mutation"))
        self._package: PackagedGraph | None = None

    def call_of(self, job: Job, with_files: bool) -> tuple[Callable[[Any], Any], Any]:
        package = self._package = self._package or package_of(self.runner, job.item)
        if package is None:
            raise _RunHere
        packed = packed_job(read_frames(job, self.runner.cg, of_cases=True))
        # A worker process that has not unpacked the package yet asks for its files.
        package = package if with_files else replace(package, files=None)
        return run_packaged_job, PackagedJob(uuid.uuid4().hex, package, self._hyperparameters, packed, self._options)

    def outcomes_of(self, future: Future[Any], job: Job) -> list[Outcome]:
        try:
            found = future.result()
        except (BrokenExecutor, CancelledError, EpypesError):
            raise
        except Exception as error:
            # By its name, since this module does not import Dask.
            if type(error).__name__ == "KilledWorker":
                raise _WorkersKilled from error
            needed = "Workers need epypes, of the same version, and what the graph imports."
            raise ScaleError(f"A worker could not do its job: {ended(_error_text(error))} {needed}") from error
        if found is None:
            raise _FilesMissing
        if isinstance(found, str):
            raise ScaleError(found)
        return unpacked_outcomes(found, job)


# -- progress -------------------------------------------------------------------------------------------------------

# Takes how many more are done, and how many of these have failed.
Advance = Callable[[int, int], None]


@contextlib.contextmanager
def progress_bar(progress: bool | None, total: int | None, what: str, *, unit: str = "image") -> Iterator[Advance]:
    """Show a bar on standard error, which a notebook shows below the cell, and yield what moves it on.

    Parameters
    ----------
    progress
        Whether there is one; None: in a terminal or a notebook, if tqdm is installed.
    total
        How many there will be; None if that is not known.
    what
        What is written before the bar.
    unit
        What is counted.
    """
    is_seen = find_spec("tqdm") is not None and _is_seen() if progress is None else progress
    if not is_seen:
        yield lambda count, failures: None
        return
    with optional_import():
        from tqdm import tqdm
    failed = 0
    with tqdm(total=total, desc=what, unit=unit, file=sys.stderr) as bar:

        def advance(count: int, failures: int) -> None:
            nonlocal failed
            failed += failures
            if failures:
                bar.set_postfix(failed=failed, refresh=False)
            bar.update(count)

        yield advance


def _is_seen() -> bool:
    ipython = sys.modules.get("IPython")
    shell = None if ipython is None else ipython.get_ipython()
    return sys.stderr is not None and (sys.stderr.isatty() or getattr(shell, "kernel", None) is not None)
