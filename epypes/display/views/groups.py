"""Groups: functions that are drawn as one box.

A group is given by ``ep.group``, or by the names of functions: in a large graph those of one prefix, such as
``left.blur`` and ``left.canny``, are one group. Where that is not enough, stretches of the data's way are groups.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import accumulate
from typing import Final

from epypes.display.views.graphview import EdgeView, FunctionState, FunctionView, GraphView, GroupView, TokenView
from epypes.graph import CompGraph
from epypes.wording import counted

# A graph of so many functions fits on a page; every one that is hidden costs a click.
MOST_SHOWN: Final = 24
# Two functions take hardly more room than the box of their group.
_LEAST_SHARED: Final = 3
_REDEFINED: Final = "redefined inside: build again"
# The state of a group is the first of these that one of its functions is in.
_BY_WEIGHT: Final[tuple[FunctionState, ...]] = (
    "failed", "running", "missing", "stale", "planned", "ran", "reused", "skipped", "not run", "static", "left out",
)  # fmt: skip


def groups_of(functions: Collection[str], given: Mapping[str, Sequence[str]]) -> dict[str, tuple[str, ...]]:
    """Return the groups that a picture can have.

    Parameters
    ----------
    functions
        The names of all functions.
    given
        The groups that were made by ``ep.group``; others are found by the prefixes of names, if the functions are many.
    """
    found = {name: tuple(inside) for name, inside in given.items()}
    if len(functions) <= MOST_SHOWN:
        return found
    grouped = {name for inside in given.values() for name in inside}
    alike: dict[str, list[str]] = {}
    for name in functions:
        prefix, dot, _ = name.partition(".")
        if prefix and dot and name not in grouped:
            alike.setdefault(prefix, []).append(name)
    taken = {*functions, *found}
    found |= {
        prefix: tuple(inside)
        for prefix, inside in alike.items()
        if len(inside) >= _LEAST_SHARED and prefix not in taken
    }
    return found


def outside_tokens(graph: GraphView, groups: Mapping[str, Sequence[str]]) -> frozenset[str]:
    """Return the tokens that are still seen when these groups are drawn as one box each."""
    inside = _inside(graph, _group_by_place(graph, groups))
    return frozenset(token.name for place, token in enumerate(graph.tokens) if place not in inside)


def twice_seen(cg: CompGraph, groups: Mapping[str, Sequence[str]]) -> int:
    """Return how many vertices are seen inside a group and outside too; the boxes of groups are among them."""
    count = 0
    for functions in groups.values():
        names = frozenset(functions)
        tokens = {token for name in names for token in (*cg.func_inputs(name), *cg.func_outputs(name))}
        count += 1
        for token in tokens:
            takers, maker = cg.digraph.consumers.get(token, ()), cg.digraph.producer.get(token)
            count += not (takers and names.issuperset(takers) and (maker is None or maker in names))
    return count


def collapsed(graph: GraphView, groups: Mapping[str, Sequence[str]]) -> GraphView:
    """Draw each group as one box, and give what is inside as graphs of their own.

    Tokens that are made and taken inside, and hyperparameters that are taken inside only, disappear into the box; those
    that come from outside, and those that no function takes, stay.
    """
    group_by_place = _group_by_place(graph, groups)
    if not group_by_place:
        return graph
    hidden = _inside(graph, group_by_place)
    members: dict[str, list[int]] = {}
    for place, name in sorted(group_by_place.items()):
        members.setdefault(name, []).append(place)
    functions: list[FunctionView] = []
    box_by_place: dict[int, int] = {}
    for place, function in enumerate(graph.functions):
        group = group_by_place.get(place)
        if group is None:
            box_by_place[place] = len(functions)
            functions.append(function)
        elif place == members[group][0]:
            box_by_place |= dict.fromkeys(members[group], len(functions))
            tokens = [graph.tokens[token] for token, other in hidden.items() if other == group]
            functions.append(_box(group, [graph.functions[member] for member in members[group]], tokens))
    kept = [token for token in range(len(graph.tokens)) if token not in hidden]
    return replace(
        graph,
        functions=tuple(functions),
        tokens=tuple(graph.tokens[token] for token in kept),
        edges=_outer_edges(graph, group_by_place, box_by_place, {token: new for new, token in enumerate(kept)}),
        groups=tuple(GroupView(name, _part(graph, places, hidden)) for name, places in members.items()),
    )


def _group_by_place(graph: GraphView, groups: Mapping[str, Sequence[str]]) -> dict[int, str]:
    """Return by index of a function the group that it is in."""
    by_function = {function: name for name, inside in groups.items() for function in inside}
    return {
        place: by_function[function.name]
        for place, function in enumerate(graph.functions)
        if function.name in by_function
    }


def _inside(graph: GraphView, group_by_place: Mapping[int, str]) -> dict[int, str]:
    """Return by index the tokens that disappear into a group, and which."""
    around: dict[int, set[str | None]] = {}
    for edge in graph.edges:
        around.setdefault(edge.token, set()).add(group_by_place.get(edge.function))
    is_taken = {edge.token for edge in graph.edges if edge.is_input}
    is_made = {edge.token for edge in graph.edges if not edge.is_input}
    found: dict[int, str] = {}
    for token, groups in around.items():
        (name, *others) = groups
        is_inner = token in is_made or graph.tokens[token].role == "hyperparameter"
        if name is not None and not others and is_inner and token in is_taken:
            found[token] = name
    return dict(sorted(found.items()))


def _outer_edges(
    graph: GraphView, group_by_place: Mapping[int, str], box_by_place: Mapping[int, int], tokens: Mapping[int, int]
) -> tuple[EdgeView, ...]:
    """Return the edges between boxes and the tokens that are still seen, each once."""
    maker = {edge.token: group_by_place.get(edge.function) for edge in graph.edges if not edge.is_input}
    live: dict[tuple[int, bool, int], bool] = {}
    for edge in graph.edges:
        name = group_by_place.get(edge.function)
        is_between_members = edge.is_input and name is not None and maker.get(edge.token) == name
        if edge.token in tokens and not is_between_members:
            key = box_by_place[edge.function], edge.is_input, tokens[edge.token]
            live[key] = live.get(key, False) or edge.is_live
    in_order = sorted(live, key=lambda key: (key[0], not key[1]))
    return tuple(EdgeView(key[0], key[2], key[1], live[key]) for key in in_order)


def _box(name: str, inside: Sequence[FunctionView], hidden: Iterable[TokenView]) -> FunctionView:
    state = min((function.state for function in inside), key=_BY_WEIGHT.index)
    durations = [function.duration_ns for function in inside if function.duration_ns is not None]
    is_redefined = any(function.is_redefined for function in inside)
    hyperparameters = sum(token.role == "hyperparameter" for token in hidden)
    placeholders = sum(function.kind == "placeholder" for function in inside)
    notes = (
        counted(len(inside), "function"),
        *(f"{counted(hyperparameters, 'hyperparameter')} inside",) * bool(hyperparameters),
        *(f"{placeholders} to be written",) * bool(placeholders),
        *(_REDEFINED,) * is_redefined,
    )
    return FunctionView(
        name,
        state,
        sum(durations) if durations else None,
        sum(function.share for function in inside),
        _message(state, inside),
        "group",
        notes,
        is_redefined,
    )


def _message(state: FunctionState, inside: Sequence[FunctionView]) -> str:
    """Say which function of a group has failed, or of how many functions the group's state is true."""
    alike = [function for function in inside if function.state == state]
    if state == "failed":
        return f"{alike[0].name}: {alike[0].message}"
    return f"{len(alike)} of {len(inside)} functions" if len(alike) < len(inside) else ""


