"""How does a graph get other names?"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from epypes.errors import Finding, GraphError, UnknownName, require_mapping
from epypes.graph.compgraph import CompGraph
from epypes.graph.parts import Default, Parts, defaults_of, groups_of


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
    require_graph("rename()", cg)
    functions = _checked("functions", functions)
    tokens = _checked("tokens", tokens)
    for name in functions:
        cg.require_function(name)
    for name in tokens:
        cg.require_token(name)
    parts = _renamed(cg, functions, tokens)
    if parts.findings:
        raise GraphError(parts.findings)
    return CompGraph._assemble(parts, cg.types)


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
    require_graph("suffix()", cg)
    kept = names_of("keep", keep)
    require_names(kept, [cg], "in this graph")
    parts = suffixed(cg, ending, kept)
    if parts.findings:
        raise GraphError(parts.findings)
    return CompGraph._assemble(parts, cg.types)


def suffixed(cg: CompGraph, ending: str, keep: Iterable[str]) -> Parts:
    """Return the parts of a graph with an ending on every name that is not kept."""
    if not isinstance(ending, str):
        raise TypeError(f'A suffix must be a string, such as "_1", not {ending!r}.')
    kept = frozenset(keep)
    parts = _renamed(
        cg,
        {name: name + ending for name in cg.functions if name not in kept},
        {token: token + ending for token in cg.tokens if token not in kept},
    )
    # A function that is kept is shared with other graphs, so it stays in the group of the old name.
    groups = {name: group + ending * (name not in kept) for name, group in groups_of(cg).items()}
    parts.groups.update((name if name in kept else name + ending, group) for name, group in groups.items())
    return parts


def _renamed(cg: CompGraph, functions: Mapping[str, str], tokens: Mapping[str, str]) -> Parts:
    """Return the parts of a graph under new names; names that become one are findings."""
    findings = [*_collisions("function", cg.functions, functions), *_collisions("token", cg.tokens, tokens)]
    new = {name: functions.get(name, name) for name in cg.functions}
    return Parts(
        {new[name]: function for name, function in cg.functions.items()},
        {new[name]: (_side(given, tokens), _side(made, tokens)) for name, (given, made) in cg.func_io.items()},
        [Default(tokens.get(token, token), value, new[name]) for token, value, name in defaults_of(cg)],
        findings,
        {new[name]: group for name, group in groups_of(cg).items()},
    )


def _side(side: Any, tokens: Mapping[str, str]) -> Any:
    if isinstance(side, tuple):
        return tuple([tokens.get(token, token) for token in side])
    return tokens.get(side, side)


def _collisions(kind: str, names: Iterable[str], new: Mapping[str, str]) -> Iterable[Finding]:
    first: dict[str, str] = {}
    for name in names:
        target = new.get(name, name)
        other = first.setdefault(target, name)
        if other != name:
            text = f"The {kind}s {other!r} and {name!r} would both be called {target!r}. Choose another name for one."
            yield Finding("one name", text, (other, name, target))


def _checked(what: str, names: Mapping[str, str] | None) -> Mapping[str, str]:
    if names is None:
        return {}
    require_mapping(what, names, "from old to new names")
    for old, new in names.items():
        if not isinstance(new, str) or not new:
            raise TypeError(f"The new name of {old!r} must be a string that is not empty, not {new!r}.")
    return names


def names_of(what: str, names: str | Iterable[str]) -> tuple[str, ...]:
    """Return one name or several as a tuple."""
    if isinstance(names, str):
        return (names,)
    if not isinstance(names, Iterable):
        raise TypeError(f"{what} must be a name or an iterable of names, not {type(names).__name__!r}.")
    return tuple(names)


def require_names(names: Iterable[str], graphs: Iterable[CompGraph], where: str) -> None:
    """Raise UnknownName, with the nearest name, unless each is that of a function or token in one of the graphs."""
    known = dict.fromkeys(name for cg in graphs for name in (*cg.functions, *cg.tokens)) if names else {}
    for name in names:
        if name not in known:
            raise UnknownName("function or token", name, known, where)


def require_graph(what: str, cg: object) -> None:
    """Raise unless this is a graph, with the way to the graph of a runner or a pipeline."""
    if not isinstance(cg, CompGraph):
        way_out = "Give its graph: .cg." if hasattr(cg, "cg") else "Make one with ep.CompGraph(func_dict, func_io)."
        raise TypeError(f"{what} takes computational graphs, not {type(cg).__name__!r}. {way_out}")
