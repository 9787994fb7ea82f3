"""How are the functions that must run, run one after another?"""

from __future__ import annotations

from epypes.run.call import call
from epypes.run.draft import Draft


def execute_from_scratch(draft: Draft, wanted: bytes | None, durations_ns: dict[int, int]) -> None:
    """Run the wanted steps, all for None, where none has been run before: as ``execute`` does, with less to ask."""
    program, values, dirty = draft.program, draft.values, draft.dirty
    steps = program.steps if wanted is None else [step for step in program.steps if wanted[step.place]]
    for step in steps:
        place, outputs = step.place, step.outputs
        made, durations_ns[place] = call(program, step, values)
        dirty[place] = 0
        if len(outputs) == 1:
            values[outputs[0]] = made[0]
        else:
            for slot, value in zip(outputs, made, strict=True):
                values[slot] = value


def execute(draft: Draft, wanted: bytes | None, durations_ns: dict[int, int]) -> None:
    """Run the dirty steps in run order, those included that become dirty on the way.

    Parameters
    ----------
    draft
        Is changed.
    wanted
        By step, 1 for those that may run; all of them for None.
    durations_ns
        Gets the nanoseconds of each step that ran.

    Raises
    ------
    StepFailed
        A function raised, or returned the wrong number of values.
    """
    program, values, dirty, store = draft.program, draft.values, draft.dirty, draft.store
    steps, next_dirty = program.steps, dirty.find
    # What depends on a step comes after it, so one pass over the flags finds everything.
    index = next_dirty(1)
    while index >= 0:
        if wanted is None or wanted[index]:
            step = steps[index]
            made, durations_ns[index] = call(program, step, values)
            store(step, made)
        index = next_dirty(1, index + 1)
