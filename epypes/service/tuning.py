"""How are the parameters of a running service changed? All or nothing, between two events, with a revision."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from epypes.errors import ParametersRefused, RevisionConflict, ServiceError
from epypes.service.desk import Desk
from epypes.service.dispatch import Dispatcher
from epypes.service.link import Link
from epypes.service.parameters import Entries, Parameters, changed, differing_values, misfits, value_of, with_value
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

    Attributes
    ----------
    current
        The parameters.
    served, path
        The bundle that they are of, and that of the first one.
    """

    def __init__(self, served: Served, dispatcher: Dispatcher, desk: Desk, timeout_s: float) -> None:
        self.current = Parameters(0, served.entries)
        self.served, self.path = served, served.path
        # Returns revision and values by token that the replicas of a bundle have agreed on; None if there are none.
        self.agreed: Callable[[str], tuple[int, Mapping[str, Any]] | None] = lambda digest: None
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
        with self._alone():
            while True:
                before, wanted, sent = self._wanted(values, revision)
                if not sent:
                    return before
                link = self._begin(before, wanted)
                if link is not None:
                    return self._sent(link, wanted, sent)

    def _sent(self, link: Link, wanted: Parameters, sent: Mapping[str, Any]) -> Parameters:
        problems = link.change(wanted.revision, sent, self._timeout_s)
        if problems:
            raise ParametersRefused(self.path, problems)
        if self.current is not wanted:
            # Another bundle has taken over meanwhile, with parameters of its own.
            raise RevisionConflict(self.path, self.current)
        return wanted

    @contextmanager
    def _alone(self) -> Iterator[None]:
        if not self._turn.acquire(timeout=self._timeout_s):
            raise ServiceError(self.path, "Other changes of parameters are under way. Try again.")
        try:
            yield
        finally:
            self._turn.release()
            self._dispatcher.publish()

    def _wanted(
        self, values: Mapping[str, Any], revision: int | None
    ) -> tuple[Parameters, Parameters, dict[str, dict[str, Any]]]:
        """Return what is, what a change makes of it, and what the worker must be told of that."""
        before = self.current
        if revision is not None and revision != before.revision:
            raise RevisionConflict(self.path, before)
        after, problems = changed(before.entries, values)
        if problems:
            raise ParametersRefused(self.path, problems)
        wanted = Parameters(before.revision + 1, after)
        return before, wanted, _differing(before.entries, after)

    # -- among replicas ---------------------------------------------------------------------------------------------

    @property
    def digest(self) -> str:
        """Of the bundle that the parameters are of."""
        return self.served.digest

    def planned(self, values: Mapping[str, Any], revision: int | None) -> Parameters:
        """Return what a change would make of them, which the worker takes; the same ones if it changes nothing.

        Raises
        ------
        RevisionConflict, ParametersRefused, ServiceError
            As `set` does.
        """
        with self._alone():
            before, wanted, sent = self._wanted(values, revision)
            if not sent:
                return before
            problems = self._link().change(wanted.revision, sent, self._timeout_s, is_trial=True)
            if problems:
                raise ParametersRefused(self.path, problems)
            return wanted

    def follow(self, digest: str, revision: int, values: Mapping[str, Any]) -> dict[str, str]:
        """Take values that the replicas of a bundle have agreed on, and their revision; return the worker's problems.

        Raises
        ------
        ServiceError
            There is no worker, it is busy, or it is one of another bundle by now.
        """
        with self._alone():
            before, served = self.current, self.served
            if served.digest == digest and (problems := misfits(served.entries, values)):
                return problems
            wanted = Parameters(revision, _with_values(served.entries, values))
            link = self._begin(before, wanted) if served.digest == digest else None
            if link is None:
                raise ServiceError(self.path, "Another bundle has taken over. Try again.")
            return link.change(revision, _differing(before.entries, wanted.entries), self._timeout_s)

    def _begin(self, before: Parameters, wanted: Parameters) -> Link | None:
        """Return the worker that is to take a change; None if it is one of other parameters by now."""
        with self._dispatcher.changed:
            if self.current is not before:
                return None
            link = self._link()
            if self._pending is not None:
                raise ServiceError(self.path, "A change is waiting for an event to end. Try again in a moment.")
            self._pending = wanted
            return link

    def _link(self) -> Link:
        link = self._dispatcher.link
        if link is None:
            raise ServiceError(self.path, "There is no worker just now. Try again in a moment.")
        return link

    def heard(self, link: Link, header: Mapping[str, Any]) -> None:
        """Take a worker's word on a change; called on its reading thread, before events that come after it."""
        with self._dispatcher.changed:
            pending = self._pending
            if link is not self._dispatcher.link or header["kind"] == "parameters_tried":
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

    def take_over(self, served: Served) -> None:
        """Begin anew with the parameters of another bundle, or with those that its replicas have. With the lock held.

        The revision rises, so that whoever has seen an earlier one knows that these are newer.
        """
        self._pending, self.served = None, served
        agreed = self.agreed(served.digest)
        revision, values = agreed or (0, {})
        problems = misfits(served.entries, values)
        if problems:
            _log.error("what is agreed on as revision %d of %s is passed over: %s", revision, served.path, problems)
            # So that its own values come after it, for all.
            revision, values = revision + 1, {}
        self._change(Parameters(max(revision, self.current.revision + 1), _with_values(served.entries, values)))


def _differing(before: Entries, after: Entries) -> dict[str, dict[str, Any]]:
    """Return the values of those entries that have another one."""
    return {token: value_of(entry) for token, entry in after.items() if entry != before.get(token)}


def _with_values(entries: Entries, values: Mapping[str, Any]) -> Entries:
    """Return entries with these values, and with their own where there is none."""
    return {token: with_value(entry, values[token]) if token in values else entry for token, entry in entries.items()}
