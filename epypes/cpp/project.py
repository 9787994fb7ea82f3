"""The functions of a graph in C++: which are translated, and why others are not."""

from __future__ import annotations

import ast
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import FunctionType
from typing import Any

from epypes.cpp import types as t
from epypes.cpp.recorded import Recording, Source, plain_function, source_of
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
    signature
        Its declaration without the semicolon.
    lines
        Its body; None if it is written by hand.
    reason, line
        Why it is written by hand, and the line of the source that is not translated; "" where there is none.
    source
        Its source in Python.
    """

    function: str
    name: str
    signature: str = ""
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


@dataclass(slots=True)
class Project:
    """A project of a recorded bundle: its functions in C++."""

    recording: Recording
    functions: list[CppFunction] = field(default_factory=list)
    called: dict[tuple[Any, ...], tuple[CppFunction, t.Type]] = field(default_factory=dict)
    helpers: set[str] = field(default_factory=set)
    stack: list[FunctionType] = field(default_factory=list)

    def translate(self) -> None:
        """Translate every function of the graph."""
        cg = self.recording.bundle.cg
        for name, function in cg.functions.items():
            self.functions.append(self._function(name, function))

    def _function(self, name: str, function: Callable[..., Any]) -> CppFunction:
        recording = self.recording
        inputs, outputs = recording.inputs_of(name), recording.outputs_of(name)
        wanted = (
            outputs[0].type
            if recording.bundle.cg.has_single_output(name)
            else t.TupleType(tuple(each.type for each in outputs))
        )
        cpp = recording.functions[name]
        plain = plain_function(function)
        parameters = [each.name for each in inputs]
        made = CppFunction(name, cpp)
        source: Source | None = None
        helpers: frozenset[str] = frozenset()
        before = dict(self.called)
        try:
            source = _call_of(name, function, parameters) if plain is None else source_of(plain)
            given = _given(source.node, inputs)
            self.stack = [plain] if plain is not None else []
            found = translated_function(source.node, source.names, given, self._own, wanted)
            made.lines, helpers = found.lines, found.helpers
            parameters = [found.parameters[key] for key in given]
        except ByHand as error:
            made.reason = str(error)
            made.line = source.line(error.line) if source is not None else ""
            self.called = before
        except RecursionError:
            made.reason = "it is nested too deep"
            self.called = before
        made.source = source.text if source is not None else ""
        self.helpers |= helpers
        listed = [f"{each.type.passed} {parameter}" for each, parameter in zip(inputs, parameters, strict=True)]
        made.signature = f"{wanted.cpp} {cpp}({', '.join(listed)})"
        if made.lines is not None:
            unused = [
                parameter
                for parameter in parameters
                if not any(re.search(rf"\b{parameter}\b", line) for line in made.lines)
            ]
            listed = [
                f"[[maybe_unused]] {text}" if parameter in unused else text
                for text, parameter in zip(listed, parameters, strict=True)
            ]
            made.lines = [f"{wanted.cpp} {cpp}({', '.join(listed)}) {{", *made.lines, "}"]
        return made

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
            try:
                source = source_of(function)
                names = [arg.arg for arg in source.node.args.args]
                self.stack.append(function)
                try:
                    given = dict(zip(names, types, strict=True))
                    found = translated_function(source.node, source.names, given, self._own)
                finally:
                    self.stack.pop()
            except ByHand as error:
                line = source.line(error.line) if source is not None else ""
                raise ByHand(f"it calls {function.__name__}: {error}{line and f', in: {line}'}") from None
            taken = [each.name for each, _ in self.called.values()] + [*self.recording.functions.values()]
            cpp = t.identifiers(
                [function.__name__], [*taken, *(token.name for token in self.recording.tokens.values())]
            )[function.__name__]
            listed = [
                f"{kind.passed} {found.parameters[name]}"
                for name, kind in zip(names, types, strict=True)
                if name in found.parameters
            ]
            head = f"{found.returns.cpp} {cpp}({', '.join(listed)})"
            made = CppFunction(function.__name__, cpp, head, [f"{head} {{", *found.lines, "}"], source=source.text)
            self.helpers |= found.helpers
            self.called[key] = made, found.returns
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
