"""How is a run as fast as hand-written code?

The engine's loop looks up, for every function, which slots it reads and how many values it makes. A run that is
repeated is written out as one Python function instead, and compiled. Its source is made of slot and step numbers only:
names and values of the user never enter it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Collection, Hashable, Iterator
from time import perf_counter_ns
from typing import Any, Final, NoReturn

from epypes.run.call import StepFailed, call, unpack
from epypes.run.draft import is_unchanged
from epypes.run.guard import ARRAYLESS, FRESH, keep, lend
from epypes.run.program import Program, Step

# Runs its steps on values by slot, and gives nanoseconds by step that ran; raises StepFailed.
CompiledRun = Callable[[list[Any], dict[int, int]], None]

# Compiling takes some 40 us per function, once: worth it for what is repeated, and a pause below 20 ms.
_RUNS_BEFORE: Final = 3
_MOST_STEPS: Final = 400
_MOST_KEPT: Final = 64


class CompiledRuns:
    """The compiled runs of a program, each made when it has been repeated."""

    __slots__ = ("_compiled", "_counts", "_program")

    def __init__(self, program: Program) -> None:
        self._program = program
        self._counts: Counter[Hashable] = Counter()
        self._compiled: dict[Hashable, CompiledRun] = {}

    def of_steps(self, wanted: bytes | None) -> CompiledRun | None:
        """Return the run of the wanted steps, all of them for None, from values of source tokens.

        None if it has not been repeated enough.
        """
        compiled = self._compiled.get(wanted)
        if compiled is None and self._is_worth_it(wanted):
            steps = [step for step in self._program.steps if wanted is None or wanted[step.place]]
            compiled = self._compiled[wanted] = compile_run(self._program, steps, ())
        return compiled

    def of_changes(self, tokens: tuple[str, ...]) -> CompiledRun | None:
        """Return the rerun of what depends on these source tokens, where everything else is up to date.

        None if it has not been repeated enough, or the graph has switches, which decide what depends on what.
        """
        compiled = self._compiled.get(tokens)
        if compiled is None and not self._program.switches and self._is_worth_it(tokens):
            program = self._program
            slots = [program.slots[token] for token in tokens]
            readers = {index for slot in slots for index in program.consumers[slot]}
            steps = [program.steps[index] for index in sorted(program.downstream(readers, ()))]
            compiled = self._compiled[tokens] = compile_run(program, steps, slots)
        return compiled

    def _is_worth_it(self, key: Hashable) -> bool:
        self._counts[key] += 1
        if self._counts[key] <= _RUNS_BEFORE or len(self._program.steps) > _MOST_STEPS:
            return False
        if len(self._compiled) >= _MOST_KEPT:
            self._compiled.clear()
            self._counts.clear()
        return True


def compile_run(program: Program, steps: list[Step], changed: Collection[int]) -> CompiledRun:
    """Write out and compile a run.

    Parameters
    ----------
    steps
        What to run, in run order.
    changed
        The slots that have new values; then a step is passed over if nothing that it reads turns out to be new.
        Empty if every step is to be run.
    """
    lines = [
        "def make(program, steps, failed, clock, kind, ARRAYLESS, FRESH, lend, keep, call, unpack, is_unchanged):",
        *(f"    f{step.place} = steps[{step.place}].function" for step in steps),
        "    def run(v, d):",
        "        at = 0",
        "        start = clock()",
        "        try:",
        *(f"            {line}" for line in _body(program, steps, set(changed))),
        "        except BaseException as error:",
        "            failed(at, error, clock() - start)",
        "    return run",
    ]
    names: dict[str, Any] = {}
    exec(compile("\n".join(lines), "<epypes: a compiled run>", "exec"), names)  # noqa: S102 - made of numbers only
    run: CompiledRun = names["make"](
        program, program.steps, _failed, perf_counter_ns, type, ARRAYLESS, FRESH, lend, keep, call, unpack, is_unchanged
    )
    return run


def _failed(index: int, error: BaseException, duration_ns: int) -> NoReturn:
    raise (error if isinstance(error, StepFailed) else StepFailed(index, error, duration_ns)) from None


def _body(program: Program, steps: list[Step], changed: set[int]) -> Iterator[str]:
    """Write out the steps: ``v[3]`` is the value in slot 3, ``c3`` whether it is new, ``f2`` the function of step 2."""
    read = {slot for step in steps for slot in step.inputs}
    known: set[int] = set()
    locked: set[int] = set()
    for step in steps:
        is_certain = not changed or not changed.isdisjoint(step.inputs)
        new = [] if is_certain else [slot for slot in step.inputs if slot in known]
        lines = [f"at = {step.place}", *_call(program, step, locked)]
        checked = [slot for slot in step.outputs if changed and slot in read]
        for place, slot in enumerate(step.outputs):
            lines += _store(step, slot, "made" if step.single else f"made[{place}]", slot in checked)
        if step.switch is None:
            locked.update(step.outputs)
        if new:
            yield from (f"c{slot} = False" for slot in checked)
            yield f"if {' or '.join(f'c{slot}' for slot in dict.fromkeys(new))}:"
            lines = [f"    {line}" for line in lines]
        yield from lines
        known.update(checked)
    yield "pass"


def _call(program: Program, step: Step, locked: set[int]) -> Iterator[str]:
    """Write out the call of a step; the slots in ``locked`` hold what ``keep`` gave."""
    if step.switch is not None or step.unguarded or step.contracts is not None:
        yield f"made, d[{step.place}] = call(program, steps[{step.place}], v)"
        if step.single:
            yield "made = made[0]"
        return
    args = []
    for place, slot in enumerate(step.inputs):
        args.append(f"a{place}")
        yield f"a{place} = v[{slot}]"
        if program.guard and not (step.is_builtin and slot in locked):
            yield f"if kind(a{place}) not in ARRAYLESS: a{place} = lend(a{place})"
    yield "start = clock()"
    yield f"made = f{step.place}({', '.join(args)})"
    yield "end = clock()"
    if not step.single:
        yield f"made = unpack(program, steps[{step.place}], made)"
    elif program.guard:
        yield "if kind(made) not in ARRAYLESS: made = keep(made, FRESH)"
    yield f"d[{step.place}] = end - start"


def _store(step: Step, slot: int, made: str, is_checked: bool) -> Iterator[str]:
    """Write out how a value is stored, and whether it is new."""
    if not is_checked:
        yield f"v[{slot}] = {made}"
        return
    given = "".join(f"v[{slot}], " for slot in step.inputs)
    yield f"c{slot} = not is_unchanged(v[{slot}], {made}, ({given}), program.guard)"
    yield f"if c{slot}: v[{slot}] = {made}"
