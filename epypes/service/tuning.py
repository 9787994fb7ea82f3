"""How are the parameters of a running service changed? All or nothing, between two events, with a revision."""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping
from typing import Any

from epypes.errors import ParametersRefused, RevisionConflict, ServiceError
from epypes.service.dispatch import Dispatcher
from epypes.service.link import Link
from epypes.service.outcome import Desk
from epypes.service.parameters import Entries, Parameters, changed, differing_values, value_of
from epypes.service.served import Served

_log = logging.getLogger("epypes.service")


class Tuning:
    """The parameters of the worker, kept over its restarts.

    Parameters
    ----------
    served
        The bundle, whose parameters are the first ones.
    dispatcher
        Who knows the worker.
    desk
        Who tells of changes.
    timeout_s
        How long a change may wait for the event that is worked on, in seconds.
    """

    def __init__(self, served: Served, dispatcher: Dispatcher, desk: Desk, timeout_s: float) -> None:
        self.current = Parameters(0, served.entries)
        self._path = served.path
        self._dispatcher, self._desk, self._timeout_s = dispatcher, desk, timeout_s
        self._turn = threading.Lock()
        self._pending: Parameters | None = None

    def set(self, values: Mapping[str, Any], revision: int | None) -> Parameters:
        """Change values; return all of them, with their revision.

        Raises
        ------
        RevisionConflict
            They have another revision by now.
        ParametersRefused
            A value can't be taken; nothing is changed.
        ServiceError
            There is no worker, or it is busy.
        """
        if not self._turn.acquire(timeout=self._timeout_s):
            raise ServiceError(self._path, "Other changes of parameters are under way. Try again.")
        try:
            return self._set(values, revision)
        finally:
            self._turn.release()
            self._dispatcher.publish()

    def _set(self, values: Mapping[str, Any], revision: int | None) -> Parameters:
        link: Link | None = None
        while link is None:
            before = self.current
            if revision is not None and revision != before.revision:
                raise RevisionConflict(self._path, before)
            after, problems = changed(before.entries, values)
            if problems:
                raise ParametersRefused(self._path, problems)
            sent = {token: value_of(after[token]) for token in values if after[token] != before.entries[token]}
            if not sent:
                return before
            wanted = Parameters(before.revision + 1, after)
            link = self._begin(before, wanted)
        problems = link.change(wanted.revision, sent, self._timeout_s)
        if problems:
            raise ParametersRefused(self._path, problems)
        if self.current is not wanted:
            # Another bundle has taken over meanwhile, with parameters of its own.
            raise RevisionConflict(self._path, self.current)
        return wanted

    def _begin(self, before: Parameters, wanted: Parameters) -> Link | None:
        """Return the worker that is to take a change; None if it is one of other parameters by now."""
        with self._dispatcher.changed:
            if self.current is not before:
                return None
            link = self._dispatcher.link
            if link is None:
                raise ServiceError(self._path, "There is no worker just now. Try again in a moment.")
            if self._pending is not None:
                raise ServiceError(self._path, "A change is waiting for an event to end. Try again in a moment.")
            self._pending = wanted
            return link

    def heard(self, link: Link, header: Mapping[str, Any]) -> None:
        """Take a worker's word on a change; called on its reading thread, before events that come after it."""
        with self._dispatcher.changed:
            pending = self._pending
            if link is not self._dispatcher.link:
                return
            if pending is None or header.get("revision") != pending.revision:
                return
            self._pending = None
            if header["kind"] == "parameters":
                changes = differing_values(self.current.entries, self.current.entries, pending.entries)
                _log.info("parameters, revision %d: %s", pending.revision, "; ".join(changes))
                self._change(pending)

    def _change(self, parameters: Parameters) -> None:
        self.current = parameters
        told = {"revision": parameters.revision, "parameters": parameters.entries}
        self._dispatcher.tell(lambda: self._desk.tell("parameters", told))

    def for_new_worker(self) -> tuple[int, dict[str, Any]] | None:
        """Return the revision and the values that a new worker must take; None if it has them. With the lock held."""
        # What the last worker was told and has not confirmed, nothing was computed with that anybody saw.
        self._pending = None
        if not self.current.revision:
            return None
        return self.current.revision, {token: value_of(entry) for token, entry in self.current.entries.items()}

    def take_over(self, entries: Entries) -> None:
        """Begin anew with the parameters of another bundle. With the lock held."""
        self._pending = None
        self._change(Parameters(self.current.revision + 1, entries))
