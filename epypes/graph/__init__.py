"""What is connected to what: computational graphs, pure and static."""

from epypes.graph.algebra import (
    delay,
    extend,
    group,
    names_of,
    needed_for,
    rename,
    subgraph,
    suffix,
    union,
    with_defaults,
    with_functions,
)
from epypes.graph.compgraph import CompGraph
from epypes.graph.identity import inner_graph, is_redefined_inside, redefined, unwrapped
from epypes.graph.placeholder import Placeholder, is_placeholder
from epypes.graph.signature import outputs
from epypes.graph.switch import Switch, as_switch, switch
from epypes.graph.token_annotations import annotated_params, colour_order, image_hint
from epypes.graph.validation import Delay

__all__ = [
    "CompGraph",
    "Delay",
    "Placeholder",
    "Switch",
    "annotated_params",
    "as_switch",
    "colour_order",
    "delay",
    "extend",
    "group",
    "image_hint",
    "inner_graph",
    "is_placeholder",
    "is_redefined_inside",
    "names_of",
    "needed_for",
    "outputs",
    "redefined",
    "rename",
    "subgraph",
    "suffix",
    "switch",
    "union",
    "unwrapped",
    "with_defaults",
    "with_functions",
]
