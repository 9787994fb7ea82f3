"""A graph as Python that needs no graph: one straight-line function."""

from __future__ import annotations

import builtins
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from typing import Any, Final

from epypes.bundle.clone import called_by, is_plain_pipeline
from epypes.bundle.equivalence import Pair, refusal
from epypes.bundle.expressions import (
    LINE,
    Item,
    escaped,
    expression_or_none,
    identifiers_of,
    is_identifier,
    laid_out,
    literal_source,
    one_per_line,
)
from epypes.bundle.module import module_text
from epypes.bundle.slice import Slice, gather
from epypes.errors import PlaceholderNeeded, SourceRefused
from epypes.graph import CompGraph, as_switch
from epypes.pipeline import Pipeline
from epypes.run import CompGraphRunner

# Python itself can't indent deeper than 100; half of that can't be read.
_DEEPEST: Final = 20
_NO_EXPRESSION: Final = "is of type {kind}, and no expression makes it again. Write a plain function (def)."
_NO_VALUE: Final = (
    "is of type {kind}, and no expression makes this value again. Leave it free, so that the function takes it; or use "
    "numbers, strings, a small array or tuples of them."
)


def to_source(
    cg: CompGraph | CompGraphRunner | Pipeline,
    hparams: Mapping[str, Any] | None = None,
    *,
    returns: Sequence[str] | str | None = None,
    name: str = "run_graph",
) -> str:
    """Write a graph as a Python module with one straight-line function that computes the same.

    The function takes the free source tokens by position, in graph order, and the hyperparameters by keyword, with
    their values as defaults. Functions that can be imported are imported; those of the notebook are written above it,
    and so is a function for every Pipeline in the graph. A switch becomes an ``if``.

    Parameters
    ----------
    cg
        A graph; or a runner or pipeline, for its graph and its hyperparameters.
    hparams
        Values of hyperparameter tokens, besides the graph's defaults and those of a runner.
    returns
        The tokens that the function returns: one as it is, several as a tuple. Only what they need is written. Without,
        everything is written and the sink tokens are returned.
    name
        What the function is called.

    Returns
    -------
    str
        The module, formatted; the same for the same graph.

    Raises
    ------
    SourceRefused
        With every reason: functions that have no name to import and no source, values that have no expression.
    PlaceholderNeeded
        Functions that are needed are still to be written.
    UnknownName
        A name in ``returns`` or ``hparams`` is not a token of the graph.
    HyperparameterError
        A hyperparameter is made by a function.

    Notes
    -----
    What a runner does around functions is not written: arrays are passed as they are, not as read-only views, and
    annotations are not compared with values. A function that several branches of a switch need is called before the
    switch, whichever is chosen.

    Semeniuta and Falkman 2019, PeerJ Computer Science 5:e176, name code generation as further work.

    Examples
    --------
    >>> import math
    >>> cg = CompGraph({"root": math.sqrt}, {"root": ("x", "y")})
    >>> print(to_source(cg, name="root"), end="")
    import math
    <BLANKLINE>
    <BLANKLINE>
    def root(x):
        \"\"\"Return y.\"\"\"
        y = math.sqrt(x)
        return y
    """
    if not isinstance(name, str):
        raise TypeError(f'name is what the function is called, a string as "run_graph", not {type(name).__name__!r}.')
    graph, values = _subject(cg, hparams)
    wanted = _wanted(graph, returns)
    return _written(name, graph, values, wanted)


def _written(name: str, cg: CompGraph, values: Mapping[str, Any], wanted: tuple[str, ...] | None) -> str:
    def write(gathered: Slice) -> list[_Part]:
        parts = _with_pipelines(_Part(name, cg, values, wanted))
        missing = [function for part in parts for function in part.cg.placeholders if function in set(part.functions)]
        if missing:
            raise PlaceholderNeeded(missing)
        gathered.refusals += _unwritable(parts, name, wanted)
        _slice(gathered, parts)
        for part in parts:
            _write_values(gathered, part)
        return parts

    gathered, parts = gather(write, reserved=(name,))
    if gathered.refusals:
        raise SourceRefused(tuple(dict.fromkeys(gathered.refusals)))
    text = module_text([], gathered, [part.text() for part in parts])
    why = _difference(text, parts)
    if why:
        raise SourceRefused((why,))
    return text


