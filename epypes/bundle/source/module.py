"""The text of a module: imports, constants, definitions in the notebook's order; and that of ``pipeline.py``.

What is emitted is simple. Whether it makes what the notebook has is found out by the comparison of their objects.
"""

from __future__ import annotations

import ast
import enum
import functools
import itertools
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, Final

from epypes.bundle.adapters import ADAPTERS, own_part
from epypes.bundle.arrays import ArrayFiles
from epypes.bundle.load import MAKER, WITH_DELAYS
from epypes.bundle.settings import Settings, members_in
from epypes.bundle.source.clone import arguments_of, parameters_of
from epypes.bundle.source.equivalence import Pair, refusal
from epypes.bundle.source.expressions import (
    LINE,
    bracketed,
    escaped,
    expression_or_none,
    identifier_of,
    laid_out,
    quoted,
)
from epypes.bundle.source.kept_files import check_files
from epypes.bundle.source.objects import without_nodes
from epypes.bundle.source.own_modules import OwnModules, functions_reached_by
from epypes.bundle.source.resolve import Refused, parsed
from epypes.bundle.source.slice import Slice, Written, gather
from epypes.errors import run_call
from epypes.graph import CompGraph, Switch, as_switch, is_placeholder
from epypes.pipeline import FullPipeline, Node, Pipeline, SinkPipeline, SourcePipeline

PIPELINES: Final = (Pipeline, SourcePipeline, SinkPipeline, FullPipeline)
# What the function that makes a pipeline is given, and hands on to the class.
_GIVEN: Final = ("cg", "q_in", "q_out", "f_in", "f_out", "hparams")
_NOT_MADE_AGAIN: Final = (
    "is made with a {kind} that no expression makes again. Make it in __init__, from numbers, strings, a small array "
    "or tuples of them."
)
_ADAPTER_COMMENTS: Final = {"f_in": "# How an event becomes a payload.", "f_out": "# How a run becomes an answer."}
# The folder is wherever the bundle is: it may be moved.
_TEXT: Final = '''"""{title}

It was promoted from a notebook. In Python, with FOLDER the one in which this file is:

    runner = epypes.load(FOLDER)
{run}

`epypes verify FOLDER` proves that it computes what the notebook did; `epypes serve`
lets it answer events. The values of its hyperparameters stand in pipeline.toml.
"""'''


# -- pipeline.py -------------------------------------------------------------------------------------------------------


