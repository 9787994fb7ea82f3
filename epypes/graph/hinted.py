"""Which values do the annotations of a graph's functions allow for a token?"""

from __future__ import annotations

from collections.abc import Iterator

from epypes.graph.compgraph import CompGraph
from epypes.hints import Param, annotated_param


def annotated_params(cg: CompGraph, token: str) -> Iterator[Param]:
    """Give the hints in the annotations of the functions that take a token, in run order."""
    for function in cg.digraph.consumers.get(token, ()):
        found = annotated_param(cg.functions[function], cg.func_inputs(function).index(token))
        if found is not None:
            yield found
