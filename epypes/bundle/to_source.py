"""How is a graph written down as Python that needs no graph?"""

from __future__ import annotations

import builtins
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from epypes.bundle.branches import Placement, place
from epypes.bundle.definitions import definitions, early_constants
from epypes.bundle.equivalence import refusal
from epypes.bundle.importorder import ordered_imports
from epypes.bundle.literal import literal_source
from epypes.bundle.nodes import called_by, is_plain_pipeline
from epypes.bundle.slicer import Slice, slice_functions
from epypes.bundle.source import Refused
from epypes.bundle.straight import Straight, emit_function
from epypes.bundle.values import expression
from epypes.bundle.words import is_word, word_of
from epypes.errors import PlaceholderNeeded, SourceRefused
from epypes.graph import CompGraph, as_switch
from epypes.pipeline import Pipeline
from epypes.run import CompGraphRunner


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
    top = _Part(name, graph, values, place(graph, wanted), graph.sink_tokens if wanted is None else wanted)
    parts = _with_pipelines(top)
    _check_placeholders(parts)
    gathered = Slice(reserved=(name,))
    gathered.refusals += _unwritable(parts, name, wanted)
    _slice(gathered, parts)
    _keep_names(gathered, parts)
    straights = [_resolved(gathered, part) for part in parts]
    if gathered.refusals:
        raise SourceRefused(tuple(dict.fromkeys(gathered.refusals)))
    text = _module(gathered, straights)
    why = _difference(text, parts, straights)
    if why:
        raise SourceRefused((why,))
    return text


def _difference(text: str, parts: Sequence[_Part], straights: Sequence[Straight]) -> str:
    """Return why what a module calls is not what the graph calls; "" if it is."""
    compared: list[tuple[str, Any, str]] = []
    for part, straight in zip(parts, straights, strict=True):
        for name, source in part.references.items():
            if name not in part.pipelines:
                compared.append((f"Function {name!r}{part.where}", part.cg.functions[name], source))
        for token, source in straight.defaults.items():
            compared.append((f"Hyperparameter {token!r}{part.where}", part.values[token], source))
    listed = "".join(f"    {source},\n" for _, _, source in compared)
    whole = f"{text}\n\nreferences = [\n{listed}]\n"
    return refusal(whole, {}, lambda module: [
        (what, ours, theirs) for (what, ours, _), theirs in zip(compared, module.references, strict=True)
    ])  # fmt: skip


@dataclass(eq=False, slots=True)
class _Part:
    """A graph that becomes a function: the one that was given, or that of a pipeline in it."""

    name: str
    cg: CompGraph
    values: Mapping[str, Any]
    placement: Placement
    returns: tuple[str, ...]
    where: str = ""
    references: dict[str, str] = field(default_factory=dict)
    pipelines: dict[str, _Part] = field(default_factory=dict)


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
        for name in part.placement.functions:
            pipeline = called_by(part.cg.functions[name])
            if not is_plain_pipeline(pipeline):
                continue
            if id(pipeline) not in by_pipeline:
                cg, values = pipeline.cg, pipeline.runner.hyperparameters
                where = f" of pipeline {pipeline.name!r}"
                inner = _Part(pipeline.name, cg, values, place(cg, None), cg.sink_tokens, where)
                by_pipeline[id(pipeline)] = inner
                found.append(inner)
                pending.append(inner)
            part.pipelines[name] = by_pipeline[id(pipeline)]
    return found[::-1]


def _check_placeholders(parts: Sequence[_Part]) -> None:
    missing = [name for part in parts for name in part.cg.placeholders if name in set(part.placement.functions)]
    if missing:
        raise PlaceholderNeeded(missing)


def _unwritable(parts: Sequence[_Part], name: str, wanted: Sequence[str] | None) -> list[str]:
    """Return what stands against writing these parts, whatever their functions are."""
    reasons = []
    if not is_word(name) or hasattr(builtins, name):
        reasons.append(f"name={name!r} can't be a function's name. Give a word that means nothing to Python.")
    if wanted == ():
        reasons.append("returns is empty: name at least one token, or leave it out for the sink tokens.")
    for part in parts:
        if part.placement.is_too_deep:
            text = f"The switches{part.where} stand in one another too deep to be indented."
            reasons.append(f"{text} Make the inner ones a Pipeline, which becomes a function of its own.")
    return reasons


