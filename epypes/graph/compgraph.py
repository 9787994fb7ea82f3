"""The computational graph: functions joined by tokens."""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Callable, Container, Iterable, Mapping
from types import FunctionType, MappingProxyType
from typing import TYPE_CHECKING, Any, Final, Self

from epypes.deprecation import OldNames, takes_old_keywords
from epypes.errors import Finding, GraphError, InvalidType, UnknownName, require_mapping
from epypes.graph.bipartite import BipartiteDigraph
from epypes.graph.colours import ColourOrder, find_orders
from epypes.graph.identity import is_redefined_inside, redefined
from epypes.graph.placeholder import is_placeholder
from epypes.graph.signature import declared_outputs, positional_of, signature_of
from epypes.graph.switch import as_switch
from epypes.graph.token_annotations import contracts_of, read_hints
from epypes.graph.validation import Default, Delay, GraphParts, find_problems, read_io
from epypes.images import Contracts
from epypes.optional import optional_import
from epypes.rich_display import mimebundle
from epypes.wording import counted

if TYPE_CHECKING:
    import networkx as nx

Tokens = str | tuple[str, ...] | list[str]
FuncIO = Mapping[str, tuple[Tokens, Tokens | None]]

_BY_HAND: Final = "name it in CompGraph(func_dict, func_io)"


