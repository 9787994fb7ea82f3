"""Jobs: an item and the settings with which one worker runs it, and how it runs them."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from time import perf_counter_ns
from typing import Any, Final

from epypes.acquisition.video import VideoFrame
from epypes.batch.items import Item, frames_of, payload_of, read_value
from epypes.batch.results import ErrorInfo, Outcome, short_value
from epypes.batch.thumbnails import Album
from epypes.errors import EpypesError, ScaleError
from epypes.graph import CompGraph
from epypes.run import CompGraphRunner, Run
from epypes.run.runner import branched

Setting = Mapping[str, Any]
State = Mapping[str, Any]
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
    states
        Of a graph with state, what the item begins with, by setting; frames begin with the initial state without.
    """

    item: Item
    settings: tuple[Setting, ...] = (NO_SETTING,)
    keep: tuple[str, ...] = ()
    show: tuple[str, ...] | None = ()
    start: SharedStart | None = None
    targets: tuple[str, ...] = ()
    states: tuple[State, ...] = ()


def run_job(runner: CompGraphRunner, job: Job, is_over: Callable[[], bool] = lambda: False) -> Iterator[Outcome]:
    """Yield the outcomes of a job, setting by setting.

    Parameters
    ----------
    runner
        One that no other thread uses; it has its hyperparameters again afterwards.
    job
        The item and its settings. Of the second setting on only what depends on what changed is run, unless the graph
        has state between runs.
    is_over
        Is asked before each frame of a case whether it is to end there, without an outcome.
    """
    has_state = job.states or job.item.frames is not None
    return _run_with_state(runner, job, is_over) if has_state else _run_without_state(runner, job)


def _run_with_state(runner: CompGraphRunner, job: Job, is_over: Callable[[], bool]) -> Iterator[Outcome]:
    """Run the item, or its frames one after another, from the beginning for each setting; give the last outcomes."""
    for place, setting in enumerate(job.settings):
        outcome = _outcome_with_state(runner, job, setting, job.states[place] if job.states else {}, is_over)
        if outcome is None:
            return
        yield outcome


def _outcome_with_state(
    runner: CompGraphRunner, job: Job, setting: Setting, state: State, is_over: Callable[[], bool]
) -> Outcome | None:
    item, total_ns, last = job.item, 0, None
    try:
        for place, frame in enumerate(frames_of(item, runner)):
            if is_over():
                return None
            last = runner.trial(setting, *job.targets, payload=payload_of(frame, runner.cg), state=state)
            total_ns += last.report.total_ns
            state = last.state
            if last.failure is not None:
                if not isinstance(last.failure.exception, Exception | SystemExit):  # Ctrl+C ends the map
                    raise last.failure.exception
                where = "" if item.frames is None else f" (frame {place}: {frame.name})"
                return _outcome_of(last, job, setting, Album(), total_ns, state, where)
        if last is None:
            raise ScaleError(f"{item.name} has no frames. Give one at least.")
    except (Exception, SystemExit) as error:  # what a file can't give, or no payload is
        (failed,) = failed_outcomes(item, [setting], ErrorInfo("", type(error).__name__, str(error)))
        return replace(failed, state=state)
    return _outcome_of(last, job, setting, Album(), total_ns, state)


def _run_without_state(runner: CompGraphRunner, job: Job) -> Iterator[Outcome]:
    item, start, now = job.item, job.start or SharedStart(), runner.hyperparameters
    # A setting may leave out what another one has: that is then as it was.
    varied = {token: now[token] for setting in job.settings for token in setting if token in now}
    waiting, begun = iter(job.settings), list[Outcome]()

    def begin() -> CompGraphRunner | None:
        """Run settings on the payload until there is a run, completed or failed; None if there is none."""
        before = runner.last
        try:
            payload = payload_of(item, runner.cg)
        except (EpypesError, OSError) as error:
            begun.extend(failed_outcomes(item, waiting, ErrorInfo("", type(error).__name__, str(error))))
            return None
        for setting in waiting:
            begun.append(_outcome(runner, job, setting, varied, payload, start.album))
            if runner.last is not before:
                return runner
        return None

    try:
        own = begin() if job.start is None else start.branch(begin)
        yield from begun
        if own is not None:
            for setting in waiting:
                yield _outcome(own, job, setting, varied, None, start.album)
            if job.start is not None:
                start.move_to(own)
    finally:
        if varied:
            runner.set(**varied)


