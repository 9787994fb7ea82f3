"""The attempt of an event that failed."""

from __future__ import annotations

import threading
from collections import OrderedDict
from typing import Any, Final

# Ids of events that failed: some for every event that may be sent again.
_MOST_REMEMBERED: Final = 1_000


def event_id(event: Any) -> str:
    """Return an event's id, if it has one that is a string; empty otherwise."""
    try:
        found = event.id
        # A plain string, since a class of one's own may refuse to be compared.
        return str.__str__(found) if isinstance(found, str) else ""
    except BaseException:  # any object can be an event, whatever its attributes do
        return ""


class Attempts:
    """Counts the failures of events by id; forgets those that failed longest ago."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: OrderedDict[str, int] = OrderedDict()

    def count(self, failed_id: str) -> int:
        """Count one more failure of an event; return which one it is. Of an event without id it is the first."""
        if not failed_id:
            return 1
        with self._lock:
            self._counts[failed_id] = count = self._counts.pop(failed_id, 0) + 1
            if len(self._counts) > _MOST_REMEMBERED:
                self._counts.popitem(last=False)
            return count
