"""Type check of a graph: what its functions' annotations say of a token must allow a common value.

The check errs on the side of leniency: what can't be judged is let pass.
"""

from __future__ import annotations

import numbers
import types
import typing
from abc import ABCMeta
from collections.abc import Iterable, Iterator, Mapping
from types import FunctionType, MethodType
from typing import Annotated, Any, Final, Literal, Union

from epypes.annotations import hints_of
from epypes.errors import Finding
from epypes.graph.bipartite import BipartiteDigraph
from epypes.graph.identity import innermost
from epypes.graph.signature import distinct, positional_of, signature_of

# A finding is a sentence; a long type is cut.
_WIDEST: Final = 60
# PEP 484 once let bytes stand for all three, and much code still does.
_BYTES: Final = frozenset({bytes, bytearray, memoryview})


def check_types(
    functions: Mapping[str, Any], digraph: BipartiteDigraph, func_io: Mapping[str, Any]
) -> Iterable[Finding]:
    """Find tokens that are made as one type and taken as another, and tuples of another length than the outputs.

    Parameters
    ----------
    functions
        The callables by name.
    digraph
        What is connected to what.
    func_io
        The io by function name, as it was written.
    """
    # A large graph has few functions under many names.
    read = {key: _read(function) for key, function in distinct(functions).items() if _is_annotated(function)}
    hints = {name: read[id(function)] for name, function in functions.items() if id(function) in read}
    made: dict[str, Any] = {}
    for name, (_, returned) in hints.items():
        outputs = func_io[name][1] if name in func_io else None
        if isinstance(outputs, str):
            made[outputs] = returned
        elif outputs:
            items = _items(returned, len(outputs))
            if len(items) == len(outputs):
                made.update(zip(outputs, items, strict=True))
            else:
                text = (
                    f"Function {name!r} returns {_type_text(returned)}, {len(items)} values, but its io names "
                    f"{len(outputs)} outputs: ({', '.join(outputs)}). "
                    "Name as many, or build the graph with types=False."
                )
                yield Finding("types", text, (name, *outputs))
    known: dict[tuple[int, int], bool] = {}
    for taker, (taken, _) in hints.items():
        for token, hint in zip(digraph.inputs.get(taker, ()), taken, strict=False):
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


def _read(function: Any) -> tuple[tuple[Any, ...], Any]:
    """Return the hint of each positional parameter, and of the return value; Any where there is none."""
    hints = hints_of(function)
    signature = signature_of(function) if hints else None
    positional = positional_of(signature) if signature is not None else ()
    return tuple(hints.get(parameter.name, Any) for parameter in positional), hints.get("return", Any)


def _is_annotated(function: Any) -> bool:
    if type(function) is FunctionType:
        return bool(function.__annotations__)
    # Other objects show the annotations of their class, which are not those of a call.
    return type(function) is MethodType or innermost(function) is not function


def _items(returned: Any, count: int) -> tuple[Any, ...]:
    """Return the hints of a tuple's items; Any for each of ``count`` where the hint says nothing about them."""
    plain = _bare(returned)
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


def are_disjoint(left: Any, right: Any) -> bool:
    """Whether surely no value satisfies both type hints.

    Examples
    --------
    >>> are_disjoint(int, str), are_disjoint(int, float), are_disjoint(int | None, str | None)
    (True, False, False)
    """
    return all(_exclude(one, other) for one in _alternatives(left) for other in _alternatives(right))


def _bare(hint: Any) -> Any:
    """Return a hint without its ``Annotated``, and what a ``type`` alias stands for."""
    origin = typing.get_origin(hint)
    if origin is Annotated:
        return _bare(typing.get_args(hint)[0])
    if type(hint).__name__ == "TypeAliasType":
        return _bare(hint.__value__)
    if type(origin).__name__ == "TypeAliasType":  # NDArray[np.uint8], from Python 3.12 on
        return _bare(origin.__value__[typing.get_args(hint)])
    return hint


def _alternatives(hint: Any) -> Iterator[Any]:
    """Give the members of a union, and the types of a literal's values; any other hint alone, without ``Annotated``."""
    plain = _bare(hint)
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
