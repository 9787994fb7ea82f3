"""A graph compiled for running: which slots each function reads and writes.

A graph is compiled once: tokens become slot numbers, functions become steps in run order.
"""

from __future__ import annotations

import contextlib
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import cached_property, partial
from types import BuiltinFunctionType, CodeType, FunctionType, MethodType
from typing import TYPE_CHECKING, Any, Final, NamedTuple
from weakref import ref

from epypes.errors import Finding, GraphError
from epypes.graph import CompGraph, Switch, as_switch
from epypes.graph.signature import distinct
from epypes.images import Contracts
from epypes.run.guard import called_for, in_out_places, is_unguarded, keep

if TYPE_CHECKING:
    from epypes.run.runner import CompGraphRunner

# What a function has that keeps hyperparameters of its own: a method that returns another value whenever they have
# changed, given the programs that ask for it.
REVISION: Final = "__epypes_revision__"
# What a function has that measures its calls: where it is true, a program calls its ``func`` in its place, and has it
# count the call when the run has ended.
IS_ITS_FUNC: Final = "__epypes_is_its_func__"
# A thousand reports of more steps would hold a gigabyte of integers.
_MOST_UNPACKED: Final = 400
MAX_UNCOUNTED: Final = 100
# What a function has that keeps state between its calls: by key, the state before the first call; and a method that
# takes a state and inputs, and returns the value and the state after.
INITIAL_STATE: Final = "__epypes_initial_state__"
CALL_WITH_STATE: Final = "__epypes_call_with_state__"
# What a nested pipeline has: its runner.
RUNNER: Final = "__epypes_runner__"
# More objects than any function refers to on purpose.
_MOST_REACHED: Final = 1_000


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
    switch
        The switch that it is, if it is one.
    contracts
        What its annotations say of the images that it takes and makes; by input and by output, if they say anything.
    is_plain
        Whether its inputs are lent and nothing more is to be done about them.
    node
        The function, if it is a node whose ``func`` may be called in its place.
    in_out
        The places of the inputs into which it writes its results, and of which it gets copies.
    nested
        The slots of what is inside, if it is a pipeline.
    """

    place: int
    name: str
    function: Callable[..., Any]
    inputs: tuple[int, ...]
    outputs: tuple[int, ...]
    single: bool
    unguarded: bool
    switch: Switch | None
    contracts: Contracts | None
    is_plain: bool
    node: Any
    in_out: tuple[int, ...]
    nested: NestedSlots | None = None


class NestedSlots(NamedTuple):
    """What a graph keeps of a pipeline that is one of its functions.

    Attributes
    ----------
    pipeline
        The function.
    names
        By hyperparameter token of the pipeline, its name in the graph: ``"function__token"``, as in scikit-learn.
    hparams
        By token, the slot of its entry: a tuple of its value and its first one, which is its version.
    run
        The slot of its Run, from which the next call goes on.
    keys
        Of its states, whose slots are the last ones of the step's inputs and outputs.
    single
        Whether its own value is one token as it is.
    """

    pipeline: Any
    names: Mapping[str, str]
    hparams: Mapping[str, int]
    run: int
    keys: tuple[str, ...]
    single: bool

    @property
    def runner(self) -> CompGraphRunner:
        """The pipeline's own, which may be replaced."""
        found: CompGraphRunner = getattr(self.pipeline, RUNNER)
        return found


class StateSlots(NamedTuple):
    """Where a value is that is kept between runs.

    Attributes
    ----------
    key
        The delayed token; of a nested pipeline ``"function.key"``.
    before, after
        The slots that it is read from, and that the next run's is taken from.
    initial
        Its value in the first run.
    """

    key: str
    before: int
    after: int
    initial: Any


