"""Replicas of one bundle that share the events of a broker's queue, by the group of this package."""

from __future__ import annotations

import os
import socket
from collections.abc import Callable, Iterable, Mapping
from time import monotonic
from types import SimpleNamespace
from typing import Any, Final

from epypes.errors import ParametersRefused, RevisionConflict
from epypes.service.group.group import Group
from epypes.service.group.membership import Heard, Member, summary, told
from epypes.service.parameters import ParameterControl, Parameters, changed_entries

# Events wait so long for the parameters of the other replicas.
_JOIN_TIMEOUT_S: Final = 5.0
_MAX_REASON: Final = 500


class Replicas:
    """One replica among those that take events from the same queue; or a service that stands alone.

    Parameters
    ----------
    address
        The queue of the broker; None for a service without a broker.
    facts
        Returns replica, name, state, reason, counts and http of the service.
    parameters
        The hyperparameters of this replica.
    on_answered
        Called with ids of events that another replica has answered.
    on_change
        Called when `is_joining` or the members may have changed.

    Attributes
    ----------
    is_joining
        Whether events must wait: the parameters that the other replicas compute with are not known yet.
    """

    def __init__(
        self,
        address: Any,
        facts: Callable[[], Mapping[str, Any]],
        parameters: ParameterControl,
        on_answered: Callable[[Iterable[str]], object],
        on_change: Callable[[], object],
    ) -> None:
        self._address, self._facts, self._parameters = address, facts, parameters
        self._on_answered, self._on_change = on_answered, on_change
        self.is_joining = False
        self._joined_s = 0.0
        self._group = self._make()

    def _make(self) -> Group | None:
        if self._address is None:
            return None
        tuned = _Planned(self._parameters)
        return Group(self._address, self._member, tuned, self._on_answered, self._changed, lambda waiting: None)

    def start(self) -> None:
        """Take part as soon as the broker is there; raises nothing."""
        self._group = self._make()
        if self._group is not None:
            self._joined_s, self.is_joining = monotonic() + _JOIN_TIMEOUT_S, True
            self._group.start()

    def stop(self, timeout_s: float) -> None:
        """Leave the group, within ``timeout_s``."""
        self.is_joining = False
        if self._group is not None:
            self._group.stop(timeout_s)

    def _changed(self) -> None:
        if self.is_joining and self._group is not None:
            self.is_joining = not (self._group.agreement.is_current or monotonic() > self._joined_s)
        self._on_change()

    def answered(self, event_id: str) -> None:
        """Have the other replicas know that this one has answered an event; returns at once."""
        if self._group is not None:
            self._group.done(SimpleNamespace(id=event_id))

    def set(self, values: Mapping[str, Any], revision: int | None) -> Parameters:
        """Change parameters in all replicas; see `Service.set_parameters`."""
        if self._group is None:
            return self._parameters.set(values, revision)
        return self._group.agreement.set(values, revision)

    def newest(self, digest: str) -> tuple[int, Mapping[str, Any]] | None:
        """Return revision and values that the replicas of a bundle compute with, None if none is known."""
        return None if self._group is None else self._group.agreement.taken_over(digest)

    def describe(self) -> dict[str, Any]:
        """Return the group as this replica knows it, JSON-ready."""
        if self._group is not None:
            return {"is_shared": True, **self._group.told()}
        present = [Heard(self._member(), 0.0)]
        members = [told(present[0], is_self=True)]
        return {"is_shared": False, **summary(present), "trouble": "", "rejected": 0, "members": members, "lost": []}

    def _member(self, id: str = "") -> Member:  # noqa: A002
        facts = dict(self._facts())
        facts["reason"] = str(facts.get("reason", ""))[:_MAX_REASON]
        served: dict[str, Any] = {"digest": self._parameters.digest, "revision": self._parameters.current.revision}
        return Member(id, host=socket.gethostname(), pid=os.getpid(), **served, **facts)


class _Planned:
    """The parameters as the group's agreement uses them."""

    def __init__(self, parameters: ParameterControl) -> None:
        self._parameters = parameters
        self.path = parameters.bundle.path

    def follow(self, digest: str, revision: int, values: Mapping[str, Any]) -> dict[str, str]:
        return dict(self._parameters.follow(digest, revision, values))

    @property
    def current(self) -> Parameters:
        return self._parameters.current

    @property
    def digest(self) -> str:
        return self._parameters.digest

    def planned(self, values: Mapping[str, Any], revision: int | None) -> Parameters:
        before = self.current
        if revision is not None and revision != before.revision:
            raise RevisionConflict(self.digest, before)
        entries, problems = changed_entries(before.entries, values)
        if problems:
            raise ParametersRefused(self.digest, problems)
        return before if entries == before.entries else Parameters(before.revision + 1, entries)
