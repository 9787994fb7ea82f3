"""How does a pipeline answer events?

The paper's reactive pipelines: a SourcePipeline puts what it computes on q_out, a SinkPipeline is driven by q_in,
a FullPipeline does both.
"""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, Final, Self

from epypes.errors import EpypesError
from epypes.graph import CompGraph
from epypes.pipeline.loop import EventLoop
from epypes.pipeline.pipeline import Pipeline
from epypes.pipeline.stages import Stage, Stages, function_stage, loop_stage, queue_stage
from epypes.pipeline.stamps import Stamps
from epypes.pipeline.view import EventView
from epypes.run import Failure, Run
from epypes.run.underway import locals_under_way

FIn = Callable[[Any], Mapping[str, Any]]
FOut = Callable[[EventView], Any]

# Ids of events that failed, for the count of attempts: some for every event that may be sent again.
_MOST_REMEMBERED: Final = 1_000

_log = logging.getLogger("epypes.pipeline")


class SourcePipeline(Pipeline):
    """A Pipeline that puts ``f_out(view)`` on ``q_out`` after every run.

    Parameters
    ----------
    q_out
        Anything with ``put(item)``.
    f_out
        Called on the thread that runs the pipeline, with this event's EventView.
    """

    def __init__(
        self,
        name: str,
        cg: CompGraph,
        q_out: Any,
        f_out: FOut,
        hparams: Mapping[str, Any] | None = None,
        *,
        workers: int = 1,
    ) -> None:
        super().__init__(name, cg, hparams, workers=workers)
        self.q_out, self.f_out = q_out, f_out

    def run(self, /, **payload: Any) -> Run:
        """Run the graph on a payload and put the result on q_out."""
        stamps = Stamps()
        run = super().run(**payload)
        _emit(self, None, run, stamps)
        return run

    def put(self, answer: Any, view: EventView) -> None:
        """Put an answer on q_out, when f_out has made it of the view; the hook for subclasses."""
        self.q_out.put(answer)

    @property
    def stages(self) -> Stages:
        """f_out and q_out, as they are at this moment."""
        return Stages(after=_stages_after(self, self.f_out, self.q_out, ""))