def _difference(text: str, parts: Sequence[_Part]) -> str:
    """Return why what a module calls is not what the graph calls; "" if it is."""
    compared: list[tuple[str, Any, str]] = []
    for part in parts:
        for name, source in part.references.items():
            if name not in part.pipelines:
                compared.append((f"Function {name!r}{part.where}", part.cg.functions[name], source))
        for token, source in part.defaults.items():
            compared.append((f"Hyperparameter {token!r}{part.where}", part.values[token], source))
    whole = "\n".join([text, *one_per_line("references = [", [("", source) for _, _, source in compared], "]"), ""])

    def pairs(module: Any) -> list[Pair]:
        return [(what, ours, made) for (what, ours, _), made in zip(compared, module.references, strict=True)]

    return refusal(whole, {}, pairs)


@dataclass(eq=False, slots=True)
class _Region:
    """A place of functions: the graph itself, or a branch of a switch.

    Attributes
    ----------
    around
        The region in which the switch is; None for the graph.
    token
        The token that the branch passes on.
    keys
        The values of the selector that choose it.
    functions
        The functions that stand in it, in run order.
    """

    around: _Region | None = None
    depth: int = 0
    token: str = ""
    keys: list[Hashable] = field(default_factory=list)
    functions: list[str] = field(default_factory=list)


