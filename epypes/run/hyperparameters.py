"""Which tokens are frozen, to which values, and which free source tokens remain?"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

from epypes.errors import HyperparameterError
from epypes.graph import CompGraph
from epypes.run.guard import read_only
from epypes.run.tokens import TokenManager, is_same_value


class Hyperparameters:
    """The hyperparameters of a runner with the version of each; replaced as a whole, never changed in place.

    Attributes
    ----------
    values
        By token.
    revision
        How often they have changed.
    """

    __slots__ = ("_versions", "cg", "revision", "values")

    def __init__(self, cg: CompGraph, values: Mapping[str, Any], versions: Mapping[str, int], revision: int) -> None:
        self.cg, self.revision = cg, revision
        self.values: Mapping[str, Any] = MappingProxyType(dict(values))
        self._versions = dict(versions)

    @property
    def free_source_tokens(self) -> tuple[str, ...]:
        """The source tokens that are not frozen: the graph's input, in order of first appearance in func_io."""
        return tuple(token for token in self.cg.source_tokens if token not in self.values)

    def frozen(self, changes: Mapping[str, Any], next_version: Callable[[], int], guard: bool) -> Hyperparameters:
        """Return these with source tokens given values; all or nothing. An equal value changes nothing."""
        for token in changes:
            self.require_source(token)
        values, versions = dict(self.values), dict(self._versions)
        changed = False
        for token, value in changes.items():
            if token in values and is_same_value(values[token], value):
                continue
            values[token] = read_only(value) if guard else value
            versions[token] = next_version()
            changed = True
        return Hyperparameters(self.cg, values, versions, self.revision + 1) if changed else self

    def unfrozen(self, token: str) -> Hyperparameters:
        """Return these without a token, which becomes a free source token."""
        self.require(token)
        values = {name: value for name, value in self.values.items() if name != token}
        return Hyperparameters(self.cg, values, self._versions, self.revision + 1)

    def apply(self, manager: TokenManager) -> None:
        """Put the values into a token store."""
        for token, value in self.values.items():
            manager.put(token, value, self._versions[token])

    def require_source(self, token: str) -> None:
        """Raise unless the token exists and no function makes it."""
        self.cg.require_token(token)
        maker = self.cg.digraph.producer.get(token)
        if maker is not None:
            text = f"Token {token!r} is made by function {maker!r}, so it can't be a hyperparameter."
            raise HyperparameterError(token, text)

    def require(self, token: str) -> None:
        """Raise unless the token is a hyperparameter, with the way out for one that is not."""
        self.require_source(token)
        if token not in self.values:
            raise HyperparameterError(
                token,
                f"Token {token!r} is a free source token, not a hyperparameter. "
                f"Pass it to run({token}=...), or make it one: freeze({token}=...).",
            )
