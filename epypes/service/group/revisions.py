"""Which hyperparameters have the replicas agreed on? What one order of proposals makes of them, for whoever reads it.

Pure. All replicas read one log, so all of them accept and refuse the same proposals. Each proposal has all values in
it, so that whoever has missed some, or finds the newest alone in a log that keeps no more, goes on from that.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Final, Literal

# Of a log: "known" has been accepted before.
Verdict = Literal["accepted", "refused", "known"]
_MOST_DIGESTS: Final = 1_000
# Whoever says one so far above what is known is none of us; after it no change could be counted any more.
_MOST_AHEAD: Final = 2**32


@dataclass(frozen=True, slots=True)
class Proposal:
    """A change of hyperparameters, as it stands in the log.

    Attributes
    ----------
    id
        Its own.
    digest
        The bundle whose hyperparameters they are.
    base
        The revision that was changed.
    revision
        The one that it becomes, above ``base``.
    values
        All values after it, by token as in pipeline.toml; none: those of the bundle.
    is_restated
        Whether it was accepted before, and stands there again for who has missed it.
    """

    id: str
    digest: str
    base: int
    revision: int
    values: Mapping[str, Any]
    is_restated: bool = False


class Revisions:
    """The hyperparameters that were agreed on, by bundle, after as much of the log as was read."""

    def __init__(self) -> None:
        self._accepted: dict[str, Proposal] = {}
        self._last: tuple[Proposal, Verdict] | None = None

    def take(self, proposal: Proposal) -> Verdict:
        """Take the next entry of the log; return what becomes of it."""
        now = self._accepted.get(proposal.digest)
        verdict = _verdict(proposal, now)
        if verdict == "accepted":
            self._keep(replace(proposal, is_restated=False))
        self._last = proposal, verdict
        return verdict

    def _keep(self, proposal: Proposal) -> None:
        # What was changed last comes last, so that the first is the one to forget.
        self._accepted.pop(proposal.digest, None)
        self._accepted[proposal.digest] = proposal
        if len(self._accepted) > _MOST_DIGESTS:
            del self._accepted[next(iter(self._accepted))]

    def accepted(self, digest: str) -> Proposal | None:
        """Return the change that was accepted last for a bundle; None if there was none."""
        return self._accepted.get(digest)

    def revision(self, digest: str) -> int:
        """Return the revision that was agreed on for a bundle; 0 for its own values."""
        now = self._accepted.get(digest)
        return 0 if now is None else now.revision

    def owed(self) -> Proposal | None:
        """Return what must be said again: the newest entry was refused, and some logs keep the newest alone."""
        if self._last is None or self._last[1] != "refused":
            return None
        return self.restated(self._last[0].digest)

    def restated(self, digest: str) -> Proposal | None:
        """Return what was accepted last for a bundle, to be said again; None if there was nothing."""
        now = self._accepted.get(digest)
        return None if now is None else replace(now, is_restated=True)


def _verdict(proposal: Proposal, now: Proposal | None) -> Verdict:
    if now is not None and proposal.id == now.id:
        return "known"
    at = 0 if now is None else now.revision
    if not max(proposal.base, 0) < proposal.revision <= at + _MOST_AHEAD:
        return "refused"
    if proposal.is_restated:
        # At the same revision somebody has found a proposal alone that was refused; what is said again corrects it.
        return "accepted" if proposal.revision >= at else "refused"
    # Whoever has changed a later revision than is known here has read what was missed here.
    return "accepted" if proposal.base >= at else "refused"