class Program:
    """A compiled graph; nothing in it changes but ``running`` and ``has_skipped``.

    Attributes
    ----------
    cg
        The graph.
    guard
        Whether functions get arrays as read-only views.
    check_mutation
        Whether each call is checked for changes to its inputs.
    tokens
        The tokens by slot; after those of the graph, what belongs to nested pipelines.
    slots
        The slots by token of the graph.
    settable
        The slots by token of the graph and by hyperparameter of nested pipelines.
    inner_names
        The hyperparameters of nested pipelines.
    nested
        By function, the slots of nested pipelines.
    inside
        By slot that nested pipelines take, the slots of their Runs.
    states
        What is kept between runs.
    steps
        The functions, in run order.
    switches, placeholders
        The steps that are one.
    nodes
        The steps that have a node, with it.
    is_large
        Whether the times of its runs are packed.
    all_steps, no_steps
        A flag for each step, which is set; which is not set.
    is_conditional
        Whether it is to be seen before each run which steps are needed, and can be run: switches, placeholders.
    uncounted
        Of runs that have ended, nanoseconds by step, for nodes to count; None if there are no nodes.
    running
        What runs at this moment, in any thread: objects whose ``running`` is a step, or -1.
    has_skipped
        Whether any run has met Nothing. As long as none has, no run looks for it.
    selectors
        By the selector's token, the switches that it selects for.
    revised
        The steps whose function computes something else when what it is or reaches has got another revision: nested
        pipelines.
    """

    def __init__(self, cg: CompGraph, guard: bool, check_mutation: bool = False) -> None:
        self.cg, self.guard, self.check_mutation = cg, guard, check_mutation
        self.slots = slots = {token: slot for slot, token in enumerate(cg.tokens)}
        found_steps = _steps(cg, slots, guard and not check_mutation)
        nested: list[StateSlots] = []
        tokens = [*cg.tokens]
        self.steps = steps = tuple(_with_nested_slots(found_steps, tokens, nested))
        self.tokens = tuple(tokens)
        self.nested = {step.name: step.nested for step in steps if step.nested is not None}
        self.settable, self.inner_names, self.inside = slots, frozenset[str](), dict[int, list[int]]()
        if self.nested:
            pairs = [(each.names, each.hparams) for each in self.nested.values()]
            self.settable = slots | {names[token]: at for names, hparams in pairs for token, at in hparams.items()}
            self.inner_names = frozenset(self.settable) - frozenset(slots)
            for step in steps:
                if step.nested is not None:
                    for slot in dict.fromkeys(step.inputs):
                        self.inside.setdefault(slot, []).append(step.nested.run)
        delays = cg.delays.items()
        own = [StateSlots(token, slots[token], slots[delay.token], delay.initial) for token, delay in delays]
        self.states = tuple(
            state._replace(initial=keep(state.initial, 0, self, state.before, ()) if guard else state.initial)
            for state in (*own, *nested)
        )
        self.nodes = tuple((step.place, step.node) for step in steps if step.node is not None)
        self.uncounted: deque[Mapping[int, int]] | None = deque() if self.nodes else None
        for _, node in self.nodes:
            node.programs.append(ref(self, node.programs.remove))
        self.running: set[Any] = set()
        self.has_skipped = False
        special = [step for step in steps if type(step.function) is not FunctionType]
        self.switches = tuple(step.place for step in special if step.switch is not None)
        self.placeholders = frozenset(step.place for step in special if step.name in cg.placeholders)
        self.is_large = len(steps) > _MOST_UNPACKED
        self.all_steps, self.no_steps = b"\1" * len(steps), bytes(len(steps))
        self.is_conditional = bool(self.switches or self.placeholders)
        found: dict[int, tuple[object, ...]] = {
            key: objects
            for key, function in distinct(cg.functions).items()
            if not _is_alone(function) and (objects := tuple(_revised_by(function)))
        }
        revised = [step for step in steps if id(cg.functions[step.name]) in found] if found else []
        self.revised = tuple(step.place for step in revised)
        self._with_revisions = tuple(found[id(cg.functions[step.name])] for step in revised)
        self._require_visible_state()
        self.selectors: dict[str, list[Switch]] = {}
        for place in self.switches:
            step = steps[place]
            if step.switch is not None:
                self.selectors.setdefault(self.tokens[step.inputs[0]], []).append(step.switch)

    # A first run asks for neither of the following, and they cost as much as the steps.

    @cached_property
    def makers(self) -> Sequence[int]:
        """By slot, the step that writes it, or -1 for a source token."""
        makers = [-1] * len(self.tokens)
        for step in self.steps:
            for slot in step.outputs:
                makers[slot] = step.place
        return makers

    @cached_property
    def consumers(self) -> Sequence[Sequence[int]]:
        """By slot, the steps that read it, in run order."""
        consumers: list[list[int]] = [[] for _ in self.tokens]
        for step in self.steps:
            for slot in dict.fromkeys((*step.inputs, *(step.nested.hparams.values() if step.nested else ()))):
                consumers[slot].append(step.place)
        return consumers

    def _require_visible_state(self) -> None:
        """Raise unless pipelines with state are functions of the graph themselves: so a rerun repeats their state."""
        for place, reached in zip(self.revised, self._with_revisions, strict=True):
            name = self.steps[place].name
            for pipeline in reached:
                if pipeline is not self.cg.functions[name] and getattr(pipeline, INITIAL_STATE, None):
                    text = (
                        f"Function {name!r} calls the pipeline {getattr(pipeline, 'name', '')!r}, which has state "
                        "between runs that a rerun could not repeat. Make the pipeline itself a function of the graph."
                    )
                    raise GraphError([Finding("delay", text, (name,))])

    def revisions(self, around: tuple[Program, ...] = ()) -> tuple[Any, ...]:
        """Return the present revisions of the functions that have one.

        ``around`` are the programs that ask for these: a pipeline's own method may be a function of its graph.
        """
        if not self._with_revisions or self in around:
            return ()
        around = (*around, self)
        return tuple(tuple([getattr(found, REVISION)(around) for found in each]) for each in self._with_revisions)

    __epypes_revision__ = revisions

    def read_by(self, step: Step, values: Sequence[Any]) -> tuple[int, ...]:
        """Return the slots that a step reads with these values: of a switch, the selector and the chosen branch."""
        if step.switch is None:
            return step.inputs
        try:
            branch = step.switch.branch_index(values[step.inputs[0]])
        except LookupError:
            return step.inputs  # the selector has no value, or one that is refused when the step runs
        return step.inputs[0], step.inputs[1 + branch]

    def required_by(self, step: Step, values: Sequence[Any]) -> tuple[int, ...]:
        """Return the slots without whose values a step is skipped: what it reads, but for a nested pipeline's state."""
        return tuple(slot for slot in self.read_by(step, values) if slot < len(self.slots))

    def running_functions(self) -> tuple[str, ...]:
        """Return the functions that were called and have not returned, in run order."""
        places = {getattr(each, "running", -1) for each in tuple(self.running)}
        return tuple(self.steps[place].name for place in sorted(places) if place >= 0)

    def __del__(self) -> None:
        # What its last runs have called; nothing if it could not be made.
        if getattr(self, "uncounted", None):
            self.count_calls()

    def count_calls(self) -> None:
        """Have the nodes count the calls of the runs that have ended; done when a node is asked for them."""
        with contextlib.suppress(IndexError):
            while self.uncounted:
                durations_ns = self.uncounted.popleft()
                for place, node in self.nodes:
                    if place in durations_ns:
                        node.count_call(durations_ns[place])

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


