"""What a run needs and would do: which functions run and why, which are reused, what is missing.

With targets, what they depend on. Without, every function, except what a switch makes superfluous: a function is left
out when all that it makes goes to branches that are not chosen. One that makes a sink token is always run.
"""

from __future__ import annotations

import contextlib
import difflib
from collections.abc import Collection, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from epypes.errors import PayloadError, PlaceholderNeeded, UnknownName, run_call
from epypes.graph import CompGraph
from epypes.rich_display import Displayed
from epypes.run.hyperparameters import Hyperparameters
from epypes.run.program import Program
from epypes.run.staleness import NOT_COMPUTED, TokenManager
from epypes.wording import counted


@dataclass(frozen=True, slots=True)
class Plan(Displayed):
    """What a run of ``targets`` would do; shows itself as a table and on the graph.

    Attributes
    ----------
    targets
        The tokens asked for; empty for all.
    order
        The functions that would run, in run order. One of them is passed over at run time if what it takes turns
        out to be unchanged, or to be Nothing.
    reused
        The functions that are needed and up to date.
    missing
        The source tokens without value that are needed.
    placeholders
        The functions that are needed and still to be written.
    left_out
        The functions that are not needed: for these targets, or since a switch has chosen another branch.
    why
        By function of ``order``, the reason why it would run.
    branches
        By switch whose selector has a value, the key of the chosen branch.
    hyperparameters
        The values that it was planned with.
    first_hyperparameters
        The values that they had when they were made or frozen.
    cg
        The graph.
    """

    targets: tuple[str, ...]
    order: tuple[str, ...]
    reused: tuple[str, ...]
    missing: tuple[str, ...]
    placeholders: tuple[str, ...]
    left_out: tuple[str, ...]
    why: Mapping[str, str]
    branches: Mapping[str, Hashable]
    hyperparameters: Mapping[str, Any] = field(repr=False, compare=False)
    first_hyperparameters: Mapping[str, Any] = field(repr=False, compare=False)
    cg: CompGraph = field(repr=False, compare=False)

    def __repr__(self) -> str:
        missing = f", {len(self.missing) + len(self.placeholders)} missing" * bool(self.missing or self.placeholders)
        count = len(self.order)
        return f"<Plan: {counted(count, 'function')} to run, {len(self.reused)} reused{missing}>"


def plan(manager: TokenManager, targets: Sequence[str], changed: Collection[str], hparams: Hyperparameters) -> Plan:
    """Plan a run that starts from these token values; changes nothing.

    Parameters
    ----------
    manager
        The values as they are now.
    targets
        Tokens of the graph; empty for all.
    changed
        The hyperparameters that have changed since the last run; for the reasons.
    hparams
        All hyperparameters now.
    """
    program = manager.program
    wanted = wanted_steps(program, manager.values, targets)
    needed = [step for step in program.steps if wanted is None or wanted[step.place]]
    stale = manager.stale
    return Plan(
        targets=tuple(targets),
        order=tuple(step.name for step in needed if step.place in stale),
        reused=tuple(step.name for step in needed if step.place not in stale),
        missing=missing_sources(program, manager.values, wanted),
        placeholders=needed_placeholders(program, wanted),
        left_out=tuple(step.name for step in program.steps if wanted is not None and not wanted[step.place]),
        why=MappingProxyType(
            {step.name: _reason(manager, step.place, changed) for step in needed if step.place in stale}
        ),
        branches=MappingProxyType(chosen_branches(program, manager.values)),
        hyperparameters=hparams.values,
        first_hyperparameters=hparams.first_values,
        cg=program.cg,
    )


def _reason(manager: TokenManager, index: int, changed: Collection[str]) -> str:
    """Return why a stale step would run."""
    program, step = manager.program, manager.program.steps[index]
    if step.outputs and all(manager.values[slot] is NOT_COMPUTED for slot in step.outputs):
        return "not computed yet"
    read = program.read_by(step, manager.values)
    inside = step.nested.hparams.values() if step.nested is not None else ()
    new = [repr(program.tokens[slot]) for slot in dict.fromkeys((*read, *inside)) if program.tokens[slot] in changed]
    if new:
        return f"{', '.join(new)} changed"
    remade = [repr(program.tokens[slot]) for slot in dict.fromkeys(read) if program.makers[slot] in manager.stale]
    if remade:
        return f"takes {', '.join(remade)}, made anew"
    if index in program.revised:
        return "an input, or a hyperparameter inside it, has changed since it ran"
    return "an input has changed since it ran" if step.outputs else "not run yet"


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
        made = [slot for slot in step.outputs if slot < len(program.slots)]  # behind them is the state of pipelines
        readers = [(index, slot) for slot in made for index in program.consumers[slot]]
        makes_sink = not all(program.consumers[slot] for slot in made)
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
