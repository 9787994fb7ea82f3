"""What are a function's parameters, and what are the first lines of its source?"""

from __future__ import annotations

import inspect
import linecache
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice
from types import CodeType, FunctionType
from typing import Any, Final
from weakref import WeakKeyDictionary

from epypes.display.previews.preview import preview
from epypes.display.previews.short import without_addresses
from epypes.graph import CompGraph, unwrapped

SIGNATURE_CHARACTERS: Final = 200
SOURCE_LINES: Final = 30
LINE_CHARACTERS: Final = 120
_DOCUMENTED: Final = "# no source in Python; its documentation begins:"
# A re-display of 200 functions must not look at 200 files again. A function that is defined again is another object.
_known: WeakKeyDictionary[Any, tuple[str, str]] = WeakKeyDictionary()


def signature_and_source(function: Any) -> tuple[str, str]:
    """Return a function's parameters, and the first lines of its source; never raises.

    Of what is decorated, partial or a node the user's own function is told. What has no source in Python has the first
    lines of its documentation instead, marked so.

    Returns
    -------
    tuple
        Two texts, either of which is empty if it can't be found: at most 200 characters; at most 30 lines of at most
        120 characters.
    """
    try:
        if function not in _known:
            _known[function] = _signature(function), _source(function)
        return _known[function]
    except TypeError:  # no weak reference to it, or no hash: it is looked at again
        return _signature(function), _source(function)
    except Exception:  # whatever odd objects raise when they are hashed or compared
        return "", ""


def graph_lines(cg: CompGraph) -> str:
    """Return the first functions of a pipeline's graph as lines: ``canny(image, low, high) -> edges``."""
    lines = [
        f"{name}({', '.join(cg.func_inputs(name))}) -> {', '.join(cg.func_outputs(name)) or 'nothing'}"
        for name in islice(cg.functions, SOURCE_LINES + 1)
    ]
    return _first_lines(lines)


def _signature(function: Any) -> str:
    if not isinstance(function, FunctionType | partial) and isinstance(unwrapped(function), FunctionType):
        function = unwrapped(function)
    return _tried(lambda: _signature_text(inspect.signature(function)))


def _signature_text(signature: inspect.Signature) -> str:
    """Return a signature as text, in which defaults are told as previews: their own repr may be long, slow or raise."""
    short = [
        each if each.default is each.empty else each.replace(default=_Told(preview(each.default).text))
        for each in signature.parameters.values()
    ]
    text = without_addresses(str(signature.replace(parameters=short)))
    if len(text) > SIGNATURE_CHARACTERS:
        plain = [each.replace(annotation=each.empty) for each in short]
        text = without_addresses(str(signature.replace(parameters=plain, return_annotation=signature.empty)))
    return _cut(text, SIGNATURE_CHARACTERS)


@dataclass(frozen=True, slots=True, repr=False)
class _Told:
    text: str

    def __repr__(self) -> str:
        return self.text


def _source(function: Any) -> str:
    return _tried(lambda: _first_lines(_code_lines(unwrapped(function)))) or _tried(lambda: _documentation(function))


def _tried(told: Callable[[], str]) -> str:
    try:
        return told()
    except Exception:  # a signature or a docstring may be any object
        return ""


def _code_lines(function: Any) -> Sequence[str]:
    """Return the lines of a function; none if the lines that are there now are not those of a definition of it.

    Found by the positions in its code: to parse the file, as ``inspect.getsource`` does, takes a hundred times longer.
    """
    if not isinstance(function, FunctionType):
        function = getattr(type(function), "__call__", None)  # noqa: B004 - the method itself is wanted
    if not isinstance(function, FunctionType):
        return ()
    code = function.__code__
    lines = linecache.getlines(code.co_filename, function.__globals__)[code.co_firstlineno - 1 : _last_line(code)]
    marks = ("lambda",) if code.co_name == "<lambda>" else (f"def {code.co_name}",)
    return lines if any(mark in line for mark in marks for line in lines) else ()


def _last_line(code: CodeType) -> int:
    """Return the last line of code, with the functions defined in it."""
    inner = (_last_line(item) for item in code.co_consts if isinstance(item, CodeType))
    own = (end for _, end, _, _ in code.co_positions() if end is not None)
    return max((*inner, *own), default=code.co_firstlineno)


def _first_lines(lines: Sequence[str]) -> str:
    kept = [line.rstrip().expandtabs(4) for line in lines[:SOURCE_LINES]]
    margin = min((len(line) - len(line.lstrip()) for line in kept if line), default=0)
    cut = [_cut(line[margin:], LINE_CHARACTERS) for line in kept]
    if len(lines) > SOURCE_LINES:
        cut[-1] = "…"
    return "\n".join(cut)


def _documentation(function: Any) -> str:
    """Return the first lines of the docstring of what is not written in Python."""
    if isinstance(unwrapped(function), FunctionType) or not callable(function):
        return ""
    text = inspect.getdoc(unwrapped(function)) or ""
    return "\n".join((_DOCUMENTED, *_lines_of(text))) if text else ""


def _lines_of(text: str) -> Iterator[str]:
    """Give the first lines of a text; a docstring may be as long as a book."""
    return (_cut(line.rstrip(), LINE_CHARACTERS) for line in islice(text[:10_000].splitlines(), SOURCE_LINES - 1))


def _cut(text: str, characters: int) -> str:
    return text if len(text) <= characters else text[: characters - 1] + "…"
