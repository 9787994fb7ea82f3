"""Running steps: compiled where a run repeats, one by one otherwise, in threads where the last times say that they pay.

All three ways change one `TokenManager` and one list of durations by step, so what is left of a run that fails is the
same in each. The step that is being run is written down before its inputs are read. A compiled run ends at the first
step that is given Nothing, before it is called; the loop goes on from there. So the compiled run need not look for it.
"""

from __future__ import annotations

import heapq
import sys
import threading
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextvars import copy_context
from functools import partial
from graphlib import TopologicalSorter
from sys import getrefcount
from time import perf_counter_ns
from types import BuiltinFunctionType
from typing import Any, Final

from epypes.nothing import Nothing, NothingGiven, NothingType
from epypes.run.call import call, unpack
from epypes.run.guard import (
    ARRAYLESS,
    FRESH,
    FRESH_HERE,
    FRESH_OWNER,
    HARMLESS,
    LONG,
    array_type,
    keep,
    lend,
)
from epypes.run.program import Program, Step
from epypes.run.staleness import TokenManager, is_unchanged, with_new_input
from epypes.run.timing import longest_path_ns
from epypes.tracebacks import HIDE

# Runs steps, and writes nanoseconds by step. What a step raises is raised; it is the step ``tokens.running``.
Way = Callable[[TokenManager], None]

# Tokens whose values hold no arrays, wanted steps, steps that were dirty before, and changed source tokens.
Key = tuple[frozenset[str], bytes | None, bytes | None, tuple[str, ...]]

# Compiling takes 120 to 180 us per function, once: worth it for what is repeated, and a pause of 50 ms at most.
RUNS_BEFORE: Final = 3
_MAX_STEPS: Final = 400
_MAX_COMPILED: Final = 64
_MAX_COUNTED: Final = 1_000
# What threads must gain at best: the start and waking of two, and a tenth of the whole.
_MIN_GAIN_NS: Final = 200_000
_MIN_SHARE: Final = 0.1
_TRIALS: Final = 3
_TRY_AGAIN_AFTER: Final = 201
LOOK_AGAIN_AFTER: Final = 100


class Executor:
    """Chooses the way in which the steps of a program are run.

    Parameters
    ----------
    program
        What is run.
    workers
        How many steps may run at once.

    Attributes
    ----------
    ways
        Those that are known.
    """

    def __init__(self, program: Program, workers: int) -> None:
        self._program, self._workers = program, workers
        self._counts: Counter[Key] = Counter()
        self._compiled: dict[Key, Way] = {}
        # Types of values by slot, as the last run had them that was not compiled.
        self._kinds: list[type] = []
        # Checked for changes to their inputs, functions that share one run one after another.
        self._may_use_threads = workers > 1 and not program.check_mutation and has_independent_steps(program)
        self.ways = {} if self._may_use_threads else self._compiled

    def way(self, key: Key, tokens: TokenManager) -> Way:
        """Return the way to run what has such a key: the dirty steps, and those that become dirty meanwhile.

        Parameters
        ----------
        key
            What it is kept by.
        tokens
            As they are before the run.
        """
        if not self._may_use_threads:
            return self._compile(key, tokens) or self._one_by_one
        if len(self.ways) >= _MAX_COMPILED:
            self.ways.clear()
        self.ways[key] = way = Gain(self._program, self._workers, partial(self._in_turn, key)).run
        return way

    def _in_turn(self, key: Key, tokens: TokenManager) -> None:
        """Run the dirty steps on this thread."""
        __tracebackhide__ = True
        (self._compiled.get(key) or self._compile(key, tokens) or self._one_by_one)(tokens)

    def _one_by_one(self, tokens: TokenManager) -> None:
        """Run the dirty steps one by one, and learn the types of the values."""
        __tracebackhide__ = True
        run_one_by_one(tokens)
        if len(self._program.steps) <= _MAX_STEPS:
            kinds = [*map(type, tokens.values)]
            if self._program.has_skipped and self._kinds:
                # Of what is Nothing now, the type that it had before.
                pairs = zip(self._kinds, kinds, strict=True)
                kinds = [before if kind is NothingType else kind for before, kind in pairs]
            self._kinds = kinds

    def _compile(self, key: Key, tokens: TokenManager) -> Way | None:
        """Return the compiled run of the dirty steps; None if it has not been repeated enough."""
        program = self._program
        if len(program.steps) > _MAX_STEPS or (program.switches and tokens.origin is not None):
            return None
        if len(self._counts) > _MAX_COUNTED:
            self._counts.clear()
        self._counts[key] += 1
        if self._counts[key] <= RUNS_BEFORE:
            return None
        if len(self._compiled) >= _MAX_COMPILED:
            self._compiled.clear()
            self._counts.clear()
        self._compiled[key] = made = _Source(tokens, [program.slots[token] for token in key[0]], self._kinds).compile()
        return made


