"""Pipelines that answer events.

The paper's reactive pipelines: a SourcePipeline puts what it computes on q_out, a SinkPipeline is driven by q_in,
a FullPipeline does both. While an event is worked on, its `EventView` says how far it has come.
"""

from __future__ import annotations

import contextlib
import threading
from collections import OrderedDict
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from threading import get_ident
from time import perf_counter_ns, time_ns
from typing import Any, Final, Self

from epypes.deprecation import OldNames, takes_old_keywords
from epypes.errors import EpypesError, InvalidType
from epypes.graph import CompGraph
from epypes.pipeline.event_loop import EventLoop, is_kept, log_error, settle
from epypes.pipeline.mailbox import Mailbox
from epypes.pipeline.pipeline import Pipeline, Stage, Stages, StageState
from epypes.run import Failure, Run, RunReport
from epypes.wording import counted

FIn = Callable[[Any], Mapping[str, Any]]
FOut = Callable[["EventView"], Any]

# Ids of events that failed: some for every event that may be sent again.
_MAX_REMEMBERED: Final = 1_000


class Stamps:
    """The times of one event, in nanoseconds of Unix time; 0 until they are known.

    They are read from one monotonic clock, which is set by the system's clock once per event: so their differences hold
    whatever the system's clock does meanwhile.
    """

    __slots__ = ("_view",)

    def __init__(self, view: EventView) -> None:
        self._view = view

    @property
    def react_ns(self) -> int:
        """When the event was taken from q_in; of a SourcePipeline when the run began."""
        return self._view.unix_ns(self._view.react)

    @property
    def f_in_start_ns(self) -> int:
        """When f_in was called."""
        return self._view.unix_ns(self._view.react if self._view.f_in_end else 0)

    @property
    def f_in_end_ns(self) -> int:
        """When f_in had returned."""
        return self._view.unix_ns(self._view.f_in_end)

    @property
    def f_out_start_ns(self) -> int:
        """When f_out was called."""
        return self._view.unix_ns(self._view.f_out_start)

    @property
    def f_out_end_ns(self) -> int:
        """When f_out had returned."""
        return self._view.unix_ns(self._view.f_out_end)

    def now_ns(self) -> int:
        """Return the time at this moment, by the event's clock."""
        return self._view.now_ns()

    def __repr__(self) -> str:
        names = ("f_in_start", "f_in_end", "f_out_start", "f_out_end")
        known = [name for name in names if getattr(self, f"{name}_ns")]
        return f"<Stamps of an event: {', '.join(known) or 'just taken'}>"


class EventView(OldNames, Mapping[str, Any]):
    """One event's run of a pipeline: what f_out is given, never shared with another event.

    Reads like the pipeline: ``view["edges"]``, ``view.attributes``, ``view.traverse_time()``.

    Attributes
    ----------
    event
        What was taken from q_in; None for a SourcePipeline.
    run
        The event's run.
    attributes
        A shallow copy of the pipeline's attributes: the mapping is this event's own, the values are the pipeline's.
    stage
        Where the event is: ``"f_in"``, ``"graph"``, ``"f_out"``, ``"q_out"``; empty when it is over.
    react, f_in_end, f_out_start, f_out_end
        Readings of ``perf_counter_ns``; 0 until they are known. ``stamps`` has them as Unix times.
    """

    # Unix times are made of the readings when they are asked for: most events are never asked.
    __slots__ = (
        "_offset_ns", "attributes", "event", "f_in_end", "f_out_end", "f_out_start", "name", "react", "run", "stage",
    )  # fmt: skip
    run: Run
    attributes: dict[str, Any]

    def __init__(self, name: str, event: Any, stage: str = "f_in") -> None:
        self.react = perf_counter_ns()
        self.name, self.event, self.stage = name, event, stage
        self.f_in_end = self.f_out_start = self.f_out_end = self._offset_ns = 0

    @classmethod
    def of_run(cls, name: str, event: Any, run: Run, attributes: Mapping[str, Any]) -> EventView:
        """Return the view of a run that has been made for an event."""
        view = cls(name, event, "f_out")
        view.run, view.attributes = run, dict(attributes)
        return view

    @property
    def stamps(self) -> Stamps:
        """When the event was taken, and when f_in and f_out worked on it."""
        return Stamps(self)

    def unix_ns(self, reading_ns: int) -> int:
        """Return a reading of ``perf_counter_ns`` as Unix time; 0 for 0."""
        if not self._offset_ns:
            self._offset_ns = time_ns() - perf_counter_ns()
        return reading_ns and self._offset_ns + reading_ns

    def now_ns(self) -> int:
        """Return the time at this moment, by the event's clock: nanoseconds of Unix time."""
        return (self._offset_ns or self.unix_ns(1) - 1) + perf_counter_ns()

    @property
    def report(self) -> RunReport:
        """The times of the event's run."""
        return self.run.report

    @property
    def time(self) -> float:
        """How long the event's run took, in seconds."""
        return self.report.total_ns / 1e9

    def traverse_time(self) -> tuple[Any, ...]:
        """Return ``(name, seconds, ((function, seconds), ...))`` of the event's own run."""
        nodes = tuple((entry.function, entry.duration_ns / 1e9) for entry in self.report.functions)
        return self.name, self.time, nodes

    def compute_overhead(self) -> float:
        """Return the graph overhead of the event's run, in seconds."""
        return self.report.overhead_ns / 1e9

    def __getitem__(self, token: str) -> Any:
        return self.run[token]

    def __iter__(self) -> Iterator[str]:
        return iter(self.run)

    def __len__(self) -> int:
        return len(self.run)

    def __repr__(self) -> str:
        return f"<EventView of {self.name!r:.40}: {len(self)} tokens>"


