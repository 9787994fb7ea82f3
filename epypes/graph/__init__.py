"""What is connected to what: computational graphs, pure and static."""

from epypes.graph.algebra import extend, subgraph, union, with_defaults, with_functions
from epypes.graph.compgraph import CompGraph
from epypes.graph.group import group
from epypes.graph.hinted import annotated_params, colour_order, image_hint
from epypes.graph.outputs import outputs
from epypes.graph.placeholder import Placeholder, is_placeholder, layers
from epypes.graph.renaming import rename, suffix
from epypes.graph.switch import Switch, as_switch, switch

__all__ = [
    "CompGraph",
    "Placeholder",
    "Switch",
    "annotated_params",
    "as_switch",
    "colour_order",
    "extend",
    "group",
    "image_hint",
    "is_placeholder",
    "layers",
    "outputs",
    "rename",
    "subgraph",
    "suffix",
    "switch",
    "union",
    "with_defaults",
    "with_functions",
]