# -- one by one -------------------------------------------------------------------------------------------------------


def run_one_by_one(tokens: TokenManager) -> None:
    """Run the dirty steps that are wanted, in run order."""
    __tracebackhide__ = True
    program, values, wanted, next_dirty = tokens.program, tokens.values, tokens.wanted, tokens.begin().dirty.find
    steps, store, durations_ns = program.steps, tokens.store, tokens.durations_ns
    # What depends on a step comes after it, so one pass over the flags finds everything.
    place = next_dirty(1)
    while place >= 0:
        if wanted is None or wanted[place]:
            tokens.running = place
            step = steps[place]
            try:
                made = call(program, step, values, durations_ns)
            except NothingGiven:
                made = None
            store(step, made)
        place = next_dirty(1, place + 1)


def go_on_one_by_one(tokens: TokenManager) -> None:
    """Run the dirty steps that a compiled run has not come to, which was given Nothing."""
    __tracebackhide__ = True
    durations_ns = tokens.durations_ns
    tokens.dirty = bytes(left and at not in durations_ns for at, left in enumerate(tokens.dirty))
    # What was new to any step is not known: a compiled run does not write it down.
    tokens.changed = ()
    if tokens.origin is not None:
        tokens.origin = tokens.program.all_steps
    run_one_by_one(tokens)


# -- compiled ---------------------------------------------------------------------------------------------------------

# What the source refers to besides the program and the functions.
_NAMES: Final = {
    "clock": perf_counter_ns,
    "kind": type,
    "count": getrefcount,
    "ARRAYLESS": ARRAYLESS,
    "HARMLESS": HARMLESS,
    "FRESH": FRESH,
    "lend": lend,
    "keep": keep,
    "call": call,
    "unpack": unpack,
    "is_unchanged": is_unchanged,
    "go_on": go_on_one_by_one,
    "Nothing": Nothing,
    "NothingGiven": NothingGiven,
    "with_new_input": with_new_input,
}
_FREQUENT: Final = ("clock", "kind", "count", "array", "HARMLESS")


