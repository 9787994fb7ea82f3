"""How do graphs become a larger graph, or a smaller one?"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from types import MethodType
from typing import TYPE_CHECKING, Any

from epypes.errors import Finding, require_mapping
from epypes.graph.compgraph import CompGraph
from epypes.graph.parts import Default, Parts, defaults_of, groups_of
from epypes.graph.placeholder import is_placeholder
from epypes.graph.redefined import have_one_name, is_defined_alike
from epypes.graph.renaming import names_of, require_graph, require_names, suffixed

if TYPE_CHECKING:
    from epypes.graph.compgraph import FuncIO


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
        require_graph("union()", cg)
    kept = names_of("keep", keep)
    require_names(kept, graphs, "to keep in these graphs")
    parts = [Parts.of(cg) for cg in graphs] if suffixes is None else _suffixed(graphs, suffixes, kept)
    merged = Parts()
    for part in parts:
        _merge(merged, part)
    return CompGraph._assemble(merged, all(cg.types for cg in graphs))


def _suffixed(graphs: Sequence[CompGraph], suffixes: Sequence[str], keep: Sequence[str]) -> list[Parts]:
    if isinstance(suffixes, str) or not isinstance(suffixes, Sequence) or len(suffixes) != len(graphs):
        text = f"union() of {len(graphs)} graphs needs a sequence of {len(graphs)} suffixes, one per graph, not "
        raise ValueError(f"{text}{suffixes!r}.")
    return [suffixed(cg, ending, keep) for cg, ending in zip(graphs, suffixes, strict=True)]


def _merge(merged: Parts, part: Parts) -> None:
    """Add a part; a function that is there already is added to the findings unless it is the same."""
    merged.findings.extend(part.findings)
    merged.defaults.extend(part.defaults)
    _merge_groups(merged, part)
    for name, function in part.functions.items():
        if name not in merged.functions:
            merged.functions[name], merged.func_io[name] = function, part.func_io[name]
        elif not _is_same(merged.functions[name], function) or not _is_same_io(
            merged.func_io[name], part.func_io[name]
        ):
            text = f"Two graphs have a function {name!r}, with another callable or io. "
            if merged.functions[name] is not function and have_one_name(merged.functions[name], function):
                text += "It was defined again in between: build both graphs anew. If both are meant: "
            text += "Rename one of them with ep.rename(), or give union() suffixes."
            merged.findings.append(Finding("two functions", text, (name,)))


def _merge_groups(merged: Parts, part: Parts) -> None:
    """Add the groups of a part; those of one name are one."""
    for function, name in part.groups.items():
        other = merged.groups.setdefault(function, name)
        if other != name:
            text = (
                f"Function {function!r} is in the group {other!r} of one graph and in {name!r} of another. "
                "Group the functions after the union, or rename one of the functions with ep.rename()."
            )
            merged.findings.append(Finding("groups", text, (function, other, name)))


def _is_same_io(left: Any, right: Any) -> bool:
    # ("x", "y") and (("x",), "y") are one io; "y" and ("y",) are not one output.
    return names_of("inputs", left[0]) == names_of("inputs", right[0]) and bool(left[1] == right[1])


def _is_same(left: Any, right: Any) -> bool:
    # A bound method is a new object each time it is read; two are equal if they are bound to one object.
    if type(left) is MethodType and type(right) is MethodType:
        return left == right
    # The cell of a function that was run again, unchanged, makes another object of it.
    return left is right or (have_one_name(left, right) and is_defined_alike(left, right))


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
    >>> from epypes.graph.placeholder import Placeholder
    >>> sketch = CompGraph({"f": Placeholder()}, {"f": ("x", "y")})
    >>> extend(sketch, {"f": abs}).placeholders
    ()
    """
    require_graph("extend()", cg)
    func_io = {} if func_io is None else func_io
    for what, given in (("func_dict", func_dict), ("func_io", func_io)):
        require_mapping(what, given, "by function name")
    parts = Parts.of(cg)
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
    return CompGraph._assemble(parts, cg.types)


def subgraph(cg: CompGraph, targets: str | Iterable[str]) -> CompGraph:
    """Return the graph of the functions that tokens need, every branch of a switch included.

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
    require_graph("subgraph()", cg)
    producer = cg.digraph.producer
    pending = list(names_of("targets", targets))
    for token in pending:
        cg.require_token(token)
    needed: set[str] = set()
    while pending:
        function = producer.get(pending.pop())
        if function is not None and function not in needed:
            needed.add(function)
            pending.extend(cg.digraph.inputs[function])
    whole = Parts.of(cg)
    parts = Parts(
        {name: function for name, function in whole.functions.items() if name in needed},
        {name: io for name, io in whole.func_io.items() if name in needed},
        whole.defaults,
        groups={name: group for name, group in whole.groups.items() if name in needed},
    )
    return CompGraph._assemble(parts, cg.types)


def with_functions(cg: CompGraph, functions: Mapping[str, Callable[..., Any]]) -> CompGraph:
    """Return the graph with other callables in place of all its functions, such as nodes that wrap them.

    Parameters
    ----------
    cg
        The graph; it stays as it is.
    functions
        A callable for every function, by name.
    """
    return CompGraph._assemble(
        Parts(dict(functions), dict(cg.func_io), defaults_of(cg), groups=groups_of(cg)), cg.types
    )


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
    return CompGraph._assemble(Parts(dict(cg.functions), dict(cg.func_io), defaults, groups=groups_of(cg)), cg.types)