class _Reactive(Pipeline):
    """What the reactive pipelines have in common: where events are."""

    # The events under way, by the thread that works on them.
    _events: dict[int, EventView]
    # Where the last event that failed did so, what was raised, and how many had been worked on.
    _failed_last: tuple[str, str, int] = ("", "", 0)

    def emit(self, event: Any, run: Run) -> None:
        """Do something with an event's run; a pipeline without q_out does nothing. The hook for subclasses."""

    def put(self, answer: Any, view: EventView) -> None:
        """Put an answer on q_out; a pipeline without one does nothing. The hook for subclasses."""

    def _failure_after(self, view: EventView, run: Run, exception: BaseException) -> Failure:
        """Describe what failed after the graph: f_out and the put on q_out, or a hook of one's own."""
        function = "f_out"
        if view.stage == "q_out" and self._is_own("put"):
            function = "put"
        elif view.stage == "f_out" and self._is_own("emit") and bool(view.f_out_start) == bool(view.f_out_end):
            function = "emit"
        return Failure(function, self.cg.sink_tokens, dict(run), exception)

    def _is_own(self, hook: str) -> bool:
        """Whether a hook is that of a user's subclass, or was set on this object."""
        return hook in vars(self) or not getattr(type(self), hook).__module__.startswith("epypes.")

    def _note_failure(self, where: str, failure: Failure) -> None:
        """Remember for the picture where the last event failed."""
        # The text alone: the exception would keep the event and all its tokens.
        named = f"{failure.function}: " if failure.function in ("emit", "put") else ""
        self._failed_last = where, f"{named}{failure.kind}: {failure.message}", self.run_count

    def _where(self) -> list[str]:
        """Return where the events under way are: one, unless several threads work on events."""
        return [view.stage for view in tuple(self._events.values()) if view.stage]

    def _function_stage(self, name: str) -> Stage:
        """Look at f_in or f_out; it has failed if the last event did so in it."""
        failed_in, message, count = self._failed_last
        failure = message if failed_in == name and count == self.run_count else ""
        state: StageState = "running" if name in self._where() else "failed" if failure else "static"
        its_own = _function_name(getattr(self, name))
        return Stage("function", name, state, tuple(note for note in (its_own, failure) if note and note != name))


class _Answering(_Reactive):
    """What SourcePipeline and FullPipeline have in common: they put ``f_out(view)`` on ``q_out``."""

    q_out: Any
    f_out: FOut

    def emit(self, event: Any, run: Run) -> None:
        """Put what f_out makes of the event's run on q_out. The hook for subclasses."""
        __tracebackhide__ = True
        view = self._events.get(get_ident())
        if view is None or view.event is not event:
            view = EventView(self.name, event, "f_out")
        view.run, view.attributes = run, self.attributes.copy()
        view.f_out_start = perf_counter_ns()
        answer = self.f_out(view)
        view.f_out_end = perf_counter_ns()
        view.stage = "q_out"
        self.put(answer, view)
        # What emit of a subclass does after this.
        view.stage = "f_out"

    def put(self, answer: Any, view: EventView) -> None:
        """Put an answer on q_out, when f_out has made it of the view; the hook for subclasses."""
        self.q_out.put(answer)

    def _stages_after(self) -> tuple[Stage, Stage]:
        """Return f_out and q_out as they are at this moment."""
        is_waited_for = "q_out" in self._where()
        return self._function_stage("f_out"), queue_stage("q_out", self.q_out, is_waited_for=is_waited_for)


