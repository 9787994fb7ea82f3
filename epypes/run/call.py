"""One call of a step's function: its inputs are lent, its result is kept, one value per output token."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from sys import getrefcount
from time import perf_counter_ns
from typing import Any

from epypes.errors import ContractBroken, InputMutated, OutputArityError
from epypes.images import Image
from epypes.nothing import Nothing, NothingGiven
from epypes.run.guard import ARRAYLESS, FRESH, is_array, keep, lend, lend_to_reader, writable, writable_copy
from epypes.run.program import Program, Step
from epypes.run.snapshot import Snapshot


def call(program: Program, step: Step, values: Sequence[Any], durations_ns: dict[int, int]) -> Sequence[Any]:
    """Call a step's function on the values of its inputs; return one value per output token, guarded.

    Raises
    ------
    OutputArityError
        The function returned the wrong number of values.
    NothingGiven
        An input is Nothing, so the function was not called.
    ContractBroken, InputMutated, IteratorRefused
        It does not keep to its contract, changed an object inside an input, or returned what can be read only once.
    """
    __tracebackhide__ = True
    # Unpacked at once: to look up one field of a named tuple takes as long.
    place, _, function, inputs, outputs, single, _, switch, contracts, is_plain, node, _ = step
    if node is not None:
        function = node.func
    start_ns = 0
    try:
        if is_plain:
            args = []
            for slot in inputs:
                value = values[slot]
                args.append(value if type(value) in ARRAYLESS else lend(value))
        else:
            args = _args(program, step, values)
            if program.check_mutation and switch is None:
                function = partial(_call_checked, program, step, function, values)
        start_ns = perf_counter_ns()
        result = function(*args)
        durations_ns[place] = perf_counter_ns() - start_ns
        made: Sequence[Any]
        if not single:
            made = unpack(program, step, result, values)
        elif type(result) in ARRAYLESS or not program.guard or switch is not None:
            made = (result,)
        else:
            made = (keep(result, FRESH, program, outputs[0], values),)
        if contracts is not None:
            _check(program, step, contracts[1], outputs, made)
    except NothingGiven:
        raise
    except BaseException:
        durations_ns[place] = perf_counter_ns() - start_ns if start_ns else 0
        raise
    return made


def _args(program: Program, step: Step, values: Sequence[Any]) -> list[Any]:
    """Return the inputs of a step that is not plain; a switch passes values on as they are stored."""
    args = [values[slot] for slot in step.inputs]
    if any(values[slot] is Nothing for slot in program.required_by(step, values)):
        raise NothingGiven
    if program.guard and step.switch is None:
        pass_on, own = writable if step.unguarded else lend, len(program.slots)
        args = [
            lend_to_reader(arg) if slot >= own else (writable_copy if at in step.in_out else pass_on)(arg)
            for at, (slot, arg) in enumerate(zip(step.inputs, args, strict=True))
        ]
    if step.contracts is not None:
        _check(program, step, step.contracts[0], step.inputs, args)
    return args


def _call_checked(program: Program, step: Step, function: Callable[..., Any], values: Sequence[Any], *args: Any) -> Any:
    """Call a step's function; put back what it has changed of its inputs, and raise InputMutated."""
    __tracebackhide__ = True
    given = {program.tokens[slot]: values[slot] for slot in step.inputs}
    if step.unguarded:  # which can write into memory that is locked for others
        views = zip(step.inputs, args, strict=True)
        given.update((program.tokens[slot], view) for slot, view in views if is_array(view))
    before = Snapshot(given)
    try:
        result = function(*args)
    except BaseException:
        before.restore()
        raise
    token = before.changed()
    if token is not None:
        before.restore()
        raise InputMutated(step.name, token, has_read_iterator=before.changed() is not None)
    return result


def _check(
    program: Program, step: Step, contracts: Sequence[Image | None], slots: Sequence[int], values: Sequence[Any]
) -> None:
    """Raise ContractBroken for the first value that is not the image that the function's annotation says."""
    for contract, slot, value in zip(contracts, slots, values, strict=False):
        found = contract.found(value) if contract is not None and value is not Nothing else None
        if contract is not None and found is not None:
            raise ContractBroken(step.name, program.tokens[slot], contract, found, made=slots is step.outputs)


def unpack(program: Program, step: Step, result: Any, values: Sequence[Any]) -> list[Any]:
    """Return a result as one value per output token, guarded; a string or an array is not split, Nothing is for all.

    Raises
    ------
    OutputArityError
        It is not a tuple or list of as many values as there are output tokens.
    """
    if not step.outputs:
        return []
    got = f"one {type(result).__name__}"
    if isinstance(result, tuple | list):
        found = list(result)
        if len(found) == len(step.outputs):
            # The result, the list and the loop each hold a reference to an item; FRESH counts one of them. The items of
            # a result that the function goes on holding are not fresh, whatever their counts say.
            fresh_count = 0 if getrefcount(result) > FRESH else FRESH + 2
            if not program.guard:
                return found
            # No zip(), which would hold a reference too.
            slots = iter(step.outputs)
            return [keep(item, fresh_count, program, next(slots), values) for item in found]
        got = f"{type(result).__name__} of {len(found)}"
    elif result is Nothing:
        return [Nothing] * len(step.outputs)
    raise OutputArityError(step.name, [program.tokens[slot] for slot in step.outputs], got)
