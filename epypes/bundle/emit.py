"""How does the module of a bundle read?"""

from __future__ import annotations

import ast
import json
import textwrap
from collections.abc import Iterator, Mapping, Sequence

from epypes.bundle.graphs import GraphText, grouped
from epypes.bundle.lines import LINE, assignment, laid_out, piece_of
from epypes.bundle.settings import Settings
from epypes.bundle.slicer import Slice
from epypes.graph import CompGraph

_USE = """\
Its functions, and how data flows between them; the values of its hyperparameters stand
in pipeline.toml beside it.

    import epypes as ep

    runner = ep.load(FOLDER)
    run = runner.run({payload})
{results}
`epypes verify FOLDER` proves that it computes what the notebook computed.
"""


def emit_module(
    settings: Settings,
    cg: CompGraph,
    needed: Slice,
    written: Mapping[str, str] | GraphText,
    blocks: Sequence[Sequence[str]] = (),
    own: Sequence[Sequence[str]] = (),
) -> str:
    """Write ``pipeline.py``: imports, constants, the functions' own source, then the graph.

    Parameters
    ----------
    settings
        The bundle's name and ports.
    cg
        The graph.
    needed
        What its functions need.
    written
        How its functions are written, or by function the expression that refers to it.
    blocks
        Lines that stand before the graph: switches, nodes and pipelines that are functions of it.
    own
        Lines that stand behind it: what the bundle has of its own in place of the usual ports and pipeline.
    """
    text = written if isinstance(written, GraphText) else GraphText(written)
    head = [_docstring(settings)]
    if needed.imports:
        head.append("\n".join(ordered_imports(list(needed.imports.values()))))
    early = [name for name in needed.constants if not _needs(needed, name)]
    if early:
        head.append("\n".join(line for name in early for line in _constant(needed, name)))
    sections = ["\n\n".join(head), *_definitions(needed)]
    tail = ["\n".join(block) for block in blocks]
    tail += ["\n".join(text.functions("func_dict")), "\n".join(text.io("func_io", cg))]
    if cg.groups:
        lines = [line for item in grouped(cg) for line in laid_out(item, 1, ",")]
        tail.append("\n".join(["# Drawn as one box each.", "func_groups = {", *lines, "}"]))
    tail += ["\n".join(block) for block in own]
    return "\n\n\n".join([*sections, "\n\n".join(tail)]) + "\n"


def _docstring(settings: Settings) -> str:
    ends = f"{', '.join(settings.inputs) or 'nothing'} -> {', '.join(settings.outputs)}"
    title = _escaped(f"The computational graph {settings.name}: {ends}.")
    if len(title) > LINE - 3:
        parts = _escaped(f"The computational graph {settings.name}."), _escaped(f"{ends}.")
        title = "\n\n".join([parts[0], *textwrap.wrap(parts[1], LINE, break_long_words=False)[:1]])
    return f'"""{title}"""'


def _constant(needed: Slice, name: str) -> list[str]:
    return assignment([name], True, piece_of(needed.constants[name]), 0)


def _needs(needed: Slice, constant: str) -> set[str]:
    """Return the definitions that a constant is made with."""
    read = {node.id for node in ast.walk(ast.parse(needed.constants[constant])) if isinstance(node, ast.Name)}
    return read & needed.definitions.keys()


def _definitions(needed: Slice) -> Iterator[str]:
    """Give functions and classes, each followed by the constants that are made with it."""
    waiting = {name: _needs(needed, name) for name in needed.constants}
    waiting = {name: needs for name, needs in waiting.items() if needs}
    there: set[str] = set()
    for name, found in needed.definitions.items():
        yield found.text.rstrip()
        there.add(name)
        ready = [constant for constant, needs in waiting.items() if needs <= there]
        for constant in ready:
            del waiting[constant]
        if ready:
            yield "\n".join(line for constant in ready for line in _constant(needed, constant))


def _escaped(text: str) -> str:
    """Return text as it may stand between triple quotes: names are data, whatever they hold."""
    return json.dumps(text)[1:-1]


def ordered_imports(statements: Sequence[str]) -> list[str]:
    """Sort as linters want it: plain imports first, then from-imports, each by name."""
    return sorted(dict.fromkeys(statements), key=lambda statement: (statement.startswith("from"), statement))