def _with_nested_slots(steps: Iterable[Step], tokens: list[str], states: list[StateSlots]) -> Iterator[Step]:
    """Give steps; nested pipelines have slots of their own, behind those of the graph."""

    def new_slot(name: str) -> int:
        tokens.append(name)
        return len(tokens) - 1

    taken = set(tokens)
    for step in steps:
        if not hasattr(type(step.function), RUNNER):
            yield step
            continue
        runner: CompGraphRunner = getattr(step.function, RUNNER)
        initial = getattr(step.function, INITIAL_STATE)
        own = [
            StateSlots(name := f"{step.name}.{key}", new_slot(name), new_slot(f"{name}, new"), value)
            for key, value in initial.items()
        ]
        states.extend(own)
        inner = runner._program
        names = dict[str, str]()
        for token in (*inner.cg.source_tokens, *(name for name in inner.settable if name in inner.inner_names)):
            if token not in inner.cg.delays:
                names[token] = f"{step.name}__{token}"
                while names[token] in taken:  # by a token of the graph
                    names[token] += "_"
                taken.add(names[token])
        hparams = {token: new_slot(name) for token, name in names.items()}
        yield step._replace(
            inputs=(*step.inputs, *(state.before for state in own)),
            outputs=(*step.outputs, *(state.after for state in own)),
            single=step.single and not own,
            is_plain=False,
            nested=NestedSlots(
                step.function, names, hparams, new_slot(f"the run of {step.name}"), tuple(initial), step.single
            ),
        )


