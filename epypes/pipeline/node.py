"""A function at run time, and the network of them that a graph becomes."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Mapping
from dataclasses import replace
from time import perf_counter_ns
from typing import TYPE_CHECKING, Any, cast
from weakref import ref

from epypes.deprecation import OldNames
from epypes.errors import InvalidType
from epypes.graph import CompGraph
from epypes.run.guard import WATCH, called_for

if TYPE_CHECKING:
    from epypes.graph.validation import GraphParts
    from epypes.run.program import Program


class Node(OldNames):
    """The runtime counterpart of a function: callable with positional inputs, measures its time.

    Made for subclassing: override ``compute`` to do something around, or instead of, the function.

    Parameters
    ----------
    name
        Its name in graphs and reports.
    func
        What it computes.

    Notes
    -----
    Semeniuta and Falkman 2019, "Nodes and pipelines".

    Examples
    --------
    >>> node = Node("double", lambda x: 2 * x)
    >>> node(21), node.run_count
    (42, 1)
    """

    def __init__(self, name: str, func: Callable[..., Any]) -> None:
        if not callable(func):
            raise InvalidType(f"Node {name!r:.40} needs a function to call, not {type(func).__name__!r}.")
        self.name = name
        self.func = called_for(name, func)
        # Nanoseconds of the last call, and how many there were.
        self._called = [0, 0]
        # Whole in every thread, which counting up is not.
        self._next_count = itertools.count(1).__next__
        # Those that call ``func`` in the node's place; they know of calls that are not counted yet.
        self.programs: list[ref[Program]] = []
        # Gives the node its function's signature, so that a graph of nodes is checked like one of functions.
        functools.update_wrapper(self, func, updated=())
        # Marks go along; whatever else a callable object or another node keeps must not take the place of our own.
        marks = {
            key: mark for key, mark in getattr(func, "__dict__", {}).items() if not hasattr(self, key) and key != WATCH
        }
        self.__dict__.update(marks)

    def __call__(self, *args: Any) -> Any:
        """Compute, and measure the time."""
        __tracebackhide__ = True
        start_ns = perf_counter_ns()
        try:
            return self.compute(*args)
        finally:
            self.count_call(perf_counter_ns() - start_ns)

    def count_call(self, duration_ns: int) -> None:
        """Take note of a call."""
        self._called = [duration_ns, self._next_count()]

    @property
    def duration_ns(self) -> int:
        """How long the last call took, in nanoseconds; 0 before the first."""
        self._count_runs()
        return self._called[0]

    @property
    def run_count(self) -> int:
        """How often the node was called, failed calls included."""
        self._count_runs()
        return self._called[1]

    def _count_runs(self) -> None:
        for found in tuple(self.programs):
            program = found()
            if program is not None:
                program.count_calls()

    @property
    def time(self) -> float:
        """How long the last call took, in seconds; 0.0 before the first."""
        return self.duration_ns / 1e9

    def compute(self, *args: Any) -> Any:
        """Compute the node's value from its inputs; the hook for subclasses."""
        __tracebackhide__ = True
        return self.func(*args)

    @property
    def __epypes_is_its_func__(self) -> bool:
        """Whether it comes to the same to call ``func``, and to count the call later."""
        kind = type(self)
        return kind.__call__ is Node.__call__ and kind.compute is Node.compute and "compute" not in vars(self)

    def stop(self) -> None:
        """Release what the node holds, such as a camera; the hook for subclasses.

        A pipeline calls it for each of its nodes when it is stopped, which may be more than once.
        """

    def traverse_time(self) -> tuple[Any, ...]:
        """Return ``(name, seconds of the last call)``; a pipeline adds its nodes' tuples as a third item."""
        return self.name, self.time

    def __repr__(self) -> str:
        return f"<{type(self).__name__:.30} {self.name!r:.40}: {self.run_count} calls>"


def wrap_calls(node: Node, wrap: Callable[[Callable[..., Any]], Callable[..., Any]]) -> None:
    """Have every call of a node go through ``wrap(function)``, also in runners that exist already."""
    if type(node).compute is Node.compute:
        node.func = wrap(node.func)
    else:
        node.compute = wrap(node.compute)  # type: ignore[method-assign]


class NodeBasedCompGraph(CompGraph):
    """The network of Nodes of a graph: the same graph with a Node in place of each function.

    Functions that are Nodes already (a Pipeline, a subclass) are kept. It is drawn and run as any graph. What
    ``ep.union`` and the other operations make of it is a CompGraph whose functions are these Nodes.

    Parameters
    ----------
    cg
        The graph; it stays as it is.

    Notes
    -----
    Semeniuta and Falkman 2019, "Nodes and pipelines".

    Examples
    --------
    >>> network = NodeBasedCompGraph(CompGraph({"double": lambda x: 2 * x}, {"double": ("x", "y")}))
    >>> network.nodes["double"](21), network.sink_tokens
    (42, ('y',))
    """

    def __init__(self, cg: CompGraph) -> None:
        if not isinstance(cg, CompGraph):
            raise InvalidType(f"A NodeBasedCompGraph is made of a CompGraph, not {type(cg).__name__!r}.")
        self._build(cg._parts())

    def _build(self, parts: GraphParts) -> None:
        nodes: dict[str, Callable[..., Any]] = {
            name: function if isinstance(function, Node) or not callable(function) else Node(name, function)
            for name, function in parts.functions.items()
        }
        super()._build(replace(parts, functions=nodes))

    @property
    def nodes(self) -> Mapping[str, Node]:
        """The nodes by function name, in run order."""
        return cast("Mapping[str, Node]", self.functions)

    def traverse_time(self) -> tuple[Any, ...]:
        """Return the nodes' ``traverse_time()``, in run order."""
        return tuple(node.traverse_time() for node in self.nodes.values())

    def __repr__(self) -> str:
        return f"<NodeBasedCompGraph: {len(self.nodes)} nodes>"
