"""Which module is written of a graph, and what does that make of the settings?"""

from __future__ import annotations

import enum
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from typing import Any

from epypes.bundle.emit import emit_module
from epypes.bundle.equivalence import Pair, refusal
from epypes.bundle.graphs import Graphs
from epypes.bundle.hyperparameters import members_in
from epypes.bundle.settings import Settings
from epypes.bundle.slicer import Slice
from epypes.bundle.source import Refused
from epypes.bundle.subject import Subject, own_lines


def write_module(subject: Subject, settings: Settings) -> tuple[str, Settings, Mapping[str, Any], list[str]]:
    """Return the text of ``pipeline.py``, the settings with what it has of its own, its arrays, the reasons against."""
    gathered = Slice(keeps_arrays=True)
    graphs = Graphs(gathered)
    ports = {f"Function {name!r}": function for name, function in subject.ports.items()}
    text = graphs.write(subject.cg, {**ports, **subject.classes})
    own = dict(own_lines(gathered, graphs, subject))
    if settings.has_groups:
        _keep(gathered, "func_groups")
    blocks = [lines for lines in own.values() if lines]
    enums = _enums(gathered, settings)
    if enums:
        blocks.append(enums)
    settings = replace(settings, own=tuple(own))
    if gathered.refusals:
        return "", settings, {}, list(dict.fromkeys(gathered.refusals))
    text_of_all = emit_module(settings, subject.cg, gathered, text, graphs.blocks, blocks)
    why = refusal(text_of_all, gathered.arrays.by_name, lambda module: _pairs(subject, settings, module))
    return text_of_all, settings, gathered.arrays.by_name, [why] if why else []


def _pairs(subject: Subject, settings: Settings, module: Any) -> Iterator[Pair]:
    """Give what of the notebook is compared with the module, by how a reason calls it."""
    for name, function in subject.cg.functions.items():
        yield f"Function {name!r}", function, module.func_dict[name]
    for name, function in subject.ports.items():
        yield f"Function {name!r}", function, getattr(module, name)
    for what, kind in subject.classes.items():
        yield what, kind, getattr(module, kind.__name__)
    for kind in _enums_in(settings):
        yield f"Class {kind.__name__!r}", kind, module.enums[kind.__qualname__]


def _enums(gathered: Slice, settings: Settings) -> list[str]:
    """Return the lines that name the enumerations whose members stand in pipeline.toml."""
    kinds = _enums_in(settings)
    return _listed(gathered, kinds) if kinds else []


def _enums_in(settings: Settings) -> dict[type[enum.Enum], None]:
    values = [settings.hyperparameters, settings.defaults, settings.attributes]
    members = [member for part in values for value in part.values() for member in members_in(value)]
    return dict.fromkeys(type(member) for member in members if isinstance(member, enum.Enum))


def _listed(gathered: Slice, kinds: Iterable[type[enum.Enum]]) -> list[str]:
    found: dict[str, str] = {}
    for kind in kinds:
        try:
            reference = gathered.add_class(kind, None, f"Class {kind.__name__!r} of a hyperparameter")
        except Refused as refusal:
            gathered.refusals.append(str(refusal))
            continue
        if found.setdefault(kind.__qualname__, reference) != reference:
            gathered.refusals.append(f"Two hyperparameters are of two classes called {kind.__name__!r}. Rename one.")
    _keep(gathered, "enums")
    return [
        "# Whose members stand in pipeline.toml.",
        "enums = {",
        *(f'    "{n}": {r},' for n, r in found.items()),
        "}",
    ]


def _keep(gathered: Slice, name: str) -> None:
    try:
        gathered.keep_name(name)
    except Refused as refusal:
        gathered.refusals.append(str(refusal))
