"""Computational graphs, pure and static: what is connected to what."""

from typing import TYPE_CHECKING

from epypes.deprecation import old_names
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
from epypes.graph.colours import ASSUMED, ColourOrder, colour_order
from epypes.graph.compgraph import CompGraph
from epypes.graph.identity import inner_graph, inside_of, is_redefined_inside, redefined, unwrapped
from epypes.graph.placeholder import Placeholder, is_placeholder
from epypes.graph.signature import outputs
from epypes.graph.switch import Switch, as_switch, switch
from epypes.graph.token_annotations import annotated_params
from epypes.graph.validation import Delay

__all__ = [
    "ASSUMED", "ColourOrder", "CompGraph", "Delay", "Placeholder", "Switch", "annotated_params", "as_switch",
    "colour_order", "delay", "extend", "group", "inner_graph", "inside_of", "is_placeholder", "is_redefined_inside",
    "names_of", "needed_for", "outputs", "redefined", "rename", "subgraph", "suffix", "switch", "union", "unwrapped",
    "with_defaults", "with_functions",
]  # fmt: skip

if not TYPE_CHECKING:
    __getattr__ = old_names(__name__)
