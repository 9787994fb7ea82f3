"""What does a runner say of itself in one line?"""

from __future__ import annotations

from typing import TYPE_CHECKING

from epypes.graph import redefined
from epypes.wording import counted

if TYPE_CHECKING:
    from epypes.run.runner import CompGraphRunner


def one_line(runner: CompGraphRunner) -> str:
    """Return how many functions and hyperparameters a runner has, and whether they are up to date."""
    last, redefinitions = runner.last, len(redefined(runner.cg))
    old = f" ({redefinitions} redefined)" * bool(redefinitions)
    if last is None:
        state = "not run yet"
    elif last.failure:
        state = f"failed in {last.failure.function!r:.{24 - len(old)}}"
    else:
        state = f"{counted(len(runner.stale), 'function')} stale" if runner.stale else "up to date"
    functions, frozen = counted(len(runner.cg.functions), "function"), len(runner.hyperparameters)
    return f"<CompGraphRunner: {functions}{old}, {counted(frozen, 'hyperparameter')}; {state}>"
