"""Which functions does a run need?

With targets, what they depend on. Without, every function, except what a switch makes superfluous: a function is left
out when all that it makes goes to branches that are not chosen. One that makes a sink token is always run.
"""

from __future__ import annotations

import contextlib
import difflib
from collections.abc import Collection, Hashable, Iterable, Sequence
from typing import Any

from epypes.errors import PayloadError, PlaceholderNeeded, UnknownName, run_call
from epypes.run.program import Program
from epypes.run.tokens import NOT_COMPUTED


def wanted_steps(program: Program, values: Sequence[Any], targets: Iterable[str]) -> bytes | None:
    """Return 1 for each step that is needed, by step; None if all are.

    Parameters
    ----------
    values
        By slot; those of the switches' selectors decide.
    targets
        Tokens of the graph; empty for all.
    """
    if targets:
        return _upstream(program, values, targets)
    return _without_superfluous(program, values) if program.switches else None


def _upstream(program: Program, values: Sequence[Any], targets: Iterable[str]) -> bytes:
    wanted = bytearray(len(program.steps))
    pending = [program.slots[token] for token in targets]
    while pending:
        index = program.makers[pending.pop()]
        if index >= 0 and not wanted[index]:
            wanted[index] = 1
            pending.extend(program.read_by(program.steps[index], values))
    return bytes(wanted)


def _without_superfluous(program: Program, values: Sequence[Any]) -> bytes:
    """Leave out what makes no sink token and is read only by branches not chosen and by what is left out itself."""
    wanted = bytearray(b"\1") * len(program.steps)
    read = {index: program.read_by(program.steps[index], values) for index in program.switches}
    for step in reversed(program.steps):
        readers = [(index, slot) for slot in step.outputs for index in program.consumers[slot]]
        makes_sink = not all(program.consumers[slot] for slot in step.outputs)
        is_read = any(wanted[index] and slot in read.get(index, (slot,)) for index, slot in readers)
        if readers and not makes_sink and not is_read:
            wanted[step.place] = 0
    return bytes(wanted)


def chosen_branches(program: Program, values: Sequence[Any]) -> dict[str, Hashable]:
    """Return the key of the chosen branch by switch, of those whose selector has a value."""
    found: dict[str, Hashable] = {}
    for index in program.switches:
        step = program.steps[index]
        selector = values[step.inputs[0]]
        if step.switch is not None and selector is not NOT_COMPUTED:
            with contextlib.suppress(UnknownName):  # such a selector is refused when the step runs
                found[step.name] = step.switch.branches[step.switch.branch_index(selector)]
    return found


def missing_sources(program: Program, values: Sequence[Any], wanted: bytes | None) -> tuple[str, ...]:
    """Return the source tokens that the wanted steps read and that have no value, in graph order."""
    slots = {
        slot
        for step in program.steps
        if wanted is None or wanted[step.place]
        for slot in program.read_by(step, values)
        if program.makers[slot] < 0 and values[slot] is NOT_COMPUTED
    }
    return tuple(program.tokens[slot] for slot in sorted(slots))


def needed_placeholders(program: Program, wanted: bytes | None) -> tuple[str, ...]:
    """Return the placeholders among the wanted steps, in run order."""
    return tuple(program.steps[index].name for index in sorted(program.placeholders) if wanted is None or wanted[index])


def check_ready(program: Program, values: Sequence[Any], wanted: bytes | None, payload: Collection[str]) -> None:
    """Raise unless the wanted steps have all the payload and functions they need; ``payload`` is what was given.

    Raises
    ------
    PlaceholderNeeded
        Functions are still to be written; all of them are listed.
    PayloadError
        Source tokens have no value; all of them are listed.
    """
    placeholders = needed_placeholders(program, wanted)
    if placeholders:
        raise PlaceholderNeeded(placeholders)
    missing = missing_sources(program, values, wanted)
    if missing:
        listed = ", ".join(map(repr, missing))
        text = f"Missing payload: {listed}. Call {run_call((*payload, *missing))}"
        if payload:
            constant = ", ".join(f"{token!r}: ..." for token in missing)
            text += f", or make what is constant a hyperparameter: CompGraphRunner(cg, {{{constant}}})"
        hints = (*_misspelt(program, missing), *_selections(program, missing))
        raise PayloadError(missing, " ".join([f"{text}.", *hints]))


def _misspelt(program: Program, missing: Iterable[str]) -> Iterable[str]:
    """Say which of these tokens may have been meant for one that a function makes."""
    made = program.cg.digraph.producer
    for token in missing:
        for near in difflib.get_close_matches(token, made, n=1, cutoff=0.8):
            yield f"No function makes {token!r}; {made[near]!r} makes {near!r}: is that what was meant?"


def _selections(program: Program, missing: Iterable[str]) -> Iterable[str]:
    """Say which of these tokens select a branch, and of which."""
    for token in missing:
        for switch in program.selectors.get(token, ()):
            branches = ", ".join(map(repr, switch.branches))
            yield f"{token!r} selects a branch of switch {switch.name!r}: {branches}."
