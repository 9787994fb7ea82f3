"""How do events come into a service? From a ZeroMQ socket, or from a broker that keeps each until it is answered."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Mapping
from typing import Any, Final, Protocol

from epypes.errors import BrokerError
from epypes.service.options import CONNECT, Options, bare
from epypes.transport import ZMQSubscriber
from epypes.transport.channels import open_channel, place_of
from epypes.transport.receiving import Subscriber

_FIRST_PAUSE_S: Final = 0.1
_LONGEST_PAUSE_S: Final = 5.0
# What a Subscriber calls events that it leaves to the dispatcher: they are dead letters, and no messages of others.
_EXHAUSTED: Final = "exhausted"


class Accepting(Protocol):
    """Who takes events: the dispatcher."""

    def put(self, item: Any, *, block: bool = False, timeout: float | None = 0.0) -> None:
        """Take an event."""

    def exhausted(self, item: Any) -> None:
        """Take an event that a broker has delivered too often."""


class SocketEntrance:
    """Events come from a ZeroMQ socket.

    Parameters
    ----------
    address
        It is bound; ``connect:ADDRESS`` is connected to.
    accept
        Who takes them.
    secured
        insecure, keys and allow, as for ZMQSubscriber.
    """

    trouble = ""

    def __init__(self, address: str, accept: Accepting, secured: Mapping[str, Any]) -> None:
        self._given, self._accept, self._secured = address, accept, secured
        self._rejected_before = self._lost_before = 0
        self._closed_at = ""
        self._subscriber = self._made(address)

    def _made(self, address: str) -> ZMQSubscriber:
        return ZMQSubscriber(bare(address), self._accept, "", not self._given.startswith(CONNECT), **self._secured)

    def open(self) -> None:
        """Take events, which wait until they are worked on."""
        self.start()

    def start(self) -> None:
        """Open it; again at the address where it was."""
        if self._closed_at:
            self._rejected_before, self._lost_before = self.rejected, self._lost
            self._subscriber = self._made(self._closed_at)
            self._closed_at = ""
        self._subscriber.start()

    def close(self, timeout_s: float) -> None:
        """Take no more events, as often as you like."""
        self._closed_at = self.address
        self._subscriber.stop(timeout_s)

    def leave(self, timeout_s: float) -> None:
        """Do nothing: what has come is here alone."""

    def stop(self, timeout_s: float) -> None:
        """Close it for good."""
        self._closed_at = ""
        self._subscriber.stop(timeout_s)

    @property
    def address(self) -> str:
        """Where it is, once it is open; where events are not taken just now, it is where they were, and will be."""
        return self._given if self._given.startswith(CONNECT) else self._closed_at or self._subscriber.address

    @property
    def rejected(self) -> int:
        """How many messages were no events."""
        return self._rejected_before + sum(self._subscriber.rejected.values())

    @property
    def _lost(self) -> int:
        return self._lost_before + sum(self._subscriber.lost.values())

    def seen(self, ids: Iterable[str]) -> None:
        """Do nothing: there are no others."""

    def make_room(self, waiting: int) -> None:
        """Do nothing: nobody waits for others."""

    def counts(self) -> dict[str, int]:
        """Return how many events were sent and never came, by the gaps in the numbers that their senders give them."""
        return {"lost": self._lost}


class BrokerEntrance:
    """Events come from a broker, who delivers again what was in hand when it is stopped.

    Parameters
    ----------
    options
        Of the service.
    accept
        Who takes them.
    on_change
        Called when the broker is away, or there again.
    """

    def __init__(self, options: Options, accept: Accepting, on_change: Callable[[], object]) -> None:
        self.place, self._options = place_of(bare(options.sub)), options
        self.subscriber = Subscriber(self.place, accept, prefetch=options.prefetch, exhausted=accept.exhausted)
        self.subscriber.on_connection = lambda is_connected, reason: on_change()
        self._on_change = on_change
        self._not_open = ""
        self._over = threading.Event()

    def open(self) -> None:
        """See that the broker has the place; no event is taken before `start`: others can work on it now.

        Raises
        ------
        BrokerError
            The broker can't be reached, refuses, or has no such place.
        """
        open_channel(self.place).close()

    def start(self) -> None:
        """Take events. If the broker is away, that is tried again, behind, until it is closed."""
        self._end_trying()
        try:
            self.subscriber.start()
            self.subscriber.resume()
        except BrokerError as error:
            self._not_open, self._over = str(error), threading.Event()
            threading.Thread(target=self._try_again, args=(self._over,), name="epypes opening", daemon=True).start()
            self._on_change()

    def _try_again(self, over: threading.Event) -> None:
        pause_s = _FIRST_PAUSE_S
        while not over.wait(pause_s):
            pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
            try:
                self.subscriber.start()
            except BrokerError as error:
                self._not_open = str(error)
                continue
            if over.is_set():
                self.subscriber.stop()
                return
            self._not_open = ""
            self._on_change()
            return

    def close(self, timeout_s: float) -> None:
        """Take no more events; those that were taken can still be acknowledged."""
        self._end_trying()
        self.subscriber.pause()

    def leave(self, timeout_s: float) -> None:
        """End the connection: what is in hand is delivered again, to whoever asks."""
        self._end_trying()
        self.subscriber.stop(timeout_s)

    # It begins anew with the next start.
    stop = leave

    def _end_trying(self) -> None:
        self._over.set()
        self._not_open = ""

    @property
    def address(self) -> str:
        """Where events come from, without the password."""
        return str(self.place)

    @property
    def trouble(self) -> str:
        """Why the broker is not there; empty if it is."""
        return self._not_open or self.subscriber.trouble

    @property
    def rejected(self) -> int:
        """How many messages were no events."""
        rejected = self.subscriber.rejected
        return sum(rejected.values()) - rejected[_EXHAUSTED]

    def seen(self, ids: Iterable[str]) -> None:
        """Note that other replicas are done with events."""
        self.subscriber.seen(ids)

    def make_room(self, waiting: int) -> None:
        """See that an event can come beside so many answers that wait for an earlier one; 0: as many as ever.

        What they wait for may be with the broker, as what a killed replica had in hand is.
        """
        usual = self._options.prefetch
        needed = max(usual + 1, waiting + self._options.threads)
        self.subscriber.prefetch = min(needed, 2 * usual) if waiting else usual

    def counts(self) -> dict[str, int]:
        """Return how often events came again that were in hand or done already, and how often the broker was lost."""
        return {"duplicates": self.subscriber.duplicates, "reconnects": self.subscriber.reconnects}


def entrance_of(
    options: Options, accept: Accepting, secured: Mapping[str, Any], on_change: Callable[[], object]
) -> SocketEntrance | BrokerEntrance:
    """Return where a service's events come from; see `SocketEntrance` and `BrokerEntrance`."""
    if options.has_broker:
        return BrokerEntrance(options, accept, on_change)
    return SocketEntrance(options.sub, accept, secured)
