"""Is there a way to the broker just now, and if not, when is it tried again?"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import weakref
from collections.abc import Callable
from time import monotonic
from typing import Any, Final

from epypes.errors import BrokerError
from epypes.transport.channels.place import Place
from epypes.transport.channels.seam import Channel, Received, open_channel

log = logging.getLogger("epypes.transport")

# A broker that restarts is met within a moment of its being there; one that is away for hours costs nothing.
_FIRST_PAUSE_S: Final = 0.1
_LONGEST_PAUSE_S: Final = 5.0


class Connection:
    """One channel after another to one place, by one thread; the others look at its attributes.

    Parameters
    ----------
    place
        Where to.
    prefetch, timeout_s
        See `open_channel`; for the first, see the attribute too.
    tell
        Called with whether there is a connection, and why not, when that has changed; on the thread that uses it.
    before
        The one of an earlier start, whose counts go on.
    receives
        See the attribute.

    Attributes
    ----------
    trouble
        Why there is none; empty if there is one.
    reconnects
        How often there was one again.
    number
        Of the connection, from 1.
    prefetch
        How many messages may be in hand; may be changed, by any thread.
    receives
        Whether it is for receiving just now, which a broker may refuse to who may connect: then it is tried when it is
        opened.
    """

    def __init__(
        self,
        place: Place,
        prefetch: int,
        timeout_s: float,
        tell: Callable[[bool, str], object],
        before: Connection | None = None,
        *,
        receives: bool = False,
    ) -> None:
        self.place = place
        self.prefetch, self._timeout_s, self._tell = prefetch, timeout_s, tell
        self.receives = receives
        self._channel: Channel | None = None
        # What came when it was opened.
        self._first: Received | None = None
        self._connected = threading.Event()
        self.trouble = ""
        self.reconnects: int = 0 if before is None else before.reconnects
        self.number: int = 0 if before is None else before.number
        # Kept in a forked child: to collect the channel of the parent might end what the parent still uses.
        self._inherited = before if before is not None and before._process != os.getpid() else None
        self._process: int = os.getpid()
        self._pause_s = _FIRST_PAUSE_S
        self._lost_s = self._opened_s = 0.0

    @property
    def is_connected(self) -> bool:
        """Whether there is a connection, as far as is known."""
        return self._connected.is_set()

    def wait(self, timeout_s: float) -> bool:
        """Return whether there is a connection within ``timeout_s`` seconds."""
        return self._connected.wait(timeout_s)

    def open(self) -> None:
        """Open the first channel.

        Raises
        ------
        BrokerError
            The broker can't be reached, refuses, or has no such place.
        """
        channel = open_channel(self.place, prefetch=self.prefetch, timeout_s=self._timeout_s)
        try:
            self._first = channel.receive(0.0) if self.receives else None
        except BaseException:
            channel.close()
            raise
        self._channel, self._opened_s = channel, monotonic()
        self.number += 1
        self._change("")

    def channel(self, is_over: threading.Event) -> Channel | None:
        """Return the channel that there is, or open one, however long that takes; None when it is over meanwhile."""
        while self._channel is None and not is_over.wait(self._pause_s):
            self._pause_s = min(2 * self._pause_s, _LONGEST_PAUSE_S)
            try:
                self.open()
            except Exception as error:
                self._change(str(error))
            else:
                self.reconnects += 1
        return None if is_over.is_set() else self._channel

    def receive(self, channel: Channel, timeout_s: float) -> Received | None:
        """Return the next message of the channel, as that does."""
        first, self._first = self._first, None
        channel.prefetch = self.prefetch
        return first or channel.receive(timeout_s)

    def look(self) -> bool:
        """Return whether there is a channel that is of use, which nobody notices while nothing is sent or received."""
        trouble = "" if self._channel is None else self._channel.trouble
        if trouble:
            self.lose(BrokerError(str(self.place), trouble))
        return self._channel is not None

    def works(self) -> None:
        """Take note that the channel has done what it is there for: the outage, if there was one, is over."""
        if self._lost_s:
            log.warning("%s is there again after %.1f s", self.place, monotonic() - self._lost_s)
            self._lost_s = 0.0
        # A broker that lets us in and hangs up again, each time, is asked less and less often.
        if monotonic() - self._opened_s > self._pause_s:
            self._pause_s = _FIRST_PAUSE_S

    def lose(self, error: Exception) -> None:
        """Take note that the channel is of no use any more."""
        self.close()
        if not self._lost_s:
            log.warning("lost %s, which is tried again until it is there: %s", self.place, error)
            self._lost_s = monotonic()
        self._change(str(error) or repr(error))

    def close(self) -> None:
        """Close the channel; as often as you like."""
        channel, self._channel = self._channel, None
        if channel is not None:
            # It is documented to raise nothing; a thread must end whatever it does.
            with contextlib.suppress(Exception):
                channel.close()

    def end(self) -> None:
        """Close the channel for good."""
        self.close()
        self._connected.clear()

    def _change(self, trouble: str) -> None:
        was_connected, self.trouble = self.is_connected, trouble
        if was_connected == (not trouble):
            return
        if trouble:
            self._connected.clear()
        else:
            self._connected.set()
        try:
            self._tell(self.is_connected, trouble)
        except BaseException:
            # It is the user's; the connection goes on.
            log.exception("on_connection itself failed")


def reporter(subscriber: Any) -> Callable[[bool, str], None]:
    """Return what calls the on_connection of a subscriber or publisher, and does not keep it alive."""
    known = weakref.ref(subscriber)

    def report(is_connected: bool, reason: str) -> None:
        found = known()
        if found is not None and found.on_connection is not None:
            found.on_connection(is_connected, reason)

    return report