def _is_alone(function: Any) -> bool:
    """Whether a function refers to nothing by name, as can be seen at a glance: large graphs are compiled fast."""
    if type(function) is not FunctionType or function.__closure__ or function.__defaults__ or function.__kwdefaults__:
        return False
    code = function.__code__
    return not code.co_names and len(code.co_consts) <= 1 and not function.__dict__


def _revised_by(function: Any) -> Iterator[object]:
    """Give what has a revision in a function; the hyperparameters of a nested pipeline are the graph's own."""
    if hasattr(type(function), RUNNER):
        inner = getattr(function, RUNNER)._program
        yield from (inner,) * bool(inner.revised)
    else:
        yield from _with_revisions(function)


def _with_revisions(function: object) -> Iterator[object]:
    """Give what has a revision among a function, what it wraps or is bound to, and what it refers to by name."""
    pending, seen = [function], set[int]()
    while pending and len(seen) < _MOST_REACHED:
        reached = pending.pop()
        if id(reached) in seen:
            continue
        seen.add(id(reached))
        if hasattr(type(reached), REVISION):
            yield reached
        else:
            with contextlib.suppress(Exception):  # whatever an object raises when it is looked at
                pending.extend(_referred(reached))


def _referred(function: Any) -> list[object]:
    """Return the objects that can be called among those that a function, a method or a callable object refers to."""
    kind = type(function)
    if kind is MethodType:
        return [function.__self__, function.__func__]
    if kind is partial:
        found = [function.func, *function.args, *function.keywords.values()]
    elif kind is FunctionType:
        found = [*(function.__defaults__ or ()), *(function.__kwdefaults__ or {}).values(), *vars(function).values()]
        for cell in function.__closure__ or ():
            with contextlib.suppress(ValueError):  # an empty cell
                found.append(cell.cell_contents)
        names = function.__globals__
        for value in [names[name] for name in _names_in(function.__code__) if name in names]:
            # Functions of other modules than the user's are not looked into.
            if type(value) is not FunctionType or value.__globals__ is names:
                found.append(value)
    else:
        found = list(vars(function).values())
    return [value for value in found if callable(value) and not isinstance(value, type | BuiltinFunctionType)]


def _names_in(code: CodeType) -> Iterator[str]:
    yield from code.co_names
    for constant in code.co_consts:
        if type(constant) is CodeType:
            yield from _names_in(constant)


def _steps(cg: CompGraph, slots: dict[str, int], lends_only: bool) -> Iterator[Step]:
    contracts, slot_of = cg.contracts, slots.__getitem__
    switches = {name: as_switch(cg.functions[name]) for name in cg.switches}
    sides = zip(cg.digraph.inputs.values(), cg.digraph.outputs.values(), cg.func_io.values(), strict=True)
    for place, ((name, function), (inputs, outputs, io)) in enumerate(zip(cg.functions.items(), sides, strict=True)):
        switch, contract = switches.get(name), contracts.get(name)
        unguarded, has_node = False, False
        in_out: tuple[int, ...] = ()
        # Of large graphs most functions are made by def alone.
        if type(function) is not FunctionType or function.__dict__:
            function = called_for(name, function)
            unguarded, in_out = is_unguarded(function), in_out_places(function, len(inputs))
            has_node = hasattr(type(function), IS_ITS_FUNC) and getattr(function, IS_ITS_FUNC)
        yield _new_step((
            place,
            name,
            function,
            (slots[inputs[0]],) if len(inputs) == 1 else tuple(map(slot_of, inputs)),
            (slots[outputs[0]],) if len(outputs) == 1 else tuple(map(slot_of, outputs)),
            type(io[1]) is str,
            unguarded,
            switch,
            contract,
            lends_only and not unguarded and switch is None and contract is None and not in_out,
            function if has_node else None,
            in_out,
            None,
        ))  # fmt: skip


# For large graphs: half the time of Step(...).
_new_step: Final[Callable[[Iterable[Any]], Step]] = partial(tuple.__new__, Step)
