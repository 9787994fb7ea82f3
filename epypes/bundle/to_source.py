"""A graph as Python that needs no graph: one straight-line function."""

from __future__ import annotations

import builtins
import copy
import inspect
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from itertools import chain, takewhile
from types import FunctionType, ModuleType
from typing import Any, Final, NamedTuple

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
from epypes.bundle.own_modules import OwnModules
from epypes.bundle.private_import import plain_name
from epypes.bundle.references import global_names, meanings_of, nested_codes
from epypes.bundle.settings import states_of
from epypes.bundle.slice import Slice, gather
from epypes.errors import PlaceholderNeeded, SourceRefused
from epypes.graph import CompGraph, Switch, as_switch, needed_for
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
_NO_INITIAL: Final = (
    "is of type {kind}, and no expression makes it again. State is numbers, text, arrays and containers of them: begin "
    "with None, and make it in the function when it gets "
    "None."
)
_STATE_OF_NOTHING: Final = (
    "keeps state, and takes or makes what may be Nothing. Make what it keeps a delay of this graph (ep.delay)."
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

    The function of a graph with delays takes the state by keyword too, with the initial values as defaults. It returns
    a pair: what it returns otherwise, and the state for the next call: ``y, state = run_graph(x, **state)``.

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


class _State(NamedTuple):
    """What is kept from one call of a function to the next.

    Attributes
    ----------
    parameter
        The variable that it comes in, also its key in the state that the function returns.
    default
        The expression of its initial value.
    maker
        The function of the graph that makes it; "" if the caller does.
    after
        The expression of what the call leaves, where the maker is called.
    following
        The variable that has it in the end where only a branch of a switch calls the maker; else "".
    inner
        Of what a pipeline keeps, the parameter of its function; else "".
    """

    parameter: str
    default: str
    maker: str
    after: str
    following: str
    inner: str


class _Module:
    """The module that a graph becomes.

    Attributes
    ----------
    gathered
        What its functions need.
    texts
        The functions: one for each pipeline in the graph, then its own.
    pipelines
        The functions of pipelines, by the id of the pipeline.
    compared
        What is compared with the notebook: how reasons call it, the value, its expression.
    """

    def __init__(self, gathered: Slice) -> None:
        self.gathered = gathered
        self.texts: list[str] = []
        self.pipelines: dict[int, _Function] = {}
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

        # The modules of a bundle can be imported by its own code alone.
        modules = OwnModules(name for name in sorted(self.gathered.modules) if plain_name(name) != name)
        modules.check([value for _, value, _ in self.compared], self.gathered.patches)
        return refusal(f"{text}references = [{sources}]\n", pairs, modules)


def _has_state(function: Any) -> bool:
    inner = without_nodes(function)
    return is_plain_pipeline(inner) and bool(states_of(inner.cg))


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


def _runs_exactly(cg: CompGraph) -> dict[str, Region]:
    """Return where functions stand of a whole graph, but for those that stand before a switch and run for a part of it.

    A function that several branches need, and not all, stands before the switch, while a runner may leave it out.
    """
    regions, _ = _regions(cg, cg.sink_tokens, True)
    needed: dict[str, set[Region | None]] = {token: {()} for token in cg.sink_tokens}
    exact: dict[str, Region] = {}
    for name in reversed(tuple(cg.functions)):
        made = cg.func_outputs(name)
        here = _joined(cg, set().union(*(needed.get(token, set()) for token in made)) if made else {()})
        if here == {regions[name]}:
            exact[name] = regions[name]
        for number, token in enumerate(cg.func_inputs(name)):
            is_branch = name in cg.switches and number
            branch = (*exact[name], (name, token)) if name in exact else None
            needed.setdefault(token, set()).update({branch} if is_branch else here)
    return exact


def _joined(cg: CompGraph, regions: set[Region | None]) -> set[Region | None]:
    """Return the fewest regions that are the same together: all branches of a switch are the region around it."""
    while True:
        known = [region for region in regions if region]
        inner = {region for region in known if any(region[:depth] in regions for depth in range(len(region)))}
        whole = {
            region[:-1]
            for region in known
            if regions >= {(*region[:-1], (region[-1][0], other)) for other in cg.func_inputs(region[-1][0])[1:]}
        }
        if not inner and whole <= regions:
            return regions
        regions = (regions - inner) | whole


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
    copied
        By function, the places of the inputs into which it writes, so that it is given copies.
    copy
        The expression that refers to what copies them; empty if there are none.
    defaults
        By hyperparameter, the expression of its value.
    finders, may_be_nothing
        The functions that may return Nothing, and the tokens that may be Nothing.
    nothing
        The expression of Nothing; "" if it is not needed.
    variables
        By token.
    taken
        The names that no variable may have.
    left
        By pipeline with state, the variable of the state that it has left.
    states
        What is kept for the next call.
    """

    def __init__(
        self, module: _Module, name: str, cg: CompGraph, values: Mapping[str, Any], wanted: Any, where: str = ""
    ) -> None:
        self.module, self.name, self.cg, self.where = module, name, cg, where
        self.values = values
        self.returns = cg.sink_tokens if wanted is None else wanted
        found, needed = (set(cg.tokens), set(cg.functions)) if wanted is None else needed_for(cg, wanted)
        delays = [previous for previous in cg.delays if previous in found]
        keepers = [name for name, function in cg.functions.items() if name in needed and _has_state(function)]
        made = self._made_for_states(delays, keepers)
        exact = _runs_exactly(cg) if made else {}
        roots = [token for token, maker in made.items() if not exact.get(maker)]
        self.regions, tokens = _regions(cg, (*self.returns, *roots), wanted is None)
        self._refuse_some_branches(made.values(), exact)
        missing = [each for each in cg.placeholders if each in self.regions]
        if missing:
            raise PlaceholderNeeded(missing)
        switches = {each: as_switch(cg.functions[each]) for each in self.regions}
        self.switches = {each: self._keys(each, switch) for each, switch in switches.items() if switch is not None}
        self.calls = {each: self._call(each) for each in self.regions if each not in self.switches}
        copied = {
            each: in_out_places(without_nodes(cg.functions[each]), len(cg.func_inputs(each))) for each in self.calls
        }
        self.copied = {each: places for each, places in copied.items() if places}
        self.copy = module.expression("The copy of an input", copy.deepcopy, _NO_EXPRESSION) if self.copied else ""
        self.defaults = {token: self._default(token, value) for token, value in values.items() if token in tokens}
        self.defaults |= {
            previous: self._default(previous, cg.delays[previous].initial, "The initial value of", _NO_INITIAL)
            for previous in delays
        }
        self.finders, self.may_be_nothing = self._found_nothing(delays)
        self.nothing = self._nothing() if self.may_be_nothing else ""
        keys = chain.from_iterable(values for switch in self.switches.values() for values in switch.values())
        sources = {*self.calls.values(), *keys, *filter(None, [self.copy, self.nothing])}
        self.taken = {name for source in sources for name in names_in(source)} | {"ValueError"}
        written = {*tokens, *delays}
        self.variables = self._named(filter(written.__contains__, cg.tokens))
        self.left: dict[str, str] = {}
        self.states = [*self._states(delays, keepers)]
        for name in keepers:
            if name in self.finders or not self.may_be_nothing.isdisjoint(cg.func_inputs(name)):
                module.gathered.refusals.append(f"Function {name!r}{where} {_STATE_OF_NOTHING}")
        module.texts.append(self._text())

    def _made_for_states(self, delays: Iterable[str], keepers: Iterable[str]) -> dict[str, str]:
        """Return tokens that are there whenever the state is left, with the function that makes each, "" for none."""
        kept = [self.cg.delays[previous].token for previous in delays]
        made = {token: self.cg.digraph.producer.get(token, "") for token in kept}
        return made | {self.cg.func_outputs(name)[0]: name for name in keepers}

    def _refuse_some_branches(self, makers: Iterable[str], exact: Mapping[str, Region]) -> None:
        """Refuse functions with state that do not run exactly where they stand."""
        for name in dict.fromkeys(filter(None, makers)):
            if name not in exact or exact[name] != self.regions.get(name):
                self.module.gathered.refusals.append(f"Function {name!r}{self.where} {_SOME_BRANCHES}")

    def _states(self, delays: Iterable[str], keepers: Iterable[str]) -> Iterator[_State]:
        """Give what is kept for the next call."""
        for previous in delays:
            token = self.cg.delays[previous].token
            maker = self.cg.digraph.producer.get(token, "")
            variable, default, after = self.variables[previous], self.defaults[previous], self.variables[token]
            yield self._state(
                variable, default, maker, after, may_be_nothing=bool(maker) and token in self.may_be_nothing
            )
        for name in keepers:
            self.left[name] = left = self._variable(f"{name}_state")
            for inner in self.module.pipelines[id(without_nodes(self.cg.functions[name]))].states:
                parameter = self._variable(f"{name}_{inner.parameter}")
                after = f'{left}["{inner.parameter}"]'
                yield self._state(parameter, inner.default, name, after, inner.parameter)

    def _state(
        self, parameter: str, default: str, maker: str, after: str, inner: str = "", may_be_nothing: bool = False
    ) -> _State:
        following = self._variable(f"next_{parameter}") if may_be_nothing or self.regions.get(maker) else ""
        return _State(parameter, default, maker, after, following, inner)

    def _call(self, name: str) -> str:
        """Return the expression of a function; of a pipeline, the name of the function that it becomes."""
        module, function = self.module, without_nodes(self.cg.functions[name])
        if not is_plain_pipeline(function):
            return module.expression(f"Function {name!r}{self.where}", function, _NO_EXPRESSION, name)
        if id(function) not in module.pipelines:
            inner, where = module.gathered.free_name(function.name), f" of pipeline {function.name!r}"
            made = _Function(module, inner, function.cg, function.runner.hyperparameters, None, where)
            module.pipelines[id(function)] = made
        return module.pipelines[id(function)].name

    def _nothing(self) -> str:
        return self.module.expression("Nothing", Nothing, _NO_EXPRESSION)

    def _found_nothing(self, delays: Iterable[str]) -> tuple[set[str], set[str]]:
        """Return the functions that may return Nothing, and the tokens that may be Nothing."""
        # A large graph has few functions under many names.
        finds = {key: _may_find_nothing(function) for key, function in distinct(self.cg.functions).items()}
        finders = {name for name in self.regions if finds[id(self.cg.functions[name])]}
        found = {token for token, value in self.values.items() if value is Nothing}
        found.update(previous for previous in delays if self.cg.delays[previous].initial is Nothing)
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

    def _default(self, token: str, value: Any, what: str = "Hyperparameter", reason: str = _NO_VALUE) -> str:
        """Return the expression of a parameter's value: a short literal or name, or the constant that holds it."""
        source = self.module.expression(f"{what} {token!r}{self.where}", value, reason)
        is_simple = literal_source(value) or source.replace(".", "").isidentifier()
        if is_simple and len(source) <= _LONGEST:
            return source
        return self.module.gathered.add_constant(token.upper(), source)

    def _text(self) -> str:
        """Return the function."""
        variables, states = self.variables, self.states
        sources = [token for token in self.cg.source_tokens if token in variables]
        given = [variables[token] for token in sources if token not in self.defaults]
        named = [f"{variables[token]}={self.defaults[token]}" for token in sources if token in self.defaults]
        named += [f"{each.parameter}={each.default}" for each in states if each.inner]
        given += ["*", *named] if named else []
        head = f"def {self.name}({', '.join(given)}):"
        lines = [head] if len(head) <= LINE else [f"def {self.name}(", *(f"    {each}," for each in given), "):"]
        lines += self._docstring([*sources, *self.returns])
        lines += [f"    {each.following} = {each.parameter}" for each in states if each.following]
        lines += self._lines(())
        returned = ", ".join(variables[token] for token in self.returns)
        is_several = len(self.returns) != 1
        if states:
            after = ", ".join(f'"{each.parameter}": {each.following or each.after}' for each in states)
            returned = f"{f'({returned})' if len(self.returns) > 1 else returned or None}, {{{after}}}"
        if returned:
            is_line = not (is_several or states) or len(returned) + len("    return ") <= LINE
            lines += [f"    return {returned}"] if is_line else laid_out(f"({returned})", 1, "return ")
        return "\n".join(lines)

    def _variable(self, wanted: str) -> str:
        """Return a variable that is not taken, and take it."""
        found = identifier_of(wanted, self.taken.__contains__)
        self.taken.add(found)
        return found

    def _named(self, tokens: Iterable[str]) -> dict[str, str]:
        """Return a variable for each token that hides nothing of the module; names that can stay come first."""
        reserved = frozenset(self.taken)
        in_order = sorted(tokens, key=lambda token: not is_identifier(token) or token in reserved)
        return {token: self._variable(token) for token in in_order}

    def _lines(self, region: Region) -> Iterator[str]:
        """Give the lines of the functions of a region, and of the branches in it."""
        for name in (name for name, place in self.regions.items() if place == region):
            if name in self.switches:
                yield from self._switch(name, region)
            else:
                yield from self._guarded(name, len(region) + 1)
                yield from self._state_lines(name, "    " * (len(region) + 1))

    def _state_lines(self, name: str, pad: str) -> Iterator[str]:
        """Give the lines that take note of what a function has left for the next call."""
        for state in self.states:
            if state.maker == name and state.following:
                is_token = not state.inner and not self.may_be_nothing.isdisjoint(self.cg.func_outputs(name))
                kept = f"{state.parameter} if {state.after} is {self.nothing} else " if is_token else ""
                yield f"{pad}{state.following} = {kept}{state.after}"

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
        arguments = [self.variables[token] for token in self.cg.func_inputs(name)]
        for place in self.copied.get(name, ()):
            arguments[place] = f"{self.copy}({arguments[place]})"
        arguments += [
            f"{state.inner}={state.parameter}" for state in self.states if state.maker == name and state.inner
        ]
        call, outputs = f"{self.calls[name]}({', '.join(arguments)})", self.cg.func_outputs(name)
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
        is_tuple_of_one = len(targets) == 1 and not self.cg.has_single_output(name)
        several = f"({targets[0]},)" if is_tuple_of_one else ", ".join(targets)
        if name in self.left:
            value = several if len(targets) == 1 else f"({several})" if targets else "_"
            return f"{value}, {self.left[name]} = "
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

    def _docstring(self, shown: Iterable[str]) -> list[str]:
        """Return the docstring: what is returned, and which parameters and results have other names than tokens."""
        returned = ", ".join(self.variables[token] for token in self.returns)
        if len(returned) > LINE - len('    """Return ."""'):
            returned = f"{len(self.returns)} values"
        summary = f"Return {returned}." if returned else "Run."
        if self.states:
            summary = f"{summary[:-1]}, and the state for the next call." if returned else "Return None, and the state."
        other = [token for token in dict.fromkeys(shown) if self.variables[token] != token]
        if not other:
            return [f'    """{summary}"""']
        lines = [f"        {self.variables[token]}: '{escaped(token, 40)}'" for token in other]
        return [f'    """{summary}', "", "    Tokens of the graph that have other names here:", "", *lines, '    """']
