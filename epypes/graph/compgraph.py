"""What is a computational graph, and what can be asked of it?"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from epypes.errors import Finding, GraphError, UnknownName
from epypes.graph.bipartite import BipartiteDigraph
from epypes.graph.checks import (
    check_arity,
    check_cycle,
    check_pairing,
    check_producers,
    is_single,
    read_io,
)
from epypes.graph.colours import check_colours

if TYPE_CHECKING:
    import networkx as nx

Tokens = str | tuple[str, ...] | list[str]
FuncIO = Mapping[str, tuple[Tokens, Tokens | None]]


class CompGraph:
    """A computational graph: functions joined by tokens, immutable and checked whole.

    Parameters
    ----------
    func_dict
        The functions by name; names are unique, one callable can serve under several.
    func_io
        By function name, its input and output tokens:
        ``(x, y)``, ``((x1, ..., xm), y)``, ``(x, (y1, ..., yn))`` or ``((x1, ..., xm), (y1, ..., yn))``.
        Outputs are None for a function without output; ``()`` is allowed for one without inputs.
        A single output token takes the value as it is, a tuple of n tokens a sequence of n values.

    Raises
    ------
    GraphError
        With every problem as a finding: a cycle, two producers of a token, a function without io, io without
        a function, an io of another shape, a number of inputs that the signature does not take, annotations that
        give the colours of a token in two orders.

    Notes
    -----
    Semeniuta and Falkman 2019, PeerJ Computer Science 5:e176, "Computational graphs".

    Examples
    --------
    >>> cg = CompGraph({"double": lambda x: 2 * x}, {"double": ("x", "y")})
    >>> cg
    <CompGraph: 1 function, 2 tokens; x -> y>
    """

    __slots__ = ("__weakref__", "_digraph", "_func_io", "_functions", "_tokens")

    def __init__(self, func_dict: Mapping[str, Callable[..., Any]], func_io: FuncIO) -> None:
        for what, given in (("func_dict", func_dict), ("func_io", func_io)):
            if not isinstance(given, Mapping):
                kind = type(given).__name__
                raise TypeError(f"{what} must be a mapping by function name, such as a dict, not {kind!r}.")
        findings: list[Finding] = []
        digraph = read_io(func_io, findings)
        findings += check_pairing(func_dict, func_io)
        findings += check_producers(digraph)
        findings += check_cycle(digraph)
        findings += check_arity(func_dict, digraph)
        findings += check_colours(func_dict, digraph)
        if findings:
            raise GraphError(findings)
        order = digraph.run_order()
        self._digraph = BipartiteDigraph(
            {name: digraph.inputs[name] for name in order}, {name: digraph.outputs[name] for name in order}
        )
        self._functions = MappingProxyType({name: func_dict[name] for name in order})
        self._func_io = MappingProxyType({name: _as_tuples(func_io[name]) for name in order})
        self._tokens = tuple(
            dict.fromkeys(token for name in order for token in (*digraph.inputs[name], *digraph.outputs[name]))
        )

    @property
    def functions(self) -> Mapping[str, Callable[..., Any]]:
        """The functions by name, in run order."""
        return self._functions

    @property
    def func_io(self) -> FuncIO:
        """The input and output tokens by function name, in run order, as they were given (lists as tuples)."""
        return self._func_io

    @property
    def digraph(self) -> BipartiteDigraph:
        """The functions, tokens and edges without the callables."""
        return self._digraph

    @property
    def tokens(self) -> tuple[str, ...]:
        """Every token, in graph order: by first appearance along the run order, inputs before outputs."""
        return self._tokens

    @property
    def source_tokens(self) -> tuple[str, ...]:
        """The tokens that no function makes, in graph order."""
        return tuple(token for token in self._tokens if token not in self._digraph.producer)

    @property
    def sink_tokens(self) -> tuple[str, ...]:
        """The tokens that no function takes, in graph order."""
        return tuple(token for token in self._tokens if token not in self._digraph.consumers)

    def func_inputs(self, name: str) -> tuple[str, ...]:
        """Return the input tokens of a function."""
        self.require_function(name)
        return self._digraph.inputs[name]

    def func_outputs(self, name: str) -> tuple[str, ...]:
        """Return the output tokens of a function."""
        self.require_function(name)
        return self._digraph.outputs[name]

    def has_single_output(self, name: str) -> bool:
        """Whether the function's value is one token as it is, not a sequence of tokens."""
        self.require_function(name)
        return is_single(self._func_io[name][1])

    def require_function(self, name: str) -> None:
        """Raise UnknownName, with the nearest name, unless there is such a function."""
        if name not in self._functions:
            raise UnknownName("function", name, self._functions)

    def require_token(self, name: str) -> None:
        """Raise UnknownName, with the nearest name, unless there is such a token."""
        if name not in self._digraph.producer and name not in self._digraph.consumers:
            made = self._digraph.outputs.get(name)
            where = "in this graph" if made is None else f"in this graph, only a function; it makes {', '.join(made)}"
            raise UnknownName("token", name, self._tokens, where)

    def to_networkx(self) -> nx.DiGraph[tuple[str, str]]:
        """Return a networkx DiGraph; its vertices are ``("function", name)`` and ``("token", name)``."""
        import networkx as nx

        graph: nx.DiGraph[tuple[str, str]] = nx.DiGraph()
        for name, function in self._functions.items():
            graph.add_node(("function", name), kind="function", function=function)
            for token in self._digraph.inputs[name]:
                graph.add_edge(("token", token), ("function", name))
            for token in self._digraph.outputs[name]:
                graph.add_edge(("function", name), ("token", token))
        for token in self._tokens:
            graph.add_node(("token", token), kind="token")
        return graph

    def __repr__(self) -> str:
        count = len(self._functions)
        ends = f"{_some(self.source_tokens)} -> {_some(self.sink_tokens)}"
        return f"<CompGraph: {count} function{'s' * (count != 1)}, {len(self._tokens)} tokens; {ends}>"

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        from epypes.display import mimebundle

        return mimebundle(self)


def _as_tuples(io: tuple[Tokens, Tokens | None]) -> tuple[Tokens, Tokens | None]:
    given, made = io
    return (
        given if isinstance(given, str) else tuple(given),
        made if made is None or isinstance(made, str) else tuple(made),
    )


def _some(tokens: tuple[str, ...], width: int = 18) -> str:
    """Join names, cut to ``width`` characters so that a repr stays one short line."""
    text = " ".join(", ".join(tokens).split()) or "nothing"
    return text if len(text) <= width else text[: width - 3] + "..."