class _Part:
    """A graph that becomes a function: the one that was given, or that of a pipeline in it.

    A function that only one branch of a switch needs stands inside it, so that it runs only when that branch is chosen.
    What several branches need stands before the switch.

    Parameters
    ----------
    name
        What the function is called.
    cg, values
        The graph, and the values of its hyperparameters.
    wanted
        The tokens that it returns; None for the sink tokens, and all functions.
    where
        How reasons call a pipeline; "" for the graph that was given.

    Attributes
    ----------
    root
        The region of the graph itself.
    branches
        The regions of each switch that is written.
    functions
        All functions that are written, in run order.
    tokens
        The tokens that are made, read or wanted, in graph order.
    references
        By function, the expression that refers to it.
    pipelines
        The functions that are pipelines, which are parts of their own.
    defaults
        By hyperparameter, the expression of its value.
    keys
        By function of a switch, the expressions of its selector's values, by value.
    variables
        By token, its variable.
    """

    def __init__(
        self, name: str, cg: CompGraph, values: Mapping[str, Any], wanted: tuple[str, ...] | None, where: str = ""
    ) -> None:
        self.name, self.cg, self.values, self.where = name, cg, values, where
        self.returns = cg.sink_tokens if wanted is None else wanted
        self.root = _Region()
        self.branches: dict[str, list[_Region]] = {}
        self.functions, self.tokens = self._place(wanted is None)
        self.references: dict[str, str] = {}
        self.pipelines: dict[str, _Part] = {}
        self.defaults: dict[str, str] = {}
        self.keys: dict[str, dict[Hashable, str]] = {}
        self.variables: dict[str, str] = {}

    def _place(self, is_whole: bool) -> tuple[list[str], list[str]]:
        """Put each function that is needed into the innermost region around what needs it."""
        cg, inside = self.cg, dict[str, _Region]()
        used = dict.fromkeys(self.returns, self.root)
        switches = set(cg.switches)
        for name in reversed(tuple(cg.functions)):
            made = cg.func_outputs(name)
            regions = [used[token] for token in made if token in used]
            if not regions and (made or not is_whole):
                continue
            inside[name] = region = _common(regions or [self.root])
            read = [(token, region) for token in cg.func_inputs(name)]
            if name in switches:
                self.branches[name] = _branches(cg, name, region)
                read = [read[0], *((branch.token, branch) for branch in self.branches[name])]
            for token, reader in read:
                used[token] = _common([used.get(token, reader), reader])
        functions = [name for name in cg.functions if name in inside]
        for name in functions:
            inside[name].functions.append(name)
        seen = {*used, *(token for name in functions for token in cg.func_outputs(name))}
        return functions, [token for token in cg.tokens if token in seen]

    def text(self) -> str:
        """Return the function."""
        self.variables = variables = identifiers_of(self.tokens, self._hidden().__contains__)
        sources = [token for token in self.cg.source_tokens if token in variables]
        given: list[Item] = [("", variables[token]) for token in sources if token not in self.defaults]
        named = [(f"{variables[token]}=", self.defaults[token]) for token in sources if token in self.defaults]
        given += [*[("", "*")][: len(named)], *named]
        whole = f"def {self.name}({', '.join(before + source for before, source in given)}):"
        head = [whole] if len(whole) <= LINE else one_per_line(f"def {self.name}(", given, "):")
        body = [*self._docstring([*sources, *self.returns]), *self._region(self.root, 1)]
        if self.returns:
            returned = [variables[token] for token in self.returns]
            source = f"({', '.join(returned)})"
            is_short = len(returned) == 1 or len(source) + 9 <= LINE
            body += laid_out(source[1:-1] if is_short else source, 1, "return ")
        elif self.where:  # a function of another graph returns a value even if there is no token to return
            body.append("    return ()")
        return "\n".join([*head, *body])

    def _hidden(self) -> set[str]:
        """Return the names of the module that the function uses: a variable of that name would hide them."""
        keys = chain.from_iterable(values.values() for values in self.keys.values())
        sources = [*self.references.values(), *(key for key in keys if not key.startswith(("'", '"')))]
        tops = {source.partition(".")[0].partition("(")[0] for source in sources}
        return {*tops, "ValueError"} if self.branches else tops

    def _region(self, region: _Region, depth: int) -> Iterator[str]:
        """Give the lines of the functions of a region, and of the branches in it."""
        for name in region.functions:
            if name in self.branches:
                yield from self._switch(name, depth)
                continue
            arguments = ", ".join(self.variables[token] for token in self.cg.func_inputs(name))
            yield from laid_out(f"{self.references[name]}({arguments})", depth, self._targets(name))

    def _targets(self, name: str) -> str:
        """Return what stands before the value of a function."""
        targets = [self.variables[token] for token in self.cg.func_outputs(name)]
        if not targets:
            return ""
        is_tuple_of_one = len(targets) == 1 and not self.cg.has_single_output(name)
        return f"({targets[0]},) = " if is_tuple_of_one else f"{', '.join(targets)} = "

    def _switch(self, name: str, depth: int) -> Iterator[str]:
        selector, keyword, pad = self.variables[self.cg.func_inputs(name)[0]], "if", "    " * depth
        for branch in self.branches[name]:
            keys = [self.keys[name][key] for key in branch.keys]
            if len(keys) == 1 and keys[0] not in ("True", "False"):
                operator, right = ("is" if keys[0] == "None" else "=="), keys[0]
            else:
                operator, right = "in", f"({', '.join(keys)}{',' if len(keys) == 1 else ''})"
            yield from laid_out(right, depth, f"{keyword} {selector} {operator} ", ":")
            body, targets = [*self._region(branch, depth + 1)], self._targets(name)
            if targets:
                body += laid_out(self.variables[branch.token], depth + 1, targets)
            yield from body or [f"{pad}    pass"]
            keyword = "elif"
        yield f"{pad}else:"
        yield f'{pad}    raise ValueError(f"Unknown {selector}: {{{selector}!r}}")'

    def _docstring(self, shown: Iterable[str]) -> list[str]:
        """Return the docstring: what is returned, and which parameters and results have other names than tokens."""
        summary = f"Return {', '.join(self.variables[token] for token in self.returns)}." if self.returns else "Run."
        if len(summary) > LINE - 10:
            summary = f"Return {len(self.returns)} values." if len(self.returns) > 1 else "Return the result."
        other = [token for token in dict.fromkeys(shown) if self.variables[token] != token]
        if not other:
            return [f'    """{summary}"""']
        lines = [f"        {self.variables[token]}: '{escaped(token, 40)}'" for token in other]
        return [f'    """{summary}', "", "    Tokens of the graph that have other names here:", "", *lines, '    """']


def _branches(cg: CompGraph, name: str, around: _Region) -> list[_Region]:
    """Return the branches of a switch; values of the selector that choose the same token choose the same branch."""
    found: dict[str, _Region] = {}
    for key, token in _keys(cg, name):
        found.setdefault(token, _Region(around, around.depth + 1, token)).keys.append(key)
    return list(found.values())


def _keys(cg: CompGraph, name: str) -> Iterator[tuple[Hashable, str]]:
    """Give the values of a switch's selector, each with the token that it chooses."""
    function = as_switch(cg.functions[name])
    yield from zip(function.branches if function is not None else (), cg.func_inputs(name)[1:], strict=True)


def _common(regions: list[_Region]) -> _Region:
    """Return the innermost region around all of these."""
    found = regions[0]
    for other in regions[1:]:
        while found is not other:
            if found.depth >= other.depth:
                found = found.around or found
            else:
                other = other.around or other
    return found


