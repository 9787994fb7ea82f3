"""Which states of a graph can be told only beside its runs: what is being run, what has changed since it was made?"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Any, Final

from epypes.display.markup import short_name
from epypes.display.previews.preview import preview
from epypes.display.views.graphview import GraphView, TokenView
from epypes.display.views.structure import with_caption
from epypes.run.staleness import is_same_value

_NAMED: Final = 8


def with_running(graph: GraphView, running: Collection[str]) -> GraphView:
    """Return a view in which these functions are being run."""
    if not running:
        return graph
    functions = tuple(
        replace(function, state="running", message="", duration_ns=None, share=0.0)
        if function.name in running
        else function
        for function in graph.functions
    )
    more = f" and {len(running) - _NAMED} more" * (len(running) > _NAMED)
    named = ", ".join(map(short_name, list(running)[:_NAMED])) + more
    return replace(graph, functions=functions, caption=with_caption(f"running: {named}", graph))


def with_first(graph: GraphView, values: Mapping[str, Any], first: Mapping[str, Any]) -> GraphView:
    """Return a view in which hyperparameters that have another value than their first one tell that."""
    changed = {
        token: first[token]
        for token, value in values.items()
        if token in first and first[token] is not value and not is_same_value(first[token], value)
    }
    if not changed:
        return graph
    return replace(graph, tokens=tuple(_with_first(token, changed) for token in graph.tokens))


def _with_first(token: TokenView, changed: Mapping[str, Any]) -> TokenView:
    if token.name not in changed:
        return token
    return replace(token, first=preview(changed[token.name], token.order).text)
