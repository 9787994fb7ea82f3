"""A graph as Python that needs no graph: one straight-line function."""

from __future__ import annotations

import builtins
import inspect
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain, takewhile
from types import FunctionType, ModuleType
from typing import Any, Final

from epypes.bundle.clone import is_plain_pipeline
from epypes.bundle.equivalence import Pair, refusal
from epypes.bundle.expressions import (
    LINE,
    bracketed,
    escaped,
    expression_or_none,
    identifier_of,
    is_identifier,
    laid_out,
    literal_source,
    names_in,
)
from epypes.bundle.module import module_text
from epypes.bundle.objects import is_of_library, without_nodes
from epypes.bundle.references import global_names, meanings_of, nested_codes
from epypes.bundle.slice import Slice, gather
from epypes.errors import PlaceholderNeeded, SourceRefused
from epypes.graph import CompGraph, Switch, as_switch
from epypes.graph.signature import distinct
from epypes.nothing import Nothing
from epypes.pipeline import Pipeline
from epypes.run import CompGraphRunner

# A longer default of a parameter is a constant above the function.
_LONGEST: Final = 60
_NO_EXPRESSION: Final = "is of type {kind}, and no expression makes it again. Write a plain function (def)."
_NO_VALUE: Final = (
    "is of type {kind}, and no expression makes this value again. Leave it free, so that the function takes it; or use "
    "numbers, strings, a small array or tuples of them."
)
_NO_KEY: Final = "by a key of type {kind}, which no expression makes again. Choose by strings or numbers."
# The branches of switches in which a function stands, from outside in: each a switch and the token that is passed on.
Region = tuple[tuple[str, str], ...]