def write_module(
    cg: CompGraph, settings: Settings, adapters: Mapping[str, Callable[..., Any]], pipeline: Pipeline | None
) -> tuple[str, Sequence[ArrayFiles | OwnModules], list[str]]:
    """Return the text of ``pipeline.py``, what it reads and imports from the bundle, and the reasons against it.

    Parameters
    ----------
    cg
        The graph with the user's own functions.
    settings
        The bundle's settings.
    adapters
        f_in and f_out, as far as they are not the usual ones of a bundle.
    pipeline
        The pipeline that is promoted, if it is of a class of the user's.
    """
    values = [*settings.hyperparameters.values(), *settings.defaults.values(), *settings.attributes.values()]
    members = [member for value in values for member in members_in(value)]
    enums = {type(member).__qualname__: type(member) for member in members if isinstance(member, enum.Enum)}
    own = {MAKER: pipeline is not None, "enums": bool(enums), "func_groups": settings.has_groups}
    own[WITH_DELAYS] = bool(settings.states)

    def write(gathered: Slice) -> tuple[dict[str, str], str]:
        graphs = Graphs(gathered)
        references, others = graphs.write(cg), dict[str, str]()
        for name, adapter in adapters.items():
            reference = graphs.value(adapter, f"Function {name!r}", name)
            if reference != name and gathered.is_taken(name):
                others[name] = reference
            elif reference != name:
                with gathered.noted_refusals():
                    gathered.reserve(name)
                gathered.define(name, f"{_ADAPTER_COMMENTS[name]}\n{name} = {reference}")
        if others:
            with gathered.noted_refusals():
                gathered.reserve(ADAPTERS)
            comment = "# The names of these mean other functions or values in this module."
            gathered.define(ADAPTERS, f"{comment}\n{_dict(ADAPTERS, others)}")
        if pipeline is not None:
            with gathered.noted_refusals():
                gathered.define(MAKER, graphs.maker(pipeline))
        kinds = {name: graphs.value(kind, f"Class {name!r} of a hyperparameter", name) for name, kind in enums.items()}
        if kinds:
            gathered.define("enums", f"# Whose members stand in pipeline.toml.\n{_dict('enums', kinds)}")
        return references, graphs.with_delays(cg)

    reserved = {"func_dict", "func_io", *(name for name, is_used in own.items() if is_used)}
    gathered, (references, delays) = gather(write, reserved, stores_arrays=True)
    modules = OwnModules(sorted(gathered.modules))
    values = [*cg.functions.values(), *adapters.values(), *enums.values(), pipeline]
    reached = [*functions_reached_by(values)]
    modules.check(reached, gathered.patches)
    for name in modules.registering:
        with gathered.noted_refusals():
            gathered.import_module(name)
    refusals = list(dict.fromkeys([*gathered.refusals, *modules.refusals]))
    refusals = refusals or check_files(reached, cg, settings.hyperparameters, settings.inputs)
    if refusals:
        return "", (), refusals
    module = emit_module(settings, cg, gathered, references, delays)
    why = refusal(module, functools.partial(_pairs, cg, adapters, pipeline, enums), gathered.arrays, modules)
    return module, (gathered.arrays, modules), [why] if why else []


def _pairs(
    cg: CompGraph, adapters: Mapping[str, Any], pipeline: Pipeline | None, enums: Mapping[str, type], module: Any
) -> Iterator[Pair]:
    """Give what of the notebook is compared with the module, by how a reason calls it."""
    for name, function in cg.functions.items():
        yield f"Function {name!r}", function, module.func_dict[name]
    for name, adapter in adapters.items():
        yield f"Function {name!r}", adapter, own_part(module, name)
    delays = module.with_delays(CompGraph(module.func_dict, module.func_io, types=False)).delays if cg.delays else {}
    for previous, delay in cg.delays.items():
        yield f"The initial value of {previous!r}", delay.initial, delays[previous].initial
    for name, kind in enums.items():
        yield f"Class {name!r}", kind, module.enums[name]
    if pipeline is not None:
        given = [getattr(pipeline, name, None) for name in _GIVEN[1:5]]
        made = module.make_pipeline(pipeline.source_cg, *given, dict(pipeline.runner.current.own))
        if isinstance(pipeline, FullPipeline):
            yield f"Pipeline {pipeline.name!r}", pipeline, made
        else:
            yield f"Class of pipeline {pipeline.name!r}", type(pipeline), type(made).__bases__[1]


def emit_module(
    settings: Settings, cg: CompGraph, needed: Slice, references: Mapping[str, str], delays: str = ""
) -> str:
    """Return the text of ``pipeline.py``.

    Parameters
    ----------
    settings
        The bundle's name and adapters.
    cg
        The graph.
    needed
        What its functions need, and what the bundle has of its own.
    references
        By function the expression that refers to it.
    delays
        The text of the function that adds the delays, if there are any.
    """
    ends = f"{', '.join(settings.inputs) or 'nothing'} -> {', '.join(settings.outputs)}"
    titles = [escaped(f"The computational graph {settings.name}{more}.") for more in (f": {ends}", "")]
    title = titles[len(titles[0]) > LINE - len('"""')]
    run = f"    runner.{run_call(settings.inputs)}"
    if not all(token.isidentifier() for token in settings.inputs) or len(run) > LINE:
        run = "    runner.run(**payload)"
    head = _TEXT.format(title=title, run=run)
    blocks = [_dict("func_dict", references), _io("func_io", cg)]
    if cg.groups:
        groups = {name: bracketed([*part], quoted) for name, part in cg.groups.items()}
        blocks.append(f"# Drawn as one box each.\n{_dict('func_groups', groups)}")
    tail = "\n\n".join(blocks)
    return module_text(needed, f"{tail}\n\n\n{delays}" if delays else tail, head)