class SinkPipeline(Pipeline):
    """A Pipeline that runs for every event on ``q_in``.

    Parameters
    ----------
    q_in
        Anything with ``get(timeout=seconds)`` that raises ``queue.Empty``.
    f_in
        Makes the payload, a mapping by free source token, from an event; called on the loop's thread.

    Attributes
    ----------
    on_error
        None, or called with a Failure on the loop's thread when f_in, a function or f_out raises. Without it,
        failures are logged. The loop goes on.
    failed
        How many events failed.
    working_on
        The event under way; None between events.
    """

    def __init__(
        self,
        name: str,
        cg: CompGraph,
        q_in: Any,
        f_in: FIn,
        hparams: Mapping[str, Any] | None = None,
        *,
        workers: int = 1,
    ) -> None:
        super().__init__(name, cg, hparams, workers=workers)
        self.q_in, self.f_in = q_in, f_in
        self.on_error: Callable[[Failure], None] | None = None
        self.failed = 0
        self.working_on: Any = None
        self._stage = ""
        self._stamps = Stamps()
        self._attempts: OrderedDict[str, int] = OrderedDict()
        # Where the last event that failed did so, what was raised, and how many had been worked on.
        self._failed_last = ("", "", 0)
        self.loop = EventLoop(q_in, self.handle, lambda event: {"event": event}, name=name, busy=self._busy)

    def handle(self, event: Any) -> None:
        """Work on one event; every failure is reported, none is raised. The hook for subclasses."""
        self._stamps = Stamps()
        self.working_on = event
        self._work_on(event)
        self.working_on = None

    def _work_on(self, event: Any) -> None:
        try:
            self._stage = "f_in"
            payload = self._payload(event)
            run = self.run(**payload)
        except BaseException as exception:  # a function's SystemExit is a failure of this event, not the loop's end
            self._fail(event, self._failure_of(exception, "f_in", {"event": event}))
            return
        try:
            self._stage = "f_out"
            self.emit(event, run)
        except BaseException as exception:
            self._fail(event, Failure("f_out", self.cg.sink_tokens, dict(run), exception))

    def _busy(self) -> tuple[str, ...]:
        """Return what has not returned: functions of the graph, or f_in, or f_out with its put on q_out."""
        return self.network.running or (self._stage,)

    @property
    def stages(self) -> Stages:
        """q_in, the event loop and f_in, as they are at this moment."""
        is_in_f_in = any(found["self"] is self for found in locals_under_way({SinkPipeline._payload.__code__}))
        return Stages(
            before=(
                queue_stage("q_in", self.q_in),
                loop_stage(self.loop, self.failed),
                function_stage("f_in", self.f_in, is_under_way=is_in_f_in, failure=self._failure_in("f_in")),
            )
        )

    def _failure_in(self, function: str) -> str:
        """Return what f_in or f_out raised for the last event; empty if none did, or that was another event."""
        failed_in, message, count = self._failed_last
        return message if failed_in == function and count == self.run_count else ""

    def emit(self, event: Any, run: Run) -> None:
        """Do something with an event's run; a SinkPipeline does nothing. The hook for subclasses."""

    def _payload(self, event: Any) -> Mapping[str, Any]:
        stamps = self._stamps
        stamps.f_in_start_ns = stamps.now_ns()
        payload = self.f_in(event)
        stamps.f_in_end_ns = stamps.now_ns()
        if not isinstance(payload, Mapping):
            text = f"f_in of {self.name!r} must return a mapping by free source token, not {type(payload).__name__}."
            raise TypeError(text)
        return payload

    def _failure_of(self, exception: BaseException, otherwise: str, inputs: Mapping[str, Any]) -> Failure:
        """Return the failure of the graph if that is where the exception is from."""
        last = self.runner.last
        if last is not None and last.failure is not None and last.failure.exception is exception:
            return last.failure
        return Failure(otherwise, self.runner.free_source_tokens, inputs, exception)

    def _fail(self, event: Any, failure: Failure) -> None:
        self.failed += 1
        # The text alone: the exception would keep the event and all its tokens.
        self._failed_last = failure.function, f"{type(failure.exception).__name__}: {failure.message}", self.run_count
        event_id = _event_id(event)
        failure = replace(failure, event_id=event_id, attempt=self._attempt(event_id), source=self.name)
        if self.on_error is None:
            expected = isinstance(failure.exception, EpypesError)
            _log.error(
                "%s: an event failed in %s",
                self.name,
                failure,
                exc_info=None if expected else failure.exception,
            )
            return
        try:
            self.on_error(failure)
        except BaseException:
            _log.exception("%s: on_error itself failed", self.name)

    def _attempt(self, event_id: str) -> int:
        """Return which try of an event this was that failed, as far as that is remembered."""
        if not event_id:
            return 1
        self._attempts[event_id] = attempt = self._attempts.pop(event_id, 0) + 1
        if len(self._attempts) > _MOST_REMEMBERED:
            self._attempts.popitem(last=False)
        return attempt

    def listen(self) -> None:
        """Start the event loop; does nothing while it runs."""
        self.loop.start()

    def stop(self, timeout_s: float = 5.0) -> None:
        """Stop the event loop; may be called twice, before listen(), and from any thread.

        Raises
        ------
        StillRunning
            A function did not return within ``timeout_s``.
        """
        self.loop.stop(timeout_s)

    def __enter__(self) -> Self:
        self.listen()
        return self

    def __exit__(self, *exception: object) -> None:
        self.stop()


class FullPipeline(SinkPipeline):
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
    ) -> None:
        super().__init__(name, cg, q_in, f_in, hparams, workers=workers)
        self.q_out, self.f_out = q_out, f_out

    def emit(self, event: Any, run: Run) -> None:
        """Put what f_out makes of the event's run on q_out."""
        _emit(self, event, run, self._stamps)

    def put(self, answer: Any, view: EventView) -> None:
        """Put an answer on q_out, when f_out has made it of the view; the hook for subclasses."""
        self.q_out.put(answer)

    @property
    def stages(self) -> Stages:
        """q_in, the event loop, f_in, f_out and q_out, as they are at this moment."""
        after = _stages_after(self, self.f_out, self.q_out, self._failure_in("f_out"))
        return replace(super().stages, after=after)


def _event_id(event: Any) -> str:
    """Return an event's id, if it has one that is a string."""
    try:
        event_id = event.id
    except Exception:  # any object can be an event, whatever its attributes do
        return ""
    return event_id if isinstance(event_id, str) else ""


def _emit(pipeline: SourcePipeline | FullPipeline, event: Any, run: Run, stamps: Stamps) -> None:
    view = EventView(pipeline.name, event, run, pipeline.attributes, stamps)
    stamps.f_out_start_ns = stamps.now_ns()
    answer = pipeline.f_out(view)
    stamps.f_out_end_ns = stamps.now_ns()
    pipeline.put(answer, view)


def _stages_after(pipeline: Pipeline, f_out: FOut, q_out: Any, failure: str) -> tuple[Stage, Stage]:
    calls = [found for found in locals_under_way({_emit.__code__}) if found["pipeline"] is pipeline]
    return (
        function_stage("f_out", f_out, is_under_way=any("answer" not in found for found in calls), failure=failure),
        queue_stage("q_out", q_out, is_waited_for=any("answer" in found for found in calls)),
    )
