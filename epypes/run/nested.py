"""Calls of pipelines that are functions of a graph: with the graph's values, and on from the run before.

The graph around a pipeline keeps for it, in slots of its own, the hyperparameters, the state between runs and the Run.
So runs in several threads, and several graphs with one pipeline, never see each other's values; what the pipeline has
itself stays as it is. A call that gets the same inputs as the one before runs what is stale inside, and nothing else.
"""

from __future__ import annotations

from collections.abc import Mapping
from threading import get_ident
from typing import TYPE_CHECKING, Any

from epypes.run.program import CALL_WITH_STATE, NestedSlots, Step
from epypes.run.staleness import NOT_COMPUTED

if TYPE_CHECKING:
    from epypes.run.hyperparameters import Hyperparameters
    from epypes.run.result import Run


class Loan:
    """What a call of a pipeline has from the graph around it, for the runs that its thread makes meanwhile.

    Attributes
    ----------
    hparams
        The hyperparameters.
    inputs
        What the pipeline is called with. A subclass may give its graph something else.
    before
        The run with the same inputs that is gone on from, if there is one.
    run
        The last run that was made, if it was with these inputs.
    """

    __slots__ = ("before", "hparams", "inputs", "run")

    def __init__(self, hparams: Hyperparameters, inputs: tuple[Any, ...], before: Run | None) -> None:
        self.hparams, self.inputs, self.before = hparams, inputs, before
        self.run: Run | None = None

    def is_passed_on(self, payload: Mapping[str, Any]) -> bool:
        """Whether a graph is run on the very inputs of the call."""
        given = payload.values()
        return len(given) == len(self.inputs) and all(a is b for a, b in zip(given, self.inputs, strict=True))


def call_nested(step: Step, nested: NestedSlots, values: list[Any], *args: Any) -> Any:
    """Call a pipeline; return its value, and after it the states that it leaves. Its Run is stored, a failed one too."""
    runner, keys, before = nested.runner, nested.keys, values[nested.run]
    count = len(args) - len(keys)
    entries = {token: values[slot] for token, slot in nested.hparams.items() if values[slot] is not NOT_COMPUTED}
    hparams = runner.current.with_entries(entries)
    loan = Loan(hparams, args[:count], None if before is NOT_COMPUTED else before)
    loans, thread = runner.loans, get_ident()
    outer, loans[thread] = loans.get(thread), loan
    try:
        if not keys:
            return step.function(*args)
        state = dict(zip(keys, args[count:], strict=True))
        value, after = getattr(step.function, CALL_WITH_STATE)(state, args[:count])
    finally:
        values[nested.run] = NOT_COMPUTED if loan.run is None else loan.run
        if outer is None:
            del loans[thread]
        else:
            loans[thread] = outer
    is_one = nested.single or not isinstance(value, tuple | list | None)
    return *((value,) if is_one else value or ()), *(after[key] for key in keys)
