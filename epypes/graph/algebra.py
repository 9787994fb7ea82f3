"""Algebra of graphs: union, extension, renaming, subgraphs, groups and delays, each of which makes a new graph."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from epypes.errors import Finding, GraphError, InvalidType, InvalidValue, UnknownName, require_mapping
from epypes.graph.compgraph import CompGraph, FuncIO
from epypes.graph.identity import have_one_name, is_same_default, is_same_function
from epypes.graph.placeholder import is_placeholder
from epypes.graph.validation import Default, Delay, GraphParts


def union(*graphs: CompGraph, suffixes: Sequence[str] | None = None, keep: str | Iterable[str] = ()) -> CompGraph:
    """Join graphs: tokens of one name are one token. ``g1 | g2`` is the same.

    Functions of one name must be the same function with the same io, and are then one.

    Parameters
    ----------
    graphs
        The graphs; their order is the order of definition.
    suffixes
        One per graph, added to the names of its functions and tokens: so a graph can be joined to itself.
    keep
        Functions and tokens that get no suffix, since they are shared.

    Raises
    ------
    GraphError
        With every problem of the result.
    UnknownName
        No graph has a name in ``keep``.
    ValueError
        There are not as many suffixes as graphs.

    Examples
    --------
    >>> one = CompGraph({"f": lambda x, k: x + k}, {"f": (("x", "k"), "y")})
    >>> union(one, one, suffixes=("_1", "_2"), keep="k").tokens
    ('x_1', 'k', 'y_1', 'x_2', 'y_2')
    """
    for cg in graphs:
        _require_graph("union()", cg)
    kept = names_of("keep", keep)
    _require_names(kept, graphs, "to keep in these graphs")
    if suffixes is None:
        parts = [cg._parts() for cg in graphs]
    elif isinstance(suffixes, str) or not isinstance(suffixes, Sequence) or len(suffixes) != len(graphs):
        text = f"union() of {len(graphs)} graphs needs a sequence of {len(graphs)} suffixes, one per graph, not "
        raise InvalidValue(f"{text}{suffixes!r}.")
    else:
        parts = [_suffixed(cg, ending, kept) for cg, ending in zip(graphs, suffixes, strict=True)]
    merged = GraphParts(types=all(cg.types for cg in graphs))
    for part in parts:
        _merge(merged, part)
    return CompGraph._of(merged)


def _merge(merged: GraphParts, part: GraphParts) -> None:
    """Add a part; a function or group that is there already is added to the findings unless it is the same."""
    merged.findings.extend(part.findings)
    merged.defaults.extend(part.defaults)
    for previous, delayed in part.delays.items():
        first = merged.delays.setdefault(previous, delayed)
        if first.token != delayed.token or not is_same_default(first.initial, delayed.initial):
            text = (
                f"Token {previous!r} is the previous value of {first.token!r} in one graph and of {delayed.token!r} in "
                "another, or begins with another value there. Rename one of them with ep.rename()."
            )
            merged.findings.append(Finding("delay", text, (previous, first.token, delayed.token)))
    for name, group_name in part.groups.items():
        other = merged.groups.setdefault(name, group_name)
        if other != group_name:
            text = (
                f"Function {name!r} is in the group {other!r} of one graph and in {group_name!r} of another. "
                "Group the functions after the union, or rename one of the functions with ep.rename()."
            )
            merged.findings.append(Finding("groups", text, (name, other, group_name)))
    for name, function in part.functions.items():
        if name not in merged.functions:
            merged.functions[name], merged.func_io[name] = function, part.func_io[name]
            continue
        known, known_io, io = merged.functions[name], merged.func_io[name], part.func_io[name]
        # ("x", "y") and (("x",), "y") are one io; "y" and ("y",) are not one output.
        is_same_io = known_io[1] == io[1] and names_of("inputs", known_io[0]) == names_of("inputs", io[0])
        if is_same_io and is_same_function(known, function):
            continue
        text = f"Two graphs have a function {name!r}, with another callable or io. "
        if known is not function and have_one_name(known, function):
            text += "It was defined again in between: build both graphs anew. If both are meant: "
        text += "Rename one of them with ep.rename(), or give union() suffixes."
        merged.findings.append(Finding("two functions", text, (name,)))


def extend(cg: CompGraph, func_dict: Mapping[str, Callable[..., Any]], func_io: FuncIO | None = None) -> CompGraph:
    """Fill placeholders of a graph, and add functions to it.

    Parameters
    ----------
    cg
        The graph; it stays as it is.
    func_dict
        Functions by name. One that is called like a placeholder fills it, any other is added.
    func_io
        Their io, as for CompGraph. That of a placeholder is kept unless another is given.

    Raises
    ------
    GraphError
        With every problem of the result; a function that is no placeholder is not replaced.

    Examples
    --------
    >>> from epypes.graph import Placeholder
    >>> sketch = CompGraph({"f": Placeholder()}, {"f": ("x", "y")})
    >>> extend(sketch, {"f": abs}).placeholders
    ()
    """
    _require_graph("extend()", cg)
    func_io = {} if func_io is None else func_io
    for what, given in (("func_dict", func_dict), ("func_io", func_io)):
        require_mapping(what, given, "by function name")
    parts = cg._parts()
    for name in dict.fromkeys([*func_dict, *func_io]):
        if name in cg.functions and not is_placeholder(cg.functions[name]):
            text = (
                f"Function {name!r} of the graph is not a placeholder, so extend() does not replace it. "
                "Give the new function another name, or make the graph anew."
            )
            parts.findings.append(Finding("not a placeholder", text, (str(name),)))
            continue
        if name in func_dict:
            parts.functions[name] = func_dict[name]
        if name in func_io:
            parts.func_io[name] = func_io[name]
    return CompGraph._of(parts)


def subgraph(cg: CompGraph, targets: str | Iterable[str]) -> CompGraph:
    """Return the graph of the functions that tokens need, every branch of a switch and every delayed token included.

    Parameters
    ----------
    cg
        The graph; it stays as it is.
    targets
        A token, or several.

    Raises
    ------
    UnknownName
        The graph has no such token.

    Examples
    --------
    >>> cg = CompGraph({"f": abs, "g": abs}, {"f": ("x", "y"), "g": ("y", "z")})
    >>> list(subgraph(cg, "y").functions)
    ['f']
    """
    _require_graph("subgraph()", cg)
    found, needed = needed_for(cg, names_of("targets", targets))
    parts = cg._parts()
    for token in [token for token in parts.delays if token not in found]:
        del parts.delays[token]
    for name in [name for name in parts.functions if name not in needed]:
        del parts.functions[name], parts.func_io[name]
        parts.groups.pop(name, None)
    return CompGraph._of(parts)


def needed_for(cg: CompGraph, targets: Iterable[str]) -> tuple[set[str], set[str]]:
    """Return the tokens and the functions that tokens need, as ``subgraph`` does.

    Raises
    ------
    UnknownName
        The graph has no such token.
    """
    pending = list(targets)
    for token in pending:
        cg.require_token(token)
    needed: set[str] = set()
    found = set(pending)
    while pending:
        token = pending.pop()
        function = cg.digraph.producer.get(token)
        read = [cg.delays[token].token] if token in cg.delays else []
        if function is not None and function not in needed:
            needed.add(function)
            read.extend(cg.digraph.inputs[function])
        pending.extend(other for other in read if other not in found)
        found.update(read)
    return found, needed


def rename(
    cg: CompGraph, functions: Mapping[str, str] | None = None, tokens: Mapping[str, str] | None = None
) -> CompGraph:
    """Give functions and tokens of a graph other names.

    Parameters
    ----------
    cg
        The graph; it stays as it is.
    functions, tokens
        New names by old ones. All change at once, so two can exchange their names.

    Raises
    ------
    GraphError
        Two functions or two tokens would have one name.
    UnknownName
        The graph has no such function or token.

    Examples
    --------
    >>> cg = CompGraph({"f": abs}, {"f": ("x", "y")})
    >>> rename(cg, tokens={"y": "size"}).tokens
    ('x', 'size')
    """
    _require_graph("rename()", cg)
    functions, tokens = functions or {}, tokens or {}
    for what, names, require in (
        ("functions", functions, cg.require_function),
        ("tokens", tokens, cg.require_token),
    ):
        require_mapping(what, names, "from old to new names")
        for old, new in names.items():
            require(old)
            if not isinstance(new, str) or not new:
                raise InvalidType(f"The new name of {old!r} must be a string that is not empty, not {new!r}.")
    return _built(_renamed(cg, functions, tokens))


def suffix(cg: CompGraph, ending: str, keep: str | Iterable[str] = ()) -> CompGraph:
    """Add an ending to the names of all functions and tokens of a graph.

    Parameters
    ----------
    cg
        The graph; it stays as it is.
    ending
        Such as ``"_1"``.
    keep
        Functions and tokens that keep their name.

    Raises
    ------
    GraphError
        A new name is that of something that is kept.
    UnknownName
        The graph has no name that is in ``keep``.

    Examples
    --------
    >>> cg = CompGraph({"f": lambda x, k: x}, {"f": (("x", "k"), "y")})
    >>> suffix(cg, "_1", keep="k").func_io["f_1"]
    (('x_1', 'k'), 'y_1')
    """
    _require_graph("suffix()", cg)
    kept = names_of("keep", keep)
    _require_names(kept, [cg], "in this graph")
    return _built(_suffixed(cg, ending, kept))


def _suffixed(cg: CompGraph, ending: str, keep: Iterable[str]) -> GraphParts:
    """Return the parts of a graph with an ending on every name that is not kept, those of its groups included."""
    if not isinstance(ending, str):
        raise InvalidType(f'A suffix must be a string, such as "_1", not {ending!r}.')
    kept = frozenset(keep)
    parts = _renamed(
        cg,
        {name: name + ending for name in cg.functions if name not in kept},
        {token: token + ending for token in cg.tokens if token not in kept},
    )
    # A function that is kept is shared with other graphs, so it stays in the group of the old name.
    groups = {name: group if name in kept else group + ending for name, group in parts.groups.items()}
    return replace(parts, groups=groups)


def _renamed(cg: CompGraph, functions: Mapping[str, str], tokens: Mapping[str, str]) -> GraphParts:
    """Return the parts of a graph under new names; names that become one are findings."""
    findings = [*_collisions("function", cg.functions, functions), *_collisions("token", cg.tokens, tokens)]
    parts = cg._parts()
    new = {name: functions.get(name, name) for name in cg.functions}

    def renamed_side(side: Any) -> Any:
        return tuple(map(renamed_side, side)) if isinstance(side, tuple) else tokens.get(side, side)

    return GraphParts(
        {new[name]: function for name, function in parts.functions.items()},
        {new[name]: renamed_side(io) for name, io in parts.func_io.items()},
        [Default(tokens.get(token, token), value, new[name]) for token, value, name in parts.defaults],
        {new[name]: group for name, group in parts.groups.items()},
        parts.types,
        findings,
        {
            tokens.get(token, token): Delay(tokens.get(delayed, delayed), initial)
            for token, (delayed, initial) in parts.delays.items()
        },
    )


def _collisions(kind: str, names: Iterable[str], new: Mapping[str, str]) -> Iterable[Finding]:
    first: dict[str, str] = {}
    for name in names:
        target = new.get(name, name)
        other = first.setdefault(target, name)
        if other != name:
            text = f"The {kind}s {other!r} and {name!r} would both be called {target!r}. Choose another name for one."
            yield Finding("one name", text, (other, name, target))


def group(cg: CompGraph, name: str, functions: str | Iterable[str]) -> CompGraph:
    """Group functions of a graph: it is drawn with one box for them, which opens.

    Groups are for the eye only: nothing runs otherwise, and no name is changed.

    Parameters
    ----------
    cg
        The graph; it stays as it is.
    name
        What stands on the box. ``union`` with suffixes and ``suffix`` add theirs to it.
    functions
        The functions inside.

    Raises
    ------
    GraphError
        There is no function in it; one is in another group already; a group, or a function outside it, is called so.
    UnknownName
        The graph has no such function.

    Examples
    --------
    >>> cg = CompGraph({"f": abs, "g": abs}, {"f": ("x", "y"), "g": ("y", "z")})
    >>> dict(group(cg, "both", functions=["f", "g"]).groups)
    {'both': ('f', 'g')}
    """
    _require_graph("group()", cg)
    if not isinstance(name, str) or not name:
        raise InvalidType(f"The name of a group must be a string that is not empty, not {name!r}.")
    inside = dict.fromkeys(names_of("functions", functions))
    for function in inside:
        cg.require_function(function)
    parts = cg._parts()
    if not inside:
        text = f"The group {name!r} would have no function. Name at least one: functions=[...]."
        parts.findings.append(Finding("groups", text, (name,)))
    if name in cg.groups:
        text = f"There is a group {name!r} already, of {', '.join(cg.groups[name])}. Choose another name."
        parts.findings.append(Finding("groups", text, (name,)))
    for function in inside:
        if function in parts.groups:
            other = parts.groups[function]
            text = f"Function {function!r} is in the group {other!r} already. A function is in one group at most."
            parts.findings.append(Finding("groups", text, (function, other)))
        parts.groups[function] = name
    return _built(parts)


def delay(cg: CompGraph, token: str, previous: str, initial: Any = None) -> CompGraph:
    """Add a unit delay to a graph: state between its runs, as the unit delay of Simulink and ``pre`` of Lustre.

    In each run the source token ``previous`` has the value that ``token`` had at the end of the last completed run, and
    ``initial`` in the first one. A ``rerun`` and a ``trial`` see the same previous value as the run that they repeat. A
    run that fails, does not compute ``token``, or for which it is ``Nothing``, leaves the state as it was.

    Parameters
    ----------
    cg
        The graph; it stays as it is.
    token
        Any token of the graph.
    previous
        A source token of the graph. It is then neither free nor a hyperparameter.
    initial
        The value of ``previous`` in the first run, and after ``runner.reset()``.

    Raises
    ------
    GraphError
        A function makes ``previous``, it is delayed already, or it is ``token`` itself.
    UnknownName
        The graph has no such token.

    Examples
    --------
    >>> cg = CompGraph({"add": lambda x, before: x + before}, {"add": (("x", "before"), "total")})
    >>> delay(cg, "total", "before", initial=0).delays["before"]
    Delay(token='total', initial=0)
    """
    _require_graph("delay()", cg)
    for name in (token, previous):
        cg.require_token(name)
    parts = cg._parts()
    if previous in cg.delays:
        known = cg.delays[previous].token
        text = f"Token {previous!r} is the previous value of {known!r} already. Read another token, or build it anew."
        parts.findings.append(Finding("delay", text, (previous, known, token)))
    parts.delays[previous] = Delay(token, initial)
    return _built(parts)


def with_functions(cg: CompGraph, functions: Mapping[str, Callable[..., Any]]) -> CompGraph:
    """Return the graph with other callables in place of all its functions, such as nodes that wrap them.

    Parameters
    ----------
    cg
        The graph; it stays as it is.
    functions
        A callable for every function, by name.
    """
    return CompGraph._of(replace(cg._parts(), functions=dict(functions)))


def with_defaults(cg: CompGraph, values: Mapping[str, Any]) -> CompGraph:
    """Return the graph with other defaults.

    Parameters
    ----------
    cg
        The graph; it stays as it is.
    values
        By source token; others are passed over.
    """
    readers = cg.digraph.consumers
    defaults = [Default(token, value, readers[token][0]) for token, value in values.items() if token in readers]
    return CompGraph._of(replace(cg._parts(), defaults=defaults))


def _built(parts: GraphParts) -> CompGraph:
    """Make a graph of parts, unless something is wrong with them already: what follows from that is not reported."""
    if parts.findings:
        raise GraphError(parts.findings)
    return CompGraph._of(parts)


def names_of(what: str, names: str | Iterable[str]) -> tuple[str, ...]:
    """Return one name or several as a tuple; ``what`` is the argument, for the error."""
    if isinstance(names, str):
        return (names,)
    if not isinstance(names, Iterable):
        raise InvalidType(f"{what} must be a name or an iterable of names, not {type(names).__name__!r}.")
    return tuple(names)


def _require_names(names: Iterable[str], graphs: Iterable[CompGraph], where: str) -> None:
    """Raise UnknownName, with the nearest name, unless each is that of a function or token in one of the graphs."""
    known = dict.fromkeys(name for cg in graphs for name in (*cg.functions, *cg.tokens))
    for name in names:
        if name not in known:
            raise UnknownName("function or token", name, known, where)


def _require_graph(what: str, cg: object) -> None:
    """Raise unless this is a graph, with the way to the graph of a runner or a pipeline."""
    if not isinstance(cg, CompGraph):
        way_out = "Give its graph: .cg." if hasattr(cg, "cg") else "Make one with ep.CompGraph(func_dict, func_io)."
        raise InvalidType(f"{what} takes computational graphs, not {type(cg).__name__!r}. {way_out}")
