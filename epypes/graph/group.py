"""How are functions of a graph drawn as one box?"""

from __future__ import annotations

from collections.abc import Iterable

from epypes.errors import Finding, GraphError
from epypes.graph.compgraph import CompGraph
from epypes.graph.parts import Parts
from epypes.graph.renaming import names_of, require_graph


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
    require_graph("group()", cg)
    if not isinstance(name, str) or not name:
        raise TypeError(f"The name of a group must be a string that is not empty, not {name!r}.")
    inside = names_of("functions", functions)
    for function in inside:
        cg.require_function(function)
    parts = Parts.of(cg)
    findings = list(_findings(cg, name, inside, parts.groups))
    if findings:
        raise GraphError(findings)
    parts.groups.update(dict.fromkeys(inside, name))
    return CompGraph._assemble(parts, cg.types)


def _findings(cg: CompGraph, name: str, inside: tuple[str, ...], groups: dict[str, str]) -> Iterable[Finding]:
    if not inside:
        text = f"The group {name!r} would have no function. Name at least one: functions=[...]."
        yield Finding("groups", text, (name,))
    if name in cg.groups:
        text = f"There is a group {name!r} already, of {', '.join(cg.groups[name])}. Choose another name."
        yield Finding("groups", text, (name,))
    for function in dict.fromkeys(inside):
        if function in groups:
            other = groups[function]
            text = f"Function {function!r} is in the group {other!r} already. A function is in one group at most."
            yield Finding("groups", text, (function, other))
