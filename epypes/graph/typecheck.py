"""Do the annotations of a graph's functions agree about its tokens?"""

from __future__ import annotations

import typing
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from types import FunctionType, MethodType
from typing import Any, Final

from epypes.errors import Finding
from epypes.graph.bipartite import BipartiteDigraph
from epypes.graph.checks import is_single
from epypes.graph.disjoint import are_disjoint, bare
from epypes.graph.placeholder import innermost
from epypes.graph.signature import parameters_of

_WAY_OUT: Final = "Change one of the annotations, or build the graph with types=False."
# A finding is a sentence; a long type is cut.
_WIDEST: Final = 60


@dataclass(slots=True)
class TokenHints:
    """What annotations say about one token.

    Attributes
    ----------
    made
        The function that makes it and the hint of what it returns; None if there is no such hint.
    taken
        Every function that takes it and the hint of that parameter, in order of definition.
    """

    token: str
    made: tuple[str, Any] | None = None
    taken: list[tuple[str, Any]] = field(default_factory=list)


def check_types(functions: Mapping[str, Any], graph: BipartiteDigraph, written: Mapping[str, Any]) -> Iterable[Finding]:
    """Find what annotations forbid. Functions without annotations cost a look.

    Parameters
    ----------
    functions
        The callables by name.
    graph
        What is connected to what.
    written
        The io by function name, as it was written.
    """
    annotated = [name for name, function in functions.items() if _is_annotated(function) and name in graph.inputs]
    if not annotated:
        return
    hints: dict[str, TokenHints] = {}
    for name in annotated:
        found = _resolved(functions[name])
        if found:
            _note_taken(hints, name, functions[name], graph.inputs[name], found)
            yield from _note_made(hints, name, written[name][1], found)
    for token in hints.values():
        for check in TOKEN_CHECKS:
            yield from check(token)


def no_common_value(hints: TokenHints) -> Iterable[Finding]:
    """Find consumers that no value of the producer's type can satisfy."""
    if hints.made is None:
        return
    maker, made = hints.made
    for taker, taken in hints.taken:
        if are_disjoint(made, taken):
            text = (
                f"Function {maker!r} makes token {hints.token!r} as {_type_text(made)}, but {taker!r} takes it as "
                f"{_type_text(taken)}, and no value is both. {_WAY_OUT}"
            )
            yield Finding("types", text, (hints.token, maker, taker))


# What is asked about every token that an annotation says something about; another check of hints is added here.
TOKEN_CHECKS: Final[tuple[Callable[[TokenHints], Iterable[Finding]], ...]] = (no_common_value,)


def _is_annotated(function: Any) -> bool:
    if type(function) is FunctionType:
        return bool(function.__annotations__)
    # Other objects show the annotations of their class, which are not those of a call.
    return type(function) is MethodType or innermost(function) is not function


def _resolved(function: Any) -> dict[str, Any]:
    """Return the hints by parameter, and that of ``return``; none where they can't be resolved."""
    try:
        return typing.get_type_hints(function, include_extras=True)
    except Exception:  # names that are not there yet, and whatever an annotation raises when it is evaluated
        return {}


def _note_taken(
    hints: dict[str, TokenHints], name: str, function: Any, tokens: tuple[str, ...], found: Mapping[str, Any]
) -> None:
    parameters = parameters_of(function)
    positional = parameters.positional if parameters is not None else ()
    for token, (parameter, _) in zip(tokens, positional, strict=False):
        if parameter in found:
            hints.setdefault(token, TokenHints(token)).taken.append((name, found[parameter]))


def _note_made(hints: dict[str, TokenHints], name: str, outputs: Any, found: Mapping[str, Any]) -> Iterable[Finding]:
    """Note what a function returns, a tuple by its items; its length is a finding if it does not fit the io."""
    if "return" not in found or not outputs:
        return
    if is_single(outputs):
        hints.setdefault(outputs, TokenHints(outputs)).made = (name, found["return"])
        return
    items = _items(found["return"], len(outputs))
    if len(items) != len(outputs):
        text = (
            f"Function {name!r} returns {_type_text(found['return'])}, {len(items)} values, but its io names "
            f"{len(outputs)} outputs: ({', '.join(outputs)}). Name as many, or build the graph with types=False."
        )
        yield Finding("types", text, (name, *outputs))
        return
    for token, item in zip(outputs, items, strict=True):
        hints.setdefault(token, TokenHints(token)).made = (name, item)


def _items(returned: Any, count: int) -> tuple[Any, ...]:
    """Return the hints of a tuple's items; Any for each of ``count`` where the hint says nothing about them."""
    plain = bare(returned)
    items = typing.get_args(plain) if typing.get_origin(plain) is tuple else ()
    if len(items) == 2 and items[1] is Ellipsis:
        return (items[0],) * count
    return items if items and not any(map(_is_unpacked, items)) else (Any,) * count


def _is_unpacked(item: Any) -> bool:
    return typing.get_origin(item) is typing.Unpack or getattr(item, "__unpacked__", False)


def _type_text(hint: Any) -> str:
    text = hint.__qualname__ if isinstance(hint, type) and not typing.get_args(hint) else repr(hint)
    text = text.replace("typing.", "")
    return text if len(text) <= _WIDEST else text[: _WIDEST - 3] + "..."
