"""What is connected to what: computational graphs, pure and static."""

from epypes.graph.compgraph import CompGraph
from epypes.graph.hinted import annotated_params, colour_order, image_hint

__all__ = ["CompGraph", "annotated_params", "colour_order", "image_hint"]
