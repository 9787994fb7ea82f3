"""Which slots does each function read and write?

A graph is compiled once: tokens become slot numbers, functions become steps in run order.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from types import BuiltinFunctionType
from typing import Any, Final, NamedTuple

from epypes.graph import CompGraph, Switch, as_switch
from epypes.images import Image, contracts_of
from epypes.run.guard import is_unguarded

# What a function has that keeps hyperparameters of its own: a value that is another one whenever they have changed.
REVISION: Final = "__epypes_revision__"


class Step(NamedTuple):
    """One function of a program.

    Attributes
    ----------
    place
        Where it stands in run order.
    inputs, outputs
        The slots it reads and writes.
    single
        Whether its value is one token as it is, not a sequence of tokens.
    unguarded
        Whether it gets its arrays writable.
    is_builtin
        Whether it is a C function, which can write into an array but has no means to change its shape.
    switch
        The switch that it is, if it is one.
    contracts
        What its annotations say of the images that it takes and makes; by input and by output, if they say anything.
    """

    place: int
    name: str
    function: Callable[..., Any]
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]
    single: bool
    unguarded: bool
    is_builtin: bool
    switch: Switch | None
    contracts: tuple[Sequence[Image | None], Sequence[Image | None]] | None


class Program:
    """A compiled graph; nothing in it changes.

    Attributes
    ----------
    cg
        The graph.
    guard
        Whether functions get arrays as read-only views.
    tokens
        The tokens by slot.
    slots
        The slots by token.
    steps
        The functions, in run order.
    makers
        By slot, the step that writes it, or -1 for a source token.
    consumers
        By slot, the steps that read it, in run order.
    switches, placeholders
        The steps that are one.
    selectors
        By the selector's token, the switches that it selects for.
    revised
        The steps whose function computes something else when it has got another revision: nested pipelines.
    """

    __slots__ = (
        "cg",
        "consumers",
        "guard",
        "makers",
        "placeholders",
        "revised",
        "selectors",
        "slots",
        "steps",
        "switches",
        "tokens",
    )

    def __init__(self, cg: CompGraph, guard: bool) -> None:
        self.cg, self.guard, self.tokens = cg, guard, cg.tokens
        self.slots = slots = {token: slot for slot, token in enumerate(cg.tokens)}
        self.steps = tuple(_steps(cg, slots))
        self.makers = [-1] * len(slots)
        consumers: list[list[int]] = [[] for _ in slots]
        for step in self.steps:
            for slot in step.outputs:
                self.makers[slot] = step.place
            for slot in step.inputs:
                if not consumers[slot] or consumers[slot][-1] != step.place:
                    consumers[slot].append(step.place)
        self.consumers: Sequence[Sequence[int]] = consumers
        self.switches = tuple(step.place for step in self.steps if step.switch is not None)
        self.placeholders = frozenset(step.place for step in self.steps if step.name in cg.placeholders)
        self.revised = tuple(step.place for step in self.steps if hasattr(type(step.function), REVISION))
        self.selectors: dict[str, list[Switch]] = {}
        for index in self.switches:
            step = self.steps[index]
            if step.switch is not None:
                self.selectors.setdefault(self.tokens[step.inputs[0]], []).append(step.switch)

    def revisions(self) -> tuple[Any, ...]:
        """Return the present revisions of the functions that have one."""
        return tuple(getattr(self.steps[place].function, REVISION) for place in self.revised)

    def read_by(self, step: Step, values: Sequence[Any]) -> tuple[int, ...]:
        """Return the slots that a step reads with these values: of a switch, the selector and the chosen branch."""
        if step.switch is None:
            return step.inputs
        try:
            branch = step.switch.branch_index(values[step.inputs[0]])
        except LookupError:
            return step.inputs  # the selector has no value, or one that is refused when the step runs
        return step.inputs[0], step.inputs[1 + branch]

    def downstream(self, starts: Iterable[int], values: Sequence[Any]) -> set[int]:
        """Return these steps and every step that, with these values, depends on one of them."""
        found = set(starts)
        pending = list(found)
        while pending:
            for slot in self.steps[pending.pop()].outputs:
                for index in self.consumers[slot]:
                    if index not in found and slot in self.read_by(self.steps[index], values):
                        found.add(index)
                        pending.append(index)
        return found


def _steps(cg: CompGraph, slots: dict[str, int]) -> Iterable[Step]:
    inputs, outputs, of = cg.digraph.inputs, cg.digraph.outputs, slots.__getitem__
    switches = set(cg.switches)
    for index, (name, function) in enumerate(cg.functions.items()):
        read, written = tuple(map(of, inputs[name])), tuple(map(of, outputs[name]))
        yield Step(
            index,
            name,
            function,
            read,
            written,
            type(cg.func_io[name][1]) is str,
            is_unguarded(function),
            type(function) is BuiltinFunctionType,
            as_switch(function) if name in switches else None,
            contracts if any(contracts := contracts_of(function, len(read), len(written))) else None,
        )


def longest_path_ns(program: Program, durations_ns: Mapping[int, int]) -> int:
    """Return how long those functions take that need each other's outputs one after another, at most."""
    ends_ns: dict[int, int] = {}
    for place in sorted(durations_ns):
        makers = {program.makers[slot] for slot in program.steps[place].inputs}
        ends_ns[place] = durations_ns[place] + max((ends_ns.get(maker, 0) for maker in makers), default=0)
    return max(ends_ns.values(), default=0)