class _Source:
    """The source of a repeated run, written out as one Python function.

    It is made of slot and step numbers only: names and values of the user never enter it. ``v[3]`` is the value in slot
    3, ``d[2]`` the duration of step 2, ``D[2]`` whether it is dirty, ``f2`` its function; ``c3`` whether slot 3 has got
    a new value, ``h3`` whether that is a long tuple without arrays. Calls into EPypes are written out for values of the
    types that the last run had, since each costs some microseconds after a function that has filled the caches with an
    image; any other value takes the general way.

    Parameters
    ----------
    tokens
        As they are before the run.
    plain
        The slots of hyperparameters that hold no arrays.
    kinds
        A guess of the types by slot; empty if there is none.
    """

    def __init__(self, tokens: TokenManager, plain: Collection[int], kinds: Sequence[type]) -> None:
        self._program = program = tokens.program
        self._plain, self._is_first = frozenset(plain), tokens.origin is None
        self._array, self._kinds = array_type(), kinds
        self._certain = bytes(tokens.begin().dirty)
        self._carried = tokens.origin or b""
        self._changed = {program.settable[token] for token in tokens.changed}
        wanted = tokens.wanted
        stale = program.downstream((place for place, dirty in enumerate(self._certain) if dirty), ())
        self._steps = [program.steps[place] for place in sorted(stale) if wanted is None or wanted[place]]
        # Whether what is dirty depends on what steps make; if not, or if all steps run, it is known what is left.
        self._has_flags = not all(self._certain[place] for place in stale)
        self._is_known = wanted is None or not self._has_flags
        places = {step.place for step in self._steps}
        self._left = bytes(dirty and place not in places for place, dirty in enumerate(self._certain))
        # Slots of which the source knows whether they are new, and those of which it knows whether their values, made
        # in this run, are long tuples without arrays.
        self._known: set[int] = set()
        self._made: set[int] = set()

    def compile(self) -> Way:
        """Return the function that runs the steps."""
        inside = self._program.inside
        lines = [
            f"def make(program, steps, {', '.join(_NAMES)}, array, dirty, left):",
            *(f"    f{step.place} = steps[{step.place}].function" for step in self._steps),
            # As arguments they stand side by side in the frame: each variable of ``make`` is an object of its own.
            f"    def run(t, {', '.join(f'{name}={name}' for name in _FREQUENT)}, {HIDE}=True):",
            "        start = 0; v = t.values; d = t.durations_ns",
            "        D = t.dirty = bytearray(dirty)" if self._has_flags else "        t.dirty = dirty",
            "        try:",
            *(
                f"            {line}"
                for slot in (sorted(self._changed & inside.keys()) if inside else ())
                for line in self._renew(slot)
            ),
            *(f"            {line}" for line in self._lend_sources()),
            *(f"            {line}" for step in self._steps for line in self._step(step)),
            "            t.dirty = left" if self._is_known else "            pass",
            "            return",
            "        except NothingGiven: pass",
            "        except BaseException:",
            "            if start: d[t.running] = clock() - start",
            "            raise",
            "        go_on(t)",
            "    return run",
        ]
        names: dict[str, Any] = {"__name__": __name__}
        exec(compile("\n".join(lines), "<epypes: a compiled run>", "exec"), names)  # noqa: S102 - numbers only
        run: Way = names["make"](
            self._program, self._program.steps, *_NAMES.values(), self._array, self._certain, self._left
        )
        return run

    def _lend_sources(self) -> Iterator[str]:
        """Lend the arrays of source tokens one after another, while the code that does it is in the caches."""
        for step in self._steps:
            slots = [slot for slot in step.inputs if self._is_lent_first(step, slot)]
            if slots:
                yield f"t.running = {step.place}"
            for slot in dict.fromkeys(slots):
                yield f"s{step.place}_{slot} = v[{slot}]"
                yield from self._lend(step, f"s{step.place}_{slot}", slot)

    def _is_lent_first(self, step: Step, slot: int) -> bool:
        is_array = self._program.makers[slot] < 0 and slot not in self._plain and self._kind(slot) is self._array
        return is_array and self._is_written_out(step) and self._program.guard and bool(self._certain[step.place])

    def _is_written_out(self, step: Step) -> bool:
        program = self._program
        return step.is_plain or not (
            step.nested or program.guard or step.contracts or program.check_mutation or step.switch is not None
        )

    def _step(self, step: Step) -> Iterator[str]:
        checked = [] if self._is_first else [slot for slot in step.outputs if self._program.consumers[slot]]
        lines = [f"t.running = {step.place}", *self._call(step)]
        for place, slot in enumerate(step.outputs):
            if slot in checked:
                lines += [
                    f"c{slot} = not is_unchanged(v[{slot}], m{place}, ({self._given(step)}), program.guard)",
                    f"if c{slot}:",
                    f"    v[{slot}] = m{place}",
                ]
                if slot in self._program.inside:
                    lines += (f"    {line}" for line in self._renew(slot))
                if self._has_flags:
                    lines.append(f"    {' = '.join(f'D[{reader}]' for reader in self._program.consumers[slot])} = 1")
            else:
                lines.append(f"v[{slot}] = m{place}")
        if self._has_flags:
            lines.append(f"D[{step.place}] = 0")
        if not self._certain[step.place]:
            yield from (f"c{slot} = False" for slot in checked)
            yield from (f"h{slot} = False" for slot in step.outputs if slot in self._made)
            yield f"if D[{step.place}]:"
            lines = [f"    {line}" for line in lines]
        yield from lines
        self._known.update(checked)

    def _renew(self, slot: int) -> list[str]:
        """Write out that nested pipelines have a new input."""
        return [f"v[{run}] = with_new_input(v[{run}], {slot})" for run in self._program.inside[slot]]

    def _given(self, step: Step) -> str:
        """Write out the values that a step read and that are not new; none if it is not known what was new to it."""
        if self._carried[step.place]:
            return ""
        old = [slot for slot in step.inputs if slot not in self._changed]
        return "".join(f"None if c{slot} else v[{slot}], " if slot in self._known else f"v[{slot}], " for slot in old)

    def _call(self, step: Step) -> Iterator[str]:
        """Write out the call of a step, whose values are then ``m0``, ``m1`` and so on."""
        program, made = self._program, [f"m{place}" for place in range(len(step.outputs))]
        if not self._is_written_out(step):
            yield "start = 0"
            yield f"{''.join(f'{name}, ' for name in made) or '_'} = call(program, steps[{step.place}], v, d)"
            return
        args = [f"v[{slot}]" for slot in step.inputs]
        if not program.guard and (asked := self._may_be_nothing(step)):
            # Nothing else looks at the inputs.
            yield f"if {' or '.join(f'v[{slot}] is Nothing' for slot in asked)}: start = 0; raise NothingGiven"
        for place, slot in enumerate(step.inputs):
            if self._is_lent_first(step, slot) and step.inputs.index(slot) == place:
                args[place] = f"s{step.place}_{slot}"
            elif program.guard and slot not in self._plain:
                args[place] = name = f"a{place}"
                yield f"start = 0; {name} = v[{slot}]"
                yield from self._lend(step, name, slot)
        yield "start = clock()"
        function = f"f{step.place}" if step.node is None else f"f{step.place}.func"
        yield f"{'m0' if step.single else 'made'} = {function}({', '.join(args)})"
        yield f"d[{step.place}] = clock() - start"
        if not step.single and step.outputs:
            names = "".join(f"{name}, " for name in made)
            yield f"if kind(made) is tuple and len(made) == {len(made)} and count(made) <= {FRESH_HERE}:"
            yield f"    {names} = made"
            yield "    made = None"  # so that it does not count as one that knows the items
            if program.guard:
                for name, slot in zip(made, step.outputs, strict=True):
                    yield from (f"    {line}" for line in self._keep(name, slot))
            unknown = "".join(f"h{slot} = " for slot in step.outputs if slot in self._made)
            yield f"else: {unknown and unknown + 'False; '}{names} = unpack(program, steps[{step.place}], made, v)"
        elif program.guard and step.outputs:
            yield from self._keep("m0", step.outputs[0])

    def _may_be_nothing(self, step: Step) -> list[int]:
        return [slot for slot in step.inputs if slot not in self._plain and slot < len(self._program.slots)]

    def _kind(self, slot: int) -> type:
        return self._kinds[slot] if self._kinds else object

    def _lend(self, step: Step, name: str, slot: int) -> Iterator[str]:
        """Write out ``lend``: what `keep` has locked needs no lock, and a function that only reads no view."""
        maker = self._program.makers[slot]
        is_locked = maker >= 0 and self._program.steps[maker].switch is None
        kind = self._kind(slot)
        if (
            kind is self._array
            and is_locked
            and only_reads_arrays(step.function if step.node is None else step.node.func)
        ):
            yield f"if kind({name}) is not array: {name} = lend({name})"
        elif kind is self._array and is_locked:
            yield f"{name} = {name}.view() if kind({name}) is array else lend({name})"
        elif kind is self._array:
            yield f"if kind({name}) is array:"
            yield f"    {name} = {name}.view()"
            yield f"    {name}.setflags(False)"
            yield f"else: {name} = lend({name})"
        elif kind is tuple and slot in self._made:
            yield f"if not h{slot}: {name} = lend({name})"
        elif kind is tuple:
            yield f"if not ({_is_harmless(name, kind)}): {name} = lend({name})"
        elif kind is list:
            yield f"{name} = {name}.copy() if {_is_harmless(name, kind)} else lend({name})"
        else:
            yield f"if kind({name}) not in ARRAYLESS: {name} = lend({name})"

    def _keep(self, name: str, slot: int) -> Iterator[str]:
        """Write out ``keep``; an array that no function reads need not be locked."""
        kind, general = self._kind(slot), f"{name} = keep({name}, FRESH, program, {slot}, v)"
        if kind is self._array:
            owner = f"kind(b) is array and b.base is None and count(b) <= {FRESH_OWNER}"
            base = f"(b := {name}.base) is None or {owner}"
            yield f"if kind({name}) is array and count({name}) <= {FRESH_HERE} and ({base}):"
            yield f"    {name}.setflags(False)" if self._program.consumers[slot] else "    pass"
            yield f"else: {general}"
        elif kind is tuple:
            yield f"h{slot} = {_is_harmless(name, kind)}"
            yield f"if not h{slot}: {general}"
            self._made.add(slot)
        elif kind is list:
            yield f"if not ({_is_harmless(name, kind)} and count({name}) <= {FRESH_HERE}): {general}"
        else:
            yield f"if kind({name}) not in ARRAYLESS: {general}"


