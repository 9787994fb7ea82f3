"""What keeps a value as it was when it was given, whatever its owner does with it afterwards?"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

from epypes.bundle.apart import without_unfrozen
from epypes.run import CompGraphRunner
from epypes.run.guard import is_array, is_plain_array


def lasting(value: Any) -> Any:
    """Return a value whose arrays are copies, also those in tuples, lists and dicts."""
    if is_plain_array(value):
        return value.copy(order="K")
    if is_array(value):
        return value.copy()
    if type(value) in (list, tuple):
        return type(value)(map(lasting, value))
    if isinstance(value, tuple) and hasattr(value, "_make"):
        return value._make(map(lasting, value))
    return {key: lasting(item) for key, item in value.items()} if type(value) is dict else value


def holds_its_arrays(values: Any) -> bool:
    """Whether an iterable is a list, a tuple or an array; any other may give one array, filled again, each time."""
    return type(values) in (list, tuple) or is_array(values)


def lasting_each(values: Iterable[Any]) -> Iterator[Any]:
    """Give what an iterable gives, copied when it is taken if it does not hold its arrays itself."""
    if holds_its_arrays(values):
        yield from values
        return
    for value in values:
        copied = lasting(dict(value) if isinstance(value, Mapping) else value)
        # Whoever waits for the next one must not keep this one alive.
        del value
        yield copied
        del copied


def settled_runner(runner: CompGraphRunner) -> CompGraphRunner:
    """Return a runner of one's own, which no longer changes when somebody sets, or writes into, hyperparameters."""
    own = {token: lasting(value) for token, value in runner.hyperparameters.items()}
    cg = without_unfrozen(runner.cg, own)
    return CompGraphRunner(cg, own, workers=runner.workers, guard=runner.guard, check_mutation=runner.check_mutation)
