"""Which values do the tokens have, and are they up to date?

Staleness goes by version, never by looking at data: each value that is put gets a version number, and a step is
up to date while the versions of its inputs are those it was last run with. The cost does not depend on the size
of the values.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

from epypes.errors import NotComputed, StaleToken
from epypes.run.guard import own_view
from epypes.run.program import Program

_SCALARS = (int, float, complex, str, bytes, bool, type(None))
_SMALL_TUPLE = 16


class _NotComputed:
    """The state of a token without value; None is a value."""

    __slots__ = ()

    def __repr__(self) -> str:
        return "NOT_COMPUTED"


NOT_COMPUTED: Final = _NotComputed()


class TokenManager:
    """The token values of one run.

    A run works on its own TokenManager, so concurrent runs never see each other's values.

    Attributes
    ----------
    values, versions
        By slot.
    used
        By step, the versions of the inputs that it was last run with, or None.
    stale
        The steps whose outputs are out of date.
    """

    __slots__ = ("program", "stale", "used", "values", "versions")

    def __init__(self, program: Program) -> None:
        self.program = program
        self.values: list[Any] = [NOT_COMPUTED] * len(program.tokens)
        self.versions: list[int] = [0] * len(program.tokens)
        self.used: list[tuple[int, ...] | None] = [None] * len(program.steps)
        self.stale: frozenset[int] = frozenset()

    def copy(self) -> TokenManager:
        """Return a copy that can change without changing this one; the values are shared."""
        twin = TokenManager.__new__(TokenManager)
        twin.program, twin.stale = self.program, self.stale
        twin.values, twin.versions, twin.used = self.values.copy(), self.versions.copy(), self.used.copy()
        return twin

    def put(self, token: str, value: Any, version: int) -> None:
        """Give a token a value."""
        slot = self.program.slots[token]
        self.values[slot], self.versions[slot] = value, version

    def forget(self, steps: Iterable[int]) -> None:
        """Make the outputs of these steps read as not computed."""
        for index in steps:
            self.used[index] = None
            for slot in self.program.steps[index].outputs:
                self.values[slot] = NOT_COMPUTED

    def is_computed(self, token: str) -> bool:
        """Whether the token has a value, be it stale."""
        return self.values[self.program.slots[token]] is not NOT_COMPUTED

    def is_stale(self, token: str) -> bool:
        """Whether the token has a value that is out of date."""
        slot = self.program.slots[token]
        return self.program.makers.get(slot) in self.stale and self.values[slot] is not NOT_COMPUTED

    def read(self, token: str) -> Any:
        """Return a token's value.

        Raises
        ------
        UnknownName
            There is no such token.
        StaleToken
            Its value is out of date.
        NotComputed
            It has none.
        """
        self.program.cg.require_token(token)
        if self.is_stale(token):
            raise StaleToken(token)
        value = self.values[self.program.slots[token]]
        if value is NOT_COMPUTED:
            raise NotComputed(token, f"Token {token!r} has not been computed. {self._way_out(token)}")
        return own_view(value)

    def _way_out(self, token: str) -> str:
        return (
            f"Call rerun({token!r}), or run() with the graph's payload."
            if self.program.slots[token] in self.program.makers
            else f"Pass it: run({token}=...)."
        )

    def stale_steps(self, steps: Iterable[int]) -> list[int]:
        """Return which of these steps (in run order, with all they depend on) are out of date."""
        found: list[int] = []
        seen: set[int] = set()
        for index in steps:
            step = self.program.steps[index]
            if self.used[index] != tuple(self.versions[slot] for slot in step.inputs) or not seen.isdisjoint(
                step.upstream
            ):
                seen.add(index)
                found.append(index)
        return found


def is_same_value(old: Any, new: Any) -> bool:
    """Whether two immutable values are cheaply known to be equal: numbers, strings and small tuples of them.

    The types must agree, so that True is not 1 and 1 is not 1.0; NaN is not equal to itself, so it counts as new.
    Arrays are never compared.
    """
    kind = type(old)
    if kind is not type(new):
        return False
    if kind in _SCALARS:
        # 0.0 == -0.0, but they do not always compute the same: the sign is in the repr.
        return bool(old == new) and (kind not in (float, complex) or repr(old) == repr(new))
    if kind is tuple:
        return len(old) == len(new) <= _SMALL_TUPLE and all(map(is_same_value, old, new))
    return False
