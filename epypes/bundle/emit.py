"""How does the module of a bundle read?"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

from epypes.bundle.constants import constants_text
from epypes.bundle.settings import Settings
from epypes.bundle.slicer import Slice
from epypes.graph import CompGraph


def emit_module(settings: Settings, cg: CompGraph, needed: Slice, references: Mapping[str, str]) -> str:
    """Write ``pipeline.py``: imports, constants, the functions' own source, then the graph.

    Parameters
    ----------
    settings
        The bundle's name and ports.
    cg
        The graph.
    needed
        What its functions need.
    references
        By function of the graph, the expression that refers to it.
    """
    ends = f"{', '.join(settings.inputs) or 'nothing'} -> {', '.join(settings.outputs)}"
    sections = [f'"""{_escaped(f"The computational graph {settings.name}: {ends}.")}"""\n']
    if needed.imports:
        sections.append("\n".join(ordered_imports(list(needed.imports.values()))) + "\n")
    if needed.constants:
        sections.append("\n".join(constants_text(needed.constants, needed.remarks)) + "\n")
    body = "\n".join(sections)
    for found in needed.definitions.values():
        body += f"\n\n{found.text}"
    functions = "".join(f"    {quoted(function)}: {reference},\n" for function, reference in references.items())
    io = "".join(
        f"    {quoted(function)}: ({_side(given)}, {_side(made)}),\n" for function, (given, made) in cg.func_io.items()
    )
    return f"{body}\n\nfunc_dict = {{\n{functions}}}\n\nfunc_io = {{\n{io}}}\n"


def _escaped(text: str) -> str:
    """Return text as it may stand between triple quotes: names are data, whatever they hold."""
    return json.dumps(text)[1:-1]


def ordered_imports(statements: Sequence[str]) -> list[str]:
    """Sort as linters want it: plain imports first, then from-imports, each by name."""
    return sorted(dict.fromkeys(statements), key=lambda statement: (statement.startswith("from"), statement))


def quoted(text: str) -> str:
    """Return a string literal, in double quotes where that needs no escapes."""
    literal = repr(text)
    return f'"{text}"' if literal == f"'{text}'" and '"' not in text else literal


def _side(tokens: str | Sequence[str] | None) -> str:
    if tokens is None or isinstance(tokens, str):
        return "None" if tokens is None else quoted(tokens)
    inner = ", ".join(map(quoted, tokens))
    return f"({inner},)" if len(tokens) == 1 else f"({inner})"
