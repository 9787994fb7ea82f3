"""How are steps run, timed and kept apart?"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from time import perf_counter_ns
from typing import Any, Final

from epypes.errors import OutputArityError
from epypes.run.failure import Failure
from epypes.run.guard import explain_write, is_array, read_only, writable
from epypes.run.program import Step
from epypes.run.tokens import TokenManager, is_same_value

# A note is one line that names the culprit, so a value in it is short.
_BRIEF: Final = 40


class StepFailed(BaseException):
    """A step raised; carries the Failure from the engine to the runner, which raises the user's exception."""

    def __init__(self, failure: Failure, step: Step) -> None:
        self.failure, self.step = failure, step


def execute(
    manager: TokenManager,
    order: Sequence[int],
    next_version: Callable[[], int],
    guard: bool,
    durations_ns: dict[str, int],
) -> None:
    """Run the steps of ``order`` whose inputs have changed; the others are left as they are.

    Parameters
    ----------
    manager
        Is changed.
    order
        Indices of steps, in run order.
    next_version
        Gives a version number that was never given before.
    guard
        Whether arrays are made read-only.
    durations_ns
        Gets the nanoseconds of each function that ran.

    Raises
    ------
    StepFailed
        A function raised, or returned the wrong number of values.
    """
    values, versions, used, steps = manager.values, manager.versions, manager.used, manager.program.steps
    for index in order:
        step = steps[index]
        given = tuple([versions[slot] for slot in step.inputs])
        if used[index] == given:
            continue
        args = [values[slot] for slot in step.inputs]
        if not step.guarded:
            args = [writable(value) for value in args]
        start_ns = perf_counter_ns()
        try:
            result = step.function(*args)
            durations_ns[step.name] = perf_counter_ns() - start_ns
            made = (result,) if step.single else _unpack(step, result, manager)
        except BaseException as exception:
            durations_ns.setdefault(step.name, perf_counter_ns() - start_ns)
            raise StepFailed(_failure(manager, step, exception), step) from None
        for slot, value in zip(step.outputs, made, strict=True):
            _store(manager, slot, value, args, next_version, guard)
        used[index] = given


def _store(
    manager: TokenManager,
    slot: int,
    value: Any,
    args: Sequence[Any],
    next_version: Callable[[], int],
    guard: bool,
) -> None:
    """Put an output; keep its version if it is cheaply known to be what it was."""
    old = manager.values[slot]
    passed_through = guard and any(value is arg for arg in args)
    if (passed_through and value is old) or is_same_value(old, value):
        return
    manager.values[slot] = read_only(value) if guard and not passed_through else value
    manager.versions[slot] = next_version()


def _unpack(step: Step, result: Any, manager: TokenManager) -> Sequence[Any]:
    """Return a result as one value per output token; a string or an array is not split."""
    if not step.outputs:
        return ()
    if isinstance(result, tuple | list) and len(result) == len(step.outputs):
        return result
    if isinstance(result, tuple | list):
        got = f"{type(result).__name__} of {len(result)}"
    else:
        got = f"one {type(result).__name__}"
    raise OutputArityError(step.name, [manager.program.tokens[slot] for slot in step.outputs], got)


def _brief(value: Any) -> str:
    """Return what a note says of an input: a small value itself, of an array its dtype and shape."""
    if type(value) in (bool, int, float, type(None)) or (type(value) is str and len(value) <= _BRIEF):
        return f"={value!r:.{_BRIEF}}"
    if is_array(value):
        return f": {value.dtype} {' x '.join(map(str, value.shape))}"
    return ""


def _failure(manager: TokenManager, step: Step, exception: BaseException) -> Failure:
    """Describe what failed, and note on the user's exception which function and tokens it concerns."""
    tokens = manager.program.tokens
    inputs = tuple(tokens[slot] for slot in step.inputs)
    outputs = tuple(tokens[slot] for slot in step.outputs)
    values = {token: manager.values[slot] for token, slot in zip(inputs, step.inputs, strict=True)}
    told = ", ".join(f"{token}{_brief(value)}" for token, value in values.items())
    note = f"In function {step.name!r}: ({told}) -> ({', '.join(outputs)})"
    if step.guarded:
        why = explain_write(step.name, inputs, exception)
        note = f"{note}\n{why}" if why else note
    if note not in getattr(exception, "__notes__", ()):
        exception.add_note(note)
    return Failure(step.name, (*inputs, *outputs), values, exception)
