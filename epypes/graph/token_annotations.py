"""Annotations of tokens: what the annotations of functions say of their inputs and outputs, images and ranges too."""

from __future__ import annotations

import typing
from collections.abc import Iterable, Iterator, Mapping
from types import FunctionType, MethodType
from typing import TYPE_CHECKING, Any, Final, NamedTuple
from weakref import WeakKeyDictionary

from epypes.errors import Finding
from epypes.graph.bipartite import BipartiteDigraph
from epypes.graph.identity import innermost, inside_of
from epypes.graph.signature import distinct, positional_names
from epypes.hints import Param, Roi, param_of
from epypes.images import Contracts, Image, mark_of

if TYPE_CHECKING:
    from epypes.graph.compgraph import CompGraph
    from epypes.graph.validation import GraphParts

_NO_HINTS: Final[Mapping[str, Any]] = {}
# Weak, so that a function of a notebook that was defined again can go. To evaluate annotations takes some 30 us.
_EVALUATED: Final[WeakKeyDictionary[FunctionType, Mapping[str, Any]]] = WeakKeyDictionary()


class TokenHints(NamedTuple):
    """The type hints of the tokens of one function; Any where there is none.

    Attributes
    ----------
    inputs
        By input token. ``*args`` speak for every input that they take.
    outputs
        By output token; of a returned tuple by its items, which may be of another number. ``tuple[A, ...]`` speaks for
        every output.
    returned
        Of the value.
    marks
        The marks of images by input and by output token, None where there is none; None without any. ``list[A]``
        speaks for every output.
    """

    inputs: tuple[Any, ...]
    outputs: tuple[Any, ...]
    returned: Any
    marks: Contracts | None


def read_hints(parts: GraphParts, digraph: BipartiteDigraph) -> dict[str, TokenHints]:
    """Return the type hints of tokens by function; functions without annotations are left out.

    If types are not compared, also those that have no marks of images.
    """
    annotated = {
        key
        for key, function in distinct(parts.functions).items()
        if _is_annotated(function) and (parts.types or _is_marked(function))
    }
    found: dict[str, TokenHints] = {}
    # A large graph has few functions under many names.
    read: dict[tuple[int, int, int | None], TokenHints | None] = {}
    for name, tokens in digraph.inputs.items():
        function = parts.functions.get(name)
        if function is not None and id(function) in annotated:
            count = None if parts.has_single_output(name) else len(digraph.outputs[name])
            key = id(function), len(tokens), count
            if key not in read:
                read[key] = _hints_of_tokens(function, len(tokens), count)
            hints = read[key]
            if hints is not None:
                found[name] = hints
    return found


def _is_annotated(function: Any) -> bool:
    if type(function) is FunctionType:
        try:
            return bool(function.__annotations__)
        except Exception:  # Python 3.14 evaluates them here; what that raises is the user's
            return False
    if type(function) is MethodType or innermost(function) is not function:
        return True
    # Other objects show the annotations of their class, which are not those of a call, unless they have their own.
    return not isinstance(function, type) and "__annotations__" in getattr(function, "__dict__", ())


def _hints_of(function: object) -> Mapping[str, Any]:
    """Return the type hints of a function by parameter, and that of ``return``; not to be changed.

    ``Annotated`` is kept. Empty where there are none, and where they can't be evaluated: a name that is not defined
    yet, a class that others have nothing to do with, whatever the text of an annotation raises.
    """
    if not isinstance(function, FunctionType):
        return _evaluated(function) or _NO_HINTS
    hints = _EVALUATED.get(function)
    if hints is None:
        hints = _evaluated(function)
        if hints is None:
            return _NO_HINTS  # and not for good: the names may be defined later
        _EVALUATED[function] = hints
    return hints


def _evaluated(function: Any) -> Mapping[str, Any] | None:
    try:
        return typing.get_type_hints(function, include_extras=True)
    except Exception:  # what the text of an annotation raises is the user's
        return None


def _is_marked(function: Any) -> bool:
    return any(mark_of(part) for hint in _hints_of(function).values() for part in (hint, *typing.get_args(hint)))


