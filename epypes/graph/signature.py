"""The signature of a function: its inputs, those of a C function by its docstring, and what ``@ep.outputs`` names."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping
from types import FunctionType
from typing import Any, Final, TypeGuard, TypeVar

from epypes.errors import InvalidType, InvalidValue

F = TypeVar("F", bound=Callable[..., Any])

_OUTPUTS: Final = "__epypes_outputs__"
# The first line of a docstring of OpenCV: "blur(src, ksize[, dst[, anchor]]) -> dst".
_DOCUMENTED: Final = re.compile(r"[\w.]+\(([^()]*)\)(?: -> (.+))?")
_BETWEEN_NAMES: Final = re.compile(r"[\[\],\s]+")


def signature_of(function: Callable[..., Any]) -> inspect.Signature | None:
    """Return the signature, or None where there is none (``cv2.Canny`` and other C functions)."""
    try:
        return inspect.signature(function)
    except Exception:  # inspect's own errors, and whatever an object's __signature__ or __getattr__ raises
        return None


def documented_signature(docstring: str) -> tuple[tuple[str, ...], tuple[str, ...]] | None:
    """Return the parameters and the results in the first line of a docstring, as OpenCV writes it; None without.

    Examples
    --------
    >>> documented_signature("circle(img, center, radius, color[, thickness]) -> img")
    (('img', 'center', 'radius', 'color', 'thickness'), ('img',))
    """
    found = _DOCUMENTED.match(docstring.lstrip())
    if found is None:
        return None
    parameters, results = (tuple(filter(None, _BETWEEN_NAMES.split(part or ""))) for part in found.groups())
    return parameters, results


def documented_in_out(docstring: str) -> tuple[int, ...]:
    """Return the places of the parameters that are results too, in any of the forms that a docstring of OpenCV lists.

    Examples
    --------
    >>> documented_in_out("floodFill(image, mask, seedPoint, newVal[, flags]) -> retval, image, mask, rect")
    (0, 1)
    """
    head = docstring.lstrip().partition("(")[0] + "("
    forms = [documented_signature(line) for line in docstring.splitlines() if line.lstrip().startswith(head)]
    shared = {place for form in forms if form for place, name in enumerate(form[0]) if name in form[1]}
    return tuple(sorted(shared))


def positional_of(signature: inspect.Signature) -> list[inspect.Parameter]:
    """Return the parameters that can be given by position, but for ``*args``."""
    kinds = (inspect.Parameter.POSITIONAL_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD)
    return [parameter for parameter in signature.parameters.values() if parameter.kind in kinds]


def distinct(functions: Mapping[str, Any]) -> dict[int, Any]:
    """Return each function once, by its id: a large graph has few functions under many names."""
    return {id(function): function for function in functions.values()}


def plain_count(function: object) -> int | None:
    """Return how many parameters a plain function has, all of which can be given by position; None for any other.

    It is read from the code: ``inspect.signature`` takes 10 us, and a graph may have 10,000 functions.
    """
    if not _is_plain(function) or function.__code__.co_kwonlyargcount:
        return None
    return function.__code__.co_argcount


def positional_names(function: Callable[..., Any]) -> tuple[tuple[str, ...], str]:
    """Return the names of the parameters that can be given by position, and that of ``*args``; empty if not known."""
    if _is_plain(function):
        code, count = function.__code__, function.__code__.co_argcount
        has_rest = code.co_flags & inspect.CO_VARARGS
        return code.co_varnames[:count], code.co_varnames[count + code.co_kwonlyargcount] if has_rest else ""
    signature = signature_of(function)
    if signature is None:
        return (), ""
    rest = (each.name for each in signature.parameters.values() if each.kind is each.VAR_POSITIONAL)
    return tuple(parameter.name for parameter in positional_of(signature)), next(rest, "")


def _is_plain(function: object) -> TypeGuard[FunctionType]:
    """Whether a function's parameters are those of its code."""
    if type(function) is not FunctionType:
        return False
    return not function.__dict__ or function.__dict__.keys().isdisjoint(("__wrapped__", "__signature__"))


def outputs(*names: str) -> Callable[[F], F]:
    """Name the output tokens of a function, for ``CompGraph.from_functions``.

    One name takes the value as it is, n names a sequence of n values; without a name there is no output.

    Examples
    --------
    >>> @outputs("keypoints", "descriptors")
    ... def detect(image):
    ...     return [], None
    """
    for name in names:
        if not isinstance(name, str) or not name:
            text = f"outputs() takes the names of tokens, not {name!r}."
            raise InvalidType(text + ' Write @ep.outputs("a", "b") above the function.' * callable(name))
    twice = [name for name in dict.fromkeys(names) if names.count(name) > 1]
    if twice:
        raise InvalidValue(f"outputs() names {', '.join(map(repr, twice))} twice. Every output is a token of its own.")

    def mark(function: F) -> F:
        try:
            setattr(function, _OUTPUTS, names)
        except (AttributeError, TypeError) as error:
            name = getattr(function, "__name__", function)
            raise InvalidType(
                f"{name!r} can't be marked. Write a function (def) that calls it, and mark that."
            ) from error
        return function

    return mark


def declared_outputs(function: object) -> tuple[str, ...] | None:
    """Return the names given to ``outputs``, None if it was not used."""
    found = getattr(function, _OUTPUTS, None)
    return found if isinstance(found, tuple) else None