def _is_harmless(name: str, kind: type) -> str:
    """Write out whether a value is a long tuple or list without arrays, as its first item tells."""
    return f"kind({name}) is {kind.__name__} and len({name}) >= {LONG} and kind({name}[0]) in HARMLESS"


def only_reads_arrays(function: object) -> bool:
    """Whether a function can change nothing about a locked array: those of OpenCV, and universal functions.

    Other C functions can: setattr changes an array's shape.
    """
    numpy, cv2 = sys.modules.get("numpy"), sys.modules.get("cv2")
    if numpy is not None and type(function) is numpy.ufunc:
        return True
    if cv2 is None or type(function) is not BuiltinFunctionType or function.__self__ is not None:
        return False
    name = function.__name__
    if vars(cv2).get(name) is function:
        return True
    parts = [module for path, module in list(sys.modules.items()) if path.startswith("cv2.")]
    return any(getattr(module, name, None) is function for module in parts)


# -- in threads -------------------------------------------------------------------------------------------------------


class SideBySide:
    """One run in threads, up to ``workers`` steps at once; one worker is the caller's thread.

    If functions fail, the one that comes first in run order is the one that failed, as if they had run one after
    another: steps that come before it are run, and those that come after it leave no trace.

    The lock is held but for the calls of functions. Threads are made for one run, which takes 100 us each, and are
    daemons: the interpreter exits while a function never returns.
    """

    def __init__(self, tokens: TokenManager, workers: int) -> None:
        program, values, wanted = tokens.program, tokens.values, tokens.wanted
        tokens.begin().side_by_side = True
        self._tokens, self._durations_ns, self._workers = tokens, tokens.durations_ns, workers
        self._before = values.copy(), tokens.dirty.copy()
        # What each step has made; None if it was skipped.
        self._made: dict[int, Sequence[Any] | None] = {}
        self._failures: dict[int, BaseException] = {}
        self._calls: set[int] = set()
        self._is_over = False
        self._changed = threading.Condition()
        stale = program.downstream((place for place, dirty in enumerate(tokens.dirty) if dirty), values)
        steps = {place for place in stale if wanted is None or wanted[place]}
        self._count = len(steps)
        self._sorter = TopologicalSorter(
            {
                place: steps.intersection(
                    program.makers[slot] for slot in program.read_by(program.steps[place], values)
                )
                for place in steps
            }
        )
        self._sorter.prepare()
        self._ready = sorted(self._sorter.get_ready())

    def run(self) -> None:
        """Run all steps; raise what the first failed one in run order has raised."""
        __tracebackhide__ = True
        tokens = self._tokens
        for _ in range(min(self._workers, self._count) - 1):
            # numpy's errstate, for one, belongs to the context.
            threading.Thread(target=copy_context().run, args=(self._work,), name="epypes worker", daemon=True).start()
        try:
            self._work()
        except BaseException as exception:  # an interrupt while waiting; what the others still make is dropped
            self._failures[min(self._calls, default=0)] = exception
        with self._changed:
            self._is_over = True
            self._changed.notify_all()
        if self._failures:
            # Ctrl-C or an exit comes before what functions raise.
            failed_at = min(self._failures, key=lambda place: (isinstance(self._failures[place], Exception), place))
            reached = [tokens.program.steps[place].nested for place in (*self._made, failed_at) if place <= failed_at]
            runs = [(each.run, tokens.values[each.run]) for each in reached if each is not None]
            tokens.values[:], tokens.dirty[:] = self._before
            for place, made in sorted(self._made.items()):
                step = tokens.program.steps[place]
                if place > failed_at:
                    self._durations_ns.pop(place, None)
                else:
                    tokens.store(step, made)
            for place in self._failures:
                if place != failed_at:
                    self._durations_ns.pop(place, None)  # one that was interrupted while it ran has none
            for slot, run in runs:
                tokens.values[slot] = run
            tokens.running = failed_at
            raise self._failures[failed_at]

    def _work(self) -> None:
        """Call what is ready, the first in run order first, until nothing is left."""
        __tracebackhide__ = True
        with self._changed:
            while not self._is_over:
                if self._ready and not (self._failures and self._ready[0] > min(self._failures)):
                    self._call(heapq.heappop(self._ready))
                elif self._calls:
                    self._changed.wait()
                else:
                    break
            self._changed.notify_all()

    def _call(self, place: int) -> None:
        __tracebackhide__ = True
        tokens = self._tokens
        program, mark = tokens.program, _Call(place)
        step = program.steps[place]
        failure: BaseException | None = None
        made: Sequence[Any] | None = None
        self._calls.add(place)
        program.running.add(mark)
        self._changed.release()
        try:
            made = call(program, step, tokens.values, self._durations_ns)
        except NothingGiven:
            pass
        except BaseException as exception:
            failure = exception
        finally:
            self._changed.acquire()
            program.running.discard(mark)
        if self._is_over:
            return
        self._calls.discard(place)
        if failure is None:
            self._made[place] = made
            tokens.store(step, made)
            self._release(place)
        else:
            self._failures[place] = failure
            # After Ctrl-C or an exit nobody waits for the others.
            self._is_over = not isinstance(failure, Exception)
        if len(self._ready) > 1 or not self._calls:
            self._changed.notify_all()

    def _release(self, done: int) -> None:
        """Make ready what waited for a step alone; what is up to date after all is passed over."""
        passed = [done]
        while passed:
            self._sorter.done(*passed)
            ready = self._sorter.get_ready()
            passed = [place for place in ready if not self._tokens.dirty[place]]
            for place in ready:
                if self._tokens.dirty[place]:
                    heapq.heappush(self._ready, place)


