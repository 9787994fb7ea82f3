"""A graph as Python that needs no graph: one straight-line function."""

from __future__ import annotations

import builtins
import copy
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import chain, takewhile
from typing import Any, Final, NamedTuple

from epypes.bundle.private_import import plain_name
from epypes.bundle.settings import states_of
from epypes.bundle.source.clone import is_plain_pipeline
from epypes.bundle.source.equivalence import refusal
from epypes.bundle.source.expressions import (
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
from epypes.bundle.source.module import module_text, no_initial_value
from epypes.bundle.source.objects import without_nodes
from epypes.bundle.source.own_modules import OwnModules, functions_reached_by
from epypes.bundle.source.references import nested_codes, reads_of
from epypes.bundle.source.slice import Slice, gather
from epypes.errors import PlaceholderNeeded, SourceRefused
from epypes.graph import CompGraph, as_switch, needed_for
from epypes.graph.signature import distinct
from epypes.nothing import Nothing
from epypes.pipeline import Pipeline
from epypes.run import CompGraphRunner
from epypes.run.guard import in_out_places

# A longer default of a parameter is a constant above the function.
_LONGEST: Final = 60
_NO_EXPRESSION: Final = "is of type {kind}, and no expression makes it again. Write a plain function (def)."
_NO_VALUE: Final = (
    "is of type {kind}, and no expression makes this value again. Leave it free, so that the function takes it; or use "
    "numbers, strings, a small array or tuples of them."
)
_SOME_BRANCHES: Final = (
    "makes what the next run begins with, and only some branches of switches need it, so that no line of a function "
    "says when it runs. Give each of these branches a function of its own."
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

    The function of a graph with delays takes the state by keyword too, with the initial values as defaults; that of a
    pipeline in the graph is a dict, which begins empty. It returns a pair: what it returns otherwise, and the state for
    the next call: ``y, state = run_graph(x, **state)``.

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
    annotations are not compared with values. A function of OpenCV that writes into an input gets a copy of it, as in a
    run. A function that several branches of a switch need is called before the switch, whichever is chosen. The call
    of a function that takes what may be Nothing stands inside an ``if``: an output of a function that refers to
    ``ep.Nothing``, or calls one by name that does, and what is made of it.

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
    reasons = [*dict.fromkeys(gathered.refusals)] or [*filter(None, [_difference(text, module)])]
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


@dataclass
class _Module:
    """The module that a graph becomes.

    Attributes
    ----------
    gathered
        What its functions need.
    texts
        The functions: one for each pipeline in the graph, then its own.
    pipelines
        The functions of pipelines, by the id of the pipeline and those of the values that the graph around gives it.
    compared
        What is compared with the notebook: how reasons call it, the value, its expression.
    """

    gathered: Slice
    texts: list[str] = field(default_factory=list)
    pipelines: dict[tuple[int, ...], _Function] = field(default_factory=dict)
    compared: list[tuple[str, Any, str]] = field(default_factory=list)

    def expression(self, what: str, value: Any, reason: str, wanted: str = "") -> str:
        """Return the expression of a value that is compared; refusals are gathered."""
        source = expression_or_none(self.gathered, value, what, reason, wanted)
        self.compared.append((what, value, source))
        return source


def _difference(text: str, module: _Module) -> str:
    """Return why what a module calls is not what the graph calls; "" if it is."""
    whats, values, sources = zip(*module.compared, strict=True) if module.compared else ((), (), ())
    # The modules of a bundle can be imported by its own code alone.
    modules = OwnModules(name for name in sorted(module.gathered.modules) if plain_name(name) != name)
    modules.check(functions_reached_by(values), module.gathered.patches)
    whole = f"{text}references = [{', '.join(sources)}]\n"
    return refusal(whole, lambda made: zip(whats, values, made.references, strict=True), modules)


# -- what a run needs --------------------------------------------------------------------------------------------------


class _Place(NamedTuple):
    """Where a function stands.

    Attributes
    ----------
    region
        The innermost branch around all that needs it.
    is_exact
        Whether a run of the whole graph executes it exactly when this branch is chosen. One that several branches need,
        and not all, stands before the switch, while a runner may leave it out.
    """

    region: Region
    is_exact: bool


def _places(cg: CompGraph, returns: Iterable[str], is_whole: bool) -> tuple[dict[str, _Place], set[str]]:
    """Return where each function that is needed stands, in run order, and the tokens that are there."""
    needed: dict[str, set[Region]] = {token: {()} for token in returns}
    found: dict[str, _Place] = {}
    for name in reversed(tuple(cg.functions)):
        made, is_switch = cg.func_outputs(name), name in cg.switches
        regions: set[Region] = set() if made or not is_whole else {()}
        regions = regions.union(*(needed.get(token, ()) for token in made))
        if not regions:
            continue
        regions = _joined(cg, regions, found)
        region = tuple(level[0] for level in takewhile(lambda level: len({*level}) == 1, zip(*regions, strict=False)))
        is_exact = regions == {region} and all(found[switch].is_exact for switch, _ in region)
        found[name] = _Place(region, is_exact)
        for number, token in enumerate(cg.func_inputs(name)):
            is_branch = is_switch and number
            needed.setdefault(token, set()).update({(*region, (name, token))} if is_branch else regions)
    places = {name: found[name] for name in cg.functions if name in found}
    return places, {*needed, *chain.from_iterable(map(cg.func_outputs, places))}


def _joined(cg: CompGraph, regions: set[Region], places: Mapping[str, _Place]) -> set[Region]:
    """Return the fewest regions that are the same together: all branches of a switch are the region around it."""
    while () not in regions:
        inner = {region for region in regions if any(region[:depth] in regions for depth in range(len(region)))}
        whole = {
            (*around,)
            for *around, (switch, _) in regions
            if places[switch].is_exact
            and regions >= {(*around, (switch, other)) for other in cg.func_inputs(switch)[1:]}
        }
        if not inner and whole <= regions:
            return regions
        regions = (regions - inner) | whole
    return {()}


def _refers_to_nothing(function: Any) -> bool:
    """Whether a function, or one of the user's that it reaches, refers to Nothing, also as ``ep.Nothing``."""
    for reached in functions_reached_by([function]):
        codes = nested_codes(reached.__code__)
        if any("Nothing" in code.co_names for code in codes) or any(
            value is Nothing for value in reads_of(reached).values()
        ):
            return True
    return False


# -- the function ------------------------------------------------------------------------------------------------------


class _State(NamedTuple):
    """What a delay keeps from one call of a function to the next.

    Attributes
    ----------
    parameter
        The variable that it comes in, also its key in the state that the function returns.
    maker
        The function of the graph that makes it; "" if the caller does.
    after
        The expression of what the call leaves, where the maker is called.
    following
        The variable that has it in the end where the maker is not always called; else "".
    """

    parameter: str
    maker: str
    after: str
    following: str


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
    places
        Where each function stands.
    switches
        By switch and token, the expressions of the values that choose it.
    calls
        By function, the expression that refers to it.
    copy, nothing
        The expressions that refer to what copies inputs, and to Nothing.
    defaults
        By hyperparameter, the expression of its value.
    finders, may_be_nothing
        The functions that may return Nothing, and the tokens that may be Nothing.
    variables
        By token.
    taken
        The names that no variable may have.
    states
        What its delays keep for the next call.
    inner_states
        By pipeline with state, the variable of that, before its call and after it.
    """

    def __init__(
        self, module: _Module, name: str, cg: CompGraph, values: Mapping[str, Any], wanted: Any, where: str = ""
    ) -> None:
        self.module, self.name, self.cg, self.values, self.where = module, name, cg, values, where
        self.returns: Collection[str] = cg.sink_tokens if wanted is None else wanted
        found, needed = (set(cg.tokens), set(cg.functions)) if wanted is None else needed_for(cg, wanted)
        delays = [previous for previous in cg.delays if previous in found]
        keepers = [name for name, function in cg.functions.items() if name in needed and _has_state(function)]
        tokens = self._find_places(delays, keepers, is_whole=wanted is None)
        self.switches = {each: self._keys(each) for each in self.places if each in cg.switches}
        self.calls = {each: self._call(each) for each in self.places if each not in self.switches}
        self.copy = ""
        if any(map(self._copied, self.calls)):
            self.copy = module.expression("The copy of an input", copy.deepcopy, _NO_EXPRESSION)
        self.defaults = {
            token: self._default(token, value, "Hyperparameter", _NO_VALUE)
            for token, value in values.items()
            if token in tokens
        }
        for previous in delays:
            initial, reason = cg.delays[previous].initial, no_initial_value(cg, previous)
            self.defaults[previous] = self._default(previous, initial, "The initial value of", reason)
        nothings = [token for token, value in values.items() if value is Nothing]
        nothings += [previous for previous in delays if cg.delays[previous].initial is Nothing]
        self.finders, self.may_be_nothing = self._find_nothing(nothings)
        compared = {cg.delays[previous].token for previous in delays}
        compared.update(*(cg.func_inputs(each) for each in self.calls))
        compared.update(*(cg.func_outputs(each) for each in self.finders if not cg.has_single_output(each)))
        is_compared = not compared.isdisjoint(self.may_be_nothing)
        self.nothing = module.expression("Nothing", Nothing, _NO_EXPRESSION) if is_compared else ""
        keys = chain.from_iterable(values for switch in self.switches.values() for values in switch.values())
        sources = {*self.calls.values(), *keys, *filter(None, [self.copy, self.nothing])}
        self.taken = {name for source in sources for name in names_in(source)} | {"ValueError"}
        # Names that can stay come first; none hides what the function reads of the module.
        reserved, written = frozenset(self.taken), [token for token in cg.tokens if token in tokens or token in delays]
        written.sort(key=lambda token: not is_identifier(token) or token in reserved)
        self.variables = {token: self._variable(token) for token in written}
        self.states = [*map(self._state, delays)]
        self.inner_states = {name: self._variable(f"{name}_state") for name in keepers}
        module.texts.append(self._text())

    def _find_places(self, delays: Iterable[str], keepers: Iterable[str], *, is_whole: bool) -> set[str]:
        """Find where each function stands; return the tokens that are needed or kept.

        Raises
        ------
        PlaceholderNeeded
            Functions that are needed are still to be written.
        """
        cg = self.cg
        # By token: what makes it must run exactly when a run of the whole graph does, since that leaves state.
        kept = {cg.delays[previous].token for previous in delays}
        made = {token: cg.digraph.producer.get(token, "") for token in cg.tokens if token in kept}
        made |= {cg.func_outputs(name)[0]: name for name in keepers}
        exact: dict[str, Region] = {}
        if made:
            whole, _ = _places(cg, cg.sink_tokens, True)
            exact = {name: place.region for name, place in whole.items() if place.is_exact}
        roots = [token for token, maker in made.items() if not exact.get(maker)]
        self.places, tokens = _places(cg, (*self.returns, *roots), is_whole)
        for name in dict.fromkeys(filter(None, made.values())):
            if name not in exact or name not in self.places or exact[name] != self.places[name].region:
                self.module.gathered.refusals.append(f"Function {name!r}{self.where} {_SOME_BRANCHES}")
        missing = [each for each in cg.placeholders if each in self.places]
        if missing:
            raise PlaceholderNeeded(missing)
        return tokens | made.keys()  # also if what makes them is refused

    # -- the expressions that it is made of ----------------------------------------------------------------------------

    def _call(self, name: str) -> str:
        """Return the expression of a function; of a pipeline, the name of the function that it becomes."""
        module, function = self.module, without_nodes(self.cg.functions[name])
        if not is_plain_pipeline(function):
            return module.expression(f"Function {name!r}{self.where}", function, _NO_EXPRESSION, name)
        key, values = self._pipeline(name, function)
        if key not in module.pipelines:
            inner, where = module.gathered.free_name(function.name), f" of pipeline {function.name!r}"
            module.pipelines[key] = _Function(module, inner, function.cg, values, None, where)
        return module.pipelines[key].name

    def _pipeline(self, name: str, function: Pipeline) -> tuple[tuple[int, ...], Mapping[str, Any]]:
        """Return what tells the function of a pipeline from others, and the hyperparameters that it has here."""
        own = function.runner.hyperparameters
        values = {token: self.values.get(f"{name}__{token}", value) for token, value in own.items()}
        return (id(function), *(id(value) for token, value in values.items() if value is not own[token])), values

    def _copied(self, name: str) -> Collection[int]:
        """Return the places of the inputs into which a function writes, so that it is given copies."""
        return in_out_places(without_nodes(self.cg.functions[name]), len(self.cg.func_inputs(name)))

    def _keys(self, name: str) -> dict[str, list[str]]:
        """Return the expressions of the values by which a switch chooses each token."""
        found: dict[str, list[str]] = {}
        switch = as_switch(self.cg.functions[name])
        for key, token in zip(switch.branches if switch else (), self.cg.func_inputs(name)[1:], strict=True):
            source = self.module.expression(f"Switch {name!r}{self.where} chooses {token!r}", key, _NO_KEY)
            found.setdefault(token, []).append(source)
        return found

    def _default(self, token: str, value: Any, what: str, reason: str) -> str:
        """Return the expression of a parameter's value: a short literal or name, or the constant that holds it."""
        source = self.module.expression(f"{what} {token!r}{self.where}", value, reason)
        is_simple = literal_source(value) or source.replace(".", "").isidentifier()
        if is_simple and len(source) <= _LONGEST:
            return source
        return self.module.gathered.add_constant(token.upper(), source)

    def _find_nothing(self, nothings: Iterable[str]) -> tuple[set[str], set[str]]:
        """Return the functions that may return Nothing, and the tokens that may be; these are at the beginning."""
        refer: dict[int, bool] = {}
        for key, function in distinct(self.cg.functions).items():  # a large graph has few under many names
            own = id(without_nodes(function))
            inner = [made for (pipeline, *_), made in self.module.pipelines.items() if pipeline == own]
            is_of_inner = any(not made.may_be_nothing.isdisjoint(made.returns) for made in inner)
            refer[key] = is_of_inner if inner else _refers_to_nothing(function)
        finders, found = {name for name in self.places if refer[id(self.cg.functions[name])]}, {*nothings}
        for name in self.places:
            if name in finders or self._asked(name, found):
                found.update(self.cg.func_outputs(name))
        return finders, found

    def _asked(self, name: str, nothings: Collection[str]) -> list[str]:
        """Return the inputs of a function that may be Nothing."""
        return [token for token in dict.fromkeys(self.cg.func_inputs(name)) if token in nothings]

    def _variable(self, wanted: str) -> str:
        """Return a variable that is not taken, and take it."""
        found = identifier_of(wanted, self.taken.__contains__)
        self.taken.add(found)
        return found

    def _state(self, previous: str) -> _State:
        token, variable = self.cg.delays[previous].token, self.variables[previous]
        maker, after = self.cg.digraph.producer.get(token, ""), self.variables[token]
        is_in_branch = maker in self.places and self.places[maker].region
        if token in self.may_be_nothing:
            after = f"{variable} if {after} is {self.nothing} else {after}"
        return _State(variable, maker, after, self._variable(f"next_{variable}") if is_in_branch else "")

    # -- its text ------------------------------------------------------------------------------------------------------

    def _text(self) -> str:
        """Return the function."""
        variables, states, inner_states = self.variables, self.states, self.inner_states.values()
        sources = [token for token in self.cg.source_tokens if token in variables]
        given = [variables[token] for token in sources if token not in self.defaults]
        named = [f"{variables[token]}={self.defaults[token]}" for token in sources if token in self.defaults]
        named += [f"{each}={{}}" for each in inner_states]
        given += ["*", *named] if named else []
        head = f"def {self.name}({', '.join(given)}):"
        lines = [head] if len(head) <= LINE else [f"def {self.name}(", *(f"    {each}," for each in given), "):"]
        lines += self._docstring([*sources, *self.returns])
        lines += [f"    {each.following} = {each.parameter}" for each in states if each.following]
        lines += self._lines(())
        returned = ", ".join(variables[token] for token in self.returns)
        after = [f'"{each.parameter}": {each.following or each.after}' for each in states]
        after += [f'"{each}": {each}' for each in inner_states]
        if after:
            returned = f"{f'({returned})' if len(self.returns) > 1 else returned or None}, {{{', '.join(after)}}}"
        if returned:
            is_line = not (after or len(self.returns) > 1) or len(returned) + len("    return ") <= LINE
            lines += [f"    return {returned}"] if is_line else laid_out(f"({returned})", 1, "return ")
        return "\n".join(lines)

    def _docstring(self, shown: Iterable[str]) -> list[str]:
        """Return the docstring: what is returned, and which parameters and results have other names than tokens."""
        returned = ", ".join(self.variables[token] for token in self.returns)
        if len(returned) > LINE - len('    """Return ."""'):
            returned = f"{len(self.returns)} values"
        summary = f"Return {returned}." if returned else "Run."
        if self.states or self.inner_states:
            summary = f"{summary[:-1]}, and the state for the next call." if returned else "Return None, and the state."
        other = [token for token in dict.fromkeys(shown) if self.variables[token] != token]
        if not other:
            return [f'    """{summary}"""']
        lines = [f"        {self.variables[token]}: '{escaped(token, 40)}'" for token in other]
        return [f'    """{summary}', "", "    Tokens of the graph that have other names here:", "", *lines, '    """']

    def _lines(self, region: Region) -> Iterator[str]:
        """Give the lines of the functions of a region, and of the branches in it."""
        depth = len(region) + 1
        for name in (name for name, place in self.places.items() if place.region == region):
            if name in self.switches:
                yield from self._switch(name, region)
                yield from self._state_lines(name, depth)
            else:
                guard = [*self._guard(name, depth)]
                yield from guard
                yield from self._call_lines(name, depth + bool(guard))
                yield from self._state_lines(name, depth + bool(guard))

    def _state_lines(self, name: str, depth: int) -> Iterator[str]:
        """Give the lines that take note of what a function has left for the next call."""
        for state in self.states:
            if state.maker == name and state.following:
                yield f"{'    ' * depth}{state.following} = {state.after}"

    def _guard(self, name: str, depth: int) -> Iterator[str]:
        """Give the lines that leave out a call where an input is Nothing; none where no input may be."""
        pad, asked = "    " * depth, [self.variables[token] for token in self._asked(name, self.may_be_nothing)]
        targets = "".join(f"{self.variables[token]} = " for token in self.cg.func_outputs(name))
        if asked and targets:
            yield f"{pad}if {' or '.join(f'{each} is {self.nothing}' for each in asked)}:"
            yield from (f"{pad}    {targets}{self.nothing}", f"{pad}else:")
        elif asked:
            yield f"{pad}if {' and '.join(f'{each} is not {self.nothing}' for each in asked)}:"

    def _call_lines(self, name: str, depth: int) -> Iterator[str]:
        """Give the lines of a call. Nothing alone stands for all of several outputs."""
        arguments = [self.variables[token] for token in self.cg.func_inputs(name)]
        for place in self._copied(name):
            arguments[place] = f"{self.copy}({arguments[place]})"
        state = self.inner_states.get(name)
        arguments += [f"**{state}"] if state else []
        call = f"{self.calls[name]}({', '.join(arguments)})"
        outputs = [self.variables[token] for token in self.cg.func_outputs(name)]
        left = f", {state} = " if state else ""
        if self.cg.has_single_output(name) or not outputs or name not in self.finders:
            targets = self._targets(name)
            if left:
                value = targets.removesuffix(" = ") or "_"
                targets = f"({value}){left}" if len(outputs) > 1 else f"{value}{left}"
            yield from laid_out(call, depth, targets)
            return
        pad, targets = "    " * depth, "".join(f"{each} = " for each in outputs)
        yield from laid_out(call, depth, f"{outputs[0]}{left or ' = '}")
        yield from (f"{pad}if {outputs[0]} is {self.nothing}:", f"{pad}    {targets}{self.nothing}", f"{pad}else:")
        yield f"{pad}    {self._targets(name)}{outputs[0]}"

    def _targets(self, name: str) -> str:
        """Return what stands before the value of a function."""
        targets = [self.variables[token] for token in self.cg.func_outputs(name)]
        is_tuple_of_one = len(targets) == 1 and not self.cg.has_single_output(name)
        several = f"({targets[0]},)" if is_tuple_of_one else ", ".join(targets)
        return f"{several} = " if targets else ""

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


def _has_state(function: Any) -> bool:
    inner = without_nodes(function)
    return is_plain_pipeline(inner) and bool(states_of(inner.cg))
