"""Validation of a graph: every problem of its parts becomes a finding, and none stops the other checks."""

from __future__ import annotations

import difflib
import inspect
import reprlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from math import inf
from types import FunctionType
from typing import Any, Final, NamedTuple

from epypes.errors import Finding
from epypes.graph.bipartite import BipartiteDigraph
from epypes.graph.identity import is_same_default
from epypes.graph.signature import distinct, plain_count, positional_of, signature_of
from epypes.graph.switch import as_switch
from epypes.graph.token_annotations import TokenHints, check_images
from epypes.graph.type_check import check_types
from epypes.images import Contracts
from epypes.wording import counted

_SHAPES: Final = "(x, y), ((x1, ..., xm), y), (x, (y1, ..., yn)) or ((x1, ..., xm), (y1, ..., yn))"
# As a constant: to make ``tuple | list`` for each of 10,000 functions takes longer than to read their io.
_SEQUENCES: Final = (tuple, list)
_ONE_SHOT: Final = inspect.CO_GENERATOR | inspect.CO_COROUTINE | inspect.CO_ASYNC_GENERATOR


class Default(NamedTuple):
    """A token's default value, and a function that gives it."""

    token: str
    value: Any
    function: str


class Delay(NamedTuple):
    """The delay of a token.

    Attributes
    ----------
    token
        The token whose value is kept for the next run.
    initial
        The value in the first run.
    """

    token: str
    initial: Any


@dataclass(frozen=True, slots=True)
class GraphParts:
    """What a graph is put together from: not a graph yet.

    Attributes
    ----------
    functions, func_io
        As a CompGraph takes them, in order of definition.
    defaults
        Every default, several for one token included.
    groups
        By function, the group that it is in.
    types
        Whether annotations are compared.
    findings
        What is already known to be wrong.
    delays
        By source token, the token whose previous value it has.
    """

    functions: dict[str, Callable[..., Any]] = field(default_factory=dict)
    func_io: dict[str, Any] = field(default_factory=dict)
    defaults: list[Default] = field(default_factory=list)
    groups: dict[str, str] = field(default_factory=dict)
    types: bool = True
    findings: list[Finding] = field(default_factory=list)
    delays: dict[str, Delay] = field(default_factory=dict)

    def has_single_output(self, name: str) -> bool:
        """Whether a function's value is one token as it is, not a sequence of tokens."""
        return isinstance(self.func_io[name][1], str)


def read_io(func_io: Mapping[str, Any], findings: list[Finding]) -> tuple[BipartiteDigraph, dict[str, Any]]:
    """Read the paper's func_io; what can't be read becomes a finding and is left out.

    Parameters
    ----------
    func_io
        By function name, a pair of input and output tokens: each a name, a tuple or list of names, and for
        the outputs None for "no output".
    findings
        Is added to.

    Returns
    -------
    tuple
        The digraph, and the io by function name as it was written, lists as tuples.
    """
    inputs: dict[str, tuple[str, ...]] = {}
    outputs: dict[str, tuple[str, ...]] = {}
    written: dict[str, Any] = {}
    for name, io in func_io.items():
        try:
            given, made = io if isinstance(io, _SEQUENCES) else ()
            taken, returned = _tokens(given), () if made is None else _tokens(made)
        except (TypeError, ValueError):
            text = f"The io of function {name!r} is {io!r}; write {_SHAPES}, with None for no output."
            findings.append(Finding("bad io", text, (str(name),)))
            continue
        inputs[name], outputs[name] = taken, returned
        is_single = made is None or isinstance(made, str)
        written[name] = (given if isinstance(given, str) else taken, made if is_single else returned)
    return BipartiteDigraph(inputs, outputs), written


def _tokens(side: Any) -> tuple[str, ...]:
    if isinstance(side, str) and side:
        return (side,)
    if not isinstance(side, _SEQUENCES) or [name for name in side if not isinstance(name, str) or not name]:
        raise TypeError
    return tuple(side)