class CompGraph(OldNames):
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
    types
        Whether annotations are compared: a token that is made as one type and taken as another, so that no value is
        both, is a problem.

    Raises
    ------
    GraphError
        With every problem as a finding: a cycle, two producers of a token, a function without io, io without
        a function, an io of another shape, a number of inputs that the signature does not take, types that exclude
        each other, a token in two orders of colours, a switch whose selector is computed.

    Notes
    -----
    Semeniuta and Falkman 2019, PeerJ Computer Science 5:e176, "Computational graphs".

    Every token that ``func_io`` names is a token of its own: defaults in the signatures of functions are read by
    ``from_functions`` only.

    Examples
    --------
    >>> cg = CompGraph({"double": lambda x: 2 * x}, {"double": ("x", "y")})
    >>> cg
    <CompGraph: 1 function, 2 tokens; x -> y>
    """

    def __init__(self, func_dict: Mapping[str, Callable[..., Any]], func_io: FuncIO, *, types: bool = True) -> None:
        if callable(func_dict):
            text = "func_dict must be a mapping by function name, not a function."
            raise InvalidType(f"{text} Of functions alone: CompGraph.from_functions(function, ...).")
        for what, given in (("func_dict", func_dict), ("func_io", func_io)):
            require_mapping(what, given, "by function name")
        self._build(GraphParts(dict(func_dict), dict(func_io), types=types))

    @classmethod
    def from_functions(cls, *functions: Callable[..., Any], types: bool = True) -> CompGraph:
        """Make a graph of functions, joined by the names of their parameters.

        A function takes the tokens that its positional parameters are called, and makes the token that it is called
        itself, or those named by ``@ep.outputs``. The default of a parameter that is a source token is kept in
        ``defaults``.

        Parameters
        ----------
        functions
            Functions with a name and a signature.
        types
            As for CompGraph.

        Raises
        ------
        GraphError
            With every problem: what CompGraph finds, functions without name or signature, two of one name, a token
            with two defaults.

        Examples
        --------
        >>> def gray(image): ...
        >>> def edges(gray, threshold=70): ...
        >>> cg = CompGraph.from_functions(gray, edges)
        >>> cg, dict(cg.defaults)
        (<CompGraph: 2 functions, 4 tokens; image, threshold -> edges>, {'threshold': 70})
        """
        return cls._of(_read_functions(functions, types))

    @classmethod
    def _of(cls, parts: GraphParts) -> Self:
        """Make a graph of parts, whose findings are reported with its own; for this package."""
        self = cls.__new__(cls)
        self._build(parts)
        return self

    def _build(self, parts: GraphParts) -> None:
        findings = list(parts.findings)
        digraph, func_io = read_io(parts.func_io, findings)
        order = digraph.run_order()
        hints = read_hints(parts, digraph)
        contracts = contracts_of(hints)
        findings += find_problems(parts, digraph, hints, contracts, len(order) == len(digraph.inputs))
        colours, contradictions = find_orders(parts, digraph, contracts)
        findings += contradictions
        if findings:
            raise GraphError(findings)
        if order != tuple(digraph.inputs):
            inputs, outputs = digraph.inputs, digraph.outputs
            digraph = BipartiteDigraph({name: inputs[name] for name in order}, {name: outputs[name] for name in order})
        self._digraph, self._types = digraph, parts.types
        self._contracts, self._colours = MappingProxyType(contracts), MappingProxyType(colours)
        self._functions = MappingProxyType({name: parts.functions[name] for name in order})
        self._func_io = MappingProxyType({name: func_io[name] for name in order})
        self._known = digraph.tokens()
        self._tokens = tuple(self._known)
        self._sources = tuple(token for token in self._tokens if token not in digraph.producer)
        taken = set(itertools.chain.from_iterable(digraph.inputs.values()))
        self._sinks = tuple(token for token in self._tokens if token not in taken)
        special = [item for item in self._functions.items() if type(item[1]) is not FunctionType]
        self._placeholders = tuple(name for name, function in special if is_placeholder(function))
        self._switches = tuple(name for name, function in special if as_switch(function) is not None)
        self._delays = MappingProxyType(
            {token: parts.delays[token] for token in self._sources if token in parts.delays}
        )
        defaults = {
            default.token: default.value for default in reversed(parts.defaults) if default.token not in parts.delays
        }
        self._defaults = MappingProxyType({token: defaults[token] for token in self._sources if token in defaults})
        groups: dict[str, list[str]] = {}
        for function in order:
            if function in parts.groups:
                groups.setdefault(parts.groups[function], []).append(function)
        self._groups = MappingProxyType({name: tuple(functions) for name, functions in groups.items()})

    def _parts(self) -> GraphParts:
        """Return what the graph can be put together from again; for this package."""
        group_of = {function: name for name, functions in self._groups.items() for function in functions}
        consumers = self._digraph.consumers
        return GraphParts(
            dict(self._functions),
            dict(self._func_io),
            [Default(token, value, consumers[token][0]) for token, value in self._defaults.items()],
            {function: group_of[function] for function in self._functions if function in group_of},
            self._types,
            delays=dict(self._delays),
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
        return self._sources

    @property
    def sink_tokens(self) -> tuple[str, ...]:
        """The tokens that no function takes, in graph order."""
        return self._sinks

    @property
    def defaults(self) -> Mapping[str, Any]:
        """The default values of source tokens, in graph order; only ``from_functions`` finds any."""
        return self._defaults

    @property
    def delays(self) -> Mapping[str, Delay]:
        """By source token, in graph order, the token whose previous value it has; see ``ep.delay``."""
        return self._delays

    @property
    def placeholders(self) -> tuple[str, ...]:
        """The names of the functions that are still to be written, in run order."""
        return self._placeholders

    @property
    def switches(self) -> tuple[str, ...]:
        """The names of the functions that are switches, in run order; the first input of each is its selector."""
        return self._switches

    @property
    def groups(self) -> Mapping[str, tuple[str, ...]]:
        """The functions of each group, in run order, and the groups by their first ones; see ``ep.group``."""
        return self._groups

    @property
    def types(self) -> bool:
        """Whether annotations were compared; what is made from this graph does it the same way."""
        return self._types

    @property
    def contracts(self) -> Mapping[str, Contracts]:
        """The marks of images in annotations, by function: a mark or None for each input, and for each output."""
        return self._contracts

    @property
    def colours(self) -> Mapping[str, ColourOrder]:
        """The order of colours by token, where a function says it: by a mark, or surely in its source."""
        return self._colours

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
        return isinstance(self._func_io[name][1], str)

    def has_token(self, name: str) -> bool:
        """Whether there is such a token."""
        return name in self._known

    def require_function(self, name: str) -> None:
        """Raise UnknownName, with the nearest name, unless there is such a function."""
        if name not in self._functions:
            raise UnknownName("function", name, self._functions)

    def require_token(self, name: str) -> None:
        """Raise UnknownName, with the nearest name, unless there is such a token."""
        if not self.has_token(name):
            made = self._digraph.outputs.get(name)
            where = "in this graph" if made is None else f"in this graph, only a function; it makes {', '.join(made)}"
            raise UnknownName("token", name, self._tokens, where)

    def __or__(self, other: object) -> CompGraph:
        from epypes.graph.algebra import union

        return union(self, other) if isinstance(other, CompGraph) else NotImplemented

    @takes_old_keywords
    def to_networkx(self) -> nx.DiGraph[tuple[str, str]]:
        """Return a networkx DiGraph; its vertices are ``("function", name)`` and ``("token", name)``."""
        with optional_import():
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

    def __reduce__(self) -> tuple[Any, ...]:
        """Give what a pickle is made of; functions are pickled by name."""
        return type(self)._of, (self._parts(),)

    def __deepcopy__(self, memo: object) -> Self:
        """Return the graph itself, which does not change."""
        return self

    def __repr__(self) -> str:
        count = len(self._functions)
        start = f"<CompGraph: {counted(count, 'function')}, {counted(len(self._tokens), 'token')}; "
        end = _redefined_text(self) + ">"
        width = min(18, (95 - len(start) - len(end)) // 2)
        return f"{start}{_some(self._sources, width)} -> {_some(self._sinks, width)}{end}"

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        return mimebundle(self)


def _read_functions(functions: Iterable[Any], types: bool) -> GraphParts:
    """Read names, io and defaults of functions; what can't be read becomes a finding and is left out."""
    parts = GraphParts(types=types)
    for function in functions:
        signature = _declaration(function, parts.functions)
        if isinstance(signature, Finding):
            parts.findings.append(signature)
            continue
        name, positional = function.__name__, positional_of(signature)
        made = declared_outputs(function)
        outputs: Any = name if made is None else made[0] if len(made) == 1 else made or None
        parts.functions[name] = function
        parts.func_io[name] = (tuple(parameter.name for parameter in positional), outputs)
        given = [parameter for parameter in positional if parameter.default is not parameter.empty]
        parts.defaults.extend(Default(parameter.name, parameter.default, name) for parameter in given)
    return parts


