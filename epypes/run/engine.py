"""How are steps run, timed and kept apart?"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from time import perf_counter_ns
from typing import Any, Final

from epypes.errors import OutputArityError
from epypes.run.failure import Failure
from epypes.run.guard import explain_write, is_array, is_plain_array, read_only, writable
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
        originals = args = [values[slot] for slot in step.inputs]
        if not step.guarded:
            args = [writable(value) for value in args]
        elif guard:
            # A view for this call alone: even its shape, which no flag protects, is not another function's.
            args = [read_only(value) for value in args]
        start_ns = perf_counter_ns()
        try:
            result = step.function(*args)
            durations_ns[step.name] = perf_counter_ns() - start_ns
            for slot, value in zip(step.outputs, _unpack(step, result, manager), strict=True):
                kept = _guarded(value, args, originals) if guard else value
                # The same guarded array has the same content; of other objects only small immutable ones are compared.
                if not (guard and is_array(kept) and kept is values[slot]) and not is_same_value(values[slot], kept):
                    values[slot], versions[slot] = kept, next_version()
        except BaseException as exception:
            durations_ns.setdefault(step.name, perf_counter_ns() - start_ns)
            raise StepFailed(_failure(manager, step, exception), step) from None
        used[index] = given


def _guarded(value: Any, args: Sequence[Any], originals: Sequence[Any]) -> Any:
    """Return an output as it is stored: an input that was passed through as the very array that it was."""
    if is_array(value):
        for arg, original in zip(args, originals, strict=True):
            # Of a subclass, more may have changed than can be seen here: a mask, a name, a unit.
            if value is arg and is_plain_array(arg):
                layout = (arg.shape, arg.strides, arg.dtype)
                return original if layout == (original.shape, original.strides, original.dtype) else read_only(arg)
    return read_only(value)


def _unpack(step: Step, result: Any, manager: TokenManager) -> Sequence[Any]:
    """Return a result as one value per output token; a string or an array is not split."""
    if step.single:
        return (result,)
    if not step.outputs:
        return ()
    got = f"one {type(result).__name__}"
    if isinstance(result, tuple | list):
        found = tuple(result)
        if len(found) == len(step.outputs):
            return found
        got = f"{type(result).__name__} of {len(found)}"
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
    # Whatever the exception's own methods do, the failure is told.
    with contextlib.suppress(BaseException):
        why = explain_write(step.name, inputs, exception) if step.guarded else None
        note = f"{note}\n{why}" if why else note
    with contextlib.suppress(BaseException):
        if note not in getattr(exception, "__notes__", ()):
            exception.add_note(note)
    return Failure(step.name, (*inputs, *outputs), values, exception)