def failed_outcomes(item: Item, settings: Iterable[Setting], error_info: ErrorInfo) -> list[Outcome]:
    """Return the outcomes of an item that could not be run, for each of its settings."""
    return [_blank(item, setting, error_info) for setting in settings]


def read_frames(job: Job, cg: CompGraph, *, of_cases: bool = False) -> Job:
    """Return a job with the pixels of its frames of a video, for an executor: this thread decodes them, in order.

    So a video is decoded once, without seeking, and worker processes need neither the file nor its codec.

    Parameters
    ----------
    job, cg
        The job, and the graph, which has the order of colours.
    of_cases
        Whether the frames that are run in the place of the item are read, too: they are then in memory together.

    Raises
    ------
    ImageFileError
        A frame is damaged.
    """
    item = _with_pixels(job.item, cg)
    if of_cases and isinstance(item.frames, tuple):
        item = replace(item, frames=tuple(_with_pixels(frame, cg) for frame in item.frames))
    return job if item is job.item else replace(job, item=item)


def _with_pixels(item: Item, cg: CompGraph) -> Item:
    if not any(isinstance(value, VideoFrame) for value in item.payload.values()):
        return item
    read = {
        token: read_value(value, cg, token) if isinstance(value, VideoFrame) else value
        for token, value in item.payload.items()
    }
    return replace(item, payload=read)


def _blank(item: Item, setting: Setting, error_info: ErrorInfo, total_ns: int = 0) -> Outcome:
    """Return the outcome of an item that has no values."""
    return Outcome(
        item.number,
        item.name,
        setting,
        total_ns=total_ns,
        error_info=error_info,
        frame=item.frame,
        time_s=item.time_s,
        series=item.series,
    )


def _outcome(
    runner: CompGraphRunner,
    job: Job,
    setting: Setting,
    varied: Setting,
    payload: Mapping[str, Any] | None,
    album: Album,
) -> Outcome:
    """Run a job's item with a setting, on a payload or on the last one, and return its outcome."""
    item, values = job.item, {**varied, **setting}
    before, start_ns = runner.last, perf_counter_ns()
    try:
        if payload is None:
            run = runner.rerun(*job.targets, **values)
        else:
            if values:
                runner.set(**values)
            run = runner.run_on(payload, job.targets)
    except (Exception, SystemExit) as error:  # whatever a function raises
        if runner.last is None or runner.last is before:
            info = ErrorInfo("", type(error).__name__, str(error))
            return _blank(item, setting, info, perf_counter_ns() - start_ns)
        run = runner.last
    return _outcome_of(run, job, setting, album)


def _outcome_of(
    run: Run, job: Job, setting: Setting, album: Album, total_ns: int = 0, state: State = NO_SETTING, where: str = ""
) -> Outcome:
    """Return the outcome of a run.

    Parameters
    ----------
    total_ns
        Of the runs before it too; 0: its own.
    state
        What it has left.
    where
        Is added to the message of a failure.
    """
    item, report, tokens, failure = job.item, run.report, run.tokens, run.failure
    sinks = [token for token in run.cg.sink_tokens if tokens.is_readable(token)]
    thumbnails, texts = album.shown_of(run, job.show) if job.show != () else ({}, {})
    return Outcome(
        item.number,
        item.name,
        setting,
        {token: short_value(run[token]) for token in sinks if not tokens.is_nothing(token)},
        report.durations_ns,
        total_ns or report.total_ns,
        None if failure is None else ErrorInfo(failure.function, failure.kind, f"{failure.message}{where}"),
        thumbnails,
        {token: run[token] for token in job.keep if tokens.is_readable(token)},
        texts,
        nothing=tuple(filter(tokens.is_nothing, sinks)),
        series=item.series,
        state=state,
        frame=item.frame,
        time_s=item.time_s,
    )


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
