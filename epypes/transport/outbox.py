"""What waits to be sent to a place, and what becomes of it? One at a time is sent, until the broker has confirmed it.

That is done by a thread of its own; or by whoever puts and waits, if nothing else is to be sent: to wake a thread for
it and to be woken by that would be two switches of threads more.
"""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import threading
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from time import monotonic
from typing import Final

from epypes.errors import BrokerError, MessageError
from epypes.run import Failure
from epypes.transport.channels.place import Place
from epypes.transport.channels.seam import Frames
from epypes.transport.connection import Connection
from epypes.transport.forked import forget_in_child
from epypes.transport.framing import Framing
from epypes.wire import Envelope, Limits, failure_event, new_id
from epypes.wire.arrays import is_immutable

log = logging.getLogger("epypes.transport")

# Called once: with None when the broker has it, else with why it will never have it.
Then = Callable[[Exception | None], object]

TIMEOUT_S: Final = 10.0
# So often a message is tried that neither the broker nor the channel says anything clear of.
_MOST_FAILURES: Final = 3
# How long the thread sleeps before it looks whether it was abandoned.
_TICK_S: Final = 0.25
# What the end takes when there is no time left.
_END_S: Final = 0.25


def _nobody_waits(error: Exception | None) -> None:
    """Be told of a message that nobody asks for."""


@dataclass(slots=True)
class Tally:
    """What has been sent, over all starts."""

    sent: int = 0
    rejected: Counter[str] = field(default_factory=Counter)


@dataclass(slots=True, eq=False)
class _Parcel:
    frames: Frames
    id: str
    headers: Mapping[str, str]
    then: Then
    # How often something failed that is not the broker's.
    failures: int = 0


