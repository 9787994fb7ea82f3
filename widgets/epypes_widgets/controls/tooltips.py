"""The tooltip of a hyperparameter."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from typing import Any, Final

from docstring_parser import Docstring, parse

from epypes.graph import CompGraph, unwrapped
from epypes.hints import Param
from epypes_widgets.controls.ranges import Range, range_text, takers

_MAX_CHARACTERS: Final = 300
# Of a docstring: that of a class may be as long as a book.
_MAX_READ: Final = 20_000
_SIGNATURE: Final = re.compile(r"^[\w.]+\(.*\)(\s*->.*)?$")


def tooltip(cg: CompGraph, token: str, param: Range) -> str:
    """Return what is known of a hyperparameter in one line of plain text, at most 300 characters.

    It is the text on the parameter in the docstring of a function that takes it, else the hint's, else the first
    line of the docstring; then the unit and the range.
    """
    about, facts = next(filter(None, _abouts(cg, token, param)), ""), _facts(param)
    text = _cut(about, _MAX_CHARACTERS - len(facts) - 1) if facts else about
    return _cut(" ".join(part for part in (text, facts) if part), _MAX_CHARACTERS)


def _abouts(cg: CompGraph, token: str, param: Range) -> Iterator[str]:
    """Yield what there is: the parameter's text of each function, the hint's, the first line of each docstring."""
    known = [(taker.parameter, _docstring(taker.function)) for taker in takers(cg, token)]
    for parameter, text in known:
        if parameter:
            yield _sentence(_described(_parsed(text), parameter) or _doxygen(text, parameter))
    yield _sentence(_one_line(getattr(param, "about", "")))
    for _, text in known:
        summary = _parsed(text).short_description or ""
        if not _SIGNATURE.match(summary):
            yield _one_line(summary)


def _docstring(function: Any) -> str:
    try:
        return (inspect.getdoc(unwrapped(function)) or "")[:_MAX_READ]
    except Exception:  # a docstring may be any object
        return ""


def _parsed(text: str) -> Docstring:
    """Return a docstring of any style: NumPy's, Google's, Sphinx' or Epydoc's."""
    try:
        return parse(text)
    except Exception:  # for some texts the parser raises others than its ParseError
        return Docstring()


def _described(docstring: Docstring, parameter: str) -> str:
    """Return the first paragraph on a parameter; several may share one: ``low, high : float``."""
    for item in docstring.params:
        names = {name.strip().lstrip("*") for name in item.arg_name.split(",")}
        if parameter in names and item.args[0] != "attribute":
            return _one_line((item.description or "").partition("\n\n")[0])
    return ""


def _doxygen(docstring: str, parameter: str) -> str:
    """Return the text of OpenCV: ``.   @param ksize blurring kernel size.``."""
    bare = re.sub(r"^\.?[ \t]*", "", docstring, flags=re.MULTILINE)
    found = re.search(rf"^@param {re.escape(parameter)} (.*?)(?=^@|\n\n|\Z)", bare, re.MULTILINE | re.DOTALL)
    return _one_line(re.sub(r"\\f\$|\\texttt|\\ref |#(?=\w)|[{}]", "", found[1])) if found else ""


def _facts(param: Range) -> str:
    if param is None:
        return ""
    if not isinstance(param, Param):
        return _sentence(range_text(param))
    unit = f" {param.unit}" if param.unit else ""
    free = param.low is None and param.high is None and not param.odd and param.choices is None
    hard = "" if free else range_text(param)
    if param.soft is None or param.soft == (param.low, param.high):
        return _sentence(hard + unit if hard else "")
    usual = f"usually {param.soft[0]:g} to {param.soft[1]:g}{unit}"
    return _sentence(f"{hard}, {usual}" if hard else usual)


def _sentence(text: str) -> str:
    if not text:
        return ""
    whole = text[0].upper() + text[1:]
    return whole if whole[-1] in ".!?…" else f"{whole}."


def _one_line(text: object) -> str:
    return " ".join(text.split()) if isinstance(text, str) else ""


def _cut(text: str, characters: int) -> str:
    return text if len(text) <= characters else f"{text[: max(characters - 1, 0)].rstrip()}…"
