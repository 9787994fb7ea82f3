"""Which failures of a storm are kept? The first of each cause, and then the newest, whenever one is due.

A camera that gives black frames fails thirty times a second, all alike: to write each down would take the disk from
what else runs, and push out the one failure that is another. So every cause has an account of its own.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any, Final

# Of one cause, so many are kept at once, then one each second.
BURST: Final = 10
_PER_S: Final = 1.0
# What waits is held in memory, with its images.
_MOST_WAITING: Final = 20
_MOST_CAUSES: Final = 16


@dataclass(slots=True)
class _Account:
    """How many failures of a cause may be kept at once, and the newest of those that may not."""

    left: float
    at_s: float
    latest: Any = None

    def fill(self, now_s: float, burst: int) -> None:
        self.left = min(self.left + (now_s - self.at_s) * _PER_S, burst)
        self.at_s = now_s


class Waiting:
    """What waits to be written. Not for threads: whoever uses it holds a lock.

    Every method takes the time in seconds, on a clock that only goes forward.
    """

    def __init__(self, burst: int = BURST) -> None:
        self._burst = burst
        self._first: deque[Any] = deque()
        self._accounts: OrderedDict[Hashable, _Account] = OrderedDict()

    def __len__(self) -> int:
        return len(self._first) + sum(account.latest is not None for account in self._accounts.values())

    def add(self, cause: Hashable, item: Any, now_s: float) -> int:
        """Take something in; return how many gave way to it."""
        given_way = self._make_room(cause)
        account = self._accounts.setdefault(cause, _Account(self._burst, now_s))
        self._accounts.move_to_end(cause)
        account.fill(now_s, self._burst)
        if account.left >= 1 and len(self._first) < _MOST_WAITING:
            account.left -= 1
            self._first.append(item)
            return given_way
        given_way += account.latest is not None
        account.latest = item
        return given_way

    def _make_room(self, cause: Hashable) -> int:
        """Forget the cause that was not heard of for longest if there are too many."""
        if cause in self._accounts or len(self._accounts) < _MOST_CAUSES:
            return 0
        _, account = self._accounts.popitem(last=False)
        return int(account.latest is not None)

    def take(self, now_s: float, *, at_once: bool = False) -> Any:
        """Return what is to be written now, None if nothing is; ``at_once`` does not wait until something is due."""
        if self._first:
            return self._first.popleft()
        for account in self._accounts.values():
            account.fill(now_s, self._burst)
            if account.latest is not None and (at_once or account.left >= 1):
                account.left = max(account.left - 1, 0.0)
                found, account.latest = account.latest, None
                return found
        return None

    def due_in_s(self, now_s: float) -> float | None:
        """Return in how many seconds the next is to be written; None if nothing waits."""
        if self._first:
            return 0.0
        left = [account for account in self._accounts.values() if account.latest is not None]
        return min((max((1 - account.left) / _PER_S - (now_s - account.at_s), 0.0) for account in left), default=None)