def find_problems(
    parts: GraphParts,
    digraph: BipartiteDigraph,
    hints: Mapping[str, TokenHints],
    contracts: Mapping[str, Contracts],
    is_acyclic: bool,
) -> Iterable[Finding]:
    """Find everything that is wrong with a graph, but for an io that can't be read.

    Parameters
    ----------
    parts
        The graph's parts.
    digraph
        What is connected to what.
    hints, contracts
        The annotations, and the marks of images among them, by function.
    is_acyclic
        Whether the run order has every function.
    """
    functions = parts.functions
    yield from _check_pairing(functions, parts.func_io)
    yield from _check_producers(digraph)
    if not is_acyclic:
        cycle = digraph.shortest_cycle()
        # A function may be called like its token.
        vertices = [f"{name}()" if place % 2 else name for place, name in enumerate(cycle)]
        text = (
            f"The graph has a cycle: {' -> '.join(vertices)}. "
            "Rename one of these tokens, or split the function that both needs and makes it."
        )
        yield Finding("cycle", text, cycle)
    yield from _check_arity(functions, digraph)
    yield from _check_special_functions(functions, digraph)
    if parts.types:
        yield from check_images(contracts, digraph)
        yield from check_types(hints, digraph)
    # A token that is made needs no default.
    yield from _check_defaults(default for default in parts.defaults if default.token not in digraph.producer)
    yield from _check_groups(functions, parts.groups)
    yield from _check_delays(parts.delays, digraph)


def _check_pairing(functions: Mapping[Any, Any], func_io: Mapping[str, Any]) -> Iterable[Finding]:
    """Find functions without io, io without function, and what can't be called."""
    for name, function in functions.items():
        if not isinstance(name, str) or not name:
            text = f"A function's name must be a string that is not empty, not {name!r}."
            yield Finding("no function", text, (str(name),))
        if not callable(function):
            inside = f", or the graph as one: ep.Pipeline({name!r}, graph)" * hasattr(function, "func_io")
            text = f"Function {name!r} is {type(function).__name__}, which can't be called. Give a function{inside}."
            yield Finding("not callable", text, (str(name),))
        if name not in func_io:
            text = f"Function {name!r} has no io. Add func_io[{name!r}] = (inputs, outputs)."
            yield Finding("no io", text, (str(name),))
    for name in func_io:
        if name not in functions:
            text = f"The io of {name!r} has no function. Add func_dict[{name!r}], or remove the io."
            yield Finding("no function", text, (str(name),))


def _check_producers(digraph: BipartiteDigraph) -> Iterable[Finding]:
    """Find tokens that are made twice."""
    if len(digraph.producer) == sum(map(len, digraph.outputs.values())):
        return
    makers: dict[str, list[str]] = {}
    for function, tokens in digraph.outputs.items():
        for token in tokens:
            makers.setdefault(token, []).append(function)
    for token, functions in makers.items():
        if len(functions) > 1:
            by = " and ".join(map(repr, functions)) if len(set(functions)) > 1 else f"{functions[0]!r} twice"
            text = f"Token {token!r} is made by {by}. Rename one of these outputs."
            yield Finding("two producers", text, (token, *functions))


