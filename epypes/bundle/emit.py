"""The text of a bundle's ``pipeline.py``: imports, constants, definitions in the notebook's order, then the graph."""

from __future__ import annotations

import enum
import functools
import itertools
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any, Final

from epypes.bundle.equivalence import Pair, refusal
from epypes.bundle.expressions import noted_refusals
from epypes.bundle.graphs import Graphs, GraphText
from epypes.bundle.load import MAKER
from epypes.bundle.module import module_text
from epypes.bundle.resolve import Refused
from epypes.bundle.settings import Settings, members_in
from epypes.bundle.slice import Slice
from epypes.bundle.subject import Subject, own_lines
from epypes.bundle.syntax import LINE, one_per_line, quoted
from epypes.errors import run_call
from epypes.graph import CompGraph
from epypes.pipeline import FullPipeline

# The folder is wherever the bundle is: it may be moved.
_TEXT: Final = '''"""{title}

It was promoted from a notebook. In Python, with FOLDER the one in which this file is:

    runner = epypes.load(FOLDER)
{run}

`epypes verify FOLDER` proves that it computes what the notebook did; `epypes serve`
lets it answer events. The values of its hyperparameters stand in pipeline.toml.
"""'''


def write_module(
    subject: Subject, settings: Settings, uncalled: Collection[int] = ()
) -> tuple[str, Settings, Mapping[str, Any], list[str]]:
    """Return the text of ``pipeline.py``, the settings with what it has of its own, its arrays, the reasons against.

    Closures whose ids are in ``uncalled`` are written with what they have captured, not as calls of their factories.
    """
    gathered = Slice(keeps_arrays=True, uncalled=uncalled)
    graphs = Graphs(gathered)
    ports = {f"Function {name!r}": function for name, function in subject.ports.items()}
    text = graphs.write(subject.cg, {**ports, **subject.classes})
    own = dict(own_lines(gathered, graphs, subject))
    if settings.has_groups:
        with noted_refusals(gathered):
            gathered.keep_name("func_groups")
    blocks = [*filter(None, own.values()), *_enums(gathered, settings)]
    settings = replace(settings, own=tuple(own))
    if gathered.refusals and gathered.called:
        again = write_module(subject, settings, {*uncalled, *gathered.called})
        if not again[3]:
            return again
    if gathered.refusals:
        return "", settings, {}, list(dict.fromkeys(gathered.refusals))
    text_of_all = emit_module(settings, subject.cg, gathered, text, graphs.blocks, blocks)
    pairs = functools.partial(_pairs, subject, settings)
    why, closure = refusal(text_of_all, gathered.arrays.by_name, pairs, gathered.called)
    if closure:
        return write_module(subject, settings, {*uncalled, closure})
    return text_of_all, settings, gathered.arrays.by_name, [why] if why else []


def _pairs(subject: Subject, settings: Settings, module: Any) -> Iterator[Pair]:
    """Give what of the notebook is compared with the module, by how a reason calls it."""
    for name, function in subject.cg.functions.items():
        yield f"Function {name!r}", function, module.func_dict[name]
    for name, function in subject.ports.items():
        yield f"Function {name!r}", function, getattr(module, name)
    for what, kind in subject.classes.items():
        yield what, kind, getattr(module, kind.__name__)
    for enumeration in _enums_in(settings):
        yield f"Class {enumeration.__name__!r}", enumeration, module.enums[enumeration.__qualname__]
    pipeline = subject.pipeline
    if MAKER in settings.own and isinstance(pipeline, FullPipeline):
        given = (pipeline.q_in, pipeline.q_out, *(getattr(pipeline, name, None) for name in ("f_in", "f_out")))
        made = module.make_pipeline(pipeline.source_cg, *given, dict(pipeline.runner.hyperparameters))
        yield f"Pipeline {pipeline.name!r}", pipeline, made


def _enums(gathered: Slice, settings: Settings) -> list[list[str]]:
    """Return the lines that name the enumerations whose members stand in pipeline.toml."""
    found: dict[str, str] = {}
    for kind in _enums_in(settings):
        with noted_refusals(gathered):
            reference = gathered.add_class(kind, None, f"Class {kind.__name__!r} of a hyperparameter")
            if found.setdefault(kind.__qualname__, reference) != reference:
                raise Refused(f"Two hyperparameters are of two classes called {kind.__name__!r}. Rename one.")
    if not found:
        return []
    with noted_refusals(gathered):
        gathered.keep_name("enums")
    items = [(f"{quoted(name)}: ", reference) for name, reference in found.items()]
    return [["# Whose members stand in pipeline.toml.", *one_per_line("enums = {", items, "}")]]


def _enums_in(settings: Settings) -> dict[type[enum.Enum], None]:
    values = [settings.hyperparameters, settings.defaults, settings.attributes]
    members = [member for part in values for value in part.values() for member in members_in(value)]
    return dict.fromkeys(type(member) for member in members if isinstance(member, enum.Enum))


def emit_module(
    settings: Settings,
    cg: CompGraph,
    needed: Slice,
    written: Mapping[str, str] | GraphText,
    blocks: Sequence[Sequence[str]] = (),
    own: Sequence[Sequence[str]] = (),
) -> str:
    """Return the text of ``pipeline.py``.

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
    tail = [*blocks, text.functions("func_dict"), text.io("func_io", cg)]
    if cg.groups:
        items = [(f"{quoted(name)}: ", f"[{', '.join(map(quoted, part))}]") for name, part in cg.groups.items()]
        tail.append(["# Drawn as one box each.", *one_per_line("func_groups = {", items, "}")])
    return module_text([_docstring(settings)], needed, [_spaced(["\n".join(block) for block in [*tail, *own]])])


def _spaced(blocks: Sequence[str]) -> str:
    """Join blocks by one empty line; by two where one of them defines something."""
    text = blocks[0]
    for before, block in itertools.pairwise(blocks):
        defines = any(line.startswith(("def ", "class ")) for line in f"{before}\n{block}".splitlines())
        text += ("\n\n\n" if defines else "\n\n") + block
    return text


def _docstring(settings: Settings) -> str:
    """Return the module's docstring, which names the graph and how to run it."""
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
