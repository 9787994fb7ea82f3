"""How does a graph look here whose functions run somewhere else?

Structure, ranges and the order of colours are those of the service, so that whatever asks the graph gets its answers;
only its functions are stand-ins, which say where they run when somebody calls them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import fields
from types import FunctionType
from typing import Annotated, Any, Final, NoReturn

from epypes.errors import ServiceError
from epypes.graph import CompGraph
from epypes.hints import Param
from epypes.images import Image

_RANGE: Final = tuple(field.name for field in fields(Param))
_PAIR: Final = ("soft", "choices", "labels")


def graph_of(
    url: str, func_io: Mapping[str, Sequence[Any]], entries: Mapping[str, Mapping[str, Any]], rgb: Iterable[str]
) -> CompGraph:
    """Return the graph of a service, whose functions say where they run.

    Parameters
    ----------
    url
        Where that is.
    func_io
        As JSON has it: lists are tuples.
    entries
        Of the hyperparameters, by token: their ranges become annotations.
    rgb
        The tokens whose colours are RGB.

    Raises
    ------
    GraphError
        This is no graph.
    """
    marks: dict[str, Any] = {token: Annotated[Any, Image(order="rgb")] for token in rgb}
    for token, entry in entries.items():
        param = param_of(entry)
        if param is not None:
            marks[token] = Annotated[Any, param]
    written = {name: (_tuple(io[0]), _tuple(io[1])) for name, io in func_io.items()}
    functions = {name: _stand_in(url, name, io, marks) for name, io in written.items()}
    return CompGraph(functions, written, types=False)


def param_of(entry: Mapping[str, Any]) -> Param | None:
    """Return the range in an entry; None if it has none, or one that contradicts itself."""
    said: dict[str, Any] = {
        key: tuple(entry[key]) if key in _PAIR else entry[key] for key in _RANGE if entry.get(key) is not None
    }
    with suppress(ValueError, TypeError):
        return Param(**said) if said else None
    return None


def _tuple(side: Any) -> Any:
    return tuple(side) if isinstance(side, list) else side


def _names(side: Any) -> tuple[str, ...]:
    return () if side is None else (side,) if isinstance(side, str) else side


def _refused() -> NoReturn:
    """Stand where each stand-in has a sentence of its own."""
    raise NotImplementedError


def _pattern() -> Any:
    return _refused()


def _stand_in(url: str, name: str, io: tuple[Any, Any], marks: Mapping[str, Any]) -> Callable[..., Any]:
    """Return a function with a parameter per input token, and with what is known of its tokens as annotations."""

    def refused() -> NoReturn:
        text = f"Function {name!r} runs in the service at {url}, not here. Load its bundle to run it: ep.load(...)."
        raise ServiceError(url, text)

    inputs, outputs = _names(io[0]), _names(io[1])
    parameters = tuple(
        token if token.isidentifier() and inputs.index(token) == place else f"_{place}"
        for place, token in enumerate(inputs)
    )
    code = _pattern.__code__.replace(
        co_name=name,
        co_varnames=parameters,
        co_nlocals=len(parameters),
        co_argcount=len(parameters),
    )
    function = FunctionType(code, {"_refused": refused}, name)
    taken = {parameter: marks.get(token) for parameter, token in zip(parameters, inputs, strict=True)}
    function.__annotations__ = {parameter: mark for parameter, mark in taken.items() if mark is not None}
    made: Any = tuple(marks.get(token, Any) for token in outputs)
    if made:
        function.__annotations__["return"] = made[0] if isinstance(io[1], str) else tuple[made]
    return function