def _dict(variable: str, items: Mapping[str, str]) -> str:
    """Return the lines of a dict that has a variable."""
    inner = ", ".join(f"{quoted(name)}: {source}" for name, source in items.items())
    return "\n".join(laid_out(f"{{{inner}}}", before=f"{variable} = ", is_broken=True))


def _io(variable: str, cg: CompGraph) -> str:
    """Return the lines of what each function of a graph takes and makes."""

    def side(tokens: str | Iterable[str] | None) -> str:
        if tokens is None or isinstance(tokens, str):
            return "None" if tokens is None else quoted(tokens)
        return bracketed(tuple(tokens), quoted)

    return _dict(variable, {name: bracketed(tuple(sides), side) for name, sides in cg.func_io.items()})


def no_initial_value(cg: CompGraph, previous: str) -> str:
    """Return why a delay can't begin with a value that has no expression, for ``expression_or_none``."""
    way_out = f"ep.delay(cg, {quoted(cg.delays[previous].token)}, {quoted(previous)}, initial=None)"
    return (
        "is of type {kind}, and no expression makes it again. State is numbers, text, arrays and containers of them: "
        f"begin with None, and make it in the function when it gets None: {way_out}."
    )


class Graphs:
    """Writes a graph; its nodes, switches and the graphs of its pipelines become definitions of the module.

    Parameters
    ----------
    gathered
        The module that it is for; is added to.
    """

    def __init__(self, gathered: Slice) -> None:
        self.gathered = gathered
        self._made: dict[int, str] = {}

    def write(self, cg: CompGraph, where: str = "") -> dict[str, str]:
        """Write a graph, or that of a pipeline, with where it is; return by function the expression that refers to it.

        Refusals are gathered.
        """
        references: dict[str, str] = {}
        for name, function in cg.functions.items():
            what, switch = f"Function {name!r}{where}", as_switch(function)
            if is_placeholder(function):
                way_out = f"Give it: ep.extend(cg, {{{name!r}: ...}}), and run that graph."
                self.gathered.refusals.append(f"{what} is a placeholder. {way_out}")
            elif switch is not None:
                with self.gathered.noted_refusals():
                    references[name] = self._switch(cg, name, switch, what)
            else:
                references[name] = self.value(function, what, name)
        return references

    def value(self, value: Any, what: str, name: str) -> str:
        """Return the expression of a function, or of an argument that makes one."""
        value = without_nodes(value)
        if not isinstance(value, Node):
            return expression_or_none(self.gathered, value, what, _NOT_MADE_AGAIN, name)
        if id(value) not in self._made:
            self._made[id(value)] = "None"
            with self.gathered.noted_refusals():
                known = self.gathered.add_class(type(value), _class_of(value, what))
                made = f"{known}({', '.join(self._arguments(value, what, name))})"
                self._made[id(value)] = self._variable(name, made)
        return self._made[id(value)]

    def _variable(self, name: str, source: str, comment: str = "") -> str:
        variable = self.gathered.free_name(name)
        self.gathered.define(variable, comment + "\n".join(laid_out(source, before=f"{variable} = ")))
        return variable

    def _switch(self, cg: CompGraph, name: str, switch: Switch, what: str) -> str:
        by, *tokens = cg.func_inputs(name)
        keys = [self.value(key, what, name) for key in switch.branches]
        branches = ", ".join(f"{key}: {quoted(token)}" for key, token in zip(keys, tokens, strict=True))
        output = quoted(cg.func_outputs(name)[0])
        epypes = self.gathered.module_name("epypes", what)
        made = f"{epypes}.switch({quoted(name)}, {{{branches}}}, by={quoted(by)}, output={output})"
        variable = self._variable(name, made, f"# Only the branch that {escaped(by, 80)} chooses is computed.\n")
        return f"{variable}.functions[{quoted(name)}]"

    def _arguments(self, made: Node, what: str, name: str, besides: Sequence[str] = ()) -> list[str]:
        """Return the arguments that make a node or pipeline again, but for some."""
        given = {parameter: value for parameter, value in arguments_of(made, what).items() if parameter not in besides}
        return [
            f"{parameter}={self._inner_graph(value, what, name)}"
            if isinstance(value, CompGraph)
            else f"{parameter}={self.value(value, what, f'{name}_{parameter}')}"
            for parameter, value in given.items()
        ]

    def _inner_graph(self, cg: CompGraph, what: str, name: str) -> str:
        """Write the graph of a pipeline; return its expression."""
        references = self.write(cg, f" of {what[0].lower()}{what[1:]}")
        variables = self.gathered.free_name(f"{name}_functions"), self.gathered.free_name(f"{name}_io")
        ends = f"{', '.join(cg.source_tokens) or 'nothing'} -> {', '.join(cg.sink_tokens) or 'nothing'}"
        comment = f"# {escaped(f'A graph of its own: {ends}.', 80)}"
        self.gathered.define(variables[0], f"{comment}\n{_dict(variables[0], references)}")
        self.gathered.define(variables[1], _io(variables[1], cg))
        epypes = self.gathered.module_name("epypes", what)
        source = f"{epypes}.CompGraph({', '.join(variables)}{'' if cg.types else ', types=False'})"
        for group, members in cg.groups.items():
            source = f"{epypes}.group({source}, {quoted(group)}, functions={bracketed([*members], quoted)})"
        for previous in cg.delays:
            source = self._delayed(source, cg, previous, f" of {what[0].lower()}{what[1:]}", f"{name}_{previous}")
        return source

    def with_delays(self, cg: CompGraph) -> str:
        """Return the function that adds the delays to the graph; "" if there are none."""
        variable = identifier_of("cg", self.gathered.is_taken)
        lines = [f"def {WITH_DELAYS}({variable}):"]
        lines += ['    """Return the graph with its state: what each run finds as the one before has left it."""']
        for previous in cg.delays:
            lines += laid_out(self._delayed(variable, cg, previous, "", previous), 1, f"{variable} = ")
        return "\n".join([*lines, f"    return {variable}"]) if cg.delays else ""

    def _delayed(self, source: str, cg: CompGraph, previous: str, where: str, wanted: str) -> str:
        """Return the expression of a graph with one delay more; ``wanted`` names the array that it may begin with."""
        token, initial = cg.delays[previous]
        what = f"The initial value of {previous!r}{where}"
        value = expression_or_none(self.gathered, initial, what, no_initial_value(cg, previous), wanted)
        epypes = self.gathered.module_name("epypes", what)
        return f"{epypes}.delay({source}, {quoted(token)}, {quoted(previous)}, initial={value})"

    def maker(self, pipeline: Pipeline) -> str:
        """Return the function that makes the pipeline of a user's class; of one that takes no events, one that does.

        Raises
        ------
        Refused
            A service can't make it, or can't give it events.
        """
        kind, what = type(pipeline), f"Pipeline {pipeline.name!r}"
        known = self.gathered.add_class(kind, _class_of(pipeline, what))
        taken = [parameter.name for parameter in parameters_of(kind)]
        of_user = {name for above in kind.__mro__ if above not in FullPipeline.__mro__ for name in vars(above)}
        if not isinstance(pipeline, FullPipeline | SourcePipeline) and not of_user & {"__init__", "emit"}:
            full = f"{self.gathered.module_name('epypes', what)}.FullPipeline"
            known, taken = f'type("Answering{kind.__name__}", ({full}, {known}), {{}})', [*_GIVEN]
        missing = [name for name in ("cg", "q_in", "q_out", "hparams") if name not in taken]
        if missing:
            text = f"{what} is of class {kind.__name__!r}, to which a service can't give {', '.join(missing)}"
            way_out = "Make it a subclass of ep.FullPipeline, whose __init__ takes them, and hands them on"
            raise Refused(f"{text}. {way_out}: super().__init__(..., {missing[0]}={missing[0]}).")
        arguments = self._arguments(pipeline, what, pipeline.name, _GIVEN)
        arguments += [f"{name}={name}" for name in _GIVEN if name in taken]
        head = [f"def {MAKER}({', '.join(_GIVEN)}):", '    """Return the pipeline that answers events."""']
        made = laid_out(f"{known}({', '.join(arguments)})", 1, "return ")
        return "\n".join([*head, *made])


