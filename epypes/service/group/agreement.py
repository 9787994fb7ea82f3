"""How do all replicas come to have the same hyperparameters, with one revision?

A change is proposed in a log that all read in one order, accepted or refused there by one rule (`revisions.py`), and
made by each replica when it reads it. RabbitMQ and NATS keep that log. An MQTT server keeps its newest entry alone: who
was away is told that, and what holds is said again where the newest was refused or is another bundle's. Of two changes
that were proposed at once a replica that comes back just then may compute with the refused one for a moment; and if
all replicas end, only the parameters of the bundle that were changed last are there when they begin again.
"""

from __future__ import annotations

import logging
import threading
import uuid
from collections.abc import Callable, Mapping
from pathlib import Path
from time import monotonic
from typing import Any, Final, Protocol

from epypes.errors import BrokerError, MessageError, RevisionConflict, ServiceError
from epypes.service.group.notices import read_proposal, written
from epypes.service.group.revisions import Proposal, Revisions, Verdict
from epypes.service.group.talk import Talk
from epypes.service.parameters import Parameters, value_of
from epypes.transport.channels import Place, Received

_log = logging.getLogger("epypes.service")
_POLL_S: Final = 0.5
# So long a replica must know less than others before they say again what holds: it may be reading just now.
_LAG_S: Final = 3.0
# How long each gives the one before it to say what holds.
_TURN_S: Final = 0.5
_MOST_VERDICTS: Final = 10_000


class Tuned(Protocol):
    """What an agreement needs of a service's parameters."""

    @property
    def current(self) -> Parameters:
        """Those of now."""

    @property
    def digest(self) -> str:
        """Of the bundle that they are of."""

    @property
    def path(self) -> Path:
        """Of the bundle."""

    def planned(self, values: Mapping[str, Any], revision: int | None) -> Parameters:
        """Return what a change would make of them, having asked the worker whether it takes it; changes nothing."""

    def follow(self, digest: str, revision: int, values: Mapping[str, Any]) -> dict[str, str]:
        """Take values that were agreed on; return the worker's problems."""


