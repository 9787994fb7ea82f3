"""How would a user of an installed peer do the same work?

A peer is made of a Work: what the user would have written in a file is prepared, not timed. Then ``build`` makes the
graph, ``run`` computes the target from the payload, ``rerun`` computes it again after one hyperparameter changed.
"""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable, Collection, Mapping
from types import FunctionType
from typing import Any, ClassVar

from tests.benchmarks.timing import Effort
from tests.benchmarks.work import Work


class Peer:
    """What all have in common."""

    name: ClassVar[str]
    module: ClassVar[str]

    def __init__(self, work: Work, *, tuned: bool = False) -> None:
        """Prepare; ``tuned`` says that the graph will be rerun, so that a peer with a cache switches it on."""
        self.work, self.tuned = work, tuned
        self.inputs = {**work.payload, **work.hparams}
        self.prepare(importlib.import_module(self.module))

    def prepare(self, library: Any) -> None:
        self.library = library

    def build(self) -> None:
        raise NotImplementedError

    def run(self) -> Any:
        raise NotImplementedError

    def rerun(self, token: str, value: Any) -> Any:
        self.inputs = {**self.inputs, token: value}
        return self.run()

    def first_result(self) -> Any:
        self.build()
        return self.run()


class PipeFunc(Peer):
    name, module = "pipefunc", "pipefunc"

    def prepare(self, library: Any) -> None:
        self.library, self.functions = library, natural_functions(self.work)

    def build(self) -> None:
        cached = {"cache_type": "simple"} if self.tuned else {}
        make = self.library.PipeFunc
        functions = [make(function, output, cache=self.tuned) for output, function in self.functions.items()]
        self.pipeline = self.library.Pipeline(functions, **cached)

    def run(self) -> Any:
        return self.pipeline(self.work.target, **self.inputs)


class Hamilton(Peer):
    name, module = "Hamilton", "hamilton.driver"

    def prepare(self, library: Any) -> None:
        self.library = library
        functions = natural_functions(self.work, Any).values()
        self.source = importlib.import_module("hamilton.ad_hoc_utils").create_temporary_module(*functions)
        self.to_dict = importlib.import_module("hamilton.base").DictResult()

    def build(self) -> None:
        builder = self.library.Builder().with_modules(self.source).with_adapters(self.to_dict)
        self.driver = builder.build()
        self.kept: dict[str, Any] = {}

    def run(self) -> Any:
        return self.driver.execute([self.work.target], inputs=self.inputs, overrides=self.kept)[self.work.target]

    def rerun(self, token: str, value: Any) -> Any:
        if not self.kept:
            self.kept = self._values_above(token)
        return super().rerun(token, value)

    def _values_above(self, token: str) -> dict[str, Any]:
        """Compute what the functions below a token take from above, given as overrides from now on."""
        stale = self.work.downstream(token).values()
        made = {output for _, output in self.work.io.values()} - {output for _, output in stale}
        wanted = sorted({each for inputs, _ in stale for each in inputs} & made)
        return dict(self.driver.execute(wanted, inputs=self.inputs))


class Dask(Peer):
    name, module = "dask", "dask"

    def build(self) -> None:
        work = self.work
        self.graph = {output: (work.functions[name], *inputs) for name, (inputs, output) in work.io.items()}

    def run(self) -> Any:
        return self.library.get({**self.graph, **self.inputs}, self.work.target)


class Loman(Peer):
    name, module = "loman", "loman"

    def prepare(self, library: Any) -> None:
        self.library, self.functions = library, natural_functions(self.work)

    def build(self) -> None:
        self.computation = self.library.Computation()
        for token, value in self.inputs.items():
            self.computation.add_node(token, value=value)
        for output, function in self.functions.items():
            self.computation.add_node(output, function)

    def run(self) -> Any:
        for token, value in self.work.payload.items():
            # An equal value changes nothing without force; here every payload counts as new, as a camera's would.
            self.computation.insert(token, value, force=True)
        return self._computed()

    def rerun(self, token: str, value: Any) -> Any:
        self.computation.insert(token, value)
        return self._computed()

    def _computed(self) -> Any:
        self.computation.compute(self.work.target, raise_exceptions=True)
        return self.computation.value(self.work.target)


ALL: tuple[type[Peer], ...] = (PipeFunc, Hamilton, Dask, Loman)


def installed() -> tuple[type[Peer], ...]:
    """Return the peers that can be imported."""
    return tuple(peer for peer in ALL if importlib.util.find_spec(peer.module.partition(".")[0]))


def built(effort: Effort, work: Work, *, tuned: bool = False, without: Collection[str] = ()) -> dict[str, Peer]:
    """Return the installed peers by name with their graphs, ready to run; none in a quick run."""
    chosen = {peer.name: peer(work, tuned=tuned) for peer in present(effort, without)}
    for peer in chosen.values():
        peer.build()
    return chosen


def present(effort: Effort, without: Collection[str] = ()) -> list[type[Peer]]:
    """Return the peers that take part."""
    return [] if effort.quick else [peer for peer in installed() if peer.name not in without]


def natural_functions(work: Work, annotation: object = None) -> dict[str, Callable[..., Any]]:
    """Return the functions by output token, called like their output, with parameters called like their inputs."""
    return {
        output: _renamed(work.functions[name], output, inputs, annotation) for name, (inputs, output) in work.io.items()
    }


def _renamed(function: Any, name: str, parameters: tuple[str, ...], annotation: object) -> Callable[..., Any]:
    """Return the same code under the names that a peer goes by: a wrapper would cost a call more."""
    code = function.__code__
    names = (*parameters, *code.co_varnames[code.co_argcount :])
    renamed = FunctionType(code.replace(co_name=name, co_qualname=name, co_varnames=names), function.__globals__, name)
    renamed.__module__ = __name__
    if annotation is not None:
        renamed.__annotations__ = _annotations(parameters, annotation)
    return renamed


def _annotations(parameters: tuple[str, ...], annotation: object) -> Mapping[str, object]:
    return {**dict.fromkeys(parameters, annotation), "return": annotation}
