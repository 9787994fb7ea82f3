"""Do the annotations of a graph's functions agree about its tokens?"""

from __future__ import annotations

import typing
from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from types import FunctionType, MethodType
from typing import Any, Final

from epypes.annotations import hints_of
from epypes.errors import Finding
from epypes.graph.bipartite import BipartiteDigraph
from epypes.graph.checks import distinct
from epypes.graph.disjoint import are_disjoint, bare
from epypes.graph.placeholder import innermost
from epypes.graph.signature import parameters_of

_WAY_OUT: Final = "Change one of the annotations, or build the graph with types=False."
# A finding is a sentence; a long type is cut.
_WIDEST: Final = 60


@dataclass(frozen=True, slots=True)
class Said:
    """What the annotations of a function say.

    Attributes
    ----------
    taken
        The hint of each positional parameter; Any where there is none.
    returned
        The hint of the return value; Any if there is none.
    """

    taken: tuple[Any, ...]
    returned: Any


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
    said = {key: _said(function) for key, function in distinct(functions).items() if _is_annotated(function)}
    if not said or _always_agree(said.values(), len(functions)):
        return
    speakers = [(name, said[id(function)]) for name, function in functions.items() if id(function) in said]
    made: dict[str, Any] = {}
    for name, speaker in speakers:
        outputs = written[name][1] if name in written else None
        if not outputs or speaker.returned is Any:
            continue
        if type(outputs) is str:
            made[outputs] = speaker.returned
        else:
            items = _items(speaker.returned, len(outputs))
            if len(items) == len(outputs):
                made.update(zip(outputs, items, strict=True))
            else:
                yield _wrong_number(name, speaker.returned, len(items), outputs)
    yield from _no_common_value(made, speakers, graph)


def _always_agree(said: Collection[Said], count: int) -> bool:
    """Whether hints can be seen to agree whatever is joined: worth asking where functions are many and hints few."""
    made = {id(each.returned): each.returned for each in said}
    taken = {id(hint): hint for each in said for hint in each.taken}
    if len(made) * len(taken) > count or any(typing.get_origin(bare(hint)) is tuple for hint in made.values()):
        return False
    return not any(are_disjoint(one, other) for one in made.values() for other in taken.values())


def _no_common_value(
    made: Mapping[str, Any], speakers: Iterable[tuple[str, Said]], graph: BipartiteDigraph
) -> Iterable[Finding]:
    """Find consumers that no value of the producer's type can satisfy."""
    disjoint: dict[tuple[int, int], bool] = {}
    for taker, said in speakers:
        for token, taken in zip(graph.inputs.get(taker, ()), said.taken, strict=False):
            hint = made.get(token, Any)
            if hint is taken or hint is Any:
                continue
            pair = id(hint), id(taken)
            if pair not in disjoint:
                disjoint[pair] = are_disjoint(hint, taken)
            if disjoint[pair]:
                maker = graph.producer[token]
                text = (
                    f"Function {maker!r} makes token {token!r} as {_type_text(hint)}, but {taker!r} takes it as "
                    f"{_type_text(taken)}, and no value is both. {_WAY_OUT}"
                )
                yield Finding("types", text, (token, maker, taker))


def _is_annotated(function: Any) -> bool:
    if type(function) is FunctionType:
        return bool(function.__annotations__)
    # Other objects show the annotations of their class, which are not those of a call.
    return type(function) is MethodType or innermost(function) is not function


def _said(function: Any) -> Said:
    hints = hints_of(function)
    parameters = parameters_of(function) if hints else None
    positional = parameters.positional if parameters is not None else ()
    return Said(tuple(hints.get(name, Any) for name, _ in positional), hints.get("return", Any))


def _wrong_number(name: str, returned: Any, count: int, outputs: tuple[str, ...]) -> Finding:
    text = (
        f"Function {name!r} returns {_type_text(returned)}, {count} values, but its io names "
        f"{len(outputs)} outputs: ({', '.join(outputs)}). Name as many, or build the graph with types=False."
    )
    return Finding("types", text, (name, *outputs))


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
