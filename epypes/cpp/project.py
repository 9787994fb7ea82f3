"""The functions of a graph in C++: which are translated, and why others are not."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FunctionType
from typing import Any

from epypes.cpp import types as t
from epypes.cpp.recorded import Recording, Source, plain_function, shown_source, source_of
from epypes.cpp.scope import ByHand, no_counterpart, refuse
from epypes.cpp.statements import function as translated_function


@dataclass(slots=True)
class CppFunction:
    """A function of the graph, or one that it calls.

    Attributes
    ----------
    function
        Its name in the graph; of one that is called, in Python.
    name
        Its name in C++.
    returns
        What it returns in C++.
    parameters
        The types and the names of its parameters in C++.
    lines
        Its body; None if it is written by hand.
    reason, line
        Why it is written by hand, and the line of the source that is not translated; "" where there is none.
    source
        Its source in Python.
    """

    function: str
    name: str
    returns: str = ""
    parameters: Sequence[tuple[str, str]] = ()
    lines: Sequence[str] | None = None
    reason: str = ""
    line: str = ""
    source: str = ""

    @property
    def is_by_hand(self) -> bool:
        """Whether it is to be written by hand."""
        return self.lines is None

    @property
    def reason_with_line(self) -> str:
        """The reason, with the line that it is about."""
        return f"{self.reason}, in: {self.line}" if self.line else self.reason

    @property
    def signature(self) -> str:
        """Its declaration without the semicolon."""
        return f"{self.returns} {self.name}({', '.join(map(' '.join, self.parameters))})"

    @property
    def head(self) -> str:
        """Its declaration, in which the parameters that its body does not use are marked."""
        words = {*re.findall(r"\w+", "\n".join(self.lines or ()))}
        marked = [f"{'' if name in words else '[[maybe_unused]] '}{kind} {name}" for kind, name in self.parameters]
        return f"{self.returns} {self.name}({', '.join(marked)})"


@dataclass(slots=True)
class Project:
    """A project of a recorded bundle: its functions in C++."""

    recording: Recording
    functions: list[CppFunction] = field(default_factory=list)
    called: dict[tuple[Any, ...], tuple[CppFunction, t.Type]] = field(default_factory=dict)
    stack: list[FunctionType] = field(default_factory=list)

    def translate(self) -> None:
        """Translate every function of the graph."""
        cg = self.recording.bundle.cg
        for name, function in cg.functions.items():
            self.functions.append(self._function(name, function))

    def _function(self, name: str, function: Callable[..., Any]) -> CppFunction:
        recording, plain = self.recording, plain_function(function)
        inputs, outputs = recording.inputs_of(name), recording.outputs_of(name)
        is_single = recording.bundle.cg.has_single_output(name)
        wanted = outputs[0].type if is_single else t.TupleType(tuple(each.type for each in outputs))
        parameters = [(each.type.passed, each.name) for each in inputs]
        made = CppFunction(name, recording.functions[name], wanted.cpp, parameters, source=shown_source(function))
        before = dict(self.called)
        source: Source | None = None
        try:
            source = _call_of(name, function, [each.name for each in inputs]) if plain is None else source_of(plain)
            made.source = source.text
            self.stack = [plain] if plain is not None else []
            self._translate(made, source, _given(source.node, inputs), wanted)
        except ByHand as error:
            made.reason = str(error)
            made.line = source.line(error.line) if source is not None else ""
        except RecursionError:
            made.reason = "it is nested too deep"
        if made.is_by_hand:
            self.called = before
        return made

    def _translate(
        self, made: CppFunction, source: Source, given: Mapping[str, t.Type], wanted: t.Type | None = None
    ) -> t.Type:
        """Translate a function for the types of its arguments; return the type that it returns."""
        found = translated_function(source.node, source.names, given, self._own, wanted)
        names = found.parameters
        made.returns, made.lines = found.returns.cpp, found.lines
        made.parameters = [(kind.passed, names[name]) for name, kind in given.items() if name in names]
        return found.returns

    def _own(self, function: FunctionType, types: Sequence[t.Type], node: Any) -> tuple[str, t.Type]:
        """Translate a function that another one calls, for the types of its arguments."""
        refuse(function in self.stack, f"{function.__name__} calls itself", node)
        is_in_bundle = Path(function.__code__.co_filename).resolve().is_relative_to(self.recording.bundle.path)
        package = str(function.__module__).partition(".")[0]
        is_own = is_in_bundle or package in {str(each.__module__).partition(".")[0] for each in self.stack}
        refuse(not is_own, no_counterpart(function), node)
        key = (function, *(each.cpp for each in types), *map(str, types))
        if key not in self.called:
            source: Source | None = None
            made = CppFunction(function.__name__, "")
            self.stack.append(function)
            try:
                source = source_of(function)
                names = [arg.arg for arg in source.node.args.args]
                returns = self._translate(made, source, dict(zip(names, types, strict=True)))
            except ByHand as error:
                line = source.line(error.line) if source is not None else ""
                raise ByHand(f"it calls {function.__name__}: {error}{line and f', in: {line}'}") from None
            finally:
                self.stack.pop()
            taken = [each.name for each, _ in self.called.values()] + [*self.recording.functions.values()]
            taken += [token.name for token in self.recording.tokens.values()]
            made.name = t.identifiers([function.__name__], taken)[function.__name__]
            self.called[key] = made, returns
        made, kind = self.called[key]
        return made.name, kind


def _given(node: ast.FunctionDef, inputs: Sequence[t.TokenType]) -> dict[str, t.Type]:
    """Return the types of a function's arguments, which the graph gives by position."""
    names = [arg.arg for arg in node.args.args]
    refuse(len(names) < len(inputs), "it takes fewer arguments than the graph gives", node)
    refuse(len(names) > len(inputs), f"the graph leaves the default of {names[-1]!r}" if names else "", node)
    return dict(zip(names, (each.type for each in inputs), strict=True))


def _call_of(name: str, function: Callable[..., Any], parameters: Sequence[str]) -> Source:
    """Return the source of a function that only calls one of OpenCV or NumPy."""
    cpp = getattr(function, "__name__", "")
    if not cpp.isidentifier() or not hasattr(function, "__module__"):
        raise ByHand(f"it is a {type(function).__name__}, no plain function")
    text = f"def {t.identifier(name)}({', '.join(parameters)}):\n    return {cpp}({', '.join(parameters)})\n"
    node: Any = ast.parse(text).body[0]
    return Source(node, f"{name} = {cpp}\n", {cpp: function})
