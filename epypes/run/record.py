"""What is left of a run? Its tokens, its times, its failure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from epypes.errors import NotComputed, StaleToken
from epypes.graph.redefined import redefined
from epypes.run.failure import Failure
from epypes.run.hyperparameters import Hyperparameters
from epypes.run.report import RunReport
from epypes.run.tokens import TokenManager

if TYPE_CHECKING:
    from epypes.graph import CompGraph


class Run(Mapping[str, Any]):
    """A run that has ended: a mapping from tokens to values, which does not change any more.

    Reading a token that was not computed raises NotComputed; iterating gives those that were. Arrays are read-only:
    draw on a copy, ``run["edges"].copy()``.
    """

    __slots__ = ("__weakref__", "_failure", "_hparams", "_manager", "_report")

    def __init__(
        self, manager: TokenManager, report: RunReport, failure: Failure | None, hparams: Hyperparameters
    ) -> None:
        self._manager, self._report, self._failure, self._hparams = manager, report, failure, hparams

    @property
    def report(self) -> RunReport:
        """The times of the run."""
        return self._report

    @property
    def failure(self) -> Failure | None:
        """None, or the function that failed; the tokens that were computed before keep their values."""
        return self._failure

    @property
    def hparams(self) -> Hyperparameters:
        """The hyperparameters that the run was computed with, and their versions."""
        return self._hparams

    @property
    def hyperparameters(self) -> Mapping[str, Any]:
        """The values that the run was computed with."""
        return self._hparams.values

    @property
    def revision(self) -> int:
        """The runner's count of hyperparameter changes when the run began."""
        return self._hparams.revision

    @property
    def cg(self) -> CompGraph:
        """The graph that was run."""
        return self._manager.program.cg

    @property
    def tokens(self) -> TokenManager:
        """The token store; take ``.copy()`` before changing it."""
        return self._manager

    def __getitem__(self, token: str) -> Any:
        try:
            return self._manager.read(token)
        except StaleToken:
            raise
        except NotComputed as error:
            if self.failure is None:
                raise
            text = f"Token {token!r} has not been computed, since {self.failure}."
            raise NotComputed(token, text) from error

    def __iter__(self) -> Iterator[str]:
        manager = self._manager
        return (token for token in self.cg.tokens if manager.is_computed(token) and not manager.is_stale(token))

    def __len__(self) -> int:
        return sum(1 for _ in self)

    # Values may be arrays, so runs are told apart by identity.
    __hash__ = object.__hash__

    def __eq__(self, other: object) -> bool:
        return self is other

    def __repr__(self) -> str:
        state = f"failed in {self.failure.function!r:.30}" if self.failure else "completed"
        redefinitions = len(redefined(self.cg))
        old = f"; {redefinitions} function{'s' * (redefinitions != 1)} redefined" * bool(redefinitions)
        return f"<Run: {state}; {len(self)} of {len(self.cg.tokens)} tokens{old}>"

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        from epypes.display import mimebundle

        return mimebundle(self)