class Outbox:
    """What is put is sent in this order, each message until the broker has confirmed it: over outages, under one id.

    Parameters
    ----------
    place
        Where to.
    topic
        Of the envelopes.
    max_message_bytes
        Larger messages are not sent.
    timeout_s
        Longest wait for the broker's word, in seconds.
    tell
        Called with whether the broker is there, and why not, when that has changed.
    tally
        Counts that go on from an earlier one.
    before
        The earlier one.

    Notes
    -----
    It holds what is put without a bound: whoever puts knows how much is under way, by ``then``.
    """

    def __init__(
        self,
        place: Place,
        *,
        topic: str = "",
        max_message_bytes: int = Limits().total_bytes,
        timeout_s: float = TIMEOUT_S,
        tell: Callable[[bool, str], object] = lambda is_connected, reason: None,
        tally: Tally | None = None,
        before: Outbox | None = None,
    ) -> None:
        self.place = place
        self.tally = Tally() if tally is None else tally
        self._framing = Framing(topic, Limits(total_bytes=max_message_bytes))
        self._connection: Connection = Connection(
            place, 1, timeout_s, tell, None if before is None else before._connection
        )
        self._process = os.getpid()
        self._make_locks()
        self._parcels: deque[_Parcel] = deque()
        self._over = threading.Event()
        self._sender = 0
        self._thread = threading.Thread(target=self._run, name=f"epypes to {place.name}", daemon=True)
        forget_in_child(self)

    @property
    def is_connected(self) -> bool:
        """Whether the broker is there, as far as is known."""
        return self._connection.is_connected

    @property
    def trouble(self) -> str:
        """Why the broker is not there; empty if it is."""
        return self._connection.trouble

    @property
    def reconnects(self) -> int:
        """How often the broker was there again."""
        return self._connection.reconnects

    @property
    def waiting(self) -> int:
        """How many messages the broker has not confirmed."""
        return len(self._parcels)

    def start(self) -> None:
        """Connect and begin to send.

        Raises
        ------
        BrokerError
            If the broker can't be reached, refuses, or has no such place.
        """
        self._connection.open()
        self._thread.start()

    def put(
        self,
        item: object,
        *,
        id: str = "",  # noqa: A002 - that is what it is called everywhere
        headers: Mapping[str, str] | None = None,
        then: Then = _nobody_waits,
        waits: bool = False,
    ) -> None:
        """Have something sent; returns at once, from any thread.

        Parameters
        ----------
        item
            What a publisher takes, or a tuple or list of frames. Arrays that could be changed are copied.
        id
            What the message is called; the id of the envelope, or a new one, without.
        headers
            What goes beside it.
        then
            Called with None when the broker has confirmed it; with the error if it can't be sent, or was not when the
            outbox stopped. On the outbox's thread or one that calls `put` or `stop`; must be quick.
        waits
            True if the caller has nothing to do until then: it may be sent on the caller's thread.
        """
        try:
            parcel = self._parcel(item, id, dict(headers or {}), then)
        except Exception as error:
            # The item's own code, called to make bytes of it, may raise anything.
            self._refuse(error, then)
            return
        is_mine = False
        with self._changed:
            if not self._is_over():
                self._parcels.append(parcel)
                is_mine = waits and self._parcels[0] is parcel and self.is_connected and not self._turn.locked()
                if not is_mine:
                    self._changed.notify_all()
                    return
        if is_mine:
            self._send_here(parcel)
        else:
            self._refuse(self._unsent(), then)

    def _parcel(self, item: object, known_as: str, headers: Mapping[str, str], then: Then) -> _Parcel:
        item = failure_event(item) if isinstance(item, Failure) else item
        frames: Frames
        if isinstance(item, tuple | list):
            frames = item
        else:
            # One at a time, since envelopes are numbered.
            with self._changed:
                frames = self._framing.frames(item)
        own = tuple(map(_own, frames))
        known_as = known_as or (item.id if isinstance(item, Envelope) else "") or new_id()
        return _Parcel(own, known_as, headers, then)

    def _refuse(self, error: Exception, then: Then) -> None:
        reason = error.reason if isinstance(error, MessageError) else type(error).__name__
        self.reject("not sent" if isinstance(error, BrokerError) else reason, str(error))
        _tell(then, error)

    def reject(self, reason: str, text: str, log_once: bool = False) -> None:
        """Count something that can't be sent."""
        with self._changed:
            self.tally.rejected[reason] += 1
            is_first = self.tally.rejected[reason] == 1
        if is_first or not log_once:
            log.warning("%s: a message was not sent (%s): %s", self.place, reason, text)

    def wait_connected(self, timeout_s: float) -> bool:
        """Return whether the broker is there within ``timeout_s`` seconds."""
        return self._connection.wait(timeout_s)

    def _unsent(self) -> BrokerError:
        why = self.trouble or "it was stopped before the broker had confirmed it"
        return BrokerError(str(self.place), f"A message to {self.place} was not sent: {why.rstrip('.')}.")

    def is_alive(self) -> bool:
        """Return whether it sends; in a forked child there is neither thread nor connection."""
        return not self._is_over() and self._thread.is_alive()

    def is_gone(self) -> bool:
        """Return whether this is a forked child."""
        return self._process != os.getpid()

    def _is_over(self) -> bool:
        return self._over.is_set() or self.is_gone()

    def is_own_thread(self) -> bool:
        """Return whether the caller runs on the thread that sends, which must not wait for itself."""
        return threading.get_ident() in (self._thread.ident, self._sender)

    def wait_empty(self, timeout_s: float) -> bool:
        """Return whether everything is confirmed within ``timeout_s`` seconds."""
        with self._emptied:
            return self._emptied.wait_for(lambda: not self._parcels or self._is_over(), timeout_s)

    def stop(self, timeout_s: float = 5.0) -> None:
        """Send what waits, then end the connection; from any thread, as often as you like.

        Parameters
        ----------
        timeout_s
            Longest wait, in seconds; what the broker has not confirmed by then is told so.
        """
        if self.is_gone():
            return
        until_s = monotonic() + timeout_s
        if self._thread.is_alive() and not self.is_own_thread():
            self.wait_empty(timeout_s)
        self.give_up()
        if self._thread.is_alive() and not self.is_own_thread():
            # If the broker does not answer, it ends when its time is over, in the background.
            self._thread.join(max(until_s - monotonic(), _END_S))

    def give_up(self) -> None:
        """End without waiting; what the broker has not confirmed is told so."""
        self.abandon()
        with self._changed:
            unsent = list(self._parcels)
            self._parcels.clear()
            self._changed.notify_all()
            self._emptied.notify_all()
        for parcel in unsent:
            self._refuse(self._unsent(), parcel.then)

    def abandon(self) -> None:
        """End without waiting and without a lock, as the garbage collector must."""
        self._over.set()

    def forget(self) -> None:
        """Take a new lock, in a forked child: the old one may be held by a thread that is not there."""
        self._make_locks()

    def _make_locks(self) -> None:
        # Re-entrant, since a signal's handler may put anywhere.
        lock = threading.RLock()
        # Two, so that the thread is not woken by what somebody else has sent.
        self._changed, self._emptied = threading.Condition(lock), threading.Condition(lock)
        # Held by the thread that sends.
        self._turn = threading.Lock()

    def _run(self) -> None:
        try:
            while not self._over.is_set():
                parcel = self._next()
                with self._turn:
                    if parcel is None:
                        self._rest()
                    else:
                        self._send(parcel)
        finally:
            self._connection.end()
            # Nobody shall wait for a confirmation that won't come.
            self.give_up()

    def _rest(self) -> None:
        """See that there is a connection, and that it is told if there is none, while there is nothing to send."""
        if self._connection.look():
            self._connection.works()
        else:
            self._connection.channel(self._over)

    def _next(self) -> _Parcel | None:
        """Return what is to be sent, without taking it: it waits until it is confirmed."""
        with self._changed:
            self._changed.wait_for(lambda: self._parcels or self._over.is_set(), _TICK_S)
            return self._parcels[0] if self._parcels else None

    def _send_here(self, parcel: _Parcel) -> None:
        """Send something on this thread; if that fails, the outbox's own goes on with it."""
        if self._turn.acquire(blocking=False):
            self._sender = threading.get_ident()
            try:
                self._send(parcel)
            except BaseException as error:
                # A signal's handler raised it, in the midst of whatever: that channel is not to be used again.
                self._connection.lose(
                    BrokerError(str(self.place), f"Sending to {self.place} was interrupted: {error!r}")
                )
                raise
            finally:
                self._sender = 0
                self._turn.release()
                self._wake()
        else:
            self._wake()

    def _wake(self) -> None:
        with self._changed:
            if self._parcels:
                self._changed.notify_all()

    def _send(self, parcel: _Parcel) -> None:
        channel = self._connection.channel(self._over)
        if channel is None or not self._is_next(parcel):
            return
        try:
            channel.send(parcel.frames, id=parcel.id, headers=parcel.headers)
        except MessageError as error:
            self._connection.works()
            if self._is_taken(parcel):
                self._refuse(error, parcel.then)
        except Exception as error:
            self._connection.lose(error)
            parcel.failures += not isinstance(error, BrokerError)
            # It may be the message's: then the others shall not wait behind it for ever.
            if parcel.failures >= _MOST_FAILURES and self._is_taken(parcel):
                self._refuse(error, parcel.then)
        else:
            self._connection.works()
            if self._is_taken(parcel):
                # Counted before: whoever is told must find it counted.
                self.tally.sent += 1
                _tell(parcel.then, None)

    def _is_taken(self, parcel: _Parcel) -> bool:
        """Take a parcel out, unless that has been given up meanwhile."""
        with self._changed:
            if not self._is_next(parcel):
                return False
            self._parcels.popleft()
            self._emptied.notify_all()
            return True

    def _is_next(self, parcel: _Parcel) -> bool:
        with self._changed:
            return bool(self._parcels) and self._parcels[0] is parcel


def _own(frame: bytes | memoryview) -> bytes | memoryview:
    """Return a frame that nobody can change."""
    if isinstance(frame, bytes) or isinstance(frame.obj, bytes):
        return frame
    # An array can only be under it if somebody has imported numpy.
    return frame if "numpy" in sys.modules and is_immutable(frame) else bytes(frame)


def _tell(then: Then, error: Exception | None) -> None:
    with contextlib.suppress(Exception):
        try:
            then(error)
        except BaseException:
            # It is somebody else's; the other messages go on.
            log.exception("what waits for a message's confirmation failed")