def _hints_of_tokens(function: Any, inputs: int, outputs: int | None) -> TokenHints | None:
    """Read the hints of a function with so many inputs and outputs, None for the value as it is."""
    hints = _hints_of(function)
    if not hints:
        return None
    names, rest = positional_names(function)
    taken = [*(hints.get(name, Any) for name in names), *[hints.get(rest, Any)] * (inputs - len(names))]
    returned = hints.get("return", Any)
    made = (returned,) if outputs is None else _items(returned, outputs)
    # The items of a list may be of several types, as those of [keypoints, None]: its images alone are known.
    shown = typing.get_args(returned) * len(made) if outputs and typing.get_origin(returned) is list else made
    marked = tuple(map(mark_of, shown)) if outputs in (None, len(made)) else (None,) * (outputs or 0)
    marks = tuple(map(mark_of, taken[:inputs])), marked
    return TokenHints(tuple(taken[:inputs]), made, returned, marks if any(map(any, marks)) else None)


def _items(returned: Any, count: int) -> tuple[Any, ...]:
    """Return the hints of a tuple's items; Any for each of ``count`` where the hint says nothing about them."""
    plain = bare(returned)
    items = typing.get_args(plain) if typing.get_origin(plain) is tuple else ()
    if items[1:] == (Ellipsis,):
        return items[:1] * count
    return items if items and not any(map(_is_unpacked, items)) else (Any,) * count


def _is_unpacked(item: Any) -> bool:
    return typing.get_origin(item) is typing.Unpack or getattr(item, "__unpacked__", False)


def bare(hint: Any) -> Any:
    """Return a hint without its ``Annotated``, and what a ``type`` alias stands for."""
    origin = typing.get_origin(hint)
    if origin is typing.Annotated:
        return bare(typing.get_args(hint)[0])
    if type(hint).__name__ == "TypeAliasType":
        return bare(hint.__value__)
    if type(origin).__name__ == "TypeAliasType":  # NDArray[np.uint8], from Python 3.12 on
        return bare(origin.__value__[typing.get_args(hint)])
    return hint


def annotated_params(cg: CompGraph, token: str) -> Iterator[Param | Roi]:
    """Give the ranges in the annotations of the functions that take a token, in run order."""
    cg, token = inside_of(cg, token)
    for name in cg.digraph.consumers.get(token, ()):
        function, tokens = cg.functions[name], cg.func_inputs(name)
        hints = _hints_of_tokens(function, len(tokens), None) if _is_annotated(function) else None
        found = param_of(hints.inputs[tokens.index(token)]) if hints is not None else None
        if found is not None:
            yield found


def contracts_of(hints: Mapping[str, TokenHints]) -> dict[str, Contracts]:
    """Return the marks of images by function; functions without any are left out."""
    return {name: each.marks for name, each in hints.items() if each.marks is not None}


def check_images(contracts: Mapping[str, Contracts], digraph: BipartiteDigraph) -> Iterable[Finding]:
    """Find tokens that two functions want as images that no image is both."""
    made: dict[str, tuple[str, Image]] = {}
    for name, token, mark, verb in marks_of(contracts, digraph):
        if verb == "makes":
            made[token] = name, mark
        elif token in made and not made[token][1].fits(mark):
            maker, as_made = made[token]
            text = (
                f"Function {maker!r} makes token {token!r} as {as_made}, but {name!r} takes it as {mark}, and no image "
                "is both. Change one of the annotations, or build the graph with types=False."
            )
            yield Finding("types", text, (token, maker, name))


def marks_of(contracts: Mapping[str, Contracts], digraph: BipartiteDigraph) -> Iterator[tuple[str, str, Image, str]]:
    """Give every mark: function, token, mark and ``"makes"`` or ``"takes"``, makers first."""
    for side, verb, tokens_of in ((1, "makes", digraph.outputs), (0, "takes", digraph.inputs)):
        for name, marks in contracts.items():
            for token, mark in zip(tokens_of[name], marks[side], strict=False):
                if mark is not None:
                    yield name, token, mark, verb