class SourcePipeline(_Answering):
    """A Pipeline that puts ``f_out(view)`` on ``q_out`` after every run.

    Parameters
    ----------
    q_out
        Anything with ``put(item)``.
    f_out
        Called on the thread that runs the pipeline, with this event's EventView.
    """

    @takes_old_keywords
    def __init__(
        self,
        name: str,
        cg: CompGraph,
        q_out: Any,
        f_out: FOut,
        hparams: Mapping[str, Any] | None = None,
        *,
        workers: int = 1,
        guard: bool = True,
    ) -> None:
        super().__init__(name, cg, hparams, workers=workers, guard=guard)
        self.q_out, self.f_out = q_out, f_out
        self._events = {}

    def run(self, /, *positional: Any, **payload: Any) -> Run:
        """Run the graph on a payload and put the result on q_out."""
        __tracebackhide__ = True
        view = EventView(self.name, None, "f_out")
        run = super().run(*positional, **payload)
        # Only now: the graph may run this pipeline itself, on this thread.
        self._events[get_ident()] = view
        try:
            self.emit(None, run)
        except BaseException as exception:
            self._note_failure("f_out", self._failure_after(view, run, exception))
            raise
        finally:
            self._events.pop(get_ident(), None)
        return run

    @property
    def stages(self) -> Stages:
        """f_out and q_out, as they are at this moment."""
        return Stages(after=self._stages_after())


