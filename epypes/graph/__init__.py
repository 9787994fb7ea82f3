"""What is connected to what: computational graphs, pure and static."""

from epypes.graph.compgraph import CompGraph

__all__ = ["CompGraph"]