def _slice(gathered: Slice, parts: Sequence[_Part]) -> None:
    """Gather what the functions need, and note by which expressions they are called."""
    called: list[tuple[_Part, str, Callable[..., Any]]] = []
    for part in parts:
        written = [name for name in part.placement.functions if name not in part.placement.branches]
        called += [(part, name, called_by(part.cg.functions[name])) for name in written if name not in part.pipelines]
    functions = [(f"Function {name!r}{part.where}", function) for part, name, function in called]
    for (part, name, _), reference in zip(called, slice_functions(gathered, functions), strict=True):
        part.references[name] = reference


def _keep_names(gathered: Slice, parts: Sequence[_Part]) -> None:
    """Name the functions of pipelines, so that they hide nothing."""
    for part in parts:
        if part.where:
            part.name = word_of(part.name, gathered.is_taken)
            gathered.keep_name(part.name)
    for part in parts:
        part.references.update({name: inner.name for name, inner in part.pipelines.items()})


def _resolved(gathered: Slice, part: _Part) -> Straight:
    """Return a part with expressions for its values."""
    read = set(part.placement.tokens)
    values = {token: value for token, value in part.values.items() if token in read}
    return Straight(
        part.name,
        part.cg,
        part.placement,
        part.returns,
        part.references,
        {token: _default(gathered, part, token, value) for token, value in values.items()},
        {name: _keys(gathered, part, name) for name in part.placement.branches},
        bool(part.where),
    )


def _default(gathered: Slice, part: _Part, token: str, value: Any) -> str:
    """Return the expression of a hyperparameter's value: as it is, or the constant above that holds it."""
    what = f"Hyperparameter {token!r}{part.where}"
    source = _expression(gathered, value, what)
    if not source:
        gathered.refusals.append(
            f"{what} is of type {type(value).__name__}, and no expression makes this value again. Leave it free, so "
            "that the function takes it; or use numbers, strings, a small array or tuples of them."
        )
        return "None"
    if literal_source(value) or source.replace(".", "").isidentifier():
        return source
    name = next((name for name, known in gathered.constants.items() if known == source), "")
    if not name:
        name = word_of(token.upper(), gathered.is_taken)
        gathered.add_made_constant(name, source)
    return name


def _expression(gathered: Slice, value: Any, what: str) -> str:
    """Return the expression of a value; "None", with the reason noted, if a name that it needs is taken."""
    try:
        return expression(gathered, value, what)
    except Refused as refusal:
        gathered.refusals.append(str(refusal))
        return "None"
    except RecursionError:  # it holds itself, or is nested deeper than Python reads
        return ""


def _keys(gathered: Slice, part: _Part, name: str) -> dict[object, str]:
    """Return the expressions of the values that a switch compares its selector with."""
    function = as_switch(part.cg.functions[name])
    tokens = part.cg.func_inputs(name)[1:]
    sources: dict[object, str] = {}
    for key, token in zip(function.branches if function is not None else (), tokens, strict=True):
        sources[key] = _expression(gathered, key, f"Switch {name!r}{part.where}")
        if not sources[key]:
            gathered.refusals.append(
                f"Switch {name!r}{part.where} chooses {token!r} by a key of type {type(key).__name__}, which no "
                "expression makes again. Choose by strings or numbers."
            )
    return sources


def _module(gathered: Slice, straights: Sequence[Straight]) -> str:
    blocks = []
    if gathered.imports:
        blocks.append("\n".join(ordered_imports(list(gathered.imports.values()))))
    constants = early_constants(gathered)
    if constants:
        blocks.append(constants)
    head = ["\n\n".join(blocks)] if blocks else []
    return "\n\n\n".join([*head, *definitions(gathered), *map(emit_function, straights)]) + "\n"
