"""Type check of a graph: what its functions' annotations say of a token must allow a common value.

The check errs on the side of leniency: what can't be judged is let pass.
"""

from __future__ import annotations

import numbers
import types
import typing
from abc import ABCMeta
from collections.abc import Iterable, Iterator, Mapping
from typing import Any, Final, Literal, Union

from epypes.errors import Finding
from epypes.graph.bipartite import BipartiteDigraph
from epypes.graph.token_annotations import TokenHints, bare

# A finding is a sentence; a long type is cut.
_WIDEST: Final = 60
# PEP 484 once let bytes stand for all three, and much code still does.
_BYTES: Final = frozenset({bytes, bytearray, memoryview})


def check_types(hints: Mapping[str, TokenHints], digraph: BipartiteDigraph) -> Iterable[Finding]:
    """Find tokens that are made as one type and taken as another, and tuples of another length than the outputs.

    Parameters
    ----------
    hints
        The annotations by function.
    digraph
        What is connected to what.
    """
    made: dict[str, Any] = {}
    for name, each in hints.items():
        outputs = digraph.outputs[name]
        if len(each.outputs) == len(outputs):
            made.update(zip(outputs, each.outputs, strict=True))
        elif outputs:
            text = (
                f"Function {name!r} returns {_type_text(each.returned)}, {len(each.outputs)} values, but its io names "
                f"{len(outputs)} outputs: ({', '.join(outputs)}). "
                "Name as many, or build the graph with types=False."
            )
            yield Finding("types", text, (name, *outputs))
    known: dict[tuple[int, int], bool] = {}
    for taker, each in hints.items():
        for token, hint in zip(digraph.inputs[taker], each.inputs, strict=True):
            as_made = made.get(token, hint)
            if as_made is hint:
                continue
            pair = id(as_made), id(hint)
            if pair not in known:
                known[pair] = are_disjoint(as_made, hint)
            if known[pair]:
                maker = digraph.producer[token]
                text = (
                    f"Function {maker!r} makes token {token!r} as {_type_text(as_made)}, but {taker!r} takes it as "
                    f"{_type_text(hint)}, and no value is both. "
                    "Change one of the annotations, or build the graph with types=False."
                )
                yield Finding("types", text, (token, maker, taker))


def _type_text(hint: Any) -> str:
    text = hint.__qualname__ if isinstance(hint, type) and not typing.get_args(hint) else repr(hint)
    text = text.replace("typing.", "")
    return text if len(text) <= _WIDEST else text[: _WIDEST - 3] + "..."


def are_disjoint(left: Any, right: Any) -> bool:
    """Whether surely no value satisfies both type hints.

    Examples
    --------
    >>> are_disjoint(int, str), are_disjoint(int, float), are_disjoint(int | None, str | None)
    (True, False, False)
    """
    return all(_exclude(one, other) for one in _alternatives(left) for other in _alternatives(right))


def _alternatives(hint: Any) -> Iterator[Any]:
    """Give the members of a union, and the types of a literal's values; any other hint alone, without ``Annotated``."""
    plain = bare(hint)
    if typing.get_origin(plain) in (Union, types.UnionType):
        for member in typing.get_args(plain):
            yield from _alternatives(member)
    elif typing.get_origin(plain) is Literal:
        yield from map(type, typing.get_args(plain))
    else:
        yield type(None) if plain is None else plain


def _exclude(left: Any, right: Any) -> bool:
    """Whether surely no value satisfies both of two hints that are no unions and no literals."""
    one, other = typing.get_origin(left) or left, typing.get_origin(right) or right
    if not isinstance(one, type) or not isinstance(other, type):
        return False  # a TypeVar, a NewType ...
    if one is other:
        # By identity: np.dtype("float64") == None.
        dtype, other_dtype = _dtype(left), _dtype(right)
        return dtype is not None and other_dtype is not None and bool(dtype != other_dtype)
    try:
        return not (_is_open(one) or _is_open(other) or _are_exchanged(one, other) or _have_common_class(one, other))
    except Exception:  # a TypedDict, or a metaclass that raises
        return False


def _is_open(kind: type) -> bool:
    """Whether classes may satisfy this one without saying so: abstract classes, protocols, Any and its subclasses."""
    return isinstance(kind, ABCMeta) or Any in kind.__mro__


def _are_exchanged(left: type, right: type) -> bool:
    """Whether values of one type are commonly given where the other is written, as an int for a float."""
    return {left, right} <= _BYTES or (_is_number(left) and _is_number(right))


def _is_number(kind: type) -> bool:
    # NumPy's bool is no numbers.Number, but stands for Python's.
    return issubclass(kind, numbers.Number) or _is_numpy_scalar(kind)


def _is_numpy_scalar(kind: type) -> bool:
    return any(base.__module__ == "numpy" and base.__name__ == "generic" for base in kind.__mro__)


def _have_common_class(left: type, right: type) -> bool:
    """Whether one is a subclass of the other, or there is a class that is both, as with a mix-in."""
    return issubclass(right, left) or _is_or_has_subclass(left, right)


def _is_or_has_subclass(kind: type, of: type) -> bool:
    return issubclass(kind, of) or any(_is_or_has_subclass(below, of) for below in type.__subclasses__(kind))


def _dtype(hint: Any) -> Any:
    """Return the dtype of an ``NDArray[scalar]``; None if there is none, or it is abstract, as np.integer is."""
    arguments = typing.get_args(hint)
    if len(arguments) != 2 or getattr(typing.get_origin(hint), "__module__", "") != "numpy":
        return None
    dtype, scalars = typing.get_origin(arguments[1]), typing.get_args(arguments[1])
    is_concrete = len(scalars) == 1 and isinstance(scalars[0], type) and _is_numpy_scalar(scalars[0])
    return dtype(scalars[0]) if is_concrete and not type.__subclasses__(scalars[0]) else None
