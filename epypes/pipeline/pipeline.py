"""A graph as one node, with its times and attributes."""

from __future__ import annotations

import inspect
import keyword
from collections.abc import Collection, Mapping
from time import perf_counter_ns
from typing import Any

from epypes.errors import HyperparameterError, PayloadError
from epypes.graph import CompGraph
from epypes.graph.hinted import annotated_params
from epypes.hints import Param, Roi
from epypes.pipeline.network import NodeBasedCompGraph
from epypes.pipeline.node import Node, is_a_call
from epypes.pipeline.stages import Stages
from epypes.rich_display import mimebundle
from epypes.run import CompGraphRunner, Run
from epypes.wording import counted


class Pipeline(Node):
    """A Node that runs a graph.

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

    Attributes
    ----------
    attributes
        What is to be known of it besides its tokens; a reactive pipeline copies them for every event.
    runner
        The runner of its network of nodes.

    Notes
    -----
    Semeniuta and Falkman 2019, "Nodes and pipelines".
    """

    def __init__(self, name: str, cg: CompGraph, hparams: Mapping[str, Any] | None = None, *, workers: int = 1) -> None:
        if not isinstance(cg, CompGraph):
            way_out = "Give its graph: .cg" if isinstance(getattr(cg, "cg", None), CompGraph) else "Pipeline(name, cg)"
            raise TypeError(f"A pipeline runs a CompGraph, not {type(cg).__name__!r}. {way_out}.")
        self.network = NodeBasedCompGraph(cg)
        self.runner = CompGraphRunner(self.network.cg, hparams, workers=workers)
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
    def cg(self) -> CompGraph:
        """The graph as it was given, with the user's own functions."""
        return self.source_cg

    @property
    def stages(self) -> Stages:
        """What an event passes before and after the graph, as it is at this moment; the hook for subclasses."""
        return Stages()

    @is_a_call
    def run(self, /, **payload: Any) -> Run:
        """Run the graph on a payload; see ``CompGraphRunner.run``. It counts as a call of the node."""
        # To free the tokens of the run before takes its time, which is not this run's.
        before = self.runner.last
        start_ns = perf_counter_ns()
        try:
            run: Run = self.compute(payload)
            return run
        finally:
            self.duration_ns = perf_counter_ns() - start_ns
            self.run_count = self.next_count()
            # Not at the end of this frame, which a failure keeps.
            del before

    def __call__(self, *args: Any) -> Any:
        """Run the graph on the free source tokens, in order; return its sink token or tokens."""
        run = self.run(**self._by_name(args))
        sinks = tuple(run[token] for token in self.cg.sink_tokens)
        return sinks[0] if len(sinks) == 1 else sinks

    def compute(self, *args: Any) -> Any:
        """Run the graph on one payload, a mapping by token; the hook for subclasses."""
        (payload,) = args
        return self.runner.run_on(payload)

    def _by_name(self, args: tuple[Any, ...]) -> dict[str, Any]:
        free = self.runner.free_source_tokens
        if len(args) != len(free):
            inputs = counted(len(free), "input")
            text = f"Pipeline {self.name!r} takes {inputs} ({', '.join(free)}), not {len(args)}."
            raise PayloadError(free, text)
        return dict(zip(free, args, strict=True))

    def __getitem__(self, token: str) -> Any:
        return self.runner[token]

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
                text = f"{token}={value!r:.60} is not what its annotation allows: {hint!r:.200}. Nothing was set."
                raise HyperparameterError(token, text)

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

        Nodes that a switch or a failure kept from running do not count. Where nodes ran side by side, it is that of
        the last run's report: wall time less the critical path.
        """
        last, nodes = self.runner.last, self.network.nodes
        report = None if last is None else last.report
        if report is not None and report.side_by_side:
            return report.overhead_ns / 1e9
        # This is asked of every event, where the whole graph ran, and entries by function take their time to make.
        counted = nodes.values() if report is not None and report.is_whole else map(nodes.__getitem__, self._counted())
        return (self.duration_ns - sum(node.duration_ns for node in counted)) / 1e9

    def _counted(self) -> Collection[str]:
        """Return the functions that took part in the last call."""
        last = self.runner.last
        if last is None:
            return self.network.nodes
        # Of a rerun, which counts as no call, the times of what was reused are still those of the call.
        return [entry.function for entry in last.report.functions if entry.ran or last.failure is None]

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        return mimebundle(self)


def _allows(hint: Param | Roi, value: Any) -> bool:
    try:
        return hint.allows(value)
    except Exception:  # a value that can't be compared with the ends of a range, be it of whatever class
        return False