def _class_of(made: Node, what: str) -> str:
    return f"Class {type(made).__name__!r} of {what[0].lower()}{what[1:]}"


# -- the layout of a module -------------------------------------------------------------------------------------------


def module_text(needed: Slice, tail: str, head: str = "") -> str:
    """Return the text of a module: what stands at its head, what its functions need, and what stands behind that."""
    written = needed.written
    definitions = {name for name, one in written.items() if not one.source}
    in_order = sorted(written.items(), key=lambda item: (not item[1].position, item[1].position))
    first = [one.text for _, one in in_order if one.source and not one.reads & definitions]
    early = [f"\n{text}" if number and text.startswith("#") else text for number, text in enumerate(first)]
    sections = ["\n\n".join(filter(None, [head, _import_lines(needed.imports.values()), "\n".join(early)]))]
    others = {name: one for name, one in in_order if not one.source or one.reads & definitions}
    for are_constants, found in itertools.groupby(_ordered(others), lambda one: bool(one.source)):
        texts = [one.text for one in found]
        sections += ["\n".join(texts)] if are_constants else texts
    return "\n\n\n".join(filter(None, [*sections, tail])) + "\n"


def _import_lines(statements: Iterable[str]) -> str:
    """Return imports in order: Python's own first, whole modules before names from modules."""

    def section(text: str) -> int:
        top = text.split()[1].partition(".")[0]
        return 0 if top == "__future__" else 1 if top in sys.stdlib_module_names else 2

    in_order = sorted(set(statements), key=lambda text: (section(text), text.startswith("from"), text.lower(), text))
    return "\n\n".join("\n".join(part) for _, part in itertools.groupby(in_order, section))


