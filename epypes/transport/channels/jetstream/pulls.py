"""How many messages may still come without being asked for anew? What a receiver has asked a NATS server for, counted.

A receiver never waits for an answer to "the next message, please": it has asked already. What it has asked for and what
it holds are together no more than its prefetch, so a busy receiver leaves the rest to others. Each request ends by
itself after a few seconds, and is replaced: a receiver whose link is cut is given nothing for longer than that.
"""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from typing import Final

# Shorter than the wait for an acknowledgement, so that what a cut receiver was given last comes to another one.
EXPIRES_S: Final = 4.0
_GRACE_S: Final = 1.0


def request(batch: int) -> bytes:
    """Return what the server is told: so many messages, as they come."""
    return json.dumps({"batch": batch, "expires": int(EXPIRES_S * 1e9)}).encode()


@dataclass(slots=True)
class Pulls:
    """What was asked for and has not come.

    Attributes
    ----------
    room
        How many messages may be held and asked for, together.
    more
        How many more than that just now: each is asked for as soon as it may be.
    expected
        How many were asked for and have not come.
    """

    room: int
    more: int = 0
    expected: int = 0
    _until_s: dict[int, float] = field(default_factory=dict)
    _last: int = 0

    def came(self) -> None:
        """Count a message that came."""
        self.expected = max(self.expected - 1, 0)

    def ended(self, number: int, pending: int) -> None:
        """Count a request that the server has ended, so many messages short."""
        if self._until_s.pop(number, None) is not None:
            self.expected = max(self.expected - pending, 0)

    def _give_up(self, now_s: float) -> None:
        # In order of their ends; there may be a thousand, and this is asked at each message.
        while self._until_s:
            number, until_s = next(iter(self._until_s.items()))
            if until_s >= now_s:
                return
            del self._until_s[number]
        self.expected = 0

    def wanted(self, held: int, now_s: float, *, is_due: bool = False) -> tuple[int, int]:
        """Return the number of a request to be made and how many messages it is for; 0 if none is to be made.

        Not one by one as they are settled, but when half of the room is free: a request costs as much as a message.
        Now and then, when it is due, also for less: who holds more than half may wait for another one to go on.
        """
        self._give_up(now_s)
        free = self.room + self.more - held - self.expected
        if free < (1 if self.more or is_due else max(self.room // 2, 1)):
            return 0, 0
        self._last += 1
        self._until_s[self._last] = now_s + EXPIRES_S + _GRACE_S
        self.expected += free
        return self._last, free
