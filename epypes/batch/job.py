"""Jobs: an item and the settings with which one worker runs it, and how it runs them."""

from __future__ import annotations

import queue
import threading
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter_ns
from typing import Any, Final

from epypes.batch.items import Item, payload_of
from epypes.batch.results import ErrorInfo, Outcome, scalar
from epypes.batch.thumbnails import Album
from epypes.display.previews.preview import sketch
from epypes.display.previews.shown import Look
from epypes.errors import EpypesError
from epypes.run import CompGraphRunner, Failure, Run
from epypes.run.branch import branched

Setting = Mapping[str, Any]
# One object, since settings are compared by identity.
NO_SETTING: Final[Setting] = {}


@dataclass(frozen=True, slots=True)
class Job:
    """An item that one worker runs with some settings, one after another.

    Attributes
    ----------
    item
        The input.
    settings
        Hyperparameters by token; the item is run with all of them, in this order.
    keep
        Tokens whose values are kept.
    show
        Tokens of which thumbnails are made; None: of every token that has a picture. Of others a text is kept.
    start
        The first run of the item, which several jobs share in this process; None for one of its own.
    targets
        Tokens; only what they need is run, branches that are not chosen too. Everything without.
    """

    item: Item
    settings: tuple[Setting, ...] = (NO_SETTING,)
    keep: tuple[str, ...] = ()
    show: tuple[str, ...] | None = ()
    start: SharedStart | None = None
    targets: tuple[str, ...] = ()


def run_job(runner: CompGraphRunner, job: Job) -> Iterator[Outcome]:
    """Yield the outcomes of a job, setting by setting.

    Parameters
    ----------
    runner
        One that no other thread uses; it has its hyperparameters again afterwards.
    job
        The item and its settings. Of the second setting on only what depends on what changed is run.
    """
    item, before = job.item, dict(runner.hyperparameters)
    # A setting may leave out what another one has: that is then as it was.
    varied = {token: before[token] for setting in job.settings for token in setting if token in before}
    album = Album() if job.start is None else job.start.album
    waiting, begun = deque(job.settings), list[Outcome]()

    def outcome_of(own: CompGraphRunner, payload: Mapping[str, Any] | None) -> Outcome:
        setting, start_ns = waiting.popleft(), perf_counter_ns()
        run, error_info = _run(own, payload, {**varied, **setting}, job.targets)
        if run is None:
            return Outcome(
                item.number, item.name, setting, total_ns=perf_counter_ns() - start_ns, error_info=error_info
            )
        return _outcome(item, setting, job, run, album)

    def begin() -> CompGraphRunner | None:
        try:
            payload = payload_of(item, runner.cg)
        except (EpypesError, OSError) as error:
            error_info = ErrorInfo("", type(error).__name__, str(error))
            begun.extend(Outcome(item.number, item.name, setting, error_info=error_info) for setting in waiting)
            waiting.clear()
            return None
        before = runner.last
        while waiting and runner.last is before:
            begun.append(outcome_of(runner, payload))
        return None if runner.last is before else runner

    try:
        own = begin() if job.start is None else job.start.branch(begin)
        yield from begun
        while own is not None and waiting:
            yield outcome_of(own, None)
        if own is not None and job.start is not None:
            job.start.move_to(own)
    finally:
        runner.set(**varied)


def _run(
    runner: CompGraphRunner, payload: Mapping[str, Any] | None, values: Setting, targets: tuple[str, ...]
) -> tuple[Run | None, ErrorInfo | None]:
    """Run on a payload, or on the last one; return the run, completed or failed, or why there is none."""
    before = runner.last
    try:
        if payload is None:
            return runner.rerun(*targets, **values), None
        runner.set(**values)
        return runner.run_on(payload, targets), None
    except (Exception, SystemExit) as error:  # whatever a function raises
        if runner.last is not before:
            return runner.last, None
        return None, ErrorInfo("", type(error).__name__, str(error))


def _outcome(item: Item, setting: Setting, job: Job, run: Run, album: Album) -> Outcome:
    report, tokens = run.report, run.tokens
    thumbnails, texts = album.shown_of(run, job.show) if job.show != () else ({}, {})
    return Outcome(
        item.number,
        item.name,
        setting,
        {token: _value(run[token]) for token in run.cg.sink_tokens if tokens.is_readable(token)},
        report.durations_ns,
        report.total_ns,
        None if run.failure is None else _error_info(run.failure),
        thumbnails,
        {token: run[token] for token in job.keep if tokens.is_readable(token)},
        texts,
    )


def _error_info(failure: Failure) -> ErrorInfo:
    return ErrorInfo(failure.function, failure.kind, failure.message)


def _value(value: Any) -> Any:
    """Return a value as a table shows it."""
    value = scalar(value)
    if value is None or type(value) in (bool, int, float, str):
        return value
    return str(value) if isinstance(value, str) else sketch(value, Look()).shown.text


class SharedStart:
    """The first run of an item, shared by several jobs of one process: parts of a grid on that item.

    The first job runs the item; the others, on whatever thread, wait for it and branch from its run.

    Attributes
    ----------
    album
        The thumbnails of the item.
    """

    def __init__(self) -> None:
        self.album = Album()
        self._lock = threading.Lock()
        self._runner: CompGraphRunner | None = None

    def branch(self, begin: Callable[[], CompGraphRunner | None]) -> CompGraphRunner | None:
        """Return a runner that has run the item.

        The first job gets what ``begin`` returns: a runner that has run the item, or None if it can't be run; then the
        next job is the first one. All others get a runner of their own, with that run as its last one.
        """
        with self._lock:
            if self._runner is not None:
                return branched(self._runner)
            begun = begin()
            self._runner = None if begun is None else branched(begun)
            return begun

    @property
    def nbytes(self) -> int:
        """How many bytes the arrays of the run have."""
        last = None if self._runner is None else self._runner.last
        if last is None:
            return 0
        values = (last[token] for token in last.cg.tokens if last.tokens.is_readable(token))
        return sum(getattr(value, "nbytes", 0) for value in values)

    def move_to(self, runner: CompGraphRunner) -> None:
        """Let the next job branch from this runner's last run."""
        with self._lock:
            self._runner = branched(runner)


class RunnerPool:
    """Runners for the threads of a pool, each used by one thread at a time.

    Parameters
    ----------
    make
        Returns a new runner; called when no runner is idle.
    """

    def __init__(self, make: Callable[[], CompGraphRunner]) -> None:
        self._make = make
        self._idle: queue.SimpleQueue[CompGraphRunner] = queue.SimpleQueue()

    @contextmanager
    def runner(self) -> Iterator[CompGraphRunner]:
        """Yield a runner that no other thread uses meanwhile."""
        try:
            own = self._idle.get_nowait()
        except queue.Empty:
            own = self._make()
        try:
            yield own
        finally:
            self._idle.put(own)
