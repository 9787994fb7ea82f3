"""The text of a module: imports, constants, definitions in the notebook's order; and that of ``pipeline.py``."""

from __future__ import annotations

import ast
import enum
import functools
import itertools
import sys
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Final

from epypes.bundle.equivalence import Pair, refusal
from epypes.bundle.expressions import LINE, array_reader, escaped, expression, laid_out, names_in, one_per_line, quoted
from epypes.bundle.graphs import Graphs, GraphText, arguments_of, parameters_of
from epypes.bundle.load import MAKER
from epypes.bundle.notebook_source import Position, parsed
from epypes.bundle.resolve import Refused
from epypes.bundle.settings import Settings, members_in
from epypes.bundle.slice import Slice, gather
from epypes.errors import run_call
from epypes.graph import CompGraph
from epypes.pipeline import FullPipeline, Pipeline, SinkPipeline, SourcePipeline

if TYPE_CHECKING:
    from epypes.bundle.promote import Subject

# What the function that makes a pipeline is given, and hands on to the class.
_GIVEN: Final = ("cg", "q_in", "q_out", "f_in", "f_out", "hparams")
PIPELINES: Final = (Pipeline, SourcePipeline, SinkPipeline, FullPipeline)
# The folder is wherever the bundle is: it may be moved.
_TEXT: Final = '''"""{title}

It was promoted from a notebook. In Python, with FOLDER the one in which this file is:

    runner = epypes.load(FOLDER)
{run}

`epypes verify FOLDER` proves that it computes what the notebook did; `epypes serve`
lets it answer events. The values of its hyperparameters stand in pipeline.toml.
"""'''


def write_module(subject: Subject, settings: Settings) -> tuple[str, Settings, Mapping[str, Any], list[str]]:
    """Return the text of ``pipeline.py``, the settings with what it has of its own, its arrays, the reasons against."""

    def write(gathered: Slice) -> tuple[GraphText, Graphs, dict[str, list[str]], list[list[str]]]:
        graphs = Graphs(gathered)
        text = graphs.write(subject.cg)
        own = dict(_own_lines(gathered, graphs, subject))
        if settings.has_groups:
            with gathered.noted_refusals():
                gathered.reserve("func_groups")
        return text, graphs, own, _enums(gathered, settings)

    gathered, (text, graphs, own, enums) = gather(write, stores_arrays=True)
    settings = replace(settings, own=tuple(own))
    if gathered.refusals:
        return "", settings, {}, list(dict.fromkeys(gathered.refusals))
    arrays = gathered.arrays
    module = emit_module(settings, subject.cg, gathered, text, graphs.blocks, [*filter(None, own.values()), *enums])
    why = refusal(module, arrays, functools.partial(_pairs, subject, settings))
    return module, settings, arrays, [why] if why else []


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
        with gathered.noted_refusals():
            reference = gathered.add_class(kind, f"Class {kind.__name__!r} of a hyperparameter")
            if found.setdefault(kind.__qualname__, reference) != reference:
                raise Refused(f"Two hyperparameters are of two classes called {kind.__name__!r}. Rename one.")
    if not found:
        return []
    with gathered.noted_refusals():
        gathered.reserve("enums")
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
    title = escaped(f"The computational graph {settings.name}: {ends}.")
    if len(title) > LINE - 3:
        title = escaped(f"The computational graph {settings.name}.")
    run = f"    runner.{run_call(settings.inputs)}"
    if not all(token.isidentifier() for token in settings.inputs) or len(run) > LINE:
        run = "    runner.run(**payload)"
    return _TEXT.format(title=title, run=escaped(run))


# -- what a bundle has of its own -------------------------------------------------------------------------------------


