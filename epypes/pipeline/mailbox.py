"""A queue with a policy for events that arrive faster than they are taken."""

from __future__ import annotations

import queue
import threading
from collections import Counter, deque
from collections.abc import Callable
from time import monotonic
from typing import Any, Final, Literal, get_args

from epypes.errors import InvalidValue, MailboxOverflow
from epypes.pipeline.event_loop import log_error, reject

Policy = Literal["latest", "drop_oldest", "block", "fault"]
_POLICIES: Final = get_args(Policy)
# What the policies that drop items call it.
_DROPPED: Final = {"latest": "superseded", "drop_oldest": "oldest"}


class Mailbox:
    """A bounded queue with a policy for when it is full; ``put`` and ``get`` as in ``queue.Queue``.

    Parameters
    ----------
    policy
        ``"latest"``: keeps the newest only; ``"drop_oldest"``: makes room for the new; ``"block"``: put waits;
        ``"fault"``: put raises MailboxOverflow.
    size
        How many items it holds; 1 for ``"latest"``.
    on_drop
        Called with each item that was dropped, on the thread that put the newer one, when that is in the mailbox. What
        it raises is logged (``epypes.pipeline``) and not raised from `put`, which has done what it should. An item with
        a ``reject``, as a broker's events have it, is rejected as well.

    Attributes
    ----------
    dropped
        How many items were dropped, by reason.

    Raises
    ------
    ValueError
        There is no such policy, or the size does not fit it.

    Examples
    --------
    >>> mailbox = Mailbox("latest")
    >>> mailbox.put(1); mailbox.put(2)
    >>> mailbox.get(), dict(mailbox.dropped)
    (2, {'superseded': 1})
    """

    def __init__(
        self, policy: Policy = "latest", size: int = 1, *, on_drop: Callable[[Any], None] | None = None
    ) -> None:
        if policy not in _POLICIES:
            raise InvalidValue(f"No policy {policy!r}. There are: {', '.join(_POLICIES)}.")
        if size < 1 or (policy == "latest" and size != 1):
            raise InvalidValue(f"A mailbox with policy {policy!r} can't have size {size}.")
        self.policy, self.size, self._on_drop = policy, size, on_drop
        self.dropped: Counter[str] = Counter()
        self._items: deque[Any] = deque()
        self._changed = threading.Condition()
        self._take: Callable[[Any], object] | None = None

    def put(self, item: Any, block: bool = True, timeout: float | None = None) -> None:
        """Put an item; never blocks unless the policy is ``"block"``.

        Raises
        ------
        queue.Full
            The policy is ``"block"`` and there was no room within ``timeout`` seconds.
        ValueError
            ``timeout`` is negative, or not a number.
        MailboxOverflow
            The policy is ``"fault"`` and there was no room.
        """
        take = self._take or self._keep(item, block, timeout)
        if take is not None:
            take(item)

    def hand_to(self, take: Callable[[Any], object], /) -> Callable[[], None]:
        """Have each item handed over within `put`, on the thread that puts, instead of kept; return what ends that.

        So no thread has to wait in `get`, and none has to be woken up: what a ZMQPublisher takes has been sent when
        ``put`` returns. What is kept already is handed over first, and then ``take`` must not raise; later what it
        raises comes out of ``put``. It must let several threads call it at once.

        Raises
        ------
        ValueError
            Its items are handed to another taker already.
        """
        with self._changed:
            if self._take is not None:
                raise InvalidValue("The items of this mailbox go to another taker. Give each publisher its own.")
            while self._items:
                take(self._items.popleft())
            self._take = take
            self._changed.notify_all()

        def end() -> None:
            # Without the lock, since the garbage collector calls this as well.
            if self._take is take:
                self._take = None

        return end

    def _keep(self, item: Any, block: bool, timeout: float | None) -> Callable[[Any], object] | None:
        """Keep an item until it is taken; return the taker that it must be handed to, if one has come meanwhile."""
        _require_timeout(block, timeout)
        with self._changed:
            dropped: list[Any] = []
            # A signal's handler may put between any two of these lines: its thread holds the lock already.
            while len(self._items) >= self.size:
                dropped += self._make_room(block, timeout)
            if self._take is not None:
                return self._take
            self._items.append(item)
            if len(self._items) > self.size and self.policy in _DROPPED:
                dropped += self._drop_beyond(self.size)
            self._changed.notify_all()
        for old in dropped:
            self._tell(old)
        return None

    def _tell(self, dropped: Any) -> None:
        reject(dropped, _DROPPED[self.policy])
        if self._on_drop is None:
            return
        try:
            self._on_drop(dropped)
        except KeyboardInterrupt:  # of the user, whom on_drop does not concern
            raise
        except BaseException as exception:
            log_error("%r: on_drop failed", self, error=exception)

    def _make_room(self, block: bool, timeout: float | None) -> list[Any]:
        """Make room for one item; return what was dropped for it."""
        if self.policy == "fault":
            raise MailboxOverflow(self.size)
        if self.policy == "block":
            wait_s = timeout if block else 0.0
            if not self._changed.wait_for(lambda: len(self._items) < self.size, wait_s):
                raise queue.Full
            return []
        return self._drop_beyond(self.size - 1)

    def _drop_beyond(self, most: int) -> list[Any]:
        """Drop the oldest items until there are no more than so many; return them."""
        items, dropped = self._items, []
        try:
            # Not by len(): after a call a signal's handler may run, and what was true may be so no more.
            while True:
                _ = items[most]
                dropped.append(items.popleft())
        except IndexError:
            self.dropped[_DROPPED[self.policy]] += len(dropped)
        return dropped

    def get(self, block: bool = True, timeout: float | None = None) -> Any:
        """Take the oldest item; raises queue.Empty if there is none within ``timeout`` seconds."""
        _require_timeout(block, timeout)
        deadline = None if timeout is None else monotonic() + timeout
        with self._changed:
            while not self._items:
                wait_s = None if deadline is None else deadline - monotonic()
                if not block or (wait_s is not None and wait_s <= 0):
                    raise queue.Empty
                self._changed.wait(wait_s)
            item = self._items.popleft()
            self._changed.notify_all()
            return item

    def put_nowait(self, item: Any) -> None:
        """Put without waiting."""
        self.put(item, block=False)

    def get_nowait(self) -> Any:
        """Take without waiting."""
        return self.get(block=False)

    def qsize(self) -> int:
        """Return how many items are waiting."""
        return len(self._items)

    def empty(self) -> bool:
        """Whether no item is waiting."""
        return not self._items

    def full(self) -> bool:
        """Whether as many items are waiting as it holds."""
        return len(self._items) >= self.size

    def __repr__(self) -> str:
        return f"<Mailbox {self.policy}: {len(self._items)} of {self.size}, {self.dropped.total()} dropped>"


def _require_timeout(block: bool, timeout: float | None) -> None:
    # As in queue.Queue; NaN, which is neither too short nor too long, would never be over.
    if block and timeout is not None and not timeout >= 0:
        raise InvalidValue(f"timeout is how many seconds to wait, 0 or more, not {timeout!r}.")
