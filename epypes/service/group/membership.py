"""Which replicas of a bundle live, and what do they say of themselves? Pure: times are given."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

# Three of its words may be lost before a replica counts as gone.
LOST_S: Final = 3.5
# The state of a replica that has gone without a word; none says it of itself.
LOST: Final = "LOST"
# Replicas come and go under names of their own; nobody runs as many at once.
_MOST: Final = 1_000


@dataclass(frozen=True, slots=True)
class Member:
    """What a replica says of itself, each second.

    Attributes
    ----------
    id
        Its own, from its start on; no other replica has had it.
    replica, host, pid
        Which one it is, to people.
    state, reason
        As of the service.
    digest, revision
        Of the bundle that it serves, and of the hyperparameters that it computes with.
    agreed
        The newest revision that it has heard of in the log; above ``revision`` while its worker is being told.
    counts
        Of its events.
    http
        Where it answers over HTTP; empty if it does not.
    trouble
        Why it does not follow the others; empty if it does.
    name
        Of the bundle.
    ordered
        Whether it keeps the order of events.
    """

    id: str
    replica: str
    host: str = ""
    pid: int = 0
    state: str = ""
    reason: str = ""
    digest: str = ""
    revision: int = 0
    agreed: int = 0
    counts: Mapping[str, int] = field(default_factory=dict)
    http: str = ""
    trouble: str = ""
    name: str = ""
    ordered: bool = False


@dataclass(frozen=True, slots=True)
class Heard:
    """What a replica said last, and how many seconds ago it was heard."""

    member: Member
    heard_s: float


class Membership:
    """Who was heard of, and when."""

    def __init__(self) -> None:
        self._heard: dict[str, tuple[Member, float]] = {}

    def heard(self, member: Member, now_s: float, *, is_self: bool = False) -> bool:
        """Note what a replica says of itself; return whether nobody knew it. There is always room for this one."""
        self._forget(now_s)
        is_new = member.id not in self._heard
        if is_new and len(self._heard) >= _MOST and not is_self:
            return False
        self._heard[member.id] = member, now_s
        return is_new

    def left(self, member_id: str) -> None:
        """Note that a replica has said that it ends."""
        self._heard.pop(member_id, None)

    def present(self, now_s: float) -> list[Heard]:
        """Return the replicas that live, in the order of their names."""
        self._forget(now_s)
        return by_name(Heard(member, max(now_s - at_s, 0.0)) for member, at_s in self._heard.values())

    def _forget(self, now_s: float) -> None:
        gone = [key for key, (_, at_s) in self._heard.items() if now_s - at_s > LOST_S]
        for key in gone:
            del self._heard[key]


def by_name(heard: Iterable[Heard]) -> list[Heard]:
    """Return replicas in the order of their names, as people count."""
    return sorted(heard, key=lambda each: (len(each.member.replica), each.member.replica, each.member.id))


def summary(present: list[Heard]) -> dict[str, Any]:
    """Return what there is to say of all replicas together, JSON-ready.

    Returns
    -------
    dict
        ``replicas``: how many live; ``ready``: how many of them answer; ``counts``: the sums of theirs; ``agree``:
        whether all serve one bundle with one revision.
    """
    counts: Counter[str] = Counter()
    for each in present:
        counts.update(each.member.counts)
    served = {(each.member.digest, each.member.revision) for each in present}
    return {
        "replicas": len(present),
        "ready": sum(each.member.state == "READY" for each in present),
        "counts": dict(counts),
        "agree": len(served) <= 1,
    }


def told(heard: Heard, *, is_self: bool) -> dict[str, Any]:
    """Return what there is to say of one replica, JSON-ready."""
    member = heard.member
    names = ("replica", "host", "pid", "state", "reason", "name", "digest", "revision", "ordered", "http", "trouble")
    said = {name: getattr(member, name) for name in names}
    return {**said, "counts": dict(member.counts), "heard_s": round(heard.heard_s, 3), "is_self": is_self}


def told_lost(heard: Heard) -> dict[str, Any]:
    """Return the same of one that has gone without a word."""
    return {
        **told(heard, is_self=False),
        "state": LOST,
        "reason": f"{last_heard(heard.heard_s)}; its counts are of then",
    }


def last_heard(heard_s: float) -> str:
    """Return since when nothing is known of a replica: a sentence without its full stop."""
    return f"it was heard last {heard_s:.1f} s ago, and has not said that it ends"