class Agreement:
    """The hyperparameters of a group, as this replica knows them.

    Parameters
    ----------
    place
        Of the log.
    tuned
        The parameters of this replica.
    timeout_s
        How long a change may take, in seconds.
    rank
        Returns how many replicas come before this one in saying again what holds; most often the first one does.
    changed
        Called when something may be another now; on the thread of the log.

    Attributes
    ----------
    trouble
        Why this replica does not follow the others; empty if it does.
    rejected
        How many entries of the log were none of a replica's.
    """

    def __init__(
        self,
        place: Place,
        tuned: Tuned,
        timeout_s: float,
        rank: Callable[[], int],
        changed: Callable[[], object],
    ) -> None:
        self._tuned, self._timeout_s = tuned, timeout_s
        self._rank, self._changed = rank, changed
        self._talk = Talk(place, self._hear, self._pause)
        self._revisions = Revisions()
        self._heard, self._own_turn = threading.Condition(), threading.Lock()
        self._verdicts: dict[str, Verdict] = {}
        # The change that this replica's values have come from, and the one that its worker has not taken.
        self._made = self._refused = ""
        self._is_caught_up = False
        self._lagging_since_s: float | None = None
        self._said_for: tuple[str, int] | None = None
        self._introduced: tuple[str, int] | None = None
        self._owed_since_s: float | None = None
        self._refusal = ""
        self.rejected = 0

    def start(self) -> None:
        """Begin to read the log, as soon as the broker is there."""
        self._talk.start()

    def end_soon(self) -> None:
        """End without waiting for it."""
        self._talk.end_soon()

    def stop(self, timeout_s: float) -> None:
        """End; bounded."""
        self._talk.stop(timeout_s)

    @property
    def trouble(self) -> str:
        """Why this replica does not follow the others; empty if it does."""
        return self._talk.trouble or self._refusal

    @property
    def agreed(self) -> int:
        """The newest revision of this replica's bundle that it has heard of."""
        with self._heard:
            return self._revisions.revision(self._tuned.digest)

    @property
    def is_current(self) -> bool:
        """Whether this replica has read the log to its end, and computes with what was agreed on."""
        with self._heard:
            accepted = self._revisions.accepted(self._tuned.digest)
            return self._is_caught_up and (accepted is None or accepted.id == self._made)

    # -- a change of ours -------------------------------------------------------------------------------------------

    def set(self, values: Mapping[str, Any], revision: int | None) -> Parameters:
        """Change values in all replicas; return all of them when this one has made the change.

        Raises
        ------
        RevisionConflict
            They have another revision by now.
        ParametersRefused
            A value can't be taken; nothing is changed.
        ServiceError
            The group can't be reached, or this replica is busy.
        """
        until_s = monotonic() + self._timeout_s
        # One after the other, so that those of one replica don't refuse each other.
        if not self._own_turn.acquire(timeout=self._timeout_s):
            raise ServiceError(self._tuned.path, "Other changes of parameters are under way. Try again.")
        try:
            return self._set(values, revision, until_s)
        finally:
            self._own_turn.release()

    def _set(self, values: Mapping[str, Any], revision: int | None, until_s: float) -> Parameters:
        while monotonic() < until_s:
            # Before it is planned: what others change meanwhile has this one refused, never lost.
            base = self._current(until_s, revision)
            before, refused = self._tuned.current, self._refused
            planned = self._tuned.planned(values, revision)
            if planned is before and not refused:
                return before
            proposal = self._proposal(planned, base)
            if self._proposed(proposal, until_s) != "refused":
                return self._made_here(proposal, planned, refused, until_s)
            if revision is not None:
                self._wait(lambda: self.is_current, until_s, "has not made the change of another")
                raise RevisionConflict(self._tuned.path, self._tuned.current)
        raise ServiceError(self._tuned.path, "Others change the parameters all the time. Try again.")

    def _current(self, until_s: float, revision: int | None) -> int:
        """Wait until this replica computes with what was agreed on; return the revision of that in the log.

        A change of whatever revision it was may follow on what this replica's worker does not take: there would be
        none any more otherwise, if no worker takes that.
        """

        def is_known() -> bool:
            return self.is_current or (self._is_refused and revision is None)

        if self._talk.trouble:
            text = f"The group can't be reached, so nothing is changed: {self._talk.trouble}"
            raise ServiceError(self._tuned.path, text)
        with self._heard:
            self._wait(is_known, until_s, "has not read what the others have agreed on")
            return self.agreed

    def _proposal(self, planned: Parameters, base: int) -> Proposal:
        values = {token: value_of(entry) for token, entry in planned.entries.items()}
        revision = max(planned.revision, base + 1)
        return Proposal(uuid.uuid4().hex, self._tuned.digest, base, revision, values)

    def _proposed(self, proposal: Proposal, until_s: float) -> Verdict:
        try:
            self._talk.say(written(proposal), id=proposal.id)
        except MessageError as error:
            raise ServiceError(self._tuned.path, f"The parameters can't be sent to the group: {error}") from error
        except BrokerError as error:
            text = f"The group was lost meanwhile, so it is not known whether anything is changed: {error}"
            raise ServiceError(self._tuned.path, f"{text} Look at the parameters when it is there again.") from error
        self._wait(lambda: proposal.id in self._verdicts, until_s, "has not read its own proposal in the log")
        return self._verdicts[proposal.id]

    def _made_here(self, proposal: Proposal, planned: Parameters, refused: str, until_s: float) -> Parameters:
        def is_refused() -> bool:
            return self._refused not in ("", refused)

        def is_made() -> bool:
            # A later change of others has all values of this one that it has not changed itself.
            is_past = self._made == proposal.id or self._tuned.current.revision > proposal.revision
            return is_past or is_refused()

        self._wait(is_made, until_s, f"has not made the change, which is revision {proposal.revision} of all")
        if is_refused():
            raise ServiceError(self._tuned.path, self._refusal)
        return Parameters(proposal.revision, planned.entries)

    @property
    def _is_refused(self) -> bool:
        return bool(self._refusal)

    def _wait(self, is_so: Callable[[], bool], until_s: float, what: str) -> None:
        with self._heard:
            while not is_so():
                left_s = until_s - monotonic()
                if left_s <= 0:
                    why = f": {self.trouble}" if self.trouble else "."
                    raise ServiceError(self._tuned.path, f"This replica {what} within {self._timeout_s:g} s{why}")
                self._heard.wait(min(left_s, _POLL_S))

    # -- what is read in the log, on its thread ---------------------------------------------------------------------

    def _hear(self, received: Received) -> None:
        try:
            proposal = read_proposal(b"".join(received.frames))
        except MessageError as error:
            # Once as a warning: another program may write a lot.
            _log.log(
                logging.DEBUG if self.rejected else logging.WARNING, "passed over in %s: %s", self._talk.place, error
            )
            self.rejected += 1
            return
        with self._heard:
            verdict = self._revisions.take(proposal)
            # One that comes again is not refused for that.
            self._verdicts.setdefault(proposal.id, verdict)
            if len(self._verdicts) > _MOST_VERDICTS:
                del self._verdicts[next(iter(self._verdicts))]
            self._heard.notify_all()

    def _pause(self, is_quiet: bool) -> None:
        """Make what was agreed on, when there is no more to read just now."""
        try:
            self._follow()
            if is_quiet:
                self._quiet()
        except ServiceError as error:
            # There is no worker just now, or it is busy: at the next pause.
            _log.debug("a change of the group waits: %s", error)
        except (BrokerError, MessageError) as error:
            _log.warning("what holds could not be said again: %s", error)
        with self._heard:
            self._heard.notify_all()
        self._changed()

    def _follow(self) -> None:
        with self._heard:
            digest = self._tuned.digest
            accepted = self._revisions.accepted(digest)
        if accepted is None or accepted.id in (self._made, self._refused):
            return
        problems = self._tuned.follow(digest, accepted.revision, accepted.values)
        if problems:
            why = " ".join(f"{token!r}: {problem}" for token, problem in problems.items())
            self._refusal = f"Its worker does not take revision {accepted.revision} of the group. {why}"
            self._refused = accepted.id
            _log.error("%s", self._refusal)
        else:
            self._made, self._refused, self._refusal = accepted.id, "", ""

    def _quiet(self) -> None:
        with self._heard:
            self._is_caught_up = True
            owed = self._revisions.owed()
        self._repay(owed, monotonic())
        self._introduce()

    def _repay(self, owed: Proposal | None, now_s: float) -> None:
        """Say again what holds if the newest entry was refused, unless another one does so first."""
        if owed is None:
            self._owed_since_s = None
            return
        if self._owed_since_s is None:
            self._owed_since_s = now_s
        if now_s - self._owed_since_s >= self._rank() * _TURN_S:
            self._talk.say(written(owed), id=uuid.uuid4().hex)
            self._owed_since_s = now_s + _LAG_S

    # -- what else there is to it -----------------------------------------------------------------------------------

    def taken_over(self, digest: str) -> tuple[int, Mapping[str, Any]] | None:
        """Return revision and values that were agreed on for a bundle that is served from now on; None if none were.

        They count as made: the caller has its worker take them.
        """
        with self._heard:
            accepted = self._revisions.accepted(digest)
            self._made = "" if accepted is None else accepted.id
            self._refused = self._refusal = ""
            return None if accepted is None else (accepted.revision, accepted.values)

    def _introduce(self) -> None:
        """Say to the others with which revision this bundle goes on, if it is one that they can't know."""
        digest, current = self._tuned.digest, self._tuned.current
        with self._heard:
            at = self._revisions.revision(digest)
        if current.revision > at and self._introduced != (digest, current.revision):
            self._talk.say(written(self._proposal(current, at)), id=uuid.uuid4().hex)
            self._introduced = digest, current.revision

    def compare(self, digest: str, agreed: int, now_s: float) -> None:
        """Say again what holds if another replica of this bundle goes on knowing less: it may have missed it."""
        ours = self.agreed
        if digest != self._tuned.digest or agreed >= ours:
            return
        if self._lagging_since_s is None or now_s - self._lagging_since_s > 2 * _LAG_S:
            self._lagging_since_s = now_s
        if now_s - self._lagging_since_s < _LAG_S or self._said_for == (digest, ours):
            return
        with self._heard:
            again = self._revisions.restated(digest)
        if again is not None:
            self._said_for = digest, ours
            self._talk.say(written(again), id=uuid.uuid4().hex)
