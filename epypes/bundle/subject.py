"""The subject of a promotion: what of a runner or pipeline goes into the bundle."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

from epypes.bundle.adapters import is_usual
from epypes.bundle.expressions import expression, noted_refusals
from epypes.bundle.graphs import Graphs
from epypes.bundle.instances import arguments_of, parameters_of
from epypes.bundle.load import MAKER
from epypes.bundle.resolve import Refused
from epypes.bundle.slice import Slice
from epypes.bundle.syntax import laid_out, quoted
from epypes.graph import CompGraph
from epypes.pipeline import FullPipeline, Pipeline, SinkPipeline, SourcePipeline
from epypes.run import CompGraphRunner
from epypes.run.guard import as_written

# What the maker is given, and hands on to the class.
_GIVEN: Final = ("cg", "q_in", "q_out", "f_in", "f_out", "hparams")
_OURS: Final = (Pipeline, SourcePipeline, SinkPipeline, FullPipeline)
_NO_RUNNER: Final = (
    "An object of class {} can't be promoted. Make a runner and run it: "
    "runner = CompGraphRunner(cg, hparams); runner.run(...)."
)


@dataclass(frozen=True, slots=True)
class Subject:
    """What is promoted.

    Attributes
    ----------
    runner, cg
        Its runner, whose last run is recorded, and the graph with the user's own functions.
    pipeline
        The pipeline; None if a runner is promoted.
    ports
        f_in and f_out, as far as they are not the usual ones of a bundle.
    attributes
        Those of the pipeline.
    """

    runner: CompGraphRunner
    cg: CompGraph
    pipeline: Pipeline | None = None
    ports: Mapping[str, Callable[..., Any]] = field(default_factory=dict)
    attributes: Mapping[str, Any] = field(default_factory=dict)

    @property
    def classes(self) -> Mapping[str, type]:
        """The class of the pipeline by how reasons call it, if it is not one of EPypes."""
        kind = type(self.pipeline)
        if self.pipeline is None or kind in _OURS:
            return {}
        return {f"Class {kind.__name__!r} of pipeline {self.pipeline.name!r}": kind}


def subject_of(given: object, f_in: Any, f_out: Any) -> Subject:
    """Return what is promoted.

    Raises
    ------
    Refused
        It is neither a runner nor a pipeline, or a port is no function.
    """
    for name, function in (("f_in", f_in), ("f_out", f_out)):
        if function is not None and not callable(function):
            raise Refused(f"{name} must be a function, not {type(function).__name__!r}.")
    if isinstance(given, CompGraphRunner):
        return Subject(given, given.cg, None, _ports({}, f_in, f_out))
    if not isinstance(given, Pipeline):
        raise Refused(_NO_RUNNER.format(type(given).__name__))
    own = {name: getattr(given, name, None) for name in ("f_in", "f_out") if _is_port(given, name)}
    return Subject(given.runner, given.source_cg, given, _ports(own, f_in, f_out), dict(given.attributes))


def _ports(own: Mapping[str, Any], f_in: Any, f_out: Any) -> dict[str, Callable[..., Any]]:
    found = {**own, **{name: port for name, port in (("f_in", f_in), ("f_out", f_out)) if port is not None}}
    return {name: as_written(port) for name, port in found.items() if port is not None and not is_usual(port)}


def _is_port(pipeline: Pipeline, name: str) -> bool:
    """Whether a pipeline was given a port, which its class may also make itself."""
    return any(parameter.name == name for parameter in parameters_of(type(pipeline)))


def own_lines(gathered: Slice, graphs: Graphs, subject: Subject) -> Iterator[tuple[str, list[str]]]:
    """Give what the module has of its own in place of what a bundle usually does, by name; refusals are gathered."""
    comments = {"f_in": "# How an event becomes a payload.", "f_out": "# How a run becomes an answer."}
    for name, function in subject.ports.items():
        reference = graphs.reference(function)
        if reference == name:
            yield name, []
            continue
        with noted_refusals(gathered):
            gathered.keep_name(name)
        yield name, [comments[name], f"{name} = {reference}"]
    if subject.pipeline is not None and type(subject.pipeline) not in _OURS:
        with noted_refusals(gathered):
            gathered.keep_name(MAKER)
            yield MAKER, _maker(gathered, subject.pipeline)


def _maker(gathered: Slice, pipeline: Pipeline) -> list[str]:
    """Return the function that makes the pipeline of a user's class."""
    kind, what = type(pipeline), f"Pipeline {pipeline.name!r}"
    known = gathered.add_class(kind, None, f"Class {kind.__name__!r} of {what[0].lower()}{what[1:]}")
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
    gathered.keep_name(name)
    full = f"{gathered.module_name('epypes', what)}.FullPipeline"
    return name, [
        f"class {name}({full}, {known}):",
        f'    """{kind.__name__}, driven by events."""',
        "",
        "",
    ]
