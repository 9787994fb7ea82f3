"""Which tokens are frozen, to which values, and which free source tokens remain?"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from epypes.errors import HyperparameterError
from epypes.run.guard import ARRAYLESS, lend
from epypes.run.program import Program
from epypes.run.tokens import NOT_COMPUTED, is_same_value


class Hyperparameters:
    """The hyperparameters of a runner; replaced as a whole, never changed in place.

    Attributes
    ----------
    entries
        By token, a tuple that holds its value. Setting a token makes a new tuple: it is the token's version.
    changed
        The values that differ from the revision before; None if that had other hyperparameters.
    revision
        How often they have changed.
    """

    # Made at every move of a slider, so what is rarely asked for is made when it is.
    _base: list[Any] | None = None
    _free: dict[str, int] | None = None

    def __init__(
        self, program: Program, entries: dict[str, tuple[Any]], changed: dict[str, Any] | None, revision: int
    ) -> None:
        self.program, self.entries, self.changed, self.revision = program, entries, changed, revision

    @property
    def values(self) -> Mapping[str, Any]:
        """The values by token."""
        return MappingProxyType({token: entry[0] for token, entry in self.entries.items()})

    @property
    def free_slots(self) -> dict[str, int]:
        """The slots of the source tokens that are not frozen, in order of first appearance in func_io."""
        if self._free is None:
            makers = self.program.makers
            self._free = {
                token: slot
                for slot, token in enumerate(self.program.tokens)
                if makers[slot] < 0 and token not in self.entries
            }
        return self._free

    @property
    def base(self) -> list[Any]:
        """The values by slot, with which a run begins."""
        if self._base is None:
            base: list[Any] = [NOT_COMPUTED] * len(self.program.tokens)
            for token, entry in self.entries.items():
                base[self.program.slots[token]] = entry[0]
            self._base = base
        return self._base

    def frozen(self, changes: Mapping[str, Any]) -> Hyperparameters:
        """Return these with source tokens given values; all or nothing. An equal value changes nothing.

        Raises
        ------
        UnknownName
            There is no such token, or a switch has no such branch.
        HyperparameterError
            A function makes the token.
        """
        new: dict[str, Any] = {}
        entries = self.entries.copy()
        same_tokens = True
        for token, value in changes.items():
            entry = entries.get(token)
            if entry is None:
                self.require_source(token)
                same_tokens = False
            elif is_same_value(entry[0], value):
                continue
            if token in self.program.selectors:
                self.require_branch(token, value)
            new[token] = value = value if type(value) in ARRAYLESS or not self.program.guard else lend(value)
            entries[token] = (value,)
        if not new:
            return self
        return Hyperparameters(self.program, entries, new if same_tokens else None, self.revision + 1)

    def unfrozen(self, token: str) -> Hyperparameters:
        """Return these without a token, which becomes a free source token."""
        self.require(token)
        entries = {name: entry for name, entry in self.entries.items() if name != token}
        return Hyperparameters(self.program, entries, None, self.revision + 1)

    def changes_since(self, earlier: Hyperparameters) -> dict[str, Any]:
        """Return the tokens that have another version than in an earlier or later revision, with their values."""
        if earlier is self:
            return {}
        if self.changed is not None and earlier.revision == self.revision - 1:
            return self.changed
        entries = self.entries.items()
        return {token: entry[0] for token, entry in entries if earlier.entries.get(token) is not entry}

    def require_source(self, token: str) -> None:
        """Raise unless the token exists and no function makes it."""
        cg = self.program.cg
        cg.require_token(token)
        maker = cg.digraph.producer.get(token)
        if maker is not None:
            text = f"Token {token!r} is made by function {maker!r}, so it can't be a hyperparameter."
            raise HyperparameterError(token, text)

    def require_branch(self, token: str, selector: Any) -> None:
        """Raise UnknownName, with the nearest name, unless the switches that the token selects for have this branch."""
        for switch in self.program.selectors.get(token, ()):
            switch.branch_index(selector)

    def require(self, token: str) -> None:
        """Raise unless the token is a hyperparameter, with the way out for one that is not."""
        if token in self.entries:
            return
        self.require_source(token)
        raise HyperparameterError(
            token,
            f"Token {token!r} is a free source token, not a hyperparameter. "
            f"Pass it to run({token}=...), or make it one: freeze({token}=...).",
        )