class _Call:
    """One call in a thread, for ``program.running``."""

    def __init__(self, place: int) -> None:
        self.running = place


class Gain:
    """What threads gain for one set of steps.

    They pay where functions release the interpreter's lock and take longer than waking a thread. That can't be
    predicted, so it is tried: the first runs go one after another and are timed, the next ones side by side if there
    is something to be gained at best, and from then on the faster way is taken. Now and then the other is tried again.
    """

    def __init__(self, program: Program, workers: int, in_turn: Way) -> None:
        self._program, self._workers, self._in_turn = program, workers, in_turn
        self._one_by_one_ns: deque[int] = deque(maxlen=_TRIALS)
        self._side_by_side_ns: deque[int] = deque(maxlen=_TRIALS)
        self._is_promising = False
        self._asked = 0

    def run(self, tokens: TokenManager) -> None:
        """Run the steps in the way that seems to be the faster one."""
        __tracebackhide__ = True
        start_ns, side_by_side = perf_counter_ns(), self.is_worth_it()
        if side_by_side:
            SideBySide(tokens, self._workers).run()
        else:
            self._in_turn(tokens)
        self.learn(tokens.durations_ns, perf_counter_ns() - start_ns, side_by_side)

    def is_worth_it(self) -> bool:
        """Whether the next run should go side by side."""
        if not self._is_promising or len(self._one_by_one_ns) < _TRIALS:
            return False
        if len(self._side_by_side_ns) < _TRIALS:
            return True
        self._asked += 1
        is_faster = min(self._side_by_side_ns) < min(self._one_by_one_ns)
        return is_faster != (self._asked % _TRY_AGAIN_AFTER == 0)

    def learn(self, durations_ns: Mapping[int, int], total_ns: int, side_by_side: bool) -> None:
        """Take note of a run that has ended without a failure: nanoseconds by step, and in all."""
        if side_by_side:
            self._side_by_side_ns.append(total_ns)
            return
        self._asked += 1
        is_known = len(self._one_by_one_ns) >= _TRIALS
        if is_known and not self._is_promising and self._asked % LOOK_AGAIN_AFTER:
            return
        self._one_by_one_ns.append(total_ns)
        work_ns = sum(durations_ns.values())
        best_ns = max(longest_path_ns(self._program, durations_ns), work_ns // self._workers)
        self._is_promising = work_ns - best_ns > max(_MIN_GAIN_NS, _MIN_SHARE * total_ns)


def has_independent_steps(program: Program) -> bool:
    """Whether any two functions could run side by side."""
    return longest_path_ns(program, {step.place: 1 for step in program.steps}) < len(program.steps)