def _own_lines(gathered: Slice, graphs: Graphs, subject: Subject) -> Iterator[tuple[str, list[str]]]:
    """Give what the module has of its own in place of what a bundle usually does, by name; refusals are gathered."""
    comments = {"f_in": "# How an event becomes a payload.", "f_out": "# How a run becomes an answer."}
    for name, function in subject.ports.items():
        reference = graphs.value(function, f"Function {name!r}", name)
        if reference == name:
            yield name, []
            continue
        with gathered.noted_refusals():
            gathered.reserve(name)
        yield name, [comments[name], f"{name} = {reference}"]
    if subject.pipeline is not None and type(subject.pipeline) not in PIPELINES:
        with gathered.noted_refusals():
            gathered.reserve(MAKER)
            yield MAKER, _maker(gathered, subject.pipeline)


def _maker(gathered: Slice, pipeline: Pipeline) -> list[str]:
    """Return the function that makes the pipeline of a user's class."""
    kind, what = type(pipeline), f"Pipeline {pipeline.name!r}"
    known = gathered.add_class(kind, f"Class {kind.__name__!r} of {what[0].lower()}{what[1:]}")
    lines: list[str] = []
    if not isinstance(pipeline, FullPipeline):
        known, lines = _answering(gathered, kind, known, what)
        arguments = [quoted(pipeline.name), *_GIVEN]
    else:
        arguments = _arguments(gathered, pipeline, what)
    made = f"{known}({', '.join(arguments)})"
    head = f"def {MAKER}({', '.join(_GIVEN)}):"
    return [*lines, head, '    """Return the pipeline that answers events."""', *laid_out(made, 1, "return ")]


def _arguments(gathered: Slice, pipeline: Pipeline, what: str) -> list[str]:
    taken = [parameter.name for parameter in parameters_of(type(pipeline))]
    for name in ("cg", "q_in", "q_out", "hparams"):
        if name not in taken:
            text = f"{what} is of class {type(pipeline).__name__!r}, whose __init__ does not take {name!r}"
            raise Refused(f"{text}. Take it, and hand it on: super().__init__(..., {name}={name}).")
    arguments: list[str] = []
    given = arguments_of(pipeline, what)
    for name in taken:
        if name in _GIVEN:
            arguments.append(f"{name}={name}")
        elif name in given:
            source = expression(gathered, given[name], what)
            if not source:
                text = f"{what} is made with {name!r}, a {type(given[name]).__name__} that no expression makes again"
                raise Refused(f"{text}. Make it in __init__, from numbers, strings or tuples of them.")
            arguments.append(f"{name}={source}")
    return arguments


def _answering(gathered: Slice, kind: type[Pipeline], known: str, what: str) -> tuple[str, list[str]]:
    """Return the name of a class that does what a user's pipeline does and answers events, and its definition."""
    way_out = "Make it a subclass of ep.FullPipeline."
    if issubclass(kind, SourcePipeline):
        raise Refused(f"{what} is of class {kind.__name__!r}, a SourcePipeline, which takes no events. {way_out}")
    usual = SinkPipeline if issubclass(kind, SinkPipeline) else Pipeline
    if getattr(kind, "emit", None) is not getattr(usual, "emit", None):
        raise Refused(f"{what} is of class {kind.__name__!r}, whose emit() a service would not call. {way_out}")
    if [parameter.name for parameter in parameters_of(kind)] != [parameter.name for parameter in parameters_of(usual)]:
        text = f"{what} is of class {kind.__name__!r}, whose __init__ takes what a service can't give."
        raise Refused(f"{text} {way_out}")
    name = f"Answering{kind.__name__}"
    gathered.reserve(name)
    full = f"{gathered.module_name('epypes', what)}.FullPipeline"
    return name, [
        f"class {name}({full}, {known}):",
        f'    """{kind.__name__}, driven by events."""',
        "",
        "",
    ]


# -- the layout of a module -------------------------------------------------------------------------------------------


