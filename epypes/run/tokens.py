"""Which values do the tokens have after a run, and are they up to date?

Staleness never looks at data: a step is dirty when something that it reads has got a new version since it last ran.
The cost does not depend on the size of the values.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

from epypes.errors import NotComputed, StaleToken
from epypes.graph import CompGraph
from epypes.run.guard import lend
from epypes.run.program import Program

_SCALARS: Final = frozenset({int, float, complex, bool, type(None)})
_TEXTS: Final = frozenset({str, bytes})
_SMALL_TUPLE: Final = 16
# Longer texts (an encoded image) are taken for new unless they are the same object.
_SHORT_TEXT: Final = 1_000


class _NotComputed:
    """The state of a token without value; None is a value."""

    __slots__ = ()

    def __repr__(self) -> str:
        return "NOT_COMPUTED"


NOT_COMPUTED: Final = _NotComputed()


class Freshness:
    """Which steps of a run are up to date; runs that are wholly up to date share one.

    Attributes
    ----------
    program
        What was run.
    dirty
        By step, 1 if it has to run before its outputs can be read: it never ran, failed, or one of its inputs has a
        new value.
    has_payload
        Whether every source token has a value; if not, each run has to see whether it needs one that has none.
    revisions
        Those of nested pipelines, when the run began.
    is_clean
        Whether every step is up to date, for good, and every source token has a value.
    clean_slots
        The slots by token if so; otherwise empty.
    """

    __slots__ = ("clean_slots", "dirty", "has_payload", "is_clean", "program", "revisions")

    def __init__(self, program: Program, dirty: bytes, has_payload: bool, revisions: tuple[Any, ...] = ()) -> None:
        self.program, self.dirty, self.has_payload, self.revisions = program, dirty, has_payload, revisions
        self.is_clean = has_payload and 1 not in dirty and not program.revised
        self.clean_slots = program.slots if self.is_clean else {}


class TokenManager:
    """The values of a graph's tokens, which do not change any more.

    A runner delegates storage to it: each run works on values of its own, so concurrent runs never see each other's,
    and leaves them as ``run.tokens``.

    Parameters
    ----------
    cg
        The graph.
    values
        By token, the values that are known and up to date; none without.

    Raises
    ------
    UnknownName
        The graph has no such token.

    Attributes
    ----------
    values
        By slot of the compiled graph.
    freshness
        Which of them are up to date.

    Notes
    -----
    Semeniuta and Falkman 2019, "Computational graphs".

    Examples
    --------
    >>> cg = CompGraph({"add": lambda x, y: x + y}, {"add": (("x", "y"), "total")})
    >>> tokens = TokenManager(cg, {"x": 1})
    >>> tokens["x"], "total" in tokens
    (1, False)
    """

    __slots__ = ("_stale", "freshness", "values")

    def __init__(self, cg: CompGraph, values: Mapping[str, Any] | None = None) -> None:
        program = Program(cg, True)
        self.values: list[Any] = [NOT_COMPUTED] * len(program.tokens)
        for token, value in (values or {}).items():
            cg.require_token(token)
            self.values[program.slots[token]] = value
        # No function is out of date; but not every token has a value.
        self.freshness = Freshness(program, bytes(len(program.steps)), False, program.revisions())
        self._stale: set[int] | None = None

    @classmethod
    def of_run(cls, values: list[Any], freshness: Freshness) -> TokenManager:
        """Return the tokens of a run, by slot."""
        self = cls.__new__(cls)
        self.values, self.freshness, self._stale = values, freshness, None
        return self

    @property
    def program(self) -> Program:
        """What was run."""
        return self.freshness.program

    @property
    def stale(self) -> set[int]:
        """The steps whose outputs are out of date: the dirty ones and what depends on them."""
        if self._stale is None:
            dirty = self.freshness.dirty
            starts = [index for index, is_dirty in enumerate(dirty) if is_dirty] if 1 in dirty else ()
            self._stale = self.program.downstream(starts, self.values)
        return self._stale

    def is_computed(self, token: str) -> bool:
        """Whether the token has a value, be it stale."""
        return self.values[self.program.slots[token]] is not NOT_COMPUTED

    def is_stale(self, token: str) -> bool:
        """Whether the token has a value that is out of date."""
        if not self.stale:
            return False
        slot = self.program.slots[token]
        return self.program.makers[slot] in self.stale and self.values[slot] is not NOT_COMPUTED

    def is_readable(self, token: str) -> bool:
        """Whether the token has a value that is up to date."""
        return self.is_computed(token) and not self.is_stale(token)

    def read(self, token: str) -> Any:
        """Return a token's value, arrays as read-only views.

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
        return lend(value) if self.program.guard else value

    def __getitem__(self, token: str) -> Any:
        return self.read(token)

    def __contains__(self, token: str) -> bool:
        return self.program.cg.has_token(token) and self.is_readable(token)

    def __iter__(self) -> Iterator[str]:
        return (token for token in self.program.tokens if self.is_readable(token))

    def _way_out(self, token: str) -> str:
        return (
            f"Pass it: run({token}=...)."
            if self.program.makers[self.program.slots[token]] < 0
            else f"Call rerun({token!r}), or run() with the graph's payload."
        )


def is_same_value(old: Any, new: Any) -> bool:
    """Whether two immutable values are cheaply known to be equal: numbers, short texts and small tuples of them.

    The types must agree, so that True is not 1 and 1 is not 1.0; NaN is not equal to itself, so it counts as new.
    Arrays are never compared.
    """
    kind = type(old)
    if kind is not type(new):
        return False
    if kind in _SCALARS:
        # 0.0 == -0.0, but they do not always compute the same: the sign is in the repr.
        return bool(old == new) and (kind not in (float, complex) or repr(old) == repr(new))
    if kind in _TEXTS:
        return old is new or (len(old) == len(new) <= _SHORT_TEXT and bool(old == new))
    if kind is tuple:
        return len(old) == len(new) <= _SMALL_TUPLE and all(map(is_same_value, old, new))
    return False
