"""Executor backends: this thread, threads, processes or a cluster run the jobs."""

from __future__ import annotations

import os
import queue
import threading
import uuid
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
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
from typing import Any, Final, Protocol

from epypes.batch.items import Item, payload_of
from epypes.batch.job import Job, do
from epypes.batch.packaged_graph import (
    PackagedGraph,
    known_package,
    package_of,
    packed_job,
    packed_values,
    unpacked_outcomes,
)
from epypes.batch.results import ErrorInfo, Outcome
from epypes.batch.worker_side import PackagedJob, Refusal, lighter, work
from epypes.bundle.clone import clone_runner
from epypes.errors import EpypesError, ExecutorBroken, ScaleError
from epypes.run import CompGraphRunner
from epypes.wording import counted, ended

# How soon a stop that somebody asks for is seen while nothing comes, and a Ctrl+C that another thread was given, which
# does not wake a main thread that waits on a lock.
_LOOK_S: Final = 0.05
_JOBS_PER_WORKER: Final = 2
# How long it is waited, once it was stopped, for what is at work.
_GRACE_S: Final = 2.0


def run_jobs(
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
    own = clone_runner(runner)
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


# A larger bundle is sent to whom asks for it, and not with every job.
_LIGHT: Final = 64_000

Again = Mapping["Future[Any]", Job]
_NONE: Final[Again] = {}


class Hands(Protocol):
    """Whoever does jobs."""

    def submit(self, job: Job) -> Future[Any]:
        """Give a job to the executor."""

    def read(self, future: Future[Any], job: Job) -> tuple[list[Outcome], Again]:
        """Return the outcomes of a job that is done, and what was submitted again in place of it."""

    def suspect(self) -> Job | None:
        """Return a job that is to be done again while no other one is; None if there is none."""


class NotTaken(Exception):
    """An executor that takes no jobs any more: it was shut down, or its client closed."""


def _given(executor: Executor, call: Callable[..., Any], argument: object) -> Future[Any]:
    try:
        return executor.submit(call, argument)
    except BrokenExecutor:
        raise
    except Exception as error:  # Python's pools raise RuntimeError, others what they like
        raise NotTaken(said(error)) from error


def said(error: BaseException) -> str:
    """Return what an error says, behind its kind."""
    return f"{type(error).__name__}: {error!s:.500}" if str(error) else type(error).__name__


class Threads:
    """Threads of this process: each job on a runner that no other thread uses meanwhile.

    Parameters
    ----------
    runner
        Its graph and hyperparameters are used.
    executor
        The threads.
    over
        Once it is set, jobs that were begun end with the item that is being run.
    stop
        Once it is set, no job is begun any more.
    """

    def __init__(
        self, runner: CompGraphRunner, executor: Executor, over: threading.Event, stop: threading.Event | None
    ) -> None:
        self._runner, self._executor, self._over, self._stop = clone_runner(runner), executor, over, stop
        self._idle: queue.SimpleQueue[CompGraphRunner] = queue.SimpleQueue()

    def submit(self, job: Job) -> Future[Any]:
        """Give a job to a thread."""
        return _given(self._executor, self._do, job)

    def _do(self, job: Job) -> list[Outcome]:
        if self._stop is not None and self._stop.is_set():
            return []
        try:
            own = self._idle.get_nowait()
        except queue.Empty:
            own = clone_runner(self._runner)
        try:
            return do(own, job, self._over)
        finally:
            self._idle.put(own)

    def read(self, future: Future[Any], job: Job) -> tuple[list[Outcome], Again]:
        """Return the outcomes of a job."""
        return future.result(), _NONE

    def suspect(self) -> Job | None:
        """Return None: a thread that dies takes this process with it."""
        return None


class Bundles:
    """Other processes, on this machine or others: what travels is a bundle, made of the first item that can be run.

    Parameters
    ----------
    runner
        Its graph and hyperparameters are used.
    executor
        Whatever has the jobs done.
    """

    def __init__(self, runner: CompGraphRunner, executor: Executor) -> None:
        self._runner, self._executor = clone_runner(runner), executor
        self._hyperparameters = packed_values(runner.hyperparameters, "Hyperparameter")
        self._parcel: PackagedGraph | None = None
        self._sent: dict[Future[Any], PackagedJob] = {}
        self._suspects: deque[Job] = deque()
        self._alone: Job | None = None

    def submit(self, job: Job) -> Future[Any]:
        """Send a job; do it here as long as nothing could be run that proves the bundle."""
        if self._parcel is None:
            self._parcel = known_package(self._runner) or self._proven(job)
        if self._parcel is None:
            here: Future[Any] = Future()
            here.set_result(do(clone_runner(self._runner), job))
            return here
        runner = self._runner
        ways = runner.workers, runner.guard, runner.check_mutation
        sent = PackagedJob("", self._parcel, self._hyperparameters, packed_job(job), *ways)
        return self._send(sent if self._parcel.size <= _LIGHT else lighter(sent))

    def _proven(self, job: Job) -> PackagedGraph | None:
        for item in job.items:
            own = clone_runner(self._runner)
            try:
                own.run_on(payload_of(item, own.cg))
            except (Exception, SystemExit):  # noqa: S112 - whatever a function raises: it will be that item's failure
                continue
            return package_of(own)
        return None

    def _send(self, sent: PackagedJob) -> Future[Any]:
        sent = replace(sent, id=uuid.uuid4().hex)
        future = _given(self._executor, work, sent)
        self._sent[future] = sent
        return future

    def read(self, future: Future[Any], job: Job) -> tuple[list[Outcome], Again]:
        """Return the outcomes of a job that came back; send it again if the bundle's files are asked for."""
        sent = self._sent.pop(future, None)
        if sent is None:
            return future.result(), _NONE
        try:
            found = future.result()
        except (BrokenExecutor, CancelledError):
            raise
        except Exception as error:
            if type(error).__name__ == "KilledWorker":
                return self._after_deaths(job), _NONE
            raise _unable(error) from error
        if not isinstance(found, Refusal):
            return unpacked_outcomes(found, job), _NONE
        if found.is_missing:
            return [], {self._send(replace(sent, parcel=self._parcel or sent.parcel)): job}
        raise ScaleError(found.text)

    def suspect(self) -> Job | None:
        """Return an item whose workers died, which is to be tried while nobody else could be the one who kills them."""
        self._alone = self._suspects.popleft() if self._suspects else None
        return self._alone

    def _after_deaths(self, job: Job) -> list[Outcome]:
        if job is not self._alone:
            self._suspects.extend(replace(job, items=(item,)) for item in job.items)
            return []
        error_info = ErrorInfo("", "KilledWorker", "every worker that ran it died")
        return [
            Outcome(item.number, item.name, setting, error_info=error_info)
            for item in job.items
            for setting in job.settings
        ]


def _unable(error: Exception) -> EpypesError:
    if isinstance(error, EpypesError):
        return error
    needed = "Workers need epypes, of the same version, and what the graph imports."
    return ScaleError(f"A worker could not do its job: {ended(said(error))} {needed}")


# As long a job takes, about: long beside the millisecond of its way, short beside a person's patience and the last
# job's, for which all others wait.
_JOB_NS: Final = 50_000_000
_MOST_ITEMS: Final = 64
# What is left is divided into so many groups per worker.
_LAST_JOBS: Final = 3
# Of arrays that wait in memory, in one job.
_MOST_BYTES: Final = 4_000_000
# One more outcome changes what is expected by so much.
_SHARE: Final = 0.2


class JobSizes:
    """Groups of items; the time that items take decides how many are in the next one.

    Parameters
    ----------
    items
        Taken one by one, when a group is asked for.
    workers
        How many work at once; 0: each group has one item only.
    total
        How many items there are, if that is known: the last groups are smaller, so that all workers end together.
    """

    def __init__(self, items: Iterable[Item], workers: int = 0, total: int | None = None) -> None:
        self._items, self._workers, self._total = iter(items), workers, total
        self._item_ns, self._taken = 0.0, 0

    def learn(self, outcomes: Iterable[Outcome]) -> None:
        """Take note of how long items took; those that could not be read tell nothing."""
        for took_ns in (outcome.total_ns for outcome in outcomes if outcome.total_ns):
            self._item_ns = self._item_ns + _SHARE * (took_ns - self._item_ns) if self._item_ns else took_ns

    def __iter__(self) -> Iterator[tuple[Item, ...]]:
        while batch := self._next():
            yield tuple(batch)
            # The items are in memory as long as somebody holds them.
            del batch

    def _next(self) -> list[Item]:
        batch: list[Item] = []
        most, size = self._most(), 0
        while len(batch) < most and size < _MOST_BYTES:
            item = next(self._items, None)
            if item is None:
                break
            batch.append(item)
            self._taken += 1
            size += _bytes_of(item.payload.values())
        return batch

    def _most(self) -> int:
        if not self._workers or not self._item_ns:
            return 1
        most = min(_MOST_ITEMS, int(_JOB_NS / self._item_ns))
        if self._total is not None:
            most = min(most, (self._total - self._taken) // (_LAST_JOBS * self._workers))
        return max(1, most)


def _bytes_of(values: Iterable[Any]) -> int:
    return sum(size for value in values if isinstance(size := getattr(value, "nbytes", 0), int))