def _ordered(written: Mapping[str, Written]) -> list[Written]:
    """Return definitions, which are in the order of the notebook, each behind what importing it reads."""
    found: dict[str, Written] = {}
    begun: set[str] = set()

    def place(name: str) -> None:
        if name not in begun:
            begun.add(name)
            needs = _needs(written[name], written)
            for other in written:
                if other in needs:
                    place(other)
            found[name] = written[name]

    for name in written:
        place(name)
    return [*found.values()]


def _needs(one: Written, written: Mapping[str, Written]) -> set[str]:
    """Return the definitions that importing one reads; what it calls may read all that it mentions.

    What makes a closure calls nothing of what it is given.
    """
    tree = parsed(one.text) or ast.Module([], [])
    for part in ast.walk(tree):
        if isinstance(part, ast.FunctionDef | ast.AsyncFunctionDef):
            part.body = []  # is not executed at import
    parts = [*ast.walk(tree)]
    found = {part.id for part in parts if isinstance(part, ast.Name) and part.id in written}
    calls = any(isinstance(part, ast.Call | ast.ClassDef) or getattr(part, "decorator_list", []) for part in parts)
    pending = [*found] if calls and not one.is_closure else []
    while pending:
        more = (written.keys() & written[pending.pop()].reads) - found
        found |= more
        pending += more
    return found
