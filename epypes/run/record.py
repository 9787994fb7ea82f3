"""What is left of a run? Its tokens, its times, its failure."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any, Final

from epypes.errors import NotComputed, StaleToken
from epypes.graph.redefined import redefined
from epypes.rich_display import mimebundle
from epypes.run.failure import Failure
from epypes.run.guard import ARRAYLESS, lend
from epypes.run.hyperparameters import Hyperparameters
from epypes.run.report import RunReport, Times
from epypes.run.tokens import Freshness, TokenManager
from epypes.wording import counted

if TYPE_CHECKING:
    from epypes.graph import CompGraph

# Values by slot, which of them are up to date, the hyperparameters with their versions, times and failure.
Record = tuple[list[Any], Freshness, Hyperparameters, Times, Failure | None]


class Run(Mapping[str, Any]):
    """A run that has ended: a mapping from tokens to values, which does not change any more.

    Reading a token that was not computed raises NotComputed; iterating gives those that were. Arrays are read-only:
    draw on a copy, ``run["edges"].copy()``. A payload array is not copied: if its owner fills it again, the run and its
    picture show what is in it then.
    """

    # One tuple to be set, and nothing else: to record a run takes a good part of what EPypes adds to its functions.
    __slots__ = ("__weakref__", "_tokens", "record")

    def __init__(self, record: Record) -> None:
        self.record = record

    @property
    def report(self) -> RunReport:
        """The times of the run."""
        return RunReport(*self.record[3])

    @property
    def failure(self) -> Failure | None:
        """None, or the function that failed; the tokens that were computed before keep their values."""
        return self.record[4]

    @property
    def hyperparameters(self) -> Mapping[str, Any]:
        """The values that the run was computed with."""
        return self.record[2].values

    @property
    def first_hyperparameters(self) -> Mapping[str, Any]:
        """The values that they had when they were made or frozen, by token."""
        return self.record[2].first_values

    @property
    def revision(self) -> int:
        """The runner's count of hyperparameter changes when the run began."""
        return self.record[2].revision

    @property
    def cg(self) -> CompGraph:
        """The graph that was run."""
        return self.record[1].program.cg

    @property
    def tokens(self) -> TokenManager:
        """The token store."""
        try:
            return self._tokens
        except AttributeError:
            self._tokens: TokenManager = TokenManager(self.record[0], self.record[1])
            return self._tokens

    def __getitem__(self, token: str) -> Any:
        record = self.record
        # Of a clean run every token has a value, and none is out of date.
        slot = record[1].clean_slots.get(token)
        if slot is not None:
            value = record[0][slot]
            return value if type(value) in ARRAYLESS or not record[1].program.guard else lend(value)
        try:
            return self.tokens.read(token)
        except StaleToken:
            raise
        except NotComputed as error:
            if self.failure is None:
                raise
            text = f"Token {token!r} has not been computed, since {self.failure}."
            raise NotComputed(token, text) from error

    def __iter__(self) -> Iterator[str]:
        tokens = self.tokens
        return (token for token in self.cg.tokens if tokens.is_readable(token))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    # Values may be arrays, so runs are told apart by identity.
    __hash__ = object.__hash__

    def __eq__(self, other: object) -> bool:
        return self is other

    def __repr__(self) -> str:
        state = f"failed in {self.failure.function!r:.30}" if self.failure else "completed"
        redefinitions = len(redefined(self.cg))
        old = f"; {counted(redefinitions, 'function')} redefined" * bool(redefinitions)
        return f"<Run: {state}; {len(self)} of {len(self.cg.tokens)} tokens{old}>"

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        return mimebundle(self)


# Half the time of Run(...), whose one assignment follows it on the short ways.
new_run: Final[Callable[[], Run]] = partial(object.__new__, Run)
