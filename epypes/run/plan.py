"""Which functions would run and why, which would be reused, and what is missing?"""

from __future__ import annotations

from collections.abc import Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any

from epypes.graph import CompGraph
from epypes.rich_display import mimebundle, to_text
from epypes.run.hyperparameters import Hyperparameters
from epypes.run.need import chosen_branches, missing_sources, needed_placeholders, wanted_steps
from epypes.run.tokens import NOT_COMPUTED, TokenManager
from epypes.wording import counted


@dataclass(frozen=True, slots=True)
class Plan:
    """What a run of ``targets`` would do; shows itself as a table and on the graph.

    Attributes
    ----------
    targets
        The tokens asked for; empty for all.
    order
        The functions that would run, in run order. One of them is passed over at run time if what it takes turns
        out to be unchanged.
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

    def __str__(self) -> str:
        return to_text(self)

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        return mimebundle(self)


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
    new = [repr(program.tokens[slot]) for slot in dict.fromkeys(read) if program.tokens[slot] in changed]
    if new:
        return f"{', '.join(new)} changed"
    remade = [repr(program.tokens[slot]) for slot in dict.fromkeys(read) if program.makers[slot] in manager.stale]
    if remade:
        return f"takes {', '.join(remade)}, made anew"
    if index in program.revised:
        return "an input, or a hyperparameter inside it, has changed since it ran"
    return "an input has changed since it ran" if step.outputs else "not run yet"
