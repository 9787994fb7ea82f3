"""A graph at run time."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

from epypes.graph import CompGraph
from epypes.pipeline.node import Node, under_way

if TYPE_CHECKING:
    from epypes.graph.validation import GraphParts


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
            raise TypeError(f"A NodeBasedCompGraph is made of a CompGraph, not {type(cg).__name__!r}.")
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

    @property
    def running(self) -> tuple[str, ...]:
        """The functions that were called and have not returned."""
        running = {id(node) for node in under_way()}
        return tuple(name for name, node in self.nodes.items() if id(node) in running)

    def __repr__(self) -> str:
        return f"<NodeBasedCompGraph: {len(self.nodes)} nodes>"
