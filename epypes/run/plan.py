"""Which functions would run, which would be reused, and what is missing?"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from epypes.run.tokens import NOT_COMPUTED, TokenManager


@dataclass(frozen=True, slots=True)
class Plan:
    """What a run of ``targets`` would do.

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
    """

    targets: tuple[str, ...]
    order: tuple[str, ...]
    reused: tuple[str, ...]
    missing: tuple[str, ...]


def needed_steps(manager: TokenManager, targets: Sequence[str]) -> tuple[int, ...]:
    """Return the steps that the targets, tokens of the graph, need, in run order; every step without targets."""
    program = manager.program
    return program.needed(targets) if targets else tuple(range(len(program.steps)))


def missing_sources(manager: TokenManager, steps: Sequence[int]) -> tuple[str, ...]:
    """Return the source tokens that these steps read and that have no value, in graph order."""
    program = manager.program
    slots = {slot for index in steps for slot in program.steps[index].inputs}
    return tuple(
        program.tokens[slot]
        for slot in sorted(slots)
        if slot not in program.makers and manager.values[slot] is NOT_COMPUTED
    )


def plan(manager: TokenManager, targets: Sequence[str]) -> Plan:
    """Plan a run that starts from these token values; changes nothing."""
    steps = needed_steps(manager, targets)
    stale = manager.stale_steps(steps)
    running = set(stale)
    names = [step.name for step in manager.program.steps]
    return Plan(
        targets=tuple(targets),
        order=tuple(names[index] for index in stale),
        reused=tuple(names[index] for index in steps if index not in running),
        missing=missing_sources(manager, steps),
    )