def ordered(
    texts: Mapping[str, str],
    positions: Mapping[str, Position],
    reads: Mapping[str, frozenset[str]],
    closures: Collection[str],
) -> list[str]:
    """Return the names of definitions in the order in which they stand in a module.

    Parameters
    ----------
    texts
        The definitions by name, in an order in which they could stand but for those that need each other.
    positions
        Where they stand in the notebook, as far as that is known; others stand before what needs them, or at the end.
    reads
        The names that definitions read from outside, as far as that is known; of others, all that they mention.
    closures
        The names of closures: what makes them calls nothing of what it is given.
    """
    trees = {name: parsed(text) or ast.Module([], []) for name, text in texts.items()}
    mentioned = {name: reads[name] if name in reads else _names(ast.walk(tree)) for name, tree in trees.items()}
    needs = {name: _needs(name, tree, mentioned, name in closures) for name, tree in trees.items()}
    found: dict[str, None] = {}
    begun: set[str] = set()
    pending = sorted(texts, key=lambda name: (name not in positions, positions.get(name, ())))[::-1]
    rank = {name: number for number, name in enumerate(pending)}
    while pending:
        if pending[-1] in begun:
            found[pending.pop()] = None
            continue
        begun.add(pending[-1])
        pending += sorted(needs[pending[-1]] - begun, key=rank.__getitem__)
    return list(found)


def _needs(name: str, tree: ast.Module, mentioned: Mapping[str, frozenset[str]], is_closure: bool) -> set[str]:
    """Return the definitions that importing one reads; what it calls may read all that it mentions."""
    read = [part for statement in tree.body for part in _read_at_import(statement)]
    found = set(_names(iter(read)) & mentioned.keys())
    if not is_closure and any(
        isinstance(part, ast.Call | ast.ClassDef) or getattr(part, "decorator_list", []) for part in read
    ):
        pending = list(found)
        while pending:
            more = (mentioned[pending.pop()] & mentioned.keys()) - found
            found |= more
            pending += more
    return found - {name}


def _names(parts: Iterator[ast.AST]) -> frozenset[str]:
    return frozenset(part.id for part in parts if isinstance(part, ast.Name))


def _read_at_import(node: ast.AST) -> Iterator[ast.AST]:
    """Give the parts of a statement that are executed at import, which the bodies of functions are not."""
    yield node
    for name, value in ast.iter_fields(node):
        if name == "body" and isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.Lambda):
            continue
        for part in value if isinstance(value, list) else [value]:
            if isinstance(part, ast.AST):
                yield from _read_at_import(part)


def module_text(head: Sequence[str], needed: Slice, tail: Sequence[str]) -> str:
    """Return the text of a module: what stands at its head, what its functions need, and what stands behind that."""
    texts = {name: text.rstrip() for name, text in needed.definitions.items()}
    positions = needed.positions | {name: one.position for name, one in needed.constants.items() if one.position}
    early: list[str] = []
    for name, known in sorted(needed.constants.items(), key=lambda item: (not item[1].position, item[1].position)):
        if names_in(known.source) & needed.definitions.keys():
            texts[name] = "\n".join(known.lines)
        else:
            early += [*[""][: bool(early) and known.lines[0].startswith("#")], *known.lines]
    reader = array_reader(needed)
    imports = [_import_lines(needed.imports.values())] if needed.imports else []
    constants = ["\n".join(early)] if early else []
    sections = ["\n\n".join([*head, *imports, *([] if reader else constants)])]
    if reader:
        sections += [reader, *constants]
    names = ordered(texts, positions, needed.reads, needed.closures)
    for are_constants, group in itertools.groupby(names, needed.constants.__contains__):
        found = [texts[name] for name in group]
        sections += ["\n".join(found)] if are_constants else found
    return "\n\n\n".join([*filter(None, sections), *tail]) + "\n"


def _import_lines(statements: Iterable[str]) -> str:
    """Return imports in order: Python's own first, whole modules before names from modules."""
    in_order = sorted(dict.fromkeys(statements), key=lambda text: (text.startswith("from"), text.lower(), text))
    first = [text for text in in_order if text.startswith("from __future__")]
    others = [text for text in in_order if text.split()[1].partition(".")[0] not in sys.stdlib_module_names]
    own = [text for text in in_order if text not in first and text not in others]
    return "\n\n".join("\n".join(part) for part in (first, own, others) if part)
