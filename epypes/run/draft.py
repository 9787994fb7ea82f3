"""What changes while functions run?"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any

from epypes.run.guard import is_plain_array, is_same_guarded_array
from epypes.run.program import Program, Step
from epypes.run.tokens import NOT_COMPUTED, Freshness, TokenManager, is_same_value

if TYPE_CHECKING:
    from epypes.run.hyperparameters import Hyperparameters
    from epypes.run.record import Run


class Draft:
    """The tokens of a run under way; becomes a TokenManager when it ends.

    Attributes
    ----------
    values, dirty, revisions
        As in TokenManager and Freshness.
    """

    __slots__ = ("_carried", "_new", "dirty", "has_payload", "program", "revisions", "values")

    def __init__(self, program: Program, values: list[Any], dirty: bytearray, has_payload: bool) -> None:
        self.program, self.values, self.dirty, self.has_payload = program, values, dirty, has_payload
        self.revisions = program.revisions()
        # Slots with new values, and the steps of which it is not known what was new to them.
        self._new: set[int] = set()
        self._carried: bytes = b""

    @classmethod
    def of_sources(cls, program: Program, values: list[Any], has_payload: bool) -> Draft:
        """Begin with values of source tokens only."""
        return cls(program, values, bytearray(b"\1") * len(program.steps), has_payload)

    @classmethod
    def after(cls, manager: TokenManager) -> Draft:
        """Begin with what another run has left; the values are shared."""
        freshness = manager.freshness
        program = freshness.program
        draft = cls(program, manager.values.copy(), bytearray(freshness.dirty), freshness.has_payload)
        for place, before, now in zip(program.revised, freshness.revisions, draft.revisions, strict=True):
            draft.dirty[place] |= before != now
        draft._carried = bytes(draft.dirty)
        return draft

    def change(self, token: str, value: Any) -> None:
        """Give a source token a value."""
        self._store(self.program.slots[token], value, ())

    def store(self, step: Step, made: Sequence[Any]) -> None:
        """Store what a step has made, guarded if the program is; the steps that read something new become dirty."""
        self.dirty[step.place] = 0
        given: Sequence[Any] = ()
        if not self._carried or not self._carried[step.place]:
            given = [self.values[slot] for slot in step.inputs if slot not in self._new]
        for slot, value in zip(step.outputs, made, strict=True):
            self._store(slot, value, given)

    def _store(self, slot: int, value: Any, given: Sequence[Any]) -> None:
        if is_unchanged(self.values[slot], value, given, self.program.guard):
            return
        self.values[slot] = value
        self._new.add(slot)
        for index in self.program.consumers[slot]:
            step = self.program.steps[index]
            if step.switch is None or slot in self.program.read_by(step, self.values):
                self.dirty[index] = 1

    def forget(self, steps: Iterable[int]) -> None:
        """Make the outputs of these steps read as not computed."""
        for index in steps:
            self.dirty[index] = 1
            for slot in self.program.steps[index].outputs:
                self.values[slot] = NOT_COMPUTED

    def freshness(self) -> Freshness:
        """Return what is up to date now, for good."""
        return Freshness(self.program, bytes(self.dirty), self.has_payload, self.revisions)

    def tokens(self) -> TokenManager:
        """Return the tokens as they are now, for good."""
        return TokenManager.of_run(self.values, self.freshness())


def draft_after(program: Program, last: Run | None, hparams: Hyperparameters) -> Draft:
    """Return a run's tokens with these hyperparameters, to go on from; those of no run without one.

    Both are given, so that what is read beside a rerun in another thread is decided from one state.
    """
    if last is None:
        return Draft.of_sources(program, hparams.base.copy(), not hparams.free_slots)
    draft = Draft.after(last.tokens)
    for token, value in hparams.changes_since(last.record[2]).items():
        draft.change(token, value)
    return draft


def tokens_now(program: Program, last: Run | None, hparams: Hyperparameters) -> TokenManager:
    """Return a run's tokens as they are to be read with these hyperparameters."""
    if last is not None and last.record[2] is hparams and not program.revised:
        return last.tokens
    return draft_after(program, last, hparams).tokens()


def is_unchanged(old: Any, new: Any, given: Sequence[Any], guard: bool) -> bool:
    """Whether a function's new value is cheaply known to be what it was.

    ``given`` are the values that the function read and that are not new. A guarded array that was passed through from
    them is known to be unchanged; of other values small immutable ones are compared.
    """
    if is_same_value(old, new):
        return True
    return guard and is_plain_array(new) and is_plain_array(old) and is_same_guarded_array(old, new, given)
