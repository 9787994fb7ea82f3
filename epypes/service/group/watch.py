"""What of the others is worth a line in a replica's log, and who has gone without a word? Pure: times are given."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from math import inf
from typing import Final

from epypes.service.group.membership import Heard, Member, by_name, last_heard

# Who looks less often has not heard anybody meanwhile: the broker was away, or this replica was stopped. Nor may the
# others: so long afterwards they may still wait for their next attempt to connect, and for their next word.
_DEAF_S: Final = 2.0
_BACK_S: Final = 10.0
# For so long, and of so many, is said that they have gone.
_LOST_FOR_S: Final = 600.0
_MOST_LOST: Final = 100
_MOST_MET: Final = 1_000
_DIGITS: Final = 12

Line = tuple[int, str]
# The name of a replica and its host; of two that are there at once only one has it.
_Place = tuple[str, str]


@dataclass(slots=True)
class _Known:
    """A replica that was there, when it was heard last, and what was found to be odd about it."""

    member: Member
    heard_at_s: float
    odd: tuple[str, ...] = ()


class Watch:
    """What was known of the others at the last look."""

    def __init__(self) -> None:
        self._known: dict[str, _Known] = {}
        self._left: set[str] = set()
        self._lost: dict[str, _Known] = {}
        # Whom this replica has heard itself, ever.
        self._met: dict[str, None] = {}
        self._looked_s, self._sure_from_s = -inf, -inf

    def left(self, member_id: str) -> None:
        """Note that a replica has said that it ends."""
        if member_id in self._known:
            self._left.add(member_id)

    def lost(self, now_s: float) -> list[Heard]:
        """Return who has gone without a word in the last ten minutes, and is not back, nor another of the same name."""
        heard = [Heard(known.member, now_s - known.heard_at_s) for known in self._lost.values()]
        return by_name(each for each in heard if each.heard_s <= _LOST_FOR_S)

    def told_of(self, lost: Heard, now_s: float) -> None:
        """Take another one's word for who is lost, if this replica has never heard him: it came later."""
        if lost.member.id not in self._met:
            self._lost.setdefault(lost.member.id, _Known(lost.member, now_s - lost.heard_s))

    def look(self, own: Member, present: list[Heard], now_s: float) -> list[Line]:
        """Return levels and lines for a log: who has come, who has gone, and who does not go with this replica."""
        if self._known and now_s - self._looked_s > _DEAF_S:
            self._sure_from_s = now_s + _BACK_S
        self._looked_s = now_s
        others = {each.member.id: each for each in present if each.member.id != own.id}
        taken = {_place(member) for member in (own, *(each.member for each in others.values()))}
        lines = self._gone(others, taken, now_s)
        for each in others.values():
            lines += self._heard(own, each, now_s)
        self._forget(others, taken)
        return lines

    def _gone(self, others: dict[str, Heard], taken: set[_Place], now_s: float) -> list[Line]:
        lines: list[Line] = []
        for key in [key for key in self._known if key not in others]:
            known = self._known[key]
            if key in self._left:
                lines.append((logging.INFO, f"{_called(known.member)} has left the group"))
            elif now_s < self._sure_from_s:
                continue
            elif _place(known.member) in taken:
                text = f"has come again, in place of process {known.member.pid}, which has not said that it ends"
                lines.append((logging.INFO, f"{_called(known.member)} {text}"))
            else:
                text = f"is gone: {last_heard(now_s - known.heard_at_s)}"
                lines.append((logging.WARNING, f"{_called(known.member)} {text}"))
                self._lost[key] = known
            del self._known[key]
        self._left.clear()
        return lines

    def _heard(self, own: Member, other: Heard, now_s: float) -> list[Line]:
        member, lines = other.member, list[Line]()
        known = self._known.get(member.id)
        if known is None:
            known = self._known[member.id] = _Known(member, now_s)
            self._met[member.id] = None
            lines.append((logging.INFO, f"{_called(member)} is in the group"))
        odd = tuple(odds(own, member))
        lines += [(logging.WARNING, f"{_called(member)} {text}") for text in odd if text not in known.odd]
        known.member, known.heard_at_s, known.odd = member, now_s - other.heard_s, odd
        return lines

    def _forget(self, others: dict[str, Heard], taken: set[_Place]) -> None:
        """Have nobody be lost who is back, or whose name another one has now, and nothing be kept without end."""
        for key, known in list(self._lost.items()):
            if key in others or _place(known.member) in taken:
                del self._lost[key]
        for kept, most in ((self._lost, _MOST_LOST), (self._met, _MOST_MET)):
            for key in list(kept)[:-most]:
                del kept[key]


def odds(own: Member, other: Member) -> list[str]:
    """Return why another replica should not take events from the same queue as this one, each after its name."""
    found = []
    if own.name != other.name:
        found.append(
            f"serves another bundle from the same queue, {_served(other)}, and this one serves {_served(own)}: "
            "each takes events of the other. Give each bundle a queue of its own."
        )
    if own.ordered != other.ordered:
        does, own_does = ("keeps", "does not") if other.ordered else ("does not keep", "does")
        text = f"{does} the order of events, and this one {own_does}: answers come out of order."
        found.append(f"{text} Serve all replicas with --ordered, or none.")
    return found


def _served(member: Member) -> str:
    return f"{member.name or 'without a name'} ({member.digest[:_DIGITS]})"


def _place(member: Member) -> _Place:
    return member.replica, member.host


def _called(member: Member) -> str:
    return f"replica {member.replica} at {member.host}"
