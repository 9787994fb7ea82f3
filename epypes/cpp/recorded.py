"""A bundle as the export sees it: its functions, and the values of every token in a run of each sample."""

from __future__ import annotations

import ast
import functools
import inspect
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FunctionType
from typing import Any, Final

from epypes.bundle.load import Bundle, read_bundle
from epypes.cpp.scope import ByHand
from epypes.cpp.types import INT, NONE, ArrayType, Int, TokenType, Type, identifiers, join, type_of
from epypes.errors import BundleError
from epypes.pipeline import Pipeline
from epypes.run import CompGraphRunner
from epypes.wire.samples import read_sample

# What generated code has for itself.
_TAKEN = tuple(
    "h inputs outputs begin first owned whole_graph Graph Hyperparameters Inputs Outputs State Clock".split()  # noqa: SIM905
)
# The longest line of a captured value that a comment shows.
_MOST_SHOWN: Final = 100


@dataclass(frozen=True, slots=True)
class Recording:
    """A bundle, and what its samples make of it.

    Attributes
    ----------
    bundle
        The bundle.
    tokens
        The tokens in C++, by name.
    runs
        The values of all tokens by sample; a state between runs is under the name of the delayed token.
    functions
        The names of the functions in C++, in run order.
    opencv_version
        The version of OpenCV that has run the samples; "" if none is installed.
    """

    bundle: Bundle
    tokens: Mapping[str, TokenType]
    runs: Mapping[str, Mapping[str, Any]]
    functions: Mapping[str, str]
    opencv_version: str

    @property
    def hyperparameters(self) -> Sequence[TokenType]:
        """The hyperparameters."""
        return [self.tokens[token] for token in self.bundle.settings.hyperparameters]

    def inputs_of(self, function: str) -> Sequence[TokenType]:
        """Return the tokens that a function takes."""
        return [self.tokens[token] for token in self.bundle.cg.func_inputs(function)]

    def outputs_of(self, function: str) -> Sequence[TokenType]:
        """Return the tokens that a function makes."""
        return [self.tokens[token] for token in self.bundle.cg.func_outputs(function)]


def record(path: str | Path) -> Recording:
    """Read a bundle and run its samples once.

    Raises
    ------
    BundleError
        The folder is no bundle, it has no sample, a token has values that C++ has no type for, or NumPy is older
        than 2.
    """
    import numpy as np

    bundle = read_bundle(path)
    if int(np.__version__.partition(".")[0]) < 2:
        text = f"The export to C++ needs NumPy 2, whose dtypes it translates; NumPy {np.__version__} is installed."
        raise BundleError(path, text)
    cg, settings = bundle.cg, bundle.settings
    if not bundle.samples:
        raise BundleError(path, f"{path} has no samples, which say the types. Promote the graph after a run.")
    odd = [name for name, function in cg.functions.items() if isinstance(function, Pipeline)]
    if odd or cg.switches or settings.own:
        what = (
            f"the nested pipeline {odd[0]!r}"
            if odd
            else f"the switch {cg.switches[0]!r}"
            if cg.switches
            else f"its own {settings.own[0]}"
        )
        raise BundleError(path, f"{path} has {what}, which has no form in C++. Promote a graph without.")
    runs: dict[str, dict[str, Any]] = {}
    for file in bundle.samples:
        sample = read_sample(file)
        runner = CompGraphRunner(cg, settings.hyperparameters)
        runner.state = sample.state
        run = runner.run(**sample.inputs)
        runs[file.stem] = {**sample.state, **{token: run[token] for token in cg.tokens if token not in sample.state}}
    values = {token: [run[token] for run in runs.values()] for token in cg.tokens}
    for token, delay in cg.delays.items():
        values[token] += [delay.initial, *values[delay.token]]
    types = {
        token: _token_type(bundle, token, found, token in settings.hyperparameters) for token, found in values.items()
    }
    names = identifiers(cg.tokens, _TAKEN)
    tokens = {token: TokenType(token, names[token], types[token]) for token in cg.tokens}
    try:
        from cv2 import __version__ as opencv_version
    except ImportError:
        opencv_version = ""
    return Recording(bundle, tokens, runs, identifiers(cg.functions, _TAKEN), opencv_version)


def _token_type(bundle: Bundle, token: str, values: Sequence[Any], is_hyperparameter: bool) -> Type:
    try:
        kind = functools.reduce(join, map(type_of, values))
    except TypeError as error:
        maker = bundle.cg.digraph.producer.get(token)
        takers = [repr(name) for name in bundle.cg.functions if token in bundle.cg.func_inputs(name)]
        merged = f"merge it with {' and '.join(takers)}, or " if takers else ""
        text = f"The values of token {token!r} are {error}, for which C++ has no type. " + (
            f"Let {maker!r} return a tuple of arrays, numbers or lists, {merged}make the graph without it."
            if maker
            else "Give arrays, numbers or lists."
        )
        raise BundleError(bundle.path, text) from None
    if kind == NONE:
        return ArrayType(is_nullable=True)
    if isinstance(kind, Int) and is_hyperparameter and all(INT.low <= value <= INT.high for value in values):
        return INT
    return kind


@dataclass(frozen=True, slots=True)
class Source:
    """The source of a function of the user.

    Attributes
    ----------
    node
        The function.
    text
        Its lines.
    names
        Its global names and what they are.
    """

    node: ast.FunctionDef
    text: str
    names: Mapping[str, Any]

    def line(self, number: int) -> str:
        """Return one of its lines, shortened; "" for the number 0."""
        lines = ["", *self.text.splitlines()]
        return textwrap.shorten(lines[number], 80, placeholder=" ...") if number < len(lines) else ""


def plain_function(function: Callable[..., Any]) -> FunctionType | None:
    """Return the function of Python that a function of a graph is; None if it is something else."""
    return function if isinstance(function, FunctionType) and not hasattr(function, "__wrapped__") else None


def shown_source(function: Callable[..., Any]) -> str:
    """Return the source of a function, with the short values that it has captured as comments; "" if it has none."""
    try:
        text = textwrap.dedent(inspect.getsource(function))
    except (OSError, TypeError):
        return ""
    captured = inspect.getclosurevars(function).nonlocals if isinstance(function, FunctionType) else {}
    lines = [f"# {name} = {value!r}" for name, value in captured.items()]
    # An address would differ at each export.
    shown = [line for line in lines if len(line) <= _MOST_SHOWN and "\n" not in line and " at 0x" not in line]
    return "\n".join([*shown, text])


def source_of(function: FunctionType) -> Source:
    """Return the source of a function.

    Raises
    ------
    ByHand
        It has none, it is a lambda, or it refers to variables of a function around it.
    """
    if function.__closure__:
        raise ByHand("it is a closure over variables of another function")
    try:
        text = textwrap.dedent(inspect.getsource(function))
        tree = ast.parse(text)
    except (OSError, SyntaxError, IndentationError):
        raise ByHand("its source can't be read") from None
    node = tree.body[0]
    if not isinstance(node, ast.FunctionDef):
        raise ByHand("it is a lambda")
    if node.decorator_list and any(_is_wrapping(each, function) for each in node.decorator_list):
        raise ByHand(f"it has the decorator {ast.unparse(node.decorator_list[0])}")
    return Source(node, text, function.__globals__)


def _is_wrapping(decorator: ast.expr, function: FunctionType) -> bool:
    """Whether a decorator may have made another function of it; ep.outputs marks it only."""
    name = decorator.func if isinstance(decorator, ast.Call) else decorator
    return ast.unparse(name).rpartition(".")[2] != "outputs" or function.__code__.co_name == "<lambda>"
