"""What is to be seen of a graph, a runner or a run, whoever paints it?

Painters read the frozen GraphView and nothing else, so their colours and labels always agree.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

from epypes.display.preview import Preview, preview
from epypes.graph import CompGraph, colour_order
from epypes.images import Order
from epypes.run import CompGraphRunner, FunctionTime, Run

TokenRole = Literal["payload", "hyperparameter"]
TokenState = Literal["static", "not computed", "fresh", "stale"]
FunctionState = Literal["static", "not run", "ran", "reused", "stale", "failed"]

# Base64 makes four characters of three bytes; together the thumbnails of one picture take at most this many.
THUMBNAIL_CHARACTERS: Final = 80_000


@dataclass(frozen=True, slots=True)
class TokenView:
    """What is to be seen of a token; ``preview`` is None if it has no value, ``order`` is that of its colours."""

    name: str
    role: TokenRole
    state: TokenState
    preview: Preview | None = None
    order: Order = "bgr"


@dataclass(frozen=True, slots=True)
class FunctionView:
    """What is to be seen of a function; ``share`` is its part of the run's time, from 0 to 1."""

    name: str
    state: FunctionState
    duration_ns: int | None = None
    share: float = 0.0
    message: str = ""


@dataclass(frozen=True, slots=True)
class GraphView:
    """What is to be seen of a graph.

    Attributes
    ----------
    functions, tokens
        In run order and graph order.
    edges
        Pairs of a function's index and a token's index, and whether the token is an input.
    caption
        What stands under the picture: the run's time and graph overhead, and what was left out.
    """

    functions: tuple[FunctionView, ...]
    tokens: tuple[TokenView, ...]
    edges: tuple[tuple[int, int, bool], ...]
    caption: str = ""

    def io(self) -> list[tuple[list[str], list[str]]]:
        """Return by function, in order, the names of its input and of its output tokens."""
        found: list[tuple[list[str], list[str]]] = [([], []) for _ in self.functions]
        for function, token, taken in self.edges:
            found[function][0 if taken else 1].append(self.tokens[token].name)
        return found


def view(shown: CompGraph | CompGraphRunner | Run) -> GraphView:
    """Look at a graph, a runner or a run; nothing is computed but previews."""
    if isinstance(shown, CompGraph):
        return _structure(shown)
    if isinstance(shown, CompGraphRunner):
        return _runner_view(shown)
    return _with_run(_structure(shown.cg), shown, shown.hyperparameters, frozenset())


def _structure(cg: CompGraph) -> GraphView:
    place = {token: index for index, token in enumerate(cg.tokens)}
    edges = [
        (index, place[token], taken)
        for index, name in enumerate(cg.functions)
        for taken, tokens in ((True, cg.func_inputs(name)), (False, cg.func_outputs(name)))
        for token in dict.fromkeys(tokens)
    ]
    return GraphView(
        tuple(FunctionView(name, "static") for name in cg.functions),
        tuple(TokenView(token, "payload", "static", order=colour_order(cg, token)) for token in cg.tokens),
        tuple(edges),
    )


def _runner_view(runner: CompGraphRunner) -> GraphView:
    structure, hparams = _structure(runner.cg), runner.hyperparameters
    if runner.last is None:
        functions = tuple(replace(function, state="not run") for function in structure.functions)
        tokens = tuple(_unrun_token(token, hparams) for token in structure.tokens)
        return replace(structure, functions=functions, tokens=tokens, caption="not run yet")
    return _with_run(structure, runner.last, hparams, frozenset(runner.stale))


def _unrun_token(token: TokenView, hparams: Mapping[str, Any]) -> TokenView:
    if token.name in hparams:
        return _hyperparameter_view(token, hparams[token.name])
    return replace(token, state="not computed")


def _hyperparameter_view(token: TokenView, value: Any) -> TokenView:
    return replace(token, role="hyperparameter", state="fresh", preview=preview(value, token.order))


def _with_run(structure: GraphView, run: Run, hparams: Mapping[str, Any], stale: frozenset[str]) -> GraphView:
    """Add a run to a graph's structure; ``stale`` are functions out of date since the run."""
    steps = run.tokens.program.steps
    stale |= {steps[index].name for index in run.tokens.stale}
    spent = {entry.function: entry for entry in run.report.functions}
    functions = tuple(
        _function_view(function.name, run, stale, spent.get(function.name)) for function in structure.functions
    )
    every = [_token_view(token, run, hparams, stale) for token in structure.tokens]
    tokens, left_out = within_budget(every, run.cg.sink_tokens)
    report = run.report
    overhead = f"{overhead_text(report.side_by_side)} {duration_text(report.overhead_ns)}"
    caption = f"{duration_text(report.total_ns)} in all, {overhead}"
    if left_out:
        caption += f"; {left_out} thumbnails left out to keep the picture small"
    return replace(structure, functions=functions, tokens=tokens, caption=caption)


def _function_view(name: str, run: Run, stale: frozenset[str], entry: FunctionTime | None) -> FunctionView:
    if run.failure and run.failure.function == name:
        return FunctionView(
            name,
            "failed",
            entry.duration_ns if entry else None,
            message=run.failure.message or type(run.failure.exception).__name__,
        )
    if name in stale:
        made = run.cg.func_outputs(name)
        return FunctionView(name, "not run" if made and not any(map(run.tokens.is_computed, made)) else "stale")
    if entry is None or not entry.ran:
        return FunctionView(name, "reused")
    return FunctionView(name, "ran", entry.duration_ns, entry.duration_ns / max(run.report.total_ns, 1))


def _token_view(token: TokenView, run: Run, hparams: Mapping[str, Any], stale: frozenset[str]) -> TokenView:
    if token.name in hparams:
        return _hyperparameter_view(token, hparams[token.name])
    if not run.tokens.is_computed(token.name):
        return replace(token, state="not computed")
    value = run.tokens.values[run.tokens.program.slots[token.name]]
    is_old = run.cg.digraph.producer.get(token.name) in stale
    return replace(token, state="stale" if is_old else "fresh", preview=preview(value, token.order))


def within_budget(tokens: list[TokenView], first: Iterable[str]) -> tuple[tuple[TokenView, ...], int]:
    """Drop thumbnails until the rest fit; those of ``first`` are kept longest, then the others in order.

    Returns
    -------
    tuple
        The tokens, and how many thumbnails were dropped.
    """
    important = set(first)
    spent = dropped = 0
    kept: dict[str, TokenView] = {}
    for token in sorted(tokens, key=lambda token: token.name not in important):
        picture = token.preview.picture if token.preview else None
        size = len(picture.data) * 4 // 3 + 100 if picture else 0
        if token.preview and picture and spent + size > THUMBNAIL_CHARACTERS:
            dropped += 1
            token = replace(token, preview=replace(token.preview, picture=None))
        else:
            spent += size
        kept[token.name] = token
    return tuple(kept[token.name] for token in tokens), dropped


def overhead_text(side_by_side: bool) -> str:
    """Return what graph overhead is called; where functions ran side by side it is another quantity."""
    return "graph overhead (wall time less critical path)" if side_by_side else "graph overhead"


def duration_text(duration_ns: int) -> str:
    """Return a duration with its unit, to three digits.

    Examples
    --------
    >>> duration_text(5_230_000), duration_text(740)
    ('5.23 ms', '740 ns')
    """
    for limit, unit in ((1e9, "s"), (1e6, "ms"), (1e3, "µs")):
        if abs(duration_ns) >= limit:
            return f"{duration_ns / limit:.3g} {unit}"
    return f"{duration_ns} ns"
