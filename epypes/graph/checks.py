"""What is wrong with a graph, all of it at once?

Every check adds findings; none stops the others (rule 2 of the design: a graph is checked whole at construction).
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping
from types import FunctionType
from typing import Any, Final

from epypes.errors import Finding
from epypes.graph.bipartite import BipartiteDigraph
from epypes.graph.signature import Parameters, is_plain, parameters_of, signature_of
from epypes.graph.switch import as_switch
from epypes.wording import counted

_STRING: Final = frozenset({str})
_SHAPES = "(x, y), ((x1, ..., xm), y), (x, (y1, ..., yn)) or ((x1, ..., xm), (y1, ..., yn))"


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
    are_strings = _STRING.issuperset
    for name, io in func_io.items():
        if type(io) is tuple and len(io) == 2:
            # As it is written nearly always; large graphs are read fast.
            given, made = io
            taken = given if type(given) is tuple else (given,)
            returned = made if type(made) is tuple else (made,)
            if are_strings(map(type, (*taken, *returned))) and "" not in taken and "" not in returned:
                inputs[name], outputs[name], written[name] = taken, returned, io
                continue
        try:
            given, made = io if isinstance(io, tuple | list) else (None, 0)
            taken, returned = _tokens(given), () if made is None else _tokens(made)
        except (TypeError, ValueError):
            text = f"The io of function {name!r} is {io!r}; write {_SHAPES}, with None for no output."
            findings.append(Finding("bad io", text, (str(name),)))
            continue
        inputs[name], outputs[name] = taken, returned
        written[name] = (_as_tuple(given), _as_tuple(made))
    return BipartiteDigraph(inputs, outputs), written


def _tokens(given: Any) -> tuple[str, ...]:
    if isinstance(given, str) and given:
        return (given,)
    if not isinstance(given, tuple | list):
        raise TypeError
    for name in given:
        if not isinstance(name, str) or not name:
            raise TypeError
    return tuple(given)


def _as_tuple(side: Any) -> Any:
    return tuple(side) if type(side) is list else side


def is_single(io_side: object) -> bool:
    """Whether a side of an io is one token as it is (``"y"``), not a sequence of tokens (``("y",)``)."""
    return isinstance(io_side, str)


def distinct(functions: Mapping[str, Any]) -> dict[int, Any]:
    """Return each function once, by its id: a large graph has few functions under many names."""
    return {id(function): function for function in functions.values()}


def check_pairing(functions: Mapping[str, Any], func_io: Mapping[str, Any]) -> Iterable[Finding]:
    """Find functions without io, io without function, and what can't be called."""
    if functions.keys() == func_io.keys() and all(map(callable, functions.values())) and _are_names(functions):
        return
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


def _are_names(functions: Mapping[Any, Any]) -> bool:
    return set(map(type, functions)) <= {str} and "" not in functions


def check_producers(graph: BipartiteDigraph) -> Iterable[Finding]:
    """Find tokens that are made twice."""
    if len(graph.producer) == sum(map(len, graph.outputs.values())):
        return
    makers: dict[str, list[str]] = {}
    for function, tokens in graph.outputs.items():
        for token in tokens:
            makers.setdefault(token, []).append(function)
    for token, functions in makers.items():
        if len(functions) > 1:
            by = " and ".join(map(repr, functions)) if len(set(functions)) > 1 else f"{functions[0]!r} twice"
            text = f"Token {token!r} is made by {by}. Rename one of these outputs."
            yield Finding("two producers", text, (token, *functions))


def check_cycle(graph: BipartiteDigraph) -> Iterable[Finding]:
    """Find a shortest cycle."""
    cycle = graph.shortest_cycle()
    if cycle:
        text = (
            f"The graph has a cycle: {' -> '.join(cycle)}. "
            "Rename one of these tokens, or split the function that both needs and makes it."
        )
        yield Finding("cycle", text, cycle)


def check_arity(functions: Mapping[str, Callable[..., Any]], graph: BipartiteDigraph) -> Iterable[Finding]:
    """Find functions that can't be called with as many inputs as their io names."""
    known: dict[int, Parameters | None] = {}
    # What a plain function takes is seen without asking more: the usual case.
    exact = {key: function.__code__.co_argcount for key, function in distinct(functions).items() if _is_exact(function)}
    for name, tokens in graph.inputs.items():
        function = functions.get(name)
        if exact.get(id(function)) == len(tokens) or function is None or not callable(function):
            continue
        if id(function) not in known:
            known[id(function)] = parameters_of(function)
        parameters = known[id(function)]
        if parameters is not None:
            yield from _arity_findings(name, function, tokens, parameters)


def _is_exact(function: Any) -> bool:
    """Whether it is a plain function whose every parameter can be given by position."""
    return is_plain(function) and not function.__code__.co_kwonlyargcount


def _arity_findings(
    name: str, function: Callable[..., Any], tokens: tuple[str, ...], parameters: Parameters
) -> Iterable[Finding]:
    least, most, required = parameters.least, parameters.most, parameters.required_by_keyword
    if not least <= len(tokens) <= most:
        takes = f"{counted(least, 'input')}" if least == most else f"{least} to {most:g} inputs"
        text = (
            f"Function {name!r} takes {takes} {signature_of(function)}, "
            f"but its io names {len(tokens)}: ({', '.join(tokens)})."
        )
        yield Finding("arity", text, (name, *tokens))
    elif required:
        text = (
            f"Function {name!r} needs {', '.join(map(repr, required))} by keyword; "
            "tokens are given by position. Wrap it in a function that takes them by position."
        )
        yield Finding("arity", text, (name, *required))


def check_selectors(functions: Mapping[str, Any], graph: BipartiteDigraph) -> Iterable[Finding]:
    """Find switches whose selector is made by a function: which branch to run must be known before anything runs."""
    for name in [name for name, function in functions.items() if type(function) is not FunctionType]:
        tokens = graph.inputs.get(name)
        maker = graph.producer.get(tokens[0]) if tokens else None
        if tokens and maker is not None and as_switch(functions[name]) is not None:
            text = (
                f"Token {tokens[0]!r} selects the branch of switch {name!r}, but function {maker!r} makes it. "
                f"The branch must be known before anything runs: leave {tokens[0]!r} a source token, "
                "or choose between the values in a function."
            )
            yield Finding("selector", text, (name, tokens[0], maker))


def check_results(functions: Mapping[str, Any], graph: BipartiteDigraph) -> Iterable[Finding]:
    """Find functions whose value can be used only once: generators and coroutines."""
    once = {key for key, function in distinct(functions).items() if _makes_what_is_used_up(function)}
    for name in functions if once else ():
        if id(functions[name]) in once and name in graph.outputs:
            text = (
                f"Function {name!r} is a generator or a coroutine, whose value can be used only once; a token is read "
                "as often as needed. Return a list, or await in a function that is not async."
            )
            yield Finding("used up", text, (name, *graph.outputs[name]))


def _makes_what_is_used_up(function: Any) -> bool:
    flags = inspect.CO_GENERATOR | inspect.CO_COROUTINE | inspect.CO_ASYNC_GENERATOR
    return type(function) is FunctionType and bool(function.__code__.co_flags & flags)
