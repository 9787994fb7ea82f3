"""Runs that are repeated, each written out as one Python function and compiled.

The engine's loop looks up, for every function, which slots it reads and how many values it makes. A run that is
repeated is written out as one Python function instead, and compiled. Its source is made of slot and step numbers only:
names and values of the user never enter it. Calls into EPypes are written out too: after a function that has filled
the caches with an image, each costs some microseconds.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from sys import getrefcount
from time import perf_counter_ns
from types import BuiltinFunctionType
from typing import Any, Final, NoReturn

from epypes.run.call import StepFailed, call, unpack
from epypes.run.draft import is_unchanged
from epypes.run.guard import ARRAYLESS, FRESH, FRESH_HERE, HARMLESS, LONG, array_type, keep, lend
from epypes.run.program import Program, Step, count_call, is_its_func

# Runs its steps on values by slot, and gives nanoseconds by step; -1, or none, for those that did not run. A rerun is
# given the new values of the source tokens too.
CompiledRun = Callable[[list[Any]], Mapping[int, int] | Sequence[int]]
CompiledRerun = Callable[[list[Any], Iterable[Any]], Mapping[int, int]]

# Marks the frames of compiled runs; the program that they run is among their globals.
FILE_NAME: Final = "<epypes: a compiled run>"

# Compiling takes some 40 us per function, once: worth it for what is repeated, and a pause below 20 ms.
_RUNS_BEFORE: Final = 3
_MOST_STEPS: Final = 400
_MOST_KEPT: Final = 64
_MOST_COUNTED: Final = 1_000


def _failed(program: Program, error: BaseException, duration_ns: int, found: Mapping[str, Any]) -> NoReturn:
    """Raise StepFailed for the step that was under way.

    ``found`` are the local variables: ``d3`` is how long step 3 took, and missing or -1 if it has not ended; ``c3``
    whether slot 3 has got a new value; ``at`` is the step under way, ``start`` when it called its function, or 0.
    """
    function = program.steps[found["at"]].function
    if duration_ns and is_its_func(function):
        count_call(function, duration_ns)
    failed = error if isinstance(error, StepFailed) else StepFailed(found["at"], error, duration_ns)
    numbered = [(name[0], int(name[1:]), value) for name, value in found.items() if name[1:].isdigit()]
    failed.done_ns = {number: spent for letter, number, spent in numbered if letter == "d"}
    failed.new = {number for letter, number, is_new in numbered if letter == "c" and is_new}
    raise failed from None


# What the source refers to besides the program and the functions.
_NAMES: Final = {
    "failed": _failed,
    "clock": perf_counter_ns,
    "kind": type,
    "count": getrefcount,
    "ARRAYLESS": ARRAYLESS,
    "HARMLESS": HARMLESS,
    "LONG": LONG,
    "FRESH": FRESH,
    "FRESH_HERE": FRESH_HERE,
    "lend": lend,
    "keep": keep,
    "call": call,
    "unpack": unpack,
    "is_unchanged": is_unchanged,
}


class CompiledRuns:
    """The compiled runs of a program, each made when it has been repeated.

    Parameters
    ----------
    program
        What is run.
    plain
        The tokens whose values hold no arrays in any of these runs.

    Attributes
    ----------
    whole
        The run of every step, as soon as there is one; never in a graph with switches or nested pipelines.
    """

    __slots__ = ("_compiled", "_counts", "_plain", "_program", "whole")

    def __init__(self, program: Program, plain: Iterable[str]) -> None:
        self._program = program
        self._plain = frozenset(program.slots[token] for token in plain)
        self.whole: CompiledRun | None = None
        self._counts: Counter[Hashable] = Counter()
        self._compiled: dict[Hashable, Any] = {}

    def of_steps(self, wanted: bytes | None) -> CompiledRun | None:
        """Return the run of the wanted steps, all of them for None, from values of source tokens.

        None if it has not been repeated enough.
        """
        compiled: CompiledRun | None = self._compiled.get(wanted)
        if compiled is None and self._is_worth_it(wanted):
            steps = [step for step in self._program.steps if wanted is None or wanted[step.place]]
            compiled = self._compiled[wanted] = compile_run(self._program, steps, self._plain)
            if wanted is None and not self._program.switches and not self._program.revised:
                self.whole = compiled
        return compiled

    def of_changes(self, tokens: Collection[str]) -> CompiledRerun | None:
        """Return the rerun of what depends on these source tokens, where everything else is up to date.

        It is given their values in this order.

        None if it has not been repeated enough, or the graph has switches, which decide what depends on what.
        """
        (key,) = tokens if len(tokens) == 1 else (tuple(tokens),)
        compiled: CompiledRerun | None = self._compiled.get(key)
        if compiled is None and not self._program.switches and self._is_worth_it(key):
            program = self._program
            slots = [program.slots[token] for token in tokens]
            readers = {index for slot in slots for index in program.consumers[slot]}
            steps = [program.steps[index] for index in sorted(program.downstream(readers, ()))]
            compiled = self._compiled[key] = compile_run(program, steps, self._plain, slots)
        return compiled

    def _is_worth_it(self, key: Hashable) -> bool:
        if len(self._counts) > _MOST_COUNTED:
            self._counts.clear()
        self._counts[key] += 1
        if self._counts[key] <= _RUNS_BEFORE or len(self._program.steps) > _MOST_STEPS:
            return False
        if len(self._compiled) >= _MOST_KEPT:
            self._compiled.clear()
            self._counts.clear()
        return True


def compile_run(program: Program, steps: list[Step], plain: Collection[int], changed: Collection[int] = ()) -> Any:
    """Write out and compile a run.

    Parameters
    ----------
    steps
        What to run, in run order.
    plain
        The slots whose values hold no arrays.
    changed
        The slots that get new values; then a step is passed over if nothing that it reads turns out to be new.
        Empty if every step is to be run.

    Returns
    -------
    CompiledRun or CompiledRerun
        A rerun if there are ``changed`` slots.
    """
    # The new values of a rerun are stored first.
    parameters, stored = (
        ("v, given", [f"{', '.join(f'v[{slot}]' for slot in changed)}, = given"]) if changed else ("v", [])
    )
    lines = [
        f"def make(program, steps, {', '.join(_NAMES)}, array):",
        *(f"    f{step.place} = steps[{step.place}].function" for step in steps),
        f"    def run({parameters}):",
        *(f"        {line}" for line in stored),
        "        at = start = 0",
        "        try:",
        *(f"            {line}" for line in _body(program, steps, plain, set(changed))),
        "        except BaseException as error:",
        "            failed(program, error, start and clock() - start, locals())",
        "    return run",
    ]
    names: dict[str, Any] = {"program": program}
    exec(compile("\n".join(lines), FILE_NAME, "exec"), names)  # noqa: S102 - made of numbers only
    return names["make"](program, program.steps, *_NAMES.values(), array_type())


def _body(program: Program, steps: list[Step], plain: Collection[int], changed: set[int]) -> Iterator[str]:
    """Write out the steps: ``v[3]`` is the value in slot 3, ``c3`` whether it is new, ``f2`` the function of step 2."""
    read = {slot for step in steps for slot in step.inputs}
    known: set[int] = set()
    locked: set[int] = set()
    for step in steps:
        is_certain = not changed or not changed.isdisjoint(step.inputs)
        new = [] if is_certain else [slot for slot in step.inputs if slot in known]
        checked = [slot for slot in step.outputs if changed and slot in read]
        lines = [f"at = {step.place}", "start = 0", *_call(program, step, plain, locked)]
        for place, slot in enumerate(step.outputs):
            given = _given(step, changed, known) if slot in checked else None
            lines += _store(slot, "made" if step.single else f"made[{place}]", given)
        lines.append(f"d{step.place} = spent")
        if _is_direct(program, step):
            # As count_call does, which would be a call into cold code.
            lines += [f"f{step.place}.duration_ns = spent", f"f{step.place}.run_count = f{step.place}.next_count()"]
        if step.switch is None:
            locked.update(step.outputs)
        if new:
            yield f"d{step.place} = -1"
            yield from (f"c{slot} = False" for slot in checked)
            yield f"if {' or '.join(f'c{slot}' for slot in dict.fromkeys(new))}:"
            lines = [f"    {line}" for line in lines]
        yield from lines
        known.update(checked)
    if len(steps) == len(program.steps) and not changed:
        yield f"return ({''.join(f'd{step.place}, ' for step in steps)})"
    else:
        yield f"return {{{', '.join(f'{step.place}: d{step.place}' for step in steps)}}}"


def _call(program: Program, step: Step, plain: Collection[int], locked: Collection[int]) -> Iterator[str]:
    """Write out the call of a step; the slots in ``locked`` hold what ``keep`` gave."""
    if not _is_written_out(program, step):
        yield f"made, spent = call(program, steps[{step.place}], v)"
        if step.single:
            yield "made = made[0]"
        return
    args = []
    for place, slot in enumerate(step.inputs):
        if not program.guard or slot in plain:
            args.append(f"v[{slot}]")
            continue
        args.append(f"a{place}")
        yield f"a{place} = v[{slot}]"
        if slot in locked and only_reads_arrays(step.function):
            yield from _lend_all_but_arrays(f"a{place}")
        else:
            yield from _lend(f"a{place}", is_locked=slot in locked)
    yield "start = clock()"
    function = f"f{step.place}.func" if _is_direct(program, step) else f"f{step.place}"
    yield f"made = {function}({', '.join(args)})"
    yield "spent = clock() - start"
    if step.single and program.guard:
        yield from _keep("made", program, step.outputs[0])
    elif not step.single:
        yield from _unpack(program, step)


def _is_written_out(program: Program, step: Step) -> bool:
    return not program.check_mutation and step.switch is None and not step.unguarded and step.contracts is None


def _is_direct(program: Program, step: Step) -> bool:
    """Whether what a node stands for is called in its place."""
    return _is_written_out(program, step) and is_its_func(step.function)


def _unpack(program: Program, step: Step) -> Iterator[str]:
    """Write out ``unpack``, for a tuple of as many values as there are output tokens."""
    count = len(step.outputs)
    items = [f"m{place}" for place in range(count)]
    if not step.outputs:
        return
    yield f"if kind(made) is tuple and len(made) == {count} and count(made) <= FRESH_HERE:"
    yield f"    {', '.join(items)}, = made"
    yield "    made = None"  # so that it does not count as one who knows the items
    for item, slot in zip(items, step.outputs, strict=True):
        if program.guard:
            yield from (f"    {line}" for line in _keep(item, program, slot))
    yield f"    made = {', '.join(items)},"
    yield f"else: made = unpack(program, steps[{step.place}], made, v)"


def _lend(name: str, is_locked: bool) -> Iterator[str]:
    """Write out ``lend``, for what it does to most values; the view of a locked array is locked."""
    yield f"k = kind({name})"
    yield "if k not in ARRAYLESS:"
    yield "    if k is array:"
    yield f"        {name} = {name}.view()"
    if not is_locked:
        yield f"        {name}.setflags(False)"
    yield f"    elif {_may_hold_arrays(name)}:"
    yield f"        {name} = lend({name})"


def _lend_all_but_arrays(name: str) -> Iterator[str]:
    """Write out ``lend`` for a function that can be given a locked array as it is stored."""
    yield f"k = kind({name})"
    yield f"if k not in ARRAYLESS and k is not array and {_may_hold_arrays(name)}:"
    yield f"    {name} = lend({name})"


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


def _keep(name: str, program: Program, slot: int) -> Iterator[str]:
    """Write out ``keep``, for what it does to most values; an array that no function reads need not be locked."""
    yield f"k = kind({name})"
    yield "if k not in ARRAYLESS:"
    yield f"    if k is array and {name}.base is None and count({name}) <= FRESH_HERE:"
    yield f"        {name}.setflags(False)" if program.consumers[slot] else "        pass"
    yield f"    elif {_may_hold_arrays(name)}:"
    yield f"        {name} = keep({name}, FRESH, program, {slot}, v)"


def _may_hold_arrays(name: str) -> str:
    return f"(k is not tuple or len({name}) < LONG or kind({name}[0]) not in HARMLESS)"


def _given(step: Step, changed: Collection[int], known: Collection[int]) -> str:
    """Write out the values that a step read and that are not new."""
    old = [slot for slot in step.inputs if slot not in changed]
    return "".join(f"None if c{slot} else v[{slot}], " if slot in known else f"v[{slot}], " for slot in old)


def _store(slot: int, made: str, given: str | None) -> Iterator[str]:
    """Write out how a value is stored, and, with what was ``given``, whether it is new."""
    if given is None:
        yield f"v[{slot}] = {made}"
        return
    yield f"c{slot} = not is_unchanged(v[{slot}], {made}, ({given}), program.guard)"
    yield f"if c{slot}: v[{slot}] = {made}"
