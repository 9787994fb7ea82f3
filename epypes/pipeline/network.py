"""A graph at run time."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from epypes.graph import CompGraph, with_functions
from epypes.pipeline.node import Node, under_way


class NodeBasedCompGraph:
    """The network of Nodes of a graph; functions that are Nodes already (a Pipeline, a subclass) are kept.

    Attributes
    ----------
    nodes
        The nodes by function name, in run order.
    cg
        The same graph with the nodes in place of the functions.

    Notes
    -----
    Semeniuta and Falkman 2019, "Nodes and pipelines".
    """

    def __init__(self, cg: CompGraph) -> None:
        self.nodes: Mapping[str, Node] = MappingProxyType(
            {
                name: function if isinstance(function, Node) else Node(name, function)
                for name, function in cg.functions.items()
            }
        )
        self.cg = with_functions(cg, self.nodes)

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
