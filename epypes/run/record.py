"""What is left of a run? Its tokens, its times, its failure."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any

from epypes.errors import NotComputed, StaleToken
from epypes.run.failure import Failure
from epypes.run.report import RunReport
from epypes.run.tokens import TokenManager

if TYPE_CHECKING:
    from epypes.graph import CompGraph


class Run(Mapping[str, Any]):
    """A run that has ended: a mapping from tokens to values, which does not change any more.

    Reading a token that was not computed raises NotComputed; iterating gives those that were. Arrays are read-only:
    draw on a copy, ``run["edges"].copy()``.

    Attributes
    ----------
    report
        The times of the run.
    failure
        None, or the function that failed; the tokens that were computed before keep their values.
    hyperparameters
        The values that the run was computed with.
    revision
        The runner's count of hyperparameter changes when the run began.
    """

    __slots__ = ("__weakref__", "_manager", "failure", "hyperparameters", "report", "revision")

    def __init__(
        self,
        manager: TokenManager,
        report: RunReport,
        failure: Failure | None,
        hyperparameters: Mapping[str, Any],
        revision: int,
    ) -> None:
        for name, value in (
            ("_manager", manager),
            ("report", report),
            ("failure", failure),
            ("hyperparameters", hyperparameters),
            ("revision", revision),
        ):
            object.__setattr__(self, name, value)

    if TYPE_CHECKING:
        _manager: TokenManager
        report: RunReport
        failure: Failure | None
        hyperparameters: Mapping[str, Any]
        revision: int

    def __setattr__(self, name: str, value: object) -> None:
        raise AttributeError(f"A Run does not change; {name!r} can't be set. Use the runner.")

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
        return f"<Run: {state}; {len(self)} of {len(self.cg.tokens)} tokens>"

    def _repr_mimebundle_(self, include: object = None, exclude: object = None) -> dict[str, str]:
        from epypes.display import mimebundle

        return mimebundle(self)
