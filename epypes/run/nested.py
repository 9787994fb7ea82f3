"""Calls of pipelines that are functions of a graph: with the graph's values, and on from the run before.

The graph around a pipeline keeps for it, in slots of its own, the hyperparameters, the state between runs and the Run.
So runs in several threads, and several graphs with one pipeline, never see each other's values; what the pipeline has
itself stays as it is. A call runs what is stale inside since the one before, and nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from threading import get_ident
from typing import TYPE_CHECKING, Any

from epypes.run.program import CALL_WITH_STATE, NestedSlots, Step
from epypes.run.staleness import NOT_COMPUTED, NestedRun, TokenManager

if TYPE_CHECKING:
    from epypes.run.hyperparameters import Hyperparameters
    from epypes.run.result import Run


class NestedCall:
    """A call of a pipeline by the graph around it: what the runs are made with that its thread makes meanwhile.

    Attributes
    ----------
    hparams
        The hyperparameters.
    inputs
        What the pipeline is called with. A subclass may give its graph something else.
    before
        The run of the call before, if there is one to go on from.
    new
        Where the inputs stand that are new since then.
    run
        The last run that was made, if it was with these inputs.
    """

    __slots__ = ("before", "hparams", "inputs", "new", "run")

    def __init__(
        self, hparams: Hyperparameters, inputs: tuple[Any, ...], before: Run | None, new: Sequence[int]
    ) -> None:
        self.hparams, self.inputs, self.before, self.new = hparams, inputs, before, new
        self.run: Run | None = None

    def is_passed_on(self, payload: Mapping[str, Any]) -> bool:
        """Whether a graph is run on the very inputs of the call."""
        given = payload.values()
        return len(given) == len(self.inputs) and all(a is b for a, b in zip(given, self.inputs, strict=True))


def call_nested(step: Step, nested: NestedSlots, values: list[Any], *args: Any) -> Any:
    """Call a pipeline and store its Run, a failed one too; return its value, then the states that it leaves."""
    __tracebackhide__ = True
    runner, keys, before = nested.runner, nested.keys, values[nested.run]
    count, is_known = len(args) - len(keys), type(before) is NestedRun
    new = [place for place, slot in enumerate(step.inputs) if slot in before.new] if is_known else []
    is_known = is_known and before.run.tokens.program is runner._program and all(place < count for place in new)
    entries = {token: values[slot] for token, slot in nested.hparams.items() if values[slot] is not NOT_COMPUTED}
    hparams = runner.current.with_entries(entries)
    call = NestedCall(hparams, args[:count], before.run if is_known else None, new)
    nested_calls, thread = runner.nested_calls, get_ident()
    outer, nested_calls[thread] = nested_calls.get(thread), call
    try:
        if not keys:
            return step.function(*args)
        state = dict(zip(keys, args[count:], strict=True))
        value, after = getattr(step.function, CALL_WITH_STATE)(state, args[:count])
    finally:
        values[nested.run] = NOT_COMPUTED if call.run is None else NestedRun(call.run)
        if outer is None:
            del nested_calls[thread]
        else:
            nested_calls[thread] = outer
    is_one = nested.single or not isinstance(value, tuple | list | None)
    return *((value,) if is_one else value or ()), *(after[key] for key in keys)


def tokens_inside(tokens: TokenManager, function: str) -> tuple[Run, TokenManager] | None:
    """Return the run inside a pipeline, and its tokens as they are to be read with those of the graph around it."""
    program = tokens.program
    step = next(step for step in program.steps if step.name == function)
    nested = step.nested
    kept = tokens.values[nested.run] if nested is not None else None
    if nested is None or type(kept) is not NestedRun:
        return None
    inner, old = kept.run.tokens.program, kept.run.hparams.entries
    now = {token: tokens.values[slot] for token, slot in nested.hparams.items()}
    new = {token: entry for token, entry in now.items() if entry is not NOT_COMPUTED and entry is not old.get(token)}
    found = kept.run.tokens.branch({token: entry[0] if token in inner.slots else entry for token, entry in new.items()})
    found.begin()
    for token, slot in zip(kept.run.hparams.free_slots, step.inputs, strict=False):
        if slot in kept.new or program.makers[slot] in tokens.stale:
            found.mark(inner.slots[token])
    return kept.run, found
