"""Which events are in hand, and which are done? So that one that comes again is not worked on again.

A broker delivers a message again when it has heard nothing of it: of a receiver that died, of one whose connection
broke just as it acknowledged, or because its sender was not sure that it had arrived. The id is the same each time.
"""

from __future__ import annotations

import hashlib
import threading
import weakref
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final, Generic, TypeVar

MOST_DONE: Final = 100_000
# Other programs give messages any ids; so many long ones would fill the memory.
_LONGEST: Final = 128

T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class Word:
    """What was said of an event.

    Attributes
    ----------
    reason
        What it was rejected for; None if it was not.
    connection
        The number of the connection over which it was said.
    """

    reason: str | None = None
    connection: int = 0


DONE: Final = Word()


def _key(id: str) -> str:  # noqa: A002
    """Return what an id is remembered by: itself, unless it is long."""
    return id if len(id) <= _LONGEST else hashlib.sha256(id.encode(errors="surrogatepass")).hexdigest()


class Seen(Generic[T]):
    """The ids of what is in hand, with what stands for it there, and of what was done last, with what was said of it.

    Any thread may call it. What nobody knows any more is not in hand: who has thrown an event away can't answer it.

    Parameters
    ----------
    most_done
        How many ids of what is done are remembered; the oldest are forgotten.
    """

    def __init__(self, most_done: int = MOST_DONE) -> None:
        self._lock = threading.RLock()
        self._most_done = most_done
        self._in_hand: weakref.WeakValueDictionary[str, T] = weakref.WeakValueDictionary()
        # In the order of time.
        self._done: dict[str, Word] = {}

    def arrive(self, id: str, item: T) -> T | None:  # noqa: A002 - that is what it is called everywhere
        """Take what has arrived into the hand, unless there is one of its id already, which is returned then.

        What has no id is never the same as anything else.
        """
        if not id:
            return None
        with self._lock:
            there = self._in_hand.get(_key(id))
            if there is None:
                self._in_hand[_key(id)] = item
            return there

    def finish(self, id: str, word: Word = DONE) -> None:  # noqa: A002
        """Take note that something is done, and of what was said of it."""
        if not id:
            return
        with self._lock:
            key = _key(id)
            self._in_hand.pop(key, None)
            self._done.pop(key, None)
            self._done[key] = word
            if len(self._done) > self._most_done:
                del self._done[next(iter(self._done))]

    def give_back(self, id: str) -> None:  # noqa: A002
        """Take note that something is neither in hand any more nor done: when it comes again it is new."""
        with self._lock:
            self._in_hand.pop(_key(id), None)

    def add(self, ids: Iterable[str]) -> None:
        """Take note that others have answered these; what is in hand here, or was done here, stays that."""
        with self._lock:
            for known_as in ids:
                if _key(known_as) not in self._in_hand and _key(known_as) not in self._done:
                    self.finish(known_as)

    def word(self, id: str) -> Word | None:  # noqa: A002
        """Return what was said of something that is done; None if it is not."""
        with self._lock:
            return self._done.get(_key(id))

    @property
    def in_hand(self) -> int:
        """How many are in hand, of those that have an id."""
        return len(self._in_hand)

    def forget_locks(self) -> None:
        """Take a new lock, in a forked child: the old one may be held by a thread that is not there."""
        self._lock = threading.RLock()
