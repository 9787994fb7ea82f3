"""What is to be seen of a graph whatever has been run: its parts, the branches chosen, what is to be written or old?"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from typing import Any, Final
from weakref import WeakKeyDictionary

from epypes.display.markup import cut
from epypes.display.previews.preview import preview
from epypes.display.views.graphview import EdgeView, FunctionState, FunctionView, GraphView, TokenView
from epypes.display.views.source import graph_lines, signature_and_source
from epypes.graph import CompGraph, Switch, as_switch, colour_order, inner_graph, is_redefined_inside, redefined
from epypes.wording import counted

TO_BE_WRITTEN: Final = "to be written"
_REDEFINED: Final = "redefined since: build the graph again"
_REDEFINED_INSIDE: Final = "a function inside was redefined: build again"
_SELECTOR_CHARACTERS: Final = 20
_KEY_CHARACTERS: Final = 16
_NAMED: Final = 3
# By graph the last structure, with what it depends on: a run changes values, and rarely more.
_kept: WeakKeyDictionary[CompGraph, tuple[tuple[Any, ...], GraphView]] = WeakKeyDictionary()


def structure_of(cg: CompGraph, branches: Mapping[str, Any], left_out: Collection[str]) -> GraphView:
    """Look at a graph.

    Parameters
    ----------
    branches
        By switch, the key of the chosen branch; a switch that has not chosen is not in it.
    left_out
        The functions that are not needed; they, and the tokens that only they make or take, get this state.
    """
    old = tuple((name, is_redefined_inside(cg.functions[name])) for name in redefined(cg))
    key = old, tuple(branches.items()), tuple(left_out)
    kept = _kept.get(cg)
    if kept is None or kept[0] != key:
        kept = _kept[cg] = key, _structure(cg, branches, left_out, frozenset(name for name, _ in old))
    return kept[1]


def _structure(cg: CompGraph, branches: Mapping[str, Any], left_out: Collection[str], old: frozenset[str]) -> GraphView:
    unread = {name: _unread(cg, name, branches) for name in cg.switches}
    return GraphView(
        tuple(_function_view(cg, name, branches, name in left_out, name in old) for name in cg.functions),
        tuple(_token_view(cg, token, branches, left_out, unread) for token in cg.tokens),
        tuple(_edges(cg, left_out, unread)),
        _redefined_caption(cg, [name for name in cg.functions if name in old]),
    )


def _unread(cg: CompGraph, name: str, branches: Mapping[str, Any]) -> frozenset[str]:
    """Return the tokens of the branches that a switch does not read: all as long as it has not chosen."""
    selector, *tokens = cg.func_inputs(name)
    read = {selector}
    function = as_switch(cg.functions[name])
    if function is not None and name in branches:
        read.add(tokens[function.branch_index(branches[name])])
    return frozenset(tokens) - read


def _function_view(
    cg: CompGraph, name: str, branches: Mapping[str, Any], is_left_out: bool, is_redefined: bool
) -> FunctionView:
    state: FunctionState = "left out" if is_left_out else "static"
    function = as_switch(cg.functions[name])
    if function is not None:
        return FunctionView(name, state, kind="switch", notes=(_choice(cg, name, function, branches),))
    if name in cg.placeholders:
        return FunctionView(name, state, kind="placeholder", notes=(TO_BE_WRITTEN,))
    inner, inside = inner_graph(cg.functions[name]), is_redefined and is_redefined_inside(cg.functions[name])
    old = (_REDEFINED_INSIDE if inside else _REDEFINED,) * is_redefined
    if inner is None:
        signature, source = signature_and_source(cg.functions[name])
        return FunctionView(name, state, notes=old, is_redefined=is_redefined, signature=signature, source=source)
    note = f"pipeline of {counted(len(inner.functions), 'function')}"
    return FunctionView(
        name, state, kind="pipeline", notes=(note, *old), is_redefined=is_redefined, source=graph_lines(inner)
    )


def _choice(cg: CompGraph, name: str, function: Switch, branches: Mapping[str, Any]) -> str:
    selector = cut(cg.func_inputs(name)[0], _SELECTOR_CHARACTERS)
    if name not in branches:
        return f"one of {len(function.branches)} by {selector}"
    key = branches[name]
    return f"{selector} = {cut(key if isinstance(key, str) else preview(key).text, _KEY_CHARACTERS)}"


def _token_view(
    cg: CompGraph,
    token: str,
    branches: Mapping[str, Any],
    left_out: Collection[str],
    unread: Mapping[str, frozenset[str]],
) -> TokenView:
    maker = cg.digraph.producer.get(token)
    if maker is not None:
        is_left_out = maker in left_out
    else:
        is_left_out = all(
            name in left_out or (name in branches and token in unread[name]) for name in cg.digraph.consumers[token]
        )
    return TokenView(token, "payload", "left out" if is_left_out else "static", order=colour_order(cg, token))


def _edges(cg: CompGraph, left_out: Collection[str], unread: Mapping[str, frozenset[str]]) -> Iterator[EdgeView]:
    place = {token: index for index, token in enumerate(cg.tokens)}
    for index, name in enumerate(cg.functions):
        is_needed, closed = name not in left_out, unread.get(name, frozenset())
        for token in dict.fromkeys(cg.func_inputs(name)):
            yield EdgeView(index, place[token], True, is_needed and token not in closed)
        for token in dict.fromkeys(cg.func_outputs(name)):
            yield EdgeView(index, place[token], False, is_needed)


def _redefined_caption(cg: CompGraph, names: list[str]) -> str:
    if not names:
        return ""
    some = ", ".join(_redefined_name(cg, name) for name in names[:_NAMED])
    some = some[0].upper() + some[1:]
    more = f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
    verb = "was" if len(names) == 1 else "were"
    return f"{some}{more} {verb} redefined since the graph was built: run the cell that builds it again"


def _redefined_name(cg: CompGraph, name: str) -> str:
    inside = "a function inside " * is_redefined_inside(cg.functions[name])
    return f"{inside}{cut(name, _SELECTOR_CHARACTERS)!r}"


def with_caption(text: str, structure: GraphView) -> str:
    """Return a caption that begins with this text and goes on with the structure's own."""
    return f"{text}. {structure.caption}" if structure.caption else text
