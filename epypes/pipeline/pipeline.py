"""A graph as one node, with its times and attributes."""

from __future__ import annotations

import contextlib
import inspect
import keyword
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from time import perf_counter_ns
from typing import Any, Literal

from epypes.deprecation import takes_old_keywords
from epypes.errors import HyperparameterError, InvalidType, PayloadError, run_call
from epypes.graph import CompGraph, annotated_params
from epypes.hints import Param, Roi
from epypes.pipeline.node import Node, NodeBasedCompGraph
from epypes.run import CompGraphRunner, Run
from epypes.run.result import TokenMapping
from epypes.wording import counted

StageKind = Literal["queue", "loop", "function"]
StageState = Literal["static", "running", "stopped", "failed"]


@dataclass(frozen=True, slots=True)
class Stage:
    """One stage of a reactive pipeline, outside its graph, at one moment.

    Attributes
    ----------
    kind
        What it is: a queue, an event loop, or a function such as f_in.
    name
        Such as ``"q_in"``.
    state
        ``"running"``: of a loop that it listens, of a function that an event is in it, of a queue that an answer
        waits to be put on it; ``"failed"``: of a function that the last event failed in it.
    notes
        Short lines: what it is, its counts.
    """

    kind: StageKind
    name: str
    state: StageState = "static"
    notes: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Stages:
    """The stages that an event passes before and after the graph, in that order."""

    before: tuple[Stage, ...] = ()
    after: tuple[Stage, ...] = ()


