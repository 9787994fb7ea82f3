"""How does an executor do a job: with the graph itself, or with a bundle of it?"""

from __future__ import annotations

import queue
import threading
import uuid
from collections import deque
from collections.abc import Callable, Mapping
from concurrent.futures import BrokenExecutor, CancelledError, Executor, Future
from dataclasses import replace
from typing import Any, Final, Protocol

from epypes.batch.atwork import Refusal, Sent, lighter, work
from epypes.batch.items import opened
from epypes.batch.job import Job, do
from epypes.batch.outcome import Outcome, Trouble
from epypes.batch.parcel import Parcel, known_parcel, parcel_of
from epypes.batch.travel import packed_job, packed_values, unpacked_outcomes
from epypes.bundle.apart import apart, without_unfrozen
from epypes.errors import EpypesError, ScaleError
from epypes.run import CompGraphRunner
from epypes.wording import ended

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


def own_runner(runner: CompGraphRunner) -> CompGraphRunner:
    """Return another runner of the same graph, with the same hyperparameters; the user's nodes see nothing of it."""
    hyperparameters = runner.hyperparameters
    cg = without_unfrozen(apart(runner.cg), hyperparameters)
    return CompGraphRunner(
        cg, hyperparameters, workers=runner.workers, guard=runner.guard, check_mutation=runner.check_mutation
    )


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
        self._runner, self._executor, self._over, self._stop = own_runner(runner), executor, over, stop
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
            own = own_runner(self._runner)
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
        self._runner, self._executor = own_runner(runner), executor
        self._hyperparameters = packed_values(runner.hyperparameters, "Hyperparameter")
        self._parcel: Parcel | None = None
        self._sent: dict[Future[Any], Sent] = {}
        self._suspects: deque[Job] = deque()
        self._alone: Job | None = None

    def submit(self, job: Job) -> Future[Any]:
        """Send a job; do it here as long as nothing could be run that proves the bundle."""
        if self._parcel is None:
            self._parcel = known_parcel(self._runner) or self._proven(job)
        if self._parcel is None:
            here: Future[Any] = Future()
            here.set_result(do(own_runner(self._runner), job))
            return here
        runner = self._runner
        ways = runner.workers, runner.guard, runner.check_mutation
        sent = Sent("", self._parcel, self._hyperparameters, packed_job(job), *ways)
        return self._send(sent if self._parcel.size <= _LIGHT else lighter(sent))

    def _proven(self, job: Job) -> Parcel | None:
        for item in job.items:
            own = own_runner(self._runner)
            try:
                own.run_on(opened(item, own.cg))
            except (Exception, SystemExit):  # noqa: S112 - whatever a function raises: it will be that item's failure
                continue
            return parcel_of(own)
        return None

    def _send(self, sent: Sent) -> Future[Any]:
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
        trouble = Trouble("", "KilledWorker", "every worker that ran it died")
        return [
            Outcome(item.number, item.name, setting, trouble=trouble) for item in job.items for setting in job.settings
        ]


def _unable(error: Exception) -> EpypesError:
    if isinstance(error, EpypesError):
        return error
    needed = "Workers need epypes, of the same version, and what the graph imports."
    return ScaleError(f"A worker could not do its job: {ended(said(error))} {needed}")