def _part(graph: GraphView, places: Collection[int], hidden: Mapping[int, str]) -> GraphView:
    """Return some functions with the tokens that they take and make.

    A token that is seen outside has its thumbnail there: none is carried twice.
    """
    new_function = {place: new for new, place in enumerate(places)}
    edges = [edge for edge in graph.edges if edge.function in new_function]
    new_token = {token: new for new, token in enumerate(sorted({edge.token for edge in edges}))}
    names = {graph.tokens[token].name for token in new_token}
    tokens = []
    for place in new_token:
        token = graph.tokens[place]
        if place not in hidden and token.preview is not None:
            token = token._replace(preview=replace(token.preview, picture=None, chart=None, rows=()))
        tokens.append(token)
    return GraphView(
        tuple(graph.functions[place] for place in places),
        tuple(tokens),
        tuple(edge._replace(function=new_function[edge.function], token=new_token[edge.token]) for edge in edges),
        direction=graph.direction,
        delays=tuple(pair for pair in graph.delays if names.issuperset(pair)),
    )


def function_count(graph: GraphView) -> int:
    """Return how many functions there are, those inside groups included."""
    return len(graph.functions) + sum(len(group.graph.functions) - 1 for group in graph.groups)


# -- stretches of a graph that is too large for a page ----------------------------------------------------------------

# The functions of a large graph become so many boxes, roughly.
_BOXES: Final = 10


def folded(cg: CompGraph, grouped: Collection[str]) -> dict[str, tuple[str, ...]]:
    """Return groups of the functions that are in none: stretches of the way that the data takes.

    They are cut from an order in which each function follows what it depends on, so no two depend on each other, and
    branches come one after the other: where a branch ends, else where few tokens go from one to the next.
    """
    makers = {
        name: {cg.digraph.producer[token] for token in cg.func_inputs(name) if token in cg.digraph.producer}
        for name in cg.functions
    }
    order = [name for name in _depth_first(cg, makers) if name not in grouped]
    place = {name: index for index, name in enumerate(order)}
    # By place, how many tokens go from what is before it to it and what is after it.
    changes = [0] * (len(order) + 2)
    for token, maker in cg.digraph.producer.items():
        last = max((place.get(name, 0) for name in cg.digraph.consumers.get(token, ())), default=0)
        if place.get(maker, last) < last:
            changes[place[maker] + 1] += 1
            changes[last + 1] -= 1
    passing = list(accumulate(changes))
    usual, start, groups = max(2, -(-len(order) // _BOXES)), 0, dict[str, tuple[str, ...]]()

    def badness(end: int) -> tuple[bool, int, int]:
        return order[end - 1] in makers[order[end]], passing[end], abs(end - start - usual)

    while start < len(order):
        # The last stretch may be longer, rather than a short one more.
        longest = usual + usual // 2
        is_last = len(order) - start <= longest
        end = len(order) if is_last else min(range(start + (usual + 1) // 2, start + longest + 1), key=badness)
        if end - start > 1:
            groups[f"{order[start]} … {order[end - 1]}"] = tuple(order[start:end])
        start = end
    return groups


def _depth_first(cg: CompGraph, makers: dict[str, set[str]]) -> list[str]:
    """Return the functions, each after all that it depends on, and as soon after the last of these as can be."""
    left = {name: len(before) for name, before in makers.items()}
    ready, order = [name for name in reversed(list(cg.functions)) if not left[name]], list[str]()
    while ready:
        name = ready.pop()
        order.append(name)
        takers = (taker for token in cg.func_outputs(name) for taker in cg.digraph.consumers.get(token, ()))
        for taker in reversed(dict.fromkeys(takers)):
            left[taker] -= 1
            if not left[taker]:
                ready.append(taker)
    return order
