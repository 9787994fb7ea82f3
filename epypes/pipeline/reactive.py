"""Pipelines that answer events.

The paper's reactive pipelines: a SourcePipeline puts what it computes on q_out, a SinkPipeline is driven by q_in,
a FullPipeline does both.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from time import perf_counter_ns
from typing import Any, Literal, Self

from epypes.errors import EpypesError
from epypes.graph import CompGraph
from epypes.pipeline.answering import Answering, FOut, OfThread
from epypes.pipeline.attempts import Attempts, event_id
from epypes.pipeline.log import log_error
from epypes.pipeline.loop import EventLoop
from epypes.pipeline.pipeline import Pipeline
from epypes.pipeline.settling import settle
from epypes.pipeline.stages import Stages, function_stage, loop_stage, queue_stage
from epypes.pipeline.stamps import Stamps
from epypes.run import Failure, Run
from epypes.run.raised import run_that_raised
from epypes.run.underway import locals_under_way

FIn = Callable[[Any], Mapping[str, Any]]
# What an event is in: its f_in, its graph, or its f_out with the put on q_out.
Where = Literal["f_in", "graph", "f_out"]


class SourcePipeline(Answering, Pipeline):
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
        self._own = OfThread()

    def run(self, /, **payload: Any) -> Run:
        """Run the graph on a payload and put the result on q_out."""
        stamps = Stamps()
        run = super().run(**payload)
        # Only now: the graph may run this pipeline itself, on this thread.
        self._own.stamps = stamps
        self.emit(None, run)
        return run

    @property
    def stages(self) -> Stages:
        """f_out and q_out, as they are at this moment."""
        return Stages(after=self._stages_after(""))


class SinkPipeline(Pipeline):
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
        self._attempts = Attempts()
        # Where the last event that failed did so, what was raised, and how many had been worked on.
        self._failed_last: tuple[Where | None, str, int] = (None, "", 0)
        self._own = OfThread()
        self.loop = EventLoop(q_in, self)

    def _react(self, event: Any, f_in: FIn | None) -> None:
        self._own.f_in = f_in
        try:
            self.handle(event)
        finally:
            self._own.f_in = None

    def handle(self, event: Any) -> None:
        """Work on one event; every failure is reported, none is raised. The hook for subclasses."""
        # To free the tokens of the run before takes its time: that is done when the answer is on its way.
        before = self.runner.last
        self.working_on = event
        run: Run | None = None
        # The stages look at it, in this frame.
        where: Where | None = "f_in"
        self._own.stamps = stamps = Stamps()
        try:
            stamps.f_in_start = stamps.react
            payload = (self._own.f_in or self.f_in)(event)
            stamps.f_in_end = perf_counter_ns()
            if type(payload) is not dict:
                self._require_mapping(payload)
            where = "graph"
            run = self.run(**payload)
            where = "f_out"
            self.emit(event, run)
            where = None
        except BaseException as exception:  # a function's SystemExit is a failure of this event, not the loop's end
            failed_in, where = where, None
            self._fail(event, failed_in, exception, run)
        else:
            self._settle(event)
        self.working_on = None
        del before

    def _require_mapping(self, payload: Any) -> None:
        if not isinstance(payload, Mapping):
            text = f"f_in of {self.name!r} must return a mapping by free source token, not {type(payload).__name__}."
            raise TypeError(text)

    @property
    def _busy(self) -> tuple[str, ...]:
        """What has not returned, for errors: functions of the graph, or f_in, or f_out with its put on q_out."""
        return self.network.running or tuple(where for where in self._under_way() if where != "graph")

    def _under_way(self) -> list[Where]:
        """Return what the events under way are in: one, unless handle is called by others than the loop too."""
        calls = locals_under_way({SinkPipeline.handle.__code__})
        return [found["where"] for found in calls if found["self"] is self and found.get("where")]

    @property
    def stages(self) -> Stages:
        """q_in, the event loop and f_in, as they are at this moment."""
        return Stages(
            before=(
                queue_stage("q_in", self.q_in),
                loop_stage(self.loop, self.failed),
                function_stage(
                    "f_in", self.f_in, is_under_way="f_in" in self._under_way(), failure=self._failure_in("f_in")
                ),
            )
        )

    def _failure_in(self, where: Where) -> str:
        """Return what f_in or f_out raised for the last event; empty if none did, or that was another event."""
        failed_in, message, count = self._failed_last
        return message if failed_in == where and count == self.run_count else ""

    def emit(self, event: Any, run: Run) -> None:
        """Do something with an event's run; a SinkPipeline does nothing. The hook for subclasses."""

    def _fail(self, event: Any, where: Where | None, exception: BaseException, run: Run | None) -> None:
        self.failed += 1
        try:
            where, failure = self._failure_of(event, where, exception, run)
        except BaseException:  # whatever a run of one's own does, the failure is told
            failure = Failure(where or "compute", (), {"event": event}, exception)
        # The text alone: the exception would keep the event and all its tokens.
        self._failed_last = where, f"{failure.kind}: {failure.message}", self.run_count
        failed_id = event_id(event)
        self._report(replace(failure, event_id=failed_id, attempt=self._attempts.count(failed_id), source=self.name))
        # When it has been told: whoever keeps the event may have nothing else to do with it.
        self._settle(event, exception, str(failure))

    def _settle(self, event: Any, exception: BaseException | None = None, text: str = "") -> None:
        self._own.settled = event
        settle(event, exception, text)

    def _has_settled(self, event: Any) -> bool:
        """Whether ``handle`` has settled the event: that of a subclass need not call this one's."""
        settled, self._own.settled = self._own.settled, None
        return settled is event

    def _failure_of(
        self, event: Any, where: Where | None, exception: BaseException, run: Run | None
    ) -> tuple[Where | None, Failure]:
        """Return what failed, and where."""
        failed = run_that_raised(exception, self.runner) if where == "graph" else None
        if failed is not None and failed.failure is not None:
            return where, failed.failure
        if run is not None:
            return where, Failure("f_out", self.cg.sink_tokens, dict(run), exception)
        # What the graph refuses to run on came from f_in; anything else was raised by a compute of one's own.
        where = "f_in" if issubclass(type(exception), EpypesError) else where
        function = "compute" if where == "graph" else "f_in"
        return where, Failure(function, self.runner.free_source_tokens, {"event": event}, exception)

    def _report(self, failure: Failure) -> None:
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


class FullPipeline(Answering, SinkPipeline):
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

    @property
    def _busy(self) -> tuple[str, ...]:
        """What has not returned, for errors; an f_out that returned is told from the put of its answer."""
        return tuple("put on q_out" if name == "f_out" and self._is_putting() else name for name in super()._busy)

    @property
    def stages(self) -> Stages:
        """q_in, the event loop, f_in, f_out and q_out, as they are at this moment."""
        return replace(super().stages, after=self._stages_after(self._failure_in("f_out")))
