"""Jobs: an item and the settings with which one worker runs it, how it runs them, and which can run next.

The items of a graph with state run in order, each with the state that the one before it in its series has left.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Hashable, Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field, replace
from itertools import zip_longest
from time import perf_counter_ns
from typing import Any, Final

from epypes.acquisition.video import VideoFrame
from epypes.batch.items import Item, frames_of, payload_of, read_value
from epypes.batch.results import ErrorInfo, Outcome, short_value
from epypes.batch.thumbnails import Album
from epypes.errors import EpypesError
from epypes.graph import CompGraph
from epypes.run import CompGraphRunner, Run
from epypes.run.runner import branched
from epypes.wording import error_message

Setting = Mapping[str, Any]
State = Mapping[str, Any]
# One object, since settings are compared by identity.
NO_SETTING: Final[Setting] = {}


@dataclass(slots=True)
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
    item = job.item
    for setting, state in zip_longest(job.settings, job.states, fillvalue=NO_SETTING):
        total_ns, where = 0, ""
        try:
            for place, frame in enumerate(frames_of(item, runner)):
                if is_over():
                    return
                run = runner.trial(setting, *job.targets, payload=payload_of(frame, runner.cg), state=state)
                total_ns, state = total_ns + run.report.total_ns, run.state
                if run.failure is not None:
                    where = "" if item.frames is None else f" (frame {place}: {frame.name})"
                    break
        except (Exception, SystemExit) as error:  # what a file can't give, or no payload is
            yield replace(failed_outcome(item, setting, error_info_of(error)), state=state)
            continue
        if run.failure is not None and not isinstance(run.failure.exception, Exception | SystemExit):
            raise run.failure.exception  # Ctrl+C ends the map
        yield _outcome_of(run, job, setting, Album(), total_ns, state, where)


def _run_without_state(runner: CompGraphRunner, job: Job) -> Iterator[Outcome]:
    """Run the item with the first setting, then only what depends on what changes from setting to setting."""
    item, start, now = job.item, job.start, runner.hyperparameters
    # A setting may leave out what another one has: that is then as it was.
    varied = {token: now[token] for setting in job.settings for token in setting if token in now}
    album = start.album if start is not None else Album()
    waiting, begun = iter(job.settings), list[Outcome]()

    def begin() -> CompGraphRunner | None:
        """Run settings on the payload until there is a run, completed or failed; None if there is none."""
        before = runner.last
        try:
            payload = payload_of(item, runner.cg)
        except (EpypesError, OSError) as error:
            begun.extend(failed_outcome(item, setting, error_info_of(error)) for setting in waiting)
            return None
        for setting in waiting:
            begun.append(_outcome(runner, job, setting, varied, payload, album))
            if runner.last is not before:
                return runner
        return None

    try:
        own = begin() if start is None else start.branch(begin)
        yield from begun
        if own is not None:
            for setting in waiting:
                yield _outcome(own, job, setting, varied, None, album)
            if start is not None:
                start.move_to(own)
    finally:
        if varied:
            runner.set(**varied)


def _outcome(
    runner: CompGraphRunner,
    job: Job,
    setting: Setting,
    varied: Setting,
    payload: Mapping[str, Any] | None,
    album: Album,
) -> Outcome:
    """Run a job's item with a setting, on a payload or on the last one, and return its outcome."""
    values, start_ns = {**varied, **setting}, perf_counter_ns()
    try:
        if payload is None:
            run = runner.rerun(*job.targets, **values)
        else:
            if values:
                runner.set(**values)
            run = runner.run_on(payload, job.targets)
    except (Exception, SystemExit) as error:  # whatever a function raises
        failed = runner.failed_run(error)
        if failed is None:
            return failed_outcome(job.item, setting, error_info_of(error), perf_counter_ns() - start_ns)
        run = failed
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
    values, nothing = dict[str, Any](), []
    for token in run.cg.sink_tokens:
        if tokens.is_readable(token):
            if tokens.is_nothing(token):
                nothing.append(token)
            else:
                values[token] = short_value(run[token])
    thumbnails, texts = album.shown_of(run, job.show) if job.show != () else ({}, {})
    return Outcome(
        item.number,
        item.name,
        setting,
        values,
        report.durations_ns,
        total_ns or report.total_ns,
        None if failure is None else ErrorInfo(failure.function, failure.kind, f"{_message_of(run)}{where}"),
        thumbnails,
        {token: run[token] for token in job.keep if tokens.is_readable(token)},
        texts,
        tuple(nothing),
        item.frame,
        item.time_s,
        item.series,
        state,
    )


def _message_of(run: Run) -> str:
    """Return the message of what has failed; inside a pipeline, with the function there and the cause that it knows."""
    if run.failure is None:
        return ""
    inner = run.nested.get(run.failure.function)
    if inner is None or inner.failure is None:
        return run.failure.message
    return f"in {inner.failure.function!r}: {_message_of(inner)}"


def failed_outcome(item: Item, setting: Setting, error_info: ErrorInfo, total_ns: int = 0) -> Outcome:
    """Return the outcome of an item that could not be run with a setting, so that it has no values."""
    outcome = Outcome(item.number, item.name, setting, total_ns=total_ns, error_info=error_info)
    return replace(outcome, frame=item.frame, time_s=item.time_s, series=item.series)