class SinkPipeline(_Reactive):
    """A Pipeline that runs for every event on ``q_in``.

    An event that a broker has delivered is acknowledged when it has been answered, and rejected, with the reason, when
    it failed.

    Parameters
    ----------
    q_in
        Anything with ``get(timeout=seconds)`` that raises ``queue.Empty``.
    f_in
        Makes the payload, a mapping by free source token, from an event; called on the loop's thread.

    Attributes
    ----------
    on_error
        None, or called with a Failure on the loop's thread when f_in, a function, f_out or a hook of a subclass raises.
        Without it, failures are logged. The loop goes on.
    failed
        How many events failed.
    """

    f_out: Any
    # Whether `handle` puts the answer of f_out on q_out itself, which takes a call less than `emit`.
    _has_usual_emit = False

    @takes_old_keywords
    def __init__(
        self,
        name: str,
        cg: CompGraph,
        q_in: Any,
        f_in: FIn,
        hparams: Mapping[str, Any] | None = None,
        *,
        workers: int = 1,
        guard: bool = True,
    ) -> None:
        super().__init__(name, cg, hparams, workers=workers, guard=guard)
        self.q_in, self.f_in = q_in, f_in
        self.on_error: Callable[[Failure], None] | None = None
        self.failed = 0
        self._events = {}
        self._attempts = _Attempts()
        # By thread, the f_in of its loop, if that has its own.
        self._f_ins: dict[int, FIn] = {}
        # The event that `handle` has settled last on each thread.
        self._settled = threading.local()
        self.loop = EventLoop(q_in, self)

    def _reaction(self, f_in: FIn | None) -> Callable[[Any], object]:
        if f_in is None:
            return self.handle

        def react(event: Any) -> None:
            self._f_ins[get_ident()] = f_in
            try:
                self.handle(event)
            finally:
                del self._f_ins[get_ident()]

        return react

    @property
    def working_on(self) -> Any:
        """The event under way; None between events."""
        return next((view.event for view in tuple(self._events.values())), None)

    def handle(self, event: Any) -> None:
        """Work on one event; every failure is reported, none is raised. The hook for subclasses."""
        view, thread = EventView(self.name, event), get_ident()
        self._events[thread] = view
        f_in = self._f_ins.get(thread, self.f_in) if self._f_ins else self.f_in
        # Looked up now: a function of the graph fills the caches with its image, and each look-up takes microseconds.
        is_usual = self._has_usual_emit and "emit" not in self.__dict__
        clock, f_out, put = perf_counter_ns, self.f_out if is_usual else None, self.put
        # To free the tokens of the run before takes its time: that is done when the answer is on its way.
        before = self.runner.last
        run: Run | None = None
        try:
            payload = f_in(event)
            view.f_in_end = perf_counter_ns()
            if type(payload) is not dict:
                self._require_mapping(payload)
            view.stage = "graph"
            run = self.run(**payload)
            view.stage = "f_out"
            if f_out is None:
                self.emit(event, run)
            else:  # as emit does it, with what has been looked up
                view.run, view.attributes = run, self.attributes.copy()
                view.f_out_start = clock()
                answer = f_out(view)
                view.f_out_end = clock()
                view.stage = "q_out"
                put(answer, view)
            view.stage = ""
        except BaseException as exception:  # a function's SystemExit is a failure of this event, not the loop's end
            self._fail(view, exception, run)
        else:
            if getattr(type(event), "ack", None) is not None:  # is_kept
                self._settle(event)
        self._events.pop(thread, None)
        del before

    def _require_mapping(self, payload: Any) -> None:
        if not isinstance(payload, Mapping):
            text = f"f_in of {self.name!r} must return a mapping by free source token, not {type(payload).__name__}."
            raise InvalidType(text)

    @property
    def _busy(self) -> tuple[str, ...]:
        """What has not returned, for errors: functions of the graph, or f_in, or f_out, or the put on q_out."""
        where = [stage for stage in self._where() if stage != "graph"]
        return self.runner.running or tuple("put on q_out" if stage == "q_out" else stage for stage in where)

    @property
    def stages(self) -> Stages:
        """q_in, the event loop and f_in, as they are at this moment."""
        state: StageState = "running" if self.loop.is_running else "stopped"
        notes = (f"{counted(self.loop.handled, 'event')}, {self.failed} failed",)
        loop = Stage("loop", "EventLoop", state, notes)
        return Stages(before=(queue_stage("q_in", self.q_in), loop, self._function_stage("f_in")))

    def _fail(self, view: EventView, exception: BaseException, run: Run | None) -> None:
        event, where = view.event, "f_out" if view.stage == "q_out" else view.stage
        self.failed += 1
        try:
            where, failure = self._failure_of(view, where, exception, run)
        except BaseException:  # whatever a run of one's own does, the failure is reported
            failure = Failure(where, (), {"event": event}, exception)
        view.stage = ""
        self._note_failure(where, failure)
        self._report(failure, event)
        # When it has been reported: a broker may have nothing else to do with the event.
        if is_kept(event):
            self._settle(event, exception, str(failure))

    def _settle(self, event: Any, exception: BaseException | None = None, text: str = "") -> None:
        self._settled.event = event
        settle(event, exception, text)

    def _has_settled(self, event: Any) -> bool:
        """Whether ``handle`` has settled the event: that of a subclass need not call this one's."""
        return vars(self._settled).pop("event", None) is event

    def _failure_of(
        self, view: EventView, where: str, exception: BaseException, run: Run | None
    ) -> tuple[str, Failure]:
        """Return what failed, and where."""
        failed = self.runner.failed_run(exception) if where == "graph" else None
        if failed is not None and failed.failure is not None:
            return where, failed.failure
        if run is not None:
            return where, self._failure_after(view, run, exception)
        # What the graph refuses to run on came from f_in; anything else was raised by a compute of one's own.
        where = "f_in" if issubclass(type(exception), EpypesError) else where
        function = "compute" if where == "graph" else "f_in"
        return where, Failure(function, self.runner.free_source_tokens, {"event": view.event}, exception)

    def _take_failure(self, event: Any, exception: BaseException, *, is_reported: bool) -> bool:
        self.failed += 1
        if not is_reported:
            self._report(Failure("handle", self.runner.free_source_tokens, {"event": event}, exception), event)
        return True

    def _report(self, failure: Failure, event: Any) -> None:
        failed_id = event_id(event)
        failure = replace(failure, event_id=failed_id, attempt=self._attempts.count(failed_id), source=self.name)
        if self.on_error is None:
            expected = issubclass(type(failure.exception), EpypesError)
            log_error("%s: an event failed in %s", self.name, failure, error=None if expected else failure.exception)
            return
        try:
            self.on_error(failure)
        except BaseException as its_own:
            log_error("%s: on_error itself failed", self.name, error=its_own)

    def listen(self, timeout_s: float = 0.5) -> None:
        """Start the event loop; does nothing while it runs. One that is about to end is waited for.

        Raises
        ------
        StillRunning
            It was stopped, but a function did not return within ``timeout_s``.
        """
        self.loop.start(timeout_s)

    def join(self, timeout_s: float | None = None) -> bool:
        """Wait until the pipeline has been stopped; return whether it has.

        Parameters
        ----------
        timeout_s
            How long to wait, in seconds; without it, for as long as it takes. Ctrl-C raises KeyboardInterrupt.
        """
        return self.loop.join(timeout_s)

    def stop(self, timeout_s: float = 5.0, *, drain: bool = False) -> None:
        """Stop the event loop, then the nodes; may be called twice, before listen(), and from any thread.

        Inside an event, the loop ends after it, and the nodes are not stopped.

        Parameters
        ----------
        timeout_s
            How long it is waited for, in seconds.
        drain
            Whether the events that are on ``q_in`` are worked off before; without it they stay there.

        Raises
        ------
        StillRunning
            A function, or with ``drain`` the queue, took longer than ``timeout_s``.
        """
        self.loop.stop(timeout_s, drain=drain)
        if not self.loop.is_running:
            super().stop()

    def __enter__(self) -> Self:
        self.listen()
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()


