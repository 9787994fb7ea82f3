"""Which slots does each function read and write?

A graph is compiled once: tokens become slot numbers, functions become steps in run order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from epypes.graph import CompGraph
from epypes.run.guard import is_unguarded


@dataclass(frozen=True, slots=True)
class Step:
    """One function of a program.

    Attributes
    ----------
    index
        Its place in run order.
    inputs, outputs
        The slots it reads and writes.
    single
        Whether its value is one token as it is, not a sequence of tokens.
    upstream
        The steps that make its inputs.
    guarded
        Whether it gets its arrays read-only.
    """

    index: int
    name: str
    function: Callable[..., Any]
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]
    single: bool
    upstream: tuple[int, ...]
    guarded: bool


@dataclass(frozen=True, slots=True)
class Program:
    """A compiled graph: tokens by slot, steps in run order."""

    cg: CompGraph
    tokens: tuple[str, ...]
    slots: Mapping[str, int]
    steps: tuple[Step, ...]
    makers: Mapping[int, int]

    def needed(self, targets: Iterable[str]) -> tuple[int, ...]:
        """Return the steps that these tokens depend on, in run order; all of them without targets."""
        wanted = {self.makers[self.slots[token]] for token in targets if self.slots[token] in self.makers}
        pending = list(wanted)
        while pending:
            for step in self.steps[pending.pop()].upstream:
                if step not in wanted:
                    wanted.add(step)
                    pending.append(step)
        return tuple(sorted(wanted))

    def downstream(self, starts: Iterable[int]) -> set[int]:
        """Return these steps and every step that depends on one of them."""
        found = set(starts)
        for step in self.steps:
            if step.index not in found and not found.isdisjoint(step.upstream):
                found.add(step.index)
        return found


def compile_graph(cg: CompGraph) -> Program:
    """Compile a graph; costs time in proportion to its size."""
    slots = {token: slot for slot, token in enumerate(cg.tokens)}
    position = {name: index for index, name in enumerate(cg.functions)}
    steps: list[Step] = []
    for index, (name, function) in enumerate(cg.functions.items()):
        upstream = {position[producer] for producer in cg.digraph.predecessors(name)}
        steps.append(
            Step(
                index=index,
                name=name,
                function=function,
                inputs=tuple(slots[token] for token in cg.digraph.inputs[name]),
                outputs=tuple(slots[token] for token in cg.digraph.outputs[name]),
                single=cg.has_single_output(name),
                upstream=tuple(sorted(upstream)),
                guarded=not is_unguarded(function),
            )
        )
    makers = {slot: step.index for step in steps for slot in step.outputs}
    return Program(cg, cg.tokens, slots, tuple(steps), makers)