def to_source(
    cg: CompGraph | CompGraphRunner | Pipeline,
    hparams: Mapping[str, Any] | None = None,
    *,
    returns: Iterable[str] | str | None = None,
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
    switch, whichever is chosen. The call of a function that takes what may be Nothing stands inside an ``if``: an
    output of a function that refers to ``ep.Nothing``, or calls one by name that does, and what is made of it.

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
    graph, values = _subject(cg, hparams)
    wanted = (returns,) if isinstance(returns, str) else None if returns is None else tuple(returns)
    for token in wanted or ():
        graph.require_token(token)

    def write(gathered: Slice) -> _Module:
        module = _Module(gathered)
        if not is_identifier(name) or hasattr(builtins, name):
            text = f"name={name!r} can't be a function's name. Give a word that means nothing to Python."
            gathered.refusals.append(text)
        _Function(module, name, graph, values, wanted)
        return module

    gathered, module = gather(write, reserved=(name,))
    text = module_text(gathered, "\n\n\n".join(module.texts))
    reasons = [*dict.fromkeys(gathered.refusals)] or [*filter(None, [module.difference(text)])]
    if reasons:
        raise SourceRefused(tuple(reasons))
    return text


def _subject(given: Any, hparams: Mapping[str, Any] | None) -> tuple[CompGraph, Mapping[str, Any]]:
    """Return a graph and the values of its hyperparameters, which are checked."""
    if isinstance(given, CompGraphRunner | Pipeline):
        runner = given.runner if isinstance(given, Pipeline) else given
        cg, known = given.cg, runner.hyperparameters
    else:
        cg, known = given, getattr(given, "defaults", {})
    values = {**known, **(hparams or {})}
    CompGraphRunner(cg, values)  # raises for what is no graph, and for what can't be a hyperparameter
    return cg, values


class _Module:
    """The module that a graph becomes.

    Attributes
    ----------
    gathered
        What its functions need.
    texts
        The functions: one for each pipeline in the graph, then its own.
    pipelines
        The names of the functions of pipelines, by id.
    compared
        What is compared with the notebook: how reasons call it, the value, its expression.
    """

    def __init__(self, gathered: Slice) -> None:
        self.gathered = gathered
        self.texts: list[str] = []
        self.pipelines: dict[int, str] = {}
        self.compared: list[tuple[str, Any, str]] = []

    def expression(self, what: str, value: Any, reason: str, wanted: str = "") -> str:
        """Return the expression of a value that is compared; refusals are gathered."""
        source = expression_or_none(self.gathered, value, what, reason, wanted)
        self.compared.append((what, value, source))
        return source

    def difference(self, text: str) -> str:
        """Return why what a module calls is not what the graph calls; "" if it is."""
        sources = ", ".join(source for _, _, source in self.compared)

        def pairs(module: Any) -> list[Pair]:
            return [(what, ours, made) for (what, ours, _), made in zip(self.compared, module.references, strict=True)]

        return refusal(f"{text}references = [{sources}]\n", pairs)


def _regions(cg: CompGraph, returns: Iterable[str], is_whole: bool) -> tuple[dict[str, Region], list[str]]:
    """Return where each function that is needed stands, in run order, and the tokens that are made, read or returned.

    It stands in the innermost branch around all that needs it.
    """
    used: dict[str, Region] = dict.fromkeys(returns, ())
    found: dict[str, Region] = {}
    switches = set(cg.switches)
    for name in reversed(tuple(cg.functions)):
        made = cg.func_outputs(name)
        readers = [used[token] for token in made if token in used]
        if not readers and (made or not is_whole):
            continue
        found[name] = region = _common(readers or [()])
        for number, token in enumerate(cg.func_inputs(name)):
            reader = (*region, (name, token)) if name in switches and number else region
            used[token] = _common([used.get(token, reader), reader])
    regions = {name: found[name] for name in cg.functions if name in found}
    seen = {*used, *chain.from_iterable(map(cg.func_outputs, regions))}
    return regions, [token for token in cg.tokens if token in seen]


def _may_find_nothing(function: Any) -> bool:
    """Whether a function, or one of the user's that it calls by name, refers to Nothing, also as ``ep.Nothing``."""
    function = without_nodes(function)
    if is_plain_pipeline(function):
        return any(map(_may_find_nothing, distinct(function.cg.functions).values()))
    pending, seen = [function], set[int]()
    while pending:
        reached = without_nodes(pending.pop())
        reached = inspect.unwrap(reached) if callable(reached) else reached
        reached = reached.func if type(reached) is partial else reached
        if not isinstance(reached, FunctionType) or id(reached) in seen or is_of_library(reached):
            continue
        seen.add(id(reached))
        codes = [*nested_codes(reached.__code__)]
        meant = meanings_of(reached, {*global_names(reached.__code__), *reached.__code__.co_freevars}).values()
        is_named = any("Nothing" in code.co_names for code in codes)
        modules = [value for value in meant if is_named and isinstance(value, ModuleType)]
        if any(value is Nothing for value in (*meant, *(getattr(module, "Nothing", None) for module in modules))):
            return True
        pending += meant
    return False


def _common(regions: Sequence[Region]) -> Region:
    """Return the innermost region around all of these."""
    levels = takewhile(lambda level: len(set(level)) == 1, zip(*regions, strict=False))
    return tuple(level[0] for level in levels)


class _Function:
    """A graph as a function, which is written into a module behind those of its pipelines.

    A function that only one branch of a switch needs stands inside it, so that it runs only when that branch is chosen.
    What several branches need stands before the switch.

    Parameters
    ----------
    module
        The module; is added to.
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
    regions
        Where each function stands.
    switches
        By switch and token, the expressions of the values that choose it.
    calls
        By function, the expression that refers to it.
    defaults
        By hyperparameter, the expression of its value.
    finders, may_be_nothing
        The functions that may return Nothing, and the tokens that may be Nothing.
    nothing
        The expression of Nothing; "" if it is not needed.
    variables
        By token.
    """

    def __init__(
        self, module: _Module, name: str, cg: CompGraph, values: Mapping[str, Any], wanted: Any, where: str = ""
    ) -> None:
        self.module, self.name, self.cg, self.where = module, name, cg, where
        self.values = values
        self.returns = cg.sink_tokens if wanted is None else wanted
        self.regions, tokens = _regions(cg, self.returns, wanted is None)
        missing = [each for each in cg.placeholders if each in self.regions]
        if missing:
            raise PlaceholderNeeded(missing)
        switches = {each: as_switch(cg.functions[each]) for each in self.regions}
        self.switches = {each: self._keys(each, switch) for each, switch in switches.items() if switch is not None}
        self.calls = {each: self._call(each) for each in self.regions if each not in self.switches}
        self.defaults = {token: self._default(token, value) for token, value in values.items() if token in tokens}
        self.finders, self.may_be_nothing = self._found_nothing()
        self.nothing = self._nothing() if self.may_be_nothing else ""
        self.variables = self._named(tokens)
        module.texts.append(self._text())

    def _call(self, name: str) -> str:
        """Return the expression of a function; of a pipeline, the name of the function that it becomes."""
        module, function = self.module, without_nodes(self.cg.functions[name])
        if not is_plain_pipeline(function):
            return module.expression(f"Function {name!r}{self.where}", function, _NO_EXPRESSION, name)
        if id(function) not in module.pipelines:
            module.pipelines[id(function)] = inner = module.gathered.free_name(function.name)
            where = f" of pipeline {function.name!r}"
            _Function(module, inner, function.cg, function.runner.hyperparameters, None, where)
        return module.pipelines[id(function)]

    def _nothing(self) -> str:
        return self.module.expression("Nothing", Nothing, _NO_EXPRESSION)

    def _found_nothing(self) -> tuple[set[str], set[str]]:
        """Return the functions that may return Nothing, and the tokens that may be Nothing."""
        # A large graph has few functions under many names.
        finds = {key: _may_find_nothing(function) for key, function in distinct(self.cg.functions).items()}
        finders = {name for name in self.regions if finds[id(self.cg.functions[name])]}
        found = {token for token, value in self.values.items() if value is Nothing}
        for name in self.regions:
            if name in finders or not found.isdisjoint(self.cg.func_inputs(name)):
                found.update(self.cg.func_outputs(name))
        return finders, found

    def _keys(self, name: str, switch: Switch) -> dict[str, list[str]]:
        """Return the expressions of the values by which a switch chooses each token."""
        found: dict[str, list[str]] = {}
        for key, token in zip(switch.branches, self.cg.func_inputs(name)[1:], strict=True):
            source = self.module.expression(f"Switch {name!r}{self.where} chooses {token!r}", key, _NO_KEY)
            found.setdefault(token, []).append(source)
        return found

    def _default(self, token: str, value: Any) -> str:
        """Return the expression of a hyperparameter's value: a short literal or name, or the constant that holds it."""
        source = self.module.expression(f"Hyperparameter {token!r}{self.where}", value, _NO_VALUE)
        is_simple = literal_source(value) or source.replace(".", "").isidentifier()
        if is_simple and len(source) <= _LONGEST:
            return source
        return self.module.gathered.add_constant(token.upper(), source)

    def _text(self) -> str:
        """Return the function."""
        variables = self.variables
        sources = [token for token in self.cg.source_tokens if token in variables]
        given = [variables[token] for token in sources if token not in self.defaults]
        named = [f"{variables[token]}={self.defaults[token]}" for token in sources if token in self.defaults]
        given += ["*", *named] if named else []
        head = f"def {self.name}({', '.join(given)}):"
        lines = [head] if len(head) <= LINE else [f"def {self.name}(", *(f"    {each}," for each in given), "):"]
        lines += [*self._docstring([*sources, *self.returns]), *self._lines(())]
        returned = ", ".join(variables[token] for token in self.returns)
        if returned:
            is_line = len(self.returns) == 1 or len(returned) + len("    return ") <= LINE
            lines += [f"    return {returned}"] if is_line else laid_out(f"({returned})", 1, "return ")
        return "\n".join(lines)

    def _named(self, tokens: Iterable[str]) -> dict[str, str]:
        """Return a variable for each token that hides nothing of the module; names that can stay come first."""
        keys = chain.from_iterable(values for switch in self.switches.values() for values in switch.values())
        sources = {*self.calls.values(), *keys, *filter(None, [self.nothing])}
        taken = {name for source in sources for name in names_in(source)} | {"ValueError"}
        found: dict[str, str] = {}
        for token in sorted(tokens, key=lambda token: not is_identifier(token) or token in taken):
            found[token] = identifier_of(token, taken.__contains__)
            taken.add(found[token])
        return found

    def _lines(self, region: Region) -> Iterator[str]:
        """Give the lines of the functions of a region, and of the branches in it."""
        for name in (name for name, place in self.regions.items() if place == region):
            if name in self.switches:
                yield from self._switch(name, region)
            else:
                yield from self._guarded(name, len(region) + 1)

    def _guarded(self, name: str, depth: int) -> Iterator[str]:
        """Give the lines of a call; inside an ``if`` where an input may be Nothing."""
        pad, inputs = "    " * depth, self.cg.func_inputs(name)
        asked = [self.variables[token] for token in dict.fromkeys(inputs) if token in self.may_be_nothing]
        if not asked:
            yield from self._call_lines(name, depth)
            return
        targets = "".join(f"{self.variables[token]} = " for token in self.cg.func_outputs(name))
        if targets:
            yield f"{pad}if {' or '.join(f'{each} is {self.nothing}' for each in asked)}:"
            yield from (f"{pad}    {targets}{self.nothing}", f"{pad}else:")
        else:
            yield f"{pad}if {' and '.join(f'{each} is not {self.nothing}' for each in asked)}:"
        yield from self._call_lines(name, depth + 1)

    def _call_lines(self, name: str, depth: int) -> Iterator[str]:
        arguments = ", ".join(self.variables[token] for token in self.cg.func_inputs(name))
        call, outputs = f"{self.calls[name]}({arguments})", self.cg.func_outputs(name)
        if self.cg.has_single_output(name) or not outputs or name not in self.finders:
            yield from laid_out(call, depth, self._targets(name))
            return
        # Nothing alone stands for all of them.
        first, pad = self.variables[outputs[0]], "    " * depth
        targets = "".join(f"{self.variables[token]} = " for token in outputs)
        yield from laid_out(call, depth, f"{first} = ")
        yield from (f"{pad}if {first} is {self.nothing}:", f"{pad}    {targets}{self.nothing}", f"{pad}else:")
        yield f"{pad}    {self._targets(name)}{first}"

    def _targets(self, name: str) -> str:
        """Return what stands before the value of a function."""
        targets = [self.variables[token] for token in self.cg.func_outputs(name)]
        if not targets:
            return ""
        is_tuple_of_one = len(targets) == 1 and not self.cg.has_single_output(name)
        return f"({targets[0]},) = " if is_tuple_of_one else f"{', '.join(targets)} = "

    def _switch(self, name: str, region: Region) -> Iterator[str]:
        depth, pad, keyword = len(region) + 1, "    " * (len(region) + 1), "if"
        selector, targets = self.variables[self.cg.func_inputs(name)[0]], self._targets(name)
        for token, keys in self.switches[name].items():
            is_one = len(keys) == 1 and keys[0] not in ("None", "True", "False")
            right = keys[0] if is_one else bracketed(tuple(keys), str)
            yield from laid_out(right, depth, f"{keyword} {selector} {'==' if is_one else 'in'} ", ":")
            body = [*self._lines((*region, (name, token)))]
            body += laid_out(self.variables[token], depth + 1, targets) if targets else []
            yield from body or [f"{pad}    pass"]
            keyword = "elif"
        yield f"{pad}else:"
        yield f'{pad}    raise ValueError(f"Unknown {selector}: {{{selector}!r}}")'

    def _docstring(self, shown: Iterable[str]) -> list[str]:
        """Return the docstring: what is returned, and which parameters and results have other names than tokens."""
        returned = ", ".join(self.variables[token] for token in self.returns)
        if len(returned) > LINE - len('    """Return ."""'):
            returned = f"{len(self.returns)} values"
        summary = f"Return {returned}." if returned else "Run."
        other = [token for token in dict.fromkeys(shown) if self.variables[token] != token]
        if not other:
            return [f'    """{summary}"""']
        lines = [f"        {self.variables[token]}: '{escaped(token, 40)}'" for token in other]
        return [f'    """{summary}', "", "    Tokens of the graph that have other names here:", "", *lines, '    """']