class Pipeline(Node, TokenMapping):
    """A Node that runs a graph; a mapping of its runner's tokens, as a CompGraphRunner is.

    Called with the free source tokens in order of first appearance in func_io, it returns its sink token, or a
    tuple of them in graph order: so it can be a function of another graph.

    Parameters
    ----------
    name
        Its name.
    cg
        The graph.
    hparams
        Values of hyperparameter tokens.
    workers
        How many functions may run at once, in threads; see CompGraphRunner.
    guard
        Whether functions get arrays as read-only views and containers as copies; see CompGraphRunner.

    Attributes
    ----------
    attributes
        What is to be known of it besides its tokens; a reactive pipeline copies them for every event.
    runner
        The runner of its network of nodes.

    Notes
    -----
    In another graph its hyperparameters are called as in scikit-learn, ``"function__token"``; what is set so is that
    graph's own, and reaches the runs that a call makes on its thread.

    Semeniuta and Falkman 2019, "Nodes and pipelines".
    """

    @takes_old_keywords
    def __init__(
        self,
        name: str,
        cg: CompGraph,
        hparams: Mapping[str, Any] | None = None,
        *,
        workers: int = 1,
        guard: bool = True,
    ) -> None:
        if not isinstance(cg, CompGraph):
            way_out = "Give its graph: .cg" if isinstance(getattr(cg, "cg", None), CompGraph) else "Pipeline(name, cg)"
            raise InvalidType(f"A pipeline runs a CompGraph, not {type(cg).__name__!r}. {way_out}.")
        self.network = NodeBasedCompGraph(cg)
        self.runner = CompGraphRunner(self.network, hparams, workers=workers, guard=guard)
        self.source_cg = cg
        self.attributes: dict[str, Any] = {}
        super().__init__(name, self.__call__)
        self.__name__ = name

    @property
    def __signature__(self) -> inspect.Signature:
        """The free source tokens, so that a graph checks how many inputs it gives, or reads what they are called."""
        kind = inspect.Parameter.POSITIONAL_ONLY
        free = self.runner.free_source_tokens
        are_names = all(token.isidentifier() and not keyword.iskeyword(token) for token in free)
        names = free if are_names else [f"input_{place}" for place, _ in enumerate(free)]
        return inspect.Signature([inspect.Parameter(name, kind) for name in names])

    def __epypes_revision__(self, around: tuple[Any, ...] = ()) -> tuple[Any, ...]:
        """Return another value whenever a hyperparameter of this pipeline, or of one inside it, has changed.

        ``around`` are the programs of the pipelines that ask.
        """
        return self.runner.revision, *self.runner._program.revisions(around)

    @property
    def __epypes_runner__(self) -> CompGraphRunner:
        """The runner, for the graph that the pipeline is a function of."""
        return self.runner

    @property
    def __epypes_initial_state__(self) -> Mapping[str, Any]:
        """The state between runs before the first one; empty without any."""
        return {slots.key: slots.initial for slots in self.runner._program.states}

    def __epypes_call_with_state__(self, state: Mapping[str, Any], inputs: tuple[Any, ...]) -> tuple[Any, Any]:
        """Call the pipeline with a state that the caller keeps; return its value and the state after."""
        return self.runner.call_with_state(state, lambda: self(*inputs))

    @property
    def state(self) -> Mapping[str, Any]:
        """What the next run begins with; see ``CompGraphRunner.state``."""
        return self.runner.state

    @state.setter
    def state(self, values: Mapping[str, Any]) -> None:
        self.runner.state = values

    def reset(self) -> None:
        """Have the next run begin with the initial state; see ``CompGraphRunner.reset``."""
        self.runner.reset()

    @property
    def cg(self) -> CompGraph:
        """The graph as it was given, with the user's own functions."""
        return self.source_cg

    @property
    def stages(self) -> Stages:
        """What an event passes before and after the graph, as it is at this moment; the hook for subclasses."""
        return Stages()

    def run(self, /, *positional: Any, **payload: Any) -> Run:
        """Run the graph on a payload; see ``CompGraphRunner.run``. It counts as a call of the node."""
        __tracebackhide__ = True
        if positional:
            free = self.runner.free_source_tokens
            raise PayloadError(free, f"Payload goes by name: {run_call(free)}.")
        start_ns = perf_counter_ns()
        # In place before the run, whose functions fill the caches: after it each look-up takes a microsecond.
        self._called = called = [*self._called]
        count = self._next_count()
        try:
            run: Run = self.compute(payload)
            return run
        finally:
            called[1] = count
            called[0] = perf_counter_ns() - start_ns

    def __call__(self, *args: Any) -> Any:
        """Run the graph on the free source tokens, in order; return its sink token or tokens."""
        __tracebackhide__ = True
        run = self.run(**self._by_name(args))
        sinks = tuple(run[token] for token in self.cg.sink_tokens)
        return sinks[0] if len(sinks) == 1 else sinks

    def compute(self, *args: Any) -> Any:
        """Run the graph on one payload, a mapping by token; the hook for subclasses."""
        __tracebackhide__ = True
        (payload,) = args
        return self.runner.run_on(payload)

    # What an EventLoop asks of its pipeline.

    def _reaction(self, f_in: Callable[[Any], Mapping[str, Any]] | None) -> Callable[[Any], object]:
        """Return what is called with each event: without f_in the event is the only input."""
        return self if f_in is None else lambda event: self.run(**f_in(event))

    def _take_failure(self, event: Any, exception: BaseException, *, is_reported: bool) -> bool:
        """Count an event whose reaction raised, and report it unless the loop does; return whether that was done."""
        return False

    def _has_settled(self, event: Any) -> bool:
        """Whether the pipeline has acknowledged or rejected the event itself."""
        return False

    @property
    def _busy(self) -> tuple[str, ...]:
        """What has not returned, for errors: functions of the graph."""
        return self.runner.running

    def _by_name(self, args: tuple[Any, ...]) -> dict[str, Any]:
        free = self.runner.free_source_tokens
        if len(args) != len(free):
            inputs = counted(len(free), "input")
            text = f"Pipeline {self.name!r} takes {inputs} ({', '.join(free)}), not {len(args)}."
            raise PayloadError(free, text)
        return dict(zip(free, args, strict=True))

    def __getitem__(self, token: str) -> Any:
        return self.runner[token]

    def __iter__(self) -> Iterator[str]:
        return iter(self.runner)

    def __len__(self) -> int:
        return len(self.runner)

    def __bool__(self) -> bool:
        """Whether there is a pipeline: true also before its first run, as of any other function."""
        return True

    def __setitem__(self, token: str, value: Any) -> None:
        self.runner[token] = value

    def set(self, /, **values: Any) -> None:
        """Set hyperparameters, all or none of them, at once: an event's run has all of the new values or none.

        The run says which by its ``revision``, and the event's view by ``view.run.revision``.

        Raises
        ------
        HyperparameterError
            A function makes the token, or it is not a hyperparameter, or a function's annotation does not allow the
            value; nothing is set then.
        UnknownName
            There is no such token, or a switch has no such branch.
        """
        for token, value in values.items():
            self._require_allowed(token, value)
        self.runner.set(**values)

    def _require_allowed(self, token: str, value: Any) -> None:
        for hint in annotated_params(self.source_cg, token):
            if not _allows(hint, value):
                text = f"{token}={value!r:.60} is not what its annotation allows, {hint.describe()}. Nothing was set."
                raise HyperparameterError(token, text)

    def stop(self) -> None:
        """Stop the nodes, the last one first, so that each releases what it holds; all of them, even if one fails."""
        with contextlib.ExitStack() as stops:
            for node in self.network.nodes.values():
                stops.callback(node.stop)

    def traverse_time(self) -> tuple[Any, ...]:
        """Return ``(name, seconds of the last call, the nodes' tuples)``; 0 seconds for nodes that it left out."""
        counted = self._counted()
        return (
            self.name,
            self.time,
            tuple(
                node.traverse_time() if function in counted else (node.name, 0.0)
                for function, node in self.network.nodes.items()
            ),
        )

    def compute_overhead(self) -> float:
        """Return the graph overhead of the last call, in seconds: its time less the sum of its nodes' times.

        Nodes that a switch, a failure or Nothing kept from running do not count. Where nodes ran side by side, it is
        that of the last run's report: wall time less the critical path.
        """
        last, nodes = self.runner.last, self.network.nodes
        report = None if last is None else last.report
        if report is not None and report.side_by_side:
            return report.overhead_ns / 1e9
        if report is not None and report.is_whole and len(report.program.nodes) == len(nodes):
            # The nodes' times, which take longer to look up one by one.
            return (self.duration_ns - sum(report.ran_ns.values())) / 1e9
        return (self.duration_ns - sum(nodes[function].duration_ns for function in self._counted())) / 1e9

    def _counted(self) -> Collection[str]:
        """Return the functions that took part in the last call."""
        last = self.runner.last
        if last is None:
            return self.network.nodes
        # Of a rerun, which counts as no call, the times of what was reused are still those of the call.
        entries = last.report.functions
        return [entry.function for entry in entries if entry.ran or (last.failure is None and entry.reused)]


def _allows(hint: Param | Roi, value: Any) -> bool:
    try:
        return hint.allows(value)
    except Exception:  # a value that can't be compared with the ends of a range, be it of whatever class
        return False
