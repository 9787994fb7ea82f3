"""How does the module of a bundle read?"""

from __future__ import annotations

import itertools
import json
from collections.abc import Mapping, Sequence
from typing import Final

from epypes.bundle.definitions import definitions, early_constants
from epypes.bundle.graphs import GraphText, grouped
from epypes.bundle.importorder import ordered_imports
from epypes.bundle.lines import LINE, laid_out
from epypes.bundle.settings import Settings
from epypes.bundle.slicer import Slice
from epypes.errors import run_call
from epypes.graph import CompGraph

# The folder is wherever the bundle is: it may be moved.
_TEXT: Final = '''"""{title}

It was promoted from a notebook. In Python, with FOLDER the one in which this file is:

    runner = epypes.load(FOLDER)
{run}

`epypes verify FOLDER` proves that it computes what the notebook did; `epypes serve`
lets it answer events. The values of its hyperparameters stand in pipeline.toml.
"""'''


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
    sections = ["\n\n".join(head)]
    constants, reader = early_constants(needed), needed.arrays.reader(needed)
    if reader:
        sections += [reader, *([constants] if constants else [])]
    elif constants:
        sections = ["\n\n".join([*head, constants])]
    sections += definitions(needed)
    tail = ["\n".join(block) for block in blocks]
    tail += ["\n".join(text.functions("func_dict")), "\n".join(text.io("func_io", cg))]
    if cg.groups:
        lines = [line for item in grouped(cg) for line in laid_out(item, 1, ",")]
        tail.append("\n".join(["# Drawn as one box each.", "func_groups = {", *lines, "}"]))
    tail += ["\n".join(block) for block in own]
    return "\n\n\n".join([*sections, _spaced(tail)]) + "\n"


def _spaced(blocks: Sequence[str]) -> str:
    """Join blocks by one empty line; by two where one of them defines something."""
    text = blocks[0]
    for before, block in itertools.pairwise(blocks):
        defines = any(line.startswith(("def ", "class ")) for line in f"{before}\n{block}".splitlines())
        text += ("\n\n\n" if defines else "\n\n") + block
    return text


def _docstring(settings: Settings) -> str:
    """Say what the module is and how it is used; names are data, whatever they hold."""
    ends = f"{', '.join(settings.inputs) or 'nothing'} -> {', '.join(settings.outputs)}"
    title = _escaped(f"The computational graph {settings.name}: {ends}.")
    if len(title) > LINE - 3:
        title = _escaped(f"The computational graph {settings.name}.")
    run = f"    runner.{run_call(settings.inputs)}"
    if not all(token.isidentifier() for token in settings.inputs) or len(run) > LINE:
        run = "    runner.run(**payload)"
    return _TEXT.format(title=title, run=_escaped(run))


def _escaped(text: str) -> str:
    """Return text as it may stand between triple quotes: names are data, whatever they hold."""
    return json.dumps(text)[1:-1]
