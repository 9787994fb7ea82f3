"""Does a broker send no more since nobody says a word on what it has sent?"""

from __future__ import annotations

import itertools
import logging
from time import monotonic
from typing import Final

from epypes.transport.channels.place import Place
from epypes.transport.channels.seam import Received

log = logging.getLogger("epypes.transport")

LONG_S: Final = 10.0


class InHand:
    """What was delivered over one connection, and not settled yet; a word on it may come from any thread.

    Parameters
    ----------
    place
        Where it comes from.
    most
        How many the broker lets be in hand.
    """

    def __init__(self, place: Place, most: int) -> None:
        self._place, self._most = place, most
        self._numbers = itertools.count()
        # Without a lock: a word may be said in a handler of signals, or in a forked child.
        self._open: set[int] = set()
        self._changed_s = monotonic()

    def take(self, received: Received) -> None:
        """Take note of a delivery, until it is settled."""
        number, settle = next(self._numbers), received.settle

        def settled(reason: str | None) -> None:
            self._open.discard(number)
            self._changed_s = monotonic()
            settle(reason)

        received.settle = settled
        self._open.add(number)
        self._changed_s = monotonic()

    @property
    def is_stuck(self) -> bool:
        """Whether nothing more can come, and no word was said for long."""
        return len(self._open) >= self._most and monotonic() - self._changed_s > LONG_S

    def warn(self) -> None:
        """Say in the log what helps."""
        text = (
            "%s sends nothing more: %d messages are in hand, and for %g s none was acknowledged. Whoever takes them "
            "from the queue calls ack() on each when it is done; or give the Subscriber acknowledge='received'."
        )
        log.warning(text, self._place, len(self._open), LONG_S)