def _wanted(cg: CompGraph, returns: Any) -> tuple[str, ...] | None:
    """Return the tokens that are asked for, which are checked; None for the sink tokens."""
    if returns is None:
        return None
    wanted = (returns,) if isinstance(returns, str) else tuple(returns) if isinstance(returns, Iterable) else (None,)
    if not all(isinstance(token, str) for token in wanted):
        kind = type(returns).__name__
        raise TypeError(f'returns takes a token or a list of tokens, as ["edges"], not this {kind!r}.')
    for token in wanted:
        cg.require_token(token)
    return wanted


def _subject(given: Any, hparams: Mapping[str, Any] | None) -> tuple[CompGraph, Mapping[str, Any]]:
    """Return a graph and the values of its hyperparameters, which are checked."""
    if isinstance(given, CompGraphRunner | Pipeline):
        runner = given.runner if isinstance(given, Pipeline) else given
        cg, known = given.cg, runner.hyperparameters
    else:
        cg, known = given, getattr(given, "defaults", {})
    if not isinstance(hparams, Mapping | None):
        kind = type(hparams).__name__
        raise TypeError(f"hparams takes the values of hyperparameters by token, such as a dict, not {kind!r}.")
    values = {**known, **(hparams or {})}
    CompGraphRunner(cg, values)  # raises for what is no graph, and for what can't be a hyperparameter
    return cg, values


def _with_pipelines(top: _Part) -> list[_Part]:
    """Return the parts of the pipelines that a part calls, and of those that they call, then the part itself."""
    by_pipeline: dict[int, _Part] = {}
    found, pending = [top], [top]
    while pending:
        part = pending.pop()
        for name in part.functions:
            pipeline = called_by(part.cg.functions[name])
            if not is_plain_pipeline(pipeline):
                continue
            if id(pipeline) not in by_pipeline:
                where = f" of pipeline {pipeline.name!r}"
                inner = _Part(pipeline.name, pipeline.cg, pipeline.runner.hyperparameters, None, where)
                by_pipeline[id(pipeline)] = inner
                found.append(inner)
                pending.append(inner)
            part.pipelines[name] = by_pipeline[id(pipeline)]
    return found[::-1]


def _unwritable(parts: Sequence[_Part], name: str, wanted: Sequence[str] | None) -> Iterator[str]:
    """Give what stands against writing these parts, whatever their functions are."""
    if not is_identifier(name) or hasattr(builtins, name):
        yield f"name={name!r} can't be a function's name. Give a word that means nothing to Python."
    if wanted == ():
        yield "returns is empty: name at least one token, or leave it out for the sink tokens."
    for part in parts:
        if any(region.depth > _DEEPEST for regions in part.branches.values() for region in regions):
            text = f"The switches{part.where} stand in one another too deep to be indented."
            yield f"{text} Make the inner ones a Pipeline, which becomes a function of its own."


def _slice(gathered: Slice, parts: Sequence[_Part]) -> None:
    """Gather what the functions need, and note by which expressions they are called."""
    for part in parts:
        for name in part.functions:
            if name not in part.branches and name not in part.pipelines:
                what, function = f"Function {name!r}{part.where}", called_by(part.cg.functions[name])
                part.references[name] = expression_or_none(gathered, function, what, _NO_EXPRESSION, name)
    for part in parts:
        if part.where:  # its name must hide nothing
            part.name = gathered.free_name(part.name)
    for part in parts:
        part.references.update({name: inner.name for name, inner in part.pipelines.items()})


def _write_values(gathered: Slice, part: _Part) -> None:
    """Write the expressions of hyperparameters and of the values that switches compare."""
    for token, value in part.values.items():
        if token in part.tokens:
            part.defaults[token] = _default(gathered, f"Hyperparameter {token!r}{part.where}", token, value)
    for name in part.branches:
        what = f"Switch {name!r}{part.where}"
        part.keys[name] = {
            key: expression_or_none(
                gathered, key, what, f"chooses {token!r} by a key of type {{kind}}, which no expression makes again. "
                "Choose by strings or numbers."
            )
            for key, token in _keys(part.cg, name)
        }  # fmt: skip


def _default(gathered: Slice, what: str, token: str, value: Any) -> str:
    """Return the expression of a hyperparameter's value: as it is, or the constant above that holds it."""
    source = expression_or_none(gathered, value, what, _NO_VALUE)
    if literal_source(value) or source.replace(".", "").isidentifier():
        return source
    return gathered.add_constant(token.upper(), source)
