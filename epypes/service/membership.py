"""The replicas of a group: which are alive, and which went silent without a goodbye, by their heartbeats.

It has a lock of its own and calls nothing while it is held. Times are those of ``time.monotonic``.
"""

from __future__ import annotations

import logging
import threading
from collections import Counter, deque
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from time import monotonic
from typing import Any, Final

from epypes.service.replica_messages import Heartbeat, Member

# Three heartbeats may be lost before a replica counts as gone.
_SILENT_AFTER_S: Final = 3.5
# A replica that was itself held up, or had no broker, has heard nothing: silence before that proves nothing. The others
# may take as long to connect again.
_HELD_UP_S: Final = 2.0
_GRACE_S: Final = 10.0
_LOST_FOR_S: Final = 600.0
_MAX_MEMBERS: Final = 1_000
_MAX_LOST: Final = 50

_log = logging.getLogger("epypes.service")


@dataclass(frozen=True, slots=True)
class _Heard:
    member: Member
    heard_s: float


class Membership:
    """The other replicas that one replica has heard of.

    Parameters
    ----------
    own_id
        Of this replica, which is never among the others.
    """

    def __init__(self, own_id: str) -> None:
        self._own_id, self._lock = own_id, threading.Lock()
        self._members: dict[str, _Heard] = {}
        self._lost: dict[str, _Heard] = {}
        self._left: deque[str] = deque(maxlen=_MAX_MEMBERS)
        self._looked_s = self._certain_from_s = 0.0

    def hear(self, heartbeat: Heartbeat) -> Member | None:
        """Take a heartbeat of another replica; return what its last one said, None if the replica is new.

        A group that is full takes no new one.
        """
        member, now_s = heartbeat.member, monotonic()
        with self._lock:
            known = self._members.get(member.id)
            if known is None and len(self._members) >= _MAX_MEMBERS:
                return member
            self._members[member.id] = _Heard(member, now_s)
            self._lost.pop(member.id, None)
            for lost, silent_ms in heartbeat.lost:
                is_known = lost.id == self._own_id or lost.id in self._members or lost.id in self._left
                if not is_known and len(self._lost) < _MAX_LOST:
                    self._lost.setdefault(lost.id, _Heard(lost, now_s - silent_ms / 1e3))
        if known is None:
            _log.info("%s is in the group", label(member))
            return None
        return known.member

    def forget(self, member_id: str) -> None:
        """Forget a replica that has stopped in order."""
        with self._lock:
            self._left.append(member_id)
            self._lost.pop(member_id, None)
            known = self._members.pop(member_id, None)
        if known is not None:
            _log.info("%s has left the group", label(known.member))

    def look_for_lost(self, own: Member, is_away: bool) -> list[tuple[Member, int]]:
        """Return the members that went silent, and for how many milliseconds; called with each own heartbeat.

        Parameters
        ----------
        own
            This replica: one that has its name, on its machine, was replaced by it.
        is_away
            Whether the broker is not connected.
        """
        now_s = monotonic()
        if is_away or (self._looked_s and now_s - self._looked_s > _HELD_UP_S):
            self._certain_from_s = now_s + _GRACE_S
        self._looked_s = now_s
        with self._lock:
            silent = [each for each in self._members.values() if now_s - each.heard_s > _SILENT_AFTER_S]
            newly_lost = silent if now_s >= self._certain_from_s else []
            for each in newly_lost:
                self._lost[each.member.id] = self._members.pop(each.member.id)
            present = {_place(own), *(_place(each.member) for each in self._members.values())}
            recent = {
                key: each
                for key, each in self._lost.items()
                if now_s - each.heard_s <= _LOST_FOR_S and _place(each.member) not in present
            }
            self._lost = dict([*recent.items()][-_MAX_LOST:])
            lost = [*self._lost.values()]
        for each in newly_lost:
            _log.warning("%s is gone: no heartbeat for %.1f s", label(each.member), now_s - each.heard_s)
        return [(each.member, int((now_s - each.heard_s) * 1e3)) for each in lost]

    def serving(self, digest: str) -> list[Member]:
        """Return the others that serve a bundle."""
        with self._lock:
            return [each.member for each in self._members.values() if each.member.digest == digest]

    def describe(self, own: Member) -> dict[str, Any]:
        """Return the fields of `Replicas.describe` that are about members, this replica among them."""
        now_s = monotonic()
        with self._lock:
            members, lost = [_Heard(own, now_s), *self._members.values()], [*self._lost.values()]
        present = [each for each in _by_name(members) if now_s - each.heard_s <= _SILENT_AFTER_S]
        counts: Counter[str] = Counter()
        for each in present:
            counts.update(each.member.counts)
        return {
            "replicas": len(present),
            "ready": sum(each.member.state == "READY" for each in present),
            "counts": dict(counts),
            "agree": len({(each.member.digest, each.member.revision) for each in present}) <= 1,
            "members": [_describe(each, now_s, own.id) for each in present],
            "lost": [_describe(_as_lost(each, now_s), now_s, own.id) for each in _by_name(lost)],
        }


def label(member: Member) -> str:
    """Return how log lines name a replica."""
    return f"replica {member.replica} at {member.host}"


def _describe(heard: _Heard, now_s: float, own_id: str) -> dict[str, Any]:
    found = asdict(heard.member)
    is_self = found.pop("id") == own_id
    del found["author"]
    # A heartbeat may have come since `now_s`.
    return {**found, "heard_s": round(max(now_s - heard.heard_s, 0.0), 3), "is_self": is_self}


def _as_lost(heard: _Heard, now_s: float) -> _Heard:
    text = f"no heartbeat for {now_s - heard.heard_s:.1f} s, and it did not stop in order; its counts are of then"
    return replace(heard, member=replace(heard.member, state="LOST", reason=text))


def _by_name(heard: Iterable[_Heard]) -> list[_Heard]:
    return sorted(heard, key=lambda each: (len(each.member.replica), each.member.replica, each.member.id))


def _place(member: Member) -> tuple[str, str]:
    return member.replica, member.host
