"""Plain functions to be tuned: the graph and the runner that are made of them, as ``ipywidgets.interact`` takes them.

Arguments by position are payload. Those by keyword are abbreviations: a number, text or truth value is where a control
begins, a tuple of two or three numbers is a range, a list or a dict has choices; an array is payload, and so is
``ipywidgets.fixed(value)``.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

import ipywidgets

from epypes.acquisition.frames import Frame, with_images
from epypes.catalog import with_odd
from epypes.display import is_image
from epypes.errors import HyperparameterError, InvalidType, InvalidValue, PayloadError, UnknownName
from epypes.graph import CompGraph, annotated_params
from epypes.graph.signature import signature_of
from epypes.hints import Param, Roi, as_param
from epypes.run import CompGraphRunner, Run
from epypes.run.guard import is_array
from epypes_widgets.controls.ranges import allows
from epypes_widgets.values import is_movable, listed

_ABSENT: Final = object()
_ABBREVIATIONS: Final = "a range (low, high), a list of choices, an ep.Param, or the value to begin with"


@dataclass(frozen=True, slots=True)
class Made:
    """A runner that was made of functions, the hints of its hyperparameters, and the token to show at first."""

    runner: CompGraphRunner
    hints: dict[str, Any]
    token: str | None = None


def are_functions(given: object) -> bool:
    """Whether a runner is made of this: of a function, of a list of functions, or of a graph; not of a pipeline."""
    return isinstance(given, CompGraph | list | tuple) or (callable(given) and not hasattr(given, "cg"))


def made_runner(
    functions: Any,
    payload: Sequence[Any],
    given: Mapping[str, Any],
    call: str,
    *,
    has_images: bool = False,
    has_camera: bool = False,
) -> Made:
    """Return a runner of functions, run on its payload.

    Parameters
    ----------
    functions
        One function; several, which are joined by the names of their parameters (``CompGraph.from_functions``); or a
        graph.
    payload
        The values of the first source tokens, which are in the order of the functions' parameters.
    given
        Abbreviations and payload by source token.
    call
        What the user has called, for errors: ``"interact"``.
    has_images
        Whether images are given besides. Then nothing is run, tokens may be left for them, and arrays are
        hyperparameters.
    has_camera
        Whether these images are a camera's, whose settings are something to tune.

    Raises
    ------
    GraphError
        The functions make no graph: one is a lambda, or has no signature.
    TypeError, ValueError
        A function takes ``*args``; an abbreviation can't be read; the image is None; there is nothing to tune.
    UnknownName
        A keyword is for no parameter.
    PayloadError, HyperparameterError
        A parameter has no value, or two, or is computed.
    Exception
        Whatever a function raises.
    """
    cg = functions if isinstance(functions, CompGraph) else _graph_of(functions, call)
    tokens = tuple(token for token in cg.source_tokens if token not in cg.delays)
    of = f"of {listed([repr(name) for name in cg.functions])}"
    _require_parameters(cg, tokens, given, of)
    if len(payload) > len(tokens):
        text = f"{len(payload)} values are given by position; the parameters {of} are: {', '.join(tokens) or 'none'}."
        raise PayloadError(tokens, text)
    values = dict(zip(tokens, payload, strict=False))
    twice = [token for token in values if token in given]
    if twice:
        raise PayloadError(twice, f"{twice[0]!r} is given by position and by name. Leave one of them out.")
    meant = {token: _meant(cg, token, value) for token, value in given.items()}
    values |= {token: value for token, (value, is_payload) in meant.items() if is_payload}
    _require_images(values, cg)
    hints = {token: value for token, (value, _) in meant.items() if token not in values and as_param(value) is not None}
    began = {token: _began(cg, token, meant.get(token)) for token in tokens if token not in values}
    hparams = {token: value for token, value in began.items() if value is not _ABSENT}
    if has_images:
        hparams, values = {**values, **hparams}, {}
    runner = CompGraphRunner(cg, hparams)
    for token in values.keys() & runner.hyperparameters.keys():  # its parameter has a default
        runner.unfreeze(token)
    if not has_images:
        missing = [token for token in runner.free_source_tokens if token not in values]
        if missing:
            text = f"No value is given for {listed(list(map(repr, missing)))} {of}. Call"
            raise PayloadError(missing, f"{text} {_call(call, cg, tokens, [*values] or missing[:1], missing)}.")
    if not runner.hyperparameters and not has_camera:
        text = f"There is nothing to tune: no parameter {of} is left for a control. Give one a default, as in"
        raise InvalidValue(f"{text} def f(image, threshold=100).")
    if has_images:
        return Made(runner, hints)
    runner = _run(runner, with_images(values, cg))
    return Made(runner, hints, None if runner.last is None else _shown_first(runner.last))


def _run(runner: CompGraphRunner, payload: Mapping[str, Any]) -> CompGraphRunner:
    """Run a runner and return it; if a function returned an image among others, one in which each is a token."""
    run, cg = runner.run(**payload), runner.cg
    counts = {
        name: len(run[name])
        for name in cg.functions
        if name in cg.sink_tokens and type(run[name]) is tuple and any(map(is_image, run[name]))
    }
    if not counts or cg.delays:
        return runner
    outputs = {name: tuple(f"{name}_{place + 1}" for place in range(count)) for name, count in counts.items()}
    io = {name: (inputs, outputs.get(name, made)) for name, (inputs, made) in cg.func_io.items()}
    runner = CompGraphRunner(CompGraph(cg.functions, io, types=cg.types), runner.hyperparameters)
    runner.run(**payload)
    return runner


def _shown_first(run: Run) -> str | None:
    """Return the token to show at first: a dict, where functions return nothing else; None leaves it to the panel.

    Raises
    ------
    ValueError
        The functions return None, and so there is nothing to show.
    """
    values = {token: run[token] for token in run.cg.sink_tokens}
    if values and all(value is None for value in values.values()):
        names = listed([repr(run.cg.digraph.producer[token]) for token in values])
        text = f"There is nothing to show: {names} returned None."
        raise InvalidValue(f"{text} A panel shows what functions return. End with: return image.")
    return next(iter(values), None) if all(isinstance(value, dict) for value in values.values()) else None


def _graph_of(functions: Any, call: str) -> CompGraph:
    each = functions if isinstance(functions, list | tuple) else (functions,)
    if any(hasattr(function, "cg") for function in each):
        raise InvalidType(f"{call}() takes functions here, not {type(each[0]).__name__!r}. A runner: tune(runner).")
    if not each:
        raise InvalidValue(f"No function is given. Call {call}([blur, edges], ...) with one at least.")
    for function in each:
        for parameter in _parameters(function).values():
            if parameter.kind is parameter.VAR_POSITIONAL:
                name = getattr(function, "__name__", "A function")
                text = f"{name!r} takes *{parameter.name}: the names of those parameters are not known."
                raise InvalidType(f"{text} Write a function (def) that names each of them.")
    return CompGraph.from_functions(*each)


def _parameters(function: Any) -> Mapping[str, Any]:
    return getattr(signature_of(function), "parameters", {})


def _require_parameters(cg: CompGraph, tokens: Sequence[str], given: Iterable[str], of: str) -> None:
    """Raise unless each name is that of a source token."""
    for name in given:
        if name in tokens:
            continue
        if cg.has_token(name):
            raise HyperparameterError(
                name, f"{name!r} is computed by the functions, so it has no control. Leave it out."
            )
        for function in cg.functions.values():
            parameter = _parameters(function).get(name)
            if parameter is not None and parameter.kind is parameter.KEYWORD_ONLY:
                text = f"Parameter {name!r} of {function.__name__!r} is given by its name only, and a graph gives all"
                raise InvalidType(f"{text} by position. Take the '*' before it out of the signature.")
        raise UnknownName("parameter", name, tokens, of)


def _require_images(values: Mapping[str, Any], cg: CompGraph) -> None:
    for token, value in values.items():
        if value is None and cg.defaults.get(token, _ABSENT) is not None:
            text = f"{token!r} is None, which is no image. Was the file found?"
            raise InvalidValue(f"{text} cv2.imread gives None for one that it can't read: check the path.")


def _call(call: str, cg: CompGraph, tokens: Sequence[str], payload: Sequence[str], missing: Sequence[str]) -> str:
    """Return the call that gives all that is missing."""
    names = ", ".join(cg.functions)
    shown = [token if call == "interact" else f"{token}={token}" for token in tokens if token in payload]
    ranges = [f"{token}=(low, high)" for token in missing if token not in payload]
    return f"{call}({', '.join([names if len(cg.functions) == 1 else f'[{names}]', *shown, *ranges])})"


def _meant(cg: CompGraph, name: str, given: Any) -> tuple[Any, bool]:
    """Return what an argument by keyword means, a value or a hint, and whether it is payload."""
    if isinstance(given, ipywidgets.fixed):
        return given.value, True
    if isinstance(given, ipywidgets.Widget):
        text = f"{name!r} is a widget ({type(given).__name__}), and a panel makes its own."
        raise InvalidType(f"{text} Give {_ABBREVIATIONS}.")
    if is_array(given) or isinstance(given, Frame):
        return given, True
    try:
        hint = as_param(given)
    except (TypeError, ValueError) as error:
        raise InvalidValue(f"Hint of {name!r}: {error}") from error
    if isinstance(hint, Param) and isinstance(given, tuple) and hint.low == hint.high:
        text = f"Hint of {name!r}: there is one value in the range {given!r}, so there is nothing to move."
        raise InvalidValue(f"{text} Give another end. If the tuple is meant itself: ipywidgets.fixed({given!r}).")
    if isinstance(hint, Param):
        hint = with_odd(given, hint, cg, name)
    return given if hint is None else hint, False


# -- where controls begin -------------------------------------------------------------------------------------------


def _began(cg: CompGraph, token: str, meant: tuple[Any, bool] | None) -> Any:
    """Return the first value of a hyperparameter, by what is meant, its default or its annotation."""
    default, value = cg.defaults.get(token, _ABSENT), _ABSENT if meant is None else meant[0]
    hint = as_param(value)
    if hint is None and value is default is _ABSENT:
        hint = next(annotated_params(cg, token), None)
    return _start(hint, default) if hint is not None else default if value is _ABSENT else value


def _start(hint: Param | Roi, default: Any) -> Any:
    """Return where a control begins: at the default, at the allowed value next to it, or in the middle."""
    if isinstance(hint, Roi) or hint.choices is not None:
        is_allowed = default is not _ABSENT and allows(hint, default)
        return default if is_allowed or isinstance(hint, Roi) else (hint.choices or ())[0]
    is_float = any(isinstance(end, float) for end in (hint.low, hint.high, hint.step))
    ends = [end for end in hint.soft or (hint.low, hint.high) if end is not None and math.isfinite(end)]
    if not ends and not is_movable(default):
        return default
    value = default if is_movable(default) else _middle(hint, ends[0], ends[-1], hint.step or (not is_float))
    value = max(value, value if hint.low is None else hint.low)
    value = min(value, value if hint.high is None else hint.high)
    if hint.odd and value % 2 == 0:
        value += 1 if allows(hint, value + 1) else -1
    return float(value) if is_float else value


def _middle(hint: Param, low: float, high: float, step: float) -> float:
    """Return the middle of a range, on its steps from the low end if there are some."""
    middle = math.sqrt(low * high) if hint.log else low + (high - low) / 2
    return low + int((middle - low) / step) * step if step else middle
