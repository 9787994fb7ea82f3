"""What is wrong with a graph, all of it at once?

Every check adds findings; none stops the others (rule 2 of the design: a graph is checked whole at construction).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from epypes.errors import Finding
from epypes.graph.bipartite import BipartiteDigraph
from epypes.graph.signature import accepted_inputs, keyword_only_required, signature_of

_SHAPES = "(x, y), ((x1, ..., xm), y), (x, (y1, ..., yn)) or ((x1, ..., xm), (y1, ..., yn))"


def read_io(func_io: Mapping[str, Any], findings: list[Finding]) -> BipartiteDigraph:
    """Read the paper's func_io; what can't be read becomes a finding and is left out.

    Parameters
    ----------
    func_io
        By function name, a pair of input and output tokens: each a name, a tuple or list of names, and for
        the outputs None for "no output".
    findings
        Is added to.
    """
    inputs: dict[str, tuple[str, ...]] = {}
    outputs: dict[str, tuple[str, ...]] = {}
    for name, io in func_io.items():
        try:
            given, made = io if isinstance(io, tuple | list) else (None, 0)
            inputs[name], outputs[name] = _tokens(given), () if made is None else _tokens(made)
        except (TypeError, ValueError):
            inputs.pop(name, None)
            text = f"The io of function {name!r} is {io!r}; write {_SHAPES}, with None for no output."
            findings.append(Finding("bad io", text, (str(name),)))
    return BipartiteDigraph(inputs, outputs)


def _tokens(given: object) -> tuple[str, ...]:
    names = (given,) if isinstance(given, str) else given
    if not isinstance(names, tuple | list) or not all(isinstance(name, str) and name for name in names):
        raise TypeError
    return tuple(names)


def is_single(io_side: object) -> bool:
    """Whether a side of an io is one token as it is (``"y"``), not a sequence of tokens (``("y",)``)."""
    return isinstance(io_side, str)


def check_pairing(functions: Mapping[str, Any], func_io: Mapping[str, Any]) -> Iterable[Finding]:
    """Find functions without io, io without function, and what can't be called."""
    for name, function in functions.items():
        if not isinstance(name, str) or not name:
            text = f"A function's name must be a string that is not empty, not {name!r}."
            yield Finding("no function", text, (str(name),))
        if not callable(function):
            text = f"Function {name!r} is {type(function).__name__}, which can't be called. Give a function."
            yield Finding("not callable", text, (str(name),))
        if name not in func_io:
            text = f"Function {name!r} has no io. Add func_io[{name!r}] = (inputs, outputs)."
            yield Finding("no io", text, (str(name),))
    for name in func_io:
        if name not in functions:
            text = f"The io of {name!r} has no function. Add func_dict[{name!r}], or remove the io."
            yield Finding("no function", text, (str(name),))


def check_producers(graph: BipartiteDigraph) -> Iterable[Finding]:
    """Find tokens that are made twice."""
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
    for name, tokens in graph.inputs.items():
        function = functions.get(name)
        signature = signature_of(function) if callable(function) else None
        if signature is None:
            continue
        least, most = accepted_inputs(signature)
        required = keyword_only_required(signature)
        if not least <= len(tokens) <= most:
            takes = f"{least}" if least == most else f"{least} to {most:g}"
            text = (
                f"Function {name!r} takes {takes} inputs {signature}, "
                f"but its io names {len(tokens)}: ({', '.join(tokens)})."
            )
            yield Finding("arity", text, (name, *tokens))
        elif required:
            text = (
                f"Function {name!r} needs {', '.join(map(repr, required))} by keyword; "
                "tokens are given by position. Wrap it in a function that takes them by position."
            )
            yield Finding("arity", text, (name, *required))