class FullPipeline(_Answering, SinkPipeline):
    """A Pipeline that runs for every event on ``q_in`` and puts ``f_out(view)`` on ``q_out``.

    Parameters
    ----------
    name
        Its name.
    cg
        The graph.
    q_in, q_out
        Where events come from and answers go: queue.Queue, queue.SimpleQueue, Mailbox.
    f_in
        Makes the payload, a mapping by free source token, from an event; called on the loop's thread.
    f_out
        Makes an answer from the event's EventView; called on the loop's thread.
    hparams
        Values of hyperparameter tokens.

    Notes
    -----
    Semeniuta and Falkman 2019, "Reactive pipelines".

    Examples
    --------
    >>> import queue
    >>> cg = CompGraph({"double": lambda x: 2 * x}, {"double": ("x", "y")})
    >>> q_in, q_out = queue.Queue(), queue.Queue()
    >>> with FullPipeline("twice", cg, q_in, q_out, lambda event: {"x": event}, lambda view: view["y"]):
    ...     q_in.put(21)
    ...     q_out.get(timeout=10)
    42
    """

    @takes_old_keywords
    def __init__(
        self,
        name: str,
        cg: CompGraph,
        q_in: Any,
        q_out: Any,
        f_in: FIn,
        f_out: FOut,
        hparams: Mapping[str, Any] | None = None,
        *,
        workers: int = 1,
        guard: bool = True,
    ) -> None:
        super().__init__(name, cg, q_in, f_in, hparams, workers=workers, guard=guard)
        self.q_out, self.f_out = q_out, f_out
        self._has_usual_emit = type(self).emit is FullPipeline.emit

    @property
    def stages(self) -> Stages:
        """q_in, the event loop, f_in, f_out and q_out, as they are at this moment."""
        return replace(super().stages, after=self._stages_after())


def event_id(event: Any) -> str:
    """Return an event's id, if it has one that is a string; empty otherwise."""
    try:
        found = event.id
        # A plain string, since a class of one's own may refuse to be compared.
        return str.__str__(found) if isinstance(found, str) else ""
    except BaseException:  # any object can be an event, whatever its attributes do
        return ""


class _Attempts:
    """Counts the failures of events by id; forgets those that failed longest ago."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: OrderedDict[str, int] = OrderedDict()

    def count(self, failed_id: str) -> int:
        """Count one more failure of an event; return which one it is. Of an event without id it is the first."""
        if not failed_id:
            return 1
        with self._lock:
            self._counts[failed_id] = count = self._counts.pop(failed_id, 0) + 1
            if len(self._counts) > _MAX_REMEMBERED:
                self._counts.popitem(last=False)
            return count


def queue_stage(name: str, queue: Any, *, is_waited_for: bool = False) -> Stage:
    """Look at a queue, which may be any object.

    Parameters
    ----------
    is_waited_for
        Whether an answer waits to be put on it.
    """
    kind, is_mailbox = type(queue).__name__, isinstance(queue, Mailbox)
    size, limit = _number(queue, "qsize"), _number(queue, "size" if is_mailbox else "maxsize")
    notes = [f"{kind} {queue.policy}" if is_mailbox else kind]
    if size is not None:
        notes.append(f"{size} of {limit} waiting" if limit is not None and limit > 0 else f"{size} waiting")
    if is_mailbox:
        # A copy, since a producer may drop for another reason meanwhile.
        notes += [f"{count} dropped: {reason}" for reason, count in dict(queue.dropped).items()]
    return Stage("queue", name, "running" if is_waited_for else "static", tuple(notes))


def _number(queue: Any, name: str) -> int | None:
    """Return a number that a queue has or returns; None if it does not."""
    with contextlib.suppress(Exception):  # a multiprocessing queue has a qsize that raises on some systems
        found = getattr(queue, name)
        found = found() if callable(found) else found
        return found if type(found) is int else None
    return None


def _function_name(function: Any) -> str:
    with contextlib.suppress(Exception):  # any object can be called, whatever its attributes do
        name = function.__name__
        if isinstance(name, str):
            return name
    return type(function).__name__