def _declaration(function: Any, taken: Container[str]) -> inspect.Signature | Finding:
    """Return the signature of a function that has one and a name that is not taken, else what is wrong with it."""
    if not callable(function):
        kind = type(function).__name__
        text = f"A graph is made of functions, not of {kind!r}. Give the function itself: edges, not edges(image)."
        if isinstance(function, list | tuple) and all(map(callable, function)):
            text = f"Give functions one by one, not as a {kind}: CompGraph.from_functions(*functions)."
        return Finding("not callable", text, ())
    name = getattr(function, "__name__", None)
    if not isinstance(name, str) or not name.isidentifier():
        what = "A lambda" if name == "<lambda>" else f"{function!r:.60}"
        text = f"{what} has no name that could be its token's. Write it as a function (def), or {_BY_HAND}."
        return Finding("no name", text, ())
    if name in taken:
        return Finding(
            "two functions", f"Two functions are called {name!r}. Rename one of them, or {_BY_HAND}.", (name,)
        )
    signature = signature_of(function)
    if signature is None:
        text = (
            f"The parameters of {name!r} are not known, since it has no signature. "
            f"Write a function (def) that calls it, or {_BY_HAND}."
        )
        return Finding("no signature", text, (name,))
    return signature


def _redefined_text(cg: CompGraph) -> str:
    names = redefined(cg)
    if len(names) != 1:
        return f"; {len(names)} functions were redefined" * bool(names)
    inside = "a function inside " * is_redefined_inside(cg.functions[names[0]])
    return f"; {inside}{_some(names, 18)!r} was redefined"


def _some(tokens: tuple[str, ...], width: int) -> str:
    """Join names, cut to ``width`` characters so that a repr stays one short line."""
    text = " ".join(", ".join(tokens).split()) or "nothing"
    return text if len(text) <= width else text[: width - 3] + "..."
