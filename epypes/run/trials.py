"""From which state of a runner was a run tried, and is that still its state?"""

from __future__ import annotations

from weakref import WeakKeyDictionary, ref

from epypes.run.hyperparameters import Hyperparameters
from epypes.run.record import Run

# A run's memory is that of its images: one that was replaced must not be kept alive by those that came of it.
_Start = tuple[Hyperparameters, "ref[Run] | None"]


class Trials:
    """The states of a runner from which runs were tried; a run that is dropped takes its entry with it."""

    def __init__(self) -> None:
        self._starts: WeakKeyDictionary[Run, _Start] = WeakKeyDictionary()

    def add(self, run: Run, hparams: Hyperparameters, last: Run | None) -> None:
        """Remember that a run was tried while these were the runner's."""
        self._starts[run] = (hparams, None if last is None else ref(last))

    def __contains__(self, run: object) -> bool:
        return run in self._starts

    def began_from(self, run: Run, hparams: Hyperparameters, last: Run | None) -> bool:
        """Whether a run was tried while exactly these were the runner's."""
        before, last_ref = self._starts[run]
        return before is hparams and (None if last_ref is None else last_ref()) is last