def _check_arity(functions: Mapping[str, Callable[..., Any]], digraph: BipartiteDigraph) -> Iterable[Finding]:
    """Find functions that can't be called with as many inputs as their io names."""
    plain = {key: plain_count(function) for key, function in distinct(functions).items()}
    signatures: dict[int, inspect.Signature | None] = {}
    for name, tokens in digraph.inputs.items():
        function = functions.get(name)
        if plain.get(id(function)) == len(tokens) or not callable(function):
            continue
        if id(function) not in signatures:
            signatures[id(function)] = signature_of(function)
        signature = signatures[id(function)]
        if signature is None:
            continue
        parameters = signature.parameters.values()
        positional = positional_of(signature)
        least = sum(parameter.default is parameter.empty for parameter in positional)
        is_variadic = any(parameter.kind is parameter.VAR_POSITIONAL for parameter in parameters)
        most = inf if is_variadic else len(positional)
        required = [each.name for each in parameters if each.kind is each.KEYWORD_ONLY and each.default is each.empty]
        if not least <= len(tokens) <= most:
            takes = counted(least, "input") if least == most else f"{least} to {most:g} inputs"
            text = (
                f"Function {name!r} takes {takes} {signature}, but its io names {len(tokens)}: ({', '.join(tokens)})."
            )
            yield Finding("arity", text, (name, *tokens))
        elif required:
            text = (
                f"Function {name!r} needs {', '.join(map(repr, required))} by keyword; "
                "tokens are given by position. Wrap it in a function that takes them by position."
            )
            yield Finding("arity", text, (name, *required))


def _check_special_functions(functions: Mapping[str, Any], digraph: BipartiteDigraph) -> Iterable[Finding]:
    """Find switches whose selector is computed, and functions whose value can be used only once."""
    for name, tokens in digraph.inputs.items():
        function = functions.get(name)
        if type(function) is FunctionType:
            if function.__code__.co_flags & _ONE_SHOT:
                text = (
                    f"Function {name!r} is a generator or a coroutine, whose value can be used only once; a token is "
                    "read as often as needed. Return a list, or await in a function that is not async."
                )
                yield Finding("used up", text, (name, *digraph.outputs[name]))
        elif tokens and tokens[0] in digraph.producer and as_switch(function) is not None:
            selector, maker = tokens[0], digraph.producer[tokens[0]]
            text = (
                f"Token {selector!r} selects the branch of switch {name!r}, but function {maker!r} makes it. "
                f"The branch must be known before anything runs: leave {selector!r} a source token, "
                "or choose between the values in a function."
            )
            yield Finding("selector", text, (name, selector, maker))


def _check_defaults(defaults: Iterable[Default]) -> Iterable[Finding]:
    """Find tokens with two different defaults."""
    first: dict[str, Default] = {}
    for default in defaults:
        other = first.setdefault(default.token, default)
        if not is_same_default(other.value, default.value):
            text = (
                f"Token {default.token!r} has the default {reprlib.repr(other.value)} in {other.function!r} "
                f"and {reprlib.repr(default.value)} in {default.function!r}. "
                "Make them equal, or rename one of the tokens."
            )
            yield Finding("defaults", text, (default.token, other.function, default.function))


def _check_groups(functions: Mapping[str, Any], groups: Mapping[str, str]) -> Iterable[Finding]:
    """Find groups that are called like a function outside them: both would be one vertex of the picture."""
    for name in dict.fromkeys(groups.values()):
        if name in functions and groups.get(name) != name:
            text = (
                f"A group and a function outside it are both called {name!r}. "
                "Give the group another name, or rename the function with ep.rename()."
            )
            yield Finding("groups", text, (name,))


def _check_delays(delays: Mapping[str, Delay], digraph: BipartiteDigraph) -> Iterable[Finding]:
    """Find delays of tokens that are made or that do not exist."""
    tokens = digraph.tokens() if delays else {}
    for previous, (token, _) in delays.items():
        maker = digraph.producer.get(previous)
        if previous == token:
            text = f"Token {previous!r} can't be its own previous value. Have a function take {previous!r} and make it."
            yield Finding("delay", text, (previous,))
        elif maker is not None:
            text = (
                f"Token {previous!r} is the previous value of {token!r}, but function {maker!r} makes it. "
                "A delayed value is a source token: rename one of the two."
            )
            yield Finding("delay", text, (previous, maker))
        elif token not in tokens:
            near = difflib.get_close_matches(token, tokens, n=1)
            hint = f" Did you mean {near[0]!r}?" if near else ""
            text = f"Token {previous!r} is the previous value of {token!r}, which is no token of the graph.{hint}"
            yield Finding("delay", text, (previous, token))