def error_info_of(error: BaseException) -> ErrorInfo:
    """Return what failed where no function of the graph did."""
    return ErrorInfo("", type(error).__name__, error_message(error))


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

    def with_pixels(item: Item) -> Item:
        frames = {token: value for token, value in item.payload.items() if isinstance(value, VideoFrame)}
        read = {token: read_value(frame, cg, token) for token, frame in frames.items()}
        return replace(item, payload={**item.payload, **read}) if read else item

    item = with_pixels(job.item)
    if of_cases and isinstance(item.frames, tuple):
        item = replace(item, frames=tuple(map(with_pixels, item.frames)))
    return job if item is job.item else replace(job, item=item)


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


# -- series -----------------------------------------------------------------------------------------------------

# A series and a setting of it, by identity.
Done = tuple[Hashable, int]


@dataclass(slots=True, eq=False)
class _Chain:
    """Runs of one series with some settings: one item at a time.

    Attributes
    ----------
    job
        Has the settings with which each item is run, and the states that the next item begins with.
    waiting
        The items that have not begun.
    pending
        How many outcomes of the item that runs are still to come.
    """

    job: Job
    waiting: deque[Item] = field(default_factory=deque)
    pending: int = 0


class SeriesRuns:
    """What can be run now of several series: iterate over it to get jobs.

    Series, and the parts of the settings, run side by side. Where all items that have come wait for others of their
    series, None is given: report outcomes, then iterate on.

    Parameters
    ----------
    items
        With the keys of their series; taken one by one.
    parts
        A job for each part of the settings, whose item and states are still to be set; parts run side by side.
    state
        What each series begins with.
    room
        How many items are taken ahead at most, for series that are busy.
    done
        The series and settings that are not run, since their outcomes are known: key, ``id(setting)``.
    """

    def __init__(
        self,
        items: Iterable[Item],
        parts: Sequence[Job],
        state: State,
        room: float,
        done: AbstractSet[Done] = frozenset(),
    ) -> None:
        self._items, self._parts, self._state = iter(items), parts, state
        self._room, self._done = room * len(parts), done
        self._chains: dict[Hashable, list[_Chain]] = {}
        self._ready: deque[_Chain] = deque()
        self._waiting = 0
        self._running: dict[tuple[int, int], tuple[_Chain, int]] = {}

    def __iter__(self) -> Iterator[Job | None]:
        is_over = False
        while True:
            while not (self._ready or is_over) and self._waiting < self._room:
                item = next(self._items, None)
                is_over = item is None
                if item is not None:
                    self._take(item)
                del item
            if self._ready:
                yield self._begin(self._ready.popleft())
            elif is_over and not self._waiting:
                return
            else:
                yield None

    def _take(self, item: Item) -> None:
        if item.series not in self._chains:
            chains = self._chains[item.series] = []
            for part in self._parts:
                left = tuple(one for one in part.settings if (item.series, id(one)) not in self._done)
                if left:
                    chains.append(_Chain(replace(part, settings=left, states=(self._state,) * len(left))))
        for chain in self._chains[item.series]:
            chain.waiting.append(item)
            self._waiting += 1
            if not chain.pending and len(chain.waiting) == 1:
                self._ready.append(chain)

    def _begin(self, chain: _Chain) -> Job:
        job = replace(chain.job, item=chain.waiting.popleft())
        self._waiting -= 1
        chain.pending = len(job.settings)
        for place, setting in enumerate(job.settings):
            self._running[job.item.number, id(setting)] = chain, place
        return job

    def settle(self, outcomes: Iterable[Outcome]) -> list[Outcome]:
        """Take what has been run: the next item of its series can begin; return the outcomes without their states."""
        settled = []
        for outcome in outcomes:
            chain, place = self._running.pop((outcome.number, id(outcome.setting)))
            if outcome.state:  # what could not be run at all has left none
                states = chain.job.states
                chain.job = replace(chain.job, states=(*states[:place], outcome.state, *states[place + 1 :]))
            chain.pending -= 1
            if not chain.pending and chain.waiting:
                self._ready.append(chain)
            settled.append(replace(outcome, state={}))
        return settled


def whole_series(
    items: Iterable[Item], settings: Sequence[Setting], found: Callable[[Item], list[Outcome | None]]
) -> tuple[list[Outcome], frozenset[Done]]:
    """Return the outcomes of the series of which all are known, and which these are.

    A series of which some are missing is run from its beginning, since the state amid it is not stored.

    Parameters
    ----------
    items
        With the keys of their series.
    settings
        With which they are run.
    found
        Returns the known outcomes of an item, by setting.
    """
    columns: dict[Done, list[Outcome]] = {}
    missing: set[Done] = set()
    for item in items:
        for setting, outcome in zip(settings, found(item), strict=True):
            key = item.series, id(setting)
            if outcome is None:
                missing.add(key)
                columns.pop(key, None)
            elif key not in missing:
                columns.setdefault(key, []).append(outcome)
    return [outcome for column in columns.values() for outcome in column], frozenset(columns)
