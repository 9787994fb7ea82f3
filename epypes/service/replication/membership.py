"""The replicas of a group: which are alive, and which went silent without a goodbye, by their heartbeats.

It has a lock of its own and calls nothing while it is held. Times are those of ``time.monotonic``.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter
from dataclasses import asdict, dataclass
from time import monotonic
from typing import Any, Final

from epypes.service.replication.messages import Heartbeat

# Three heartbeats may be lost before a replica counts as gone.
_SILENT_AFTER_S: Final = 3.5
# A replica that was itself held up, or had no broker, has heard nothing: silence before that proves nothing. The others
# may take as long to connect again.
_HELD_UP_S: Final = 2.0
_GRACE_S: Final = 10.0
_LOST_FOR_S: Final = 600.0
_MAX_MEMBERS: Final = 1_000

_log = logging.getLogger("epypes.service")


@dataclass(slots=True)
class _Member:
    """A replica: its last heartbeat, when that came, and whether the replica went silent since."""

    heartbeat: Heartbeat
    heard_s: float
    is_lost: bool = False


class Membership:
    """The other replicas that one replica has heard of."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._members: dict[str, _Member] = {}
        self._looked_s = self._certain_from_s = 0.0

    def hear(self, heartbeat: Heartbeat) -> Heartbeat | None:
        """Take a heartbeat of another replica; return its last one, None if the replica is new.

        A group that is full takes no new one.
        """
        with self._lock:
            known = self._members.get(heartbeat.id)
            if known is None and len(self._members) >= _MAX_MEMBERS:
                return heartbeat
            self._members[heartbeat.id] = _Member(heartbeat, monotonic())
        if known is None or known.is_lost:
            _log.info("%s is in the group", label(heartbeat))
            return None
        return known.heartbeat

    def forget(self, replica_id: str) -> None:
        """Forget a replica that has stopped in order."""
        with self._lock:
            known = self._members.pop(replica_id, None)
        if known is not None:
            _log.info("%s has left the group", label(known.heartbeat))

    def look_for_lost(self, own: Heartbeat, is_away: bool) -> None:
        """Find the members that went silent; called with each own heartbeat.

        Parameters
        ----------
        own
            Of this replica: one that has its name, on its machine, was replaced by it.
        is_away
            Whether the broker is not connected.
        """
        now_s = monotonic()
        if is_away or (self._looked_s and now_s - self._looked_s > _HELD_UP_S):
            self._certain_from_s = now_s + _GRACE_S
        self._looked_s = now_s
        with self._lock:
            members = [*self._members.values()]
            silent = [each for each in members if not each.is_lost and now_s - each.heard_s > _SILENT_AFTER_S]
            newly_lost = silent if now_s >= self._certain_from_s else []
            for each in newly_lost:
                each.is_lost = True
            present = {_place(own), *(_place(each.heartbeat) for each in members if not each.is_lost)}
            for each in members:
                if each.is_lost and (now_s - each.heard_s > _LOST_FOR_S or _place(each.heartbeat) in present):
                    del self._members[each.heartbeat.id]
        for each in newly_lost:
            _log.warning("%s is gone: no heartbeat for %.1f s", label(each.heartbeat), now_s - each.heard_s)

    def present(self) -> list[Heartbeat]:
        """Return the last heartbeats of the others that are alive."""
        with self._lock:
            return [each.heartbeat for each in self._members.values() if not each.is_lost]

    def serving(self, digest: str) -> list[Heartbeat]:
        """Return the last heartbeats of the others that serve a bundle."""
        return [heartbeat for heartbeat in self.present() if heartbeat.digest == digest]

    def describe(self, own: Heartbeat) -> dict[str, Any]:
        """Return the fields of `Replicas.describe` that are about members, this replica among them."""
        now_s = monotonic()
        with self._lock:
            members = sorted([_Member(own, now_s), *self._members.values()], key=_order)
        lost = [each for each in members if each.is_lost]
        present = [each for each in members if not each.is_lost and now_s - each.heard_s <= _SILENT_AFTER_S]
        heartbeats = [each.heartbeat for each in present]
        counts: Counter[str] = Counter()
        for heartbeat in heartbeats:
            counts.update(heartbeat.counts)
        return {
            "replicas": len(present),
            "ready": sum(heartbeat.state == "READY" for heartbeat in heartbeats),
            "counts": dict(counts),
            "agree": len({(heartbeat.digest, heartbeat.revision) for heartbeat in heartbeats}) <= 1,
            "members": [_describe(each, now_s, own.id) for each in present],
            "lost": [_describe(each, now_s, own.id) for each in lost],
        }


def label(heartbeat: Heartbeat) -> str:
    """Return how log lines name a replica."""
    return f"replica {heartbeat.replica} at {heartbeat.host}"


def _describe(member: _Member, now_s: float, own_id: str) -> dict[str, Any]:
    # A heartbeat may have come since `now_s`.
    silent_s = max(now_s - member.heard_s, 0.0)
    found = asdict(member.heartbeat)
    is_self = found.pop("id") == own_id
    del found["author"], found["kind"]
    if member.is_lost:
        text = f"no heartbeat for {silent_s:.1f} s, and it did not stop in order; its counts are of then"
        found |= {"state": "LOST", "reason": text}
    return {**found, "heard_s": round(silent_s, 3), "is_self": is_self}


def _order(member: _Member) -> tuple[int, str, str]:
    heartbeat = member.heartbeat
    return len(heartbeat.replica), heartbeat.replica, heartbeat.id


def _place(heartbeat: Heartbeat) -> tuple[str, str]:
    return heartbeat.replica, heartbeat.host
