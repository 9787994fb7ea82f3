"""How does an answer, or a failure, leave a service? Through a ZeroMQ socket, or to a broker that confirms it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, Final

from epypes.errors import BrokerError, MessageError
from epypes.pipeline import Mailbox
from epypes.service.desk import Arrived
from epypes.service.options import CONNECT, bare
from epypes.transport import ZMQPublisher
from epypes.transport.channels import is_brokered, place_of
from epypes.transport.outbox import Outbox

# Answers kept for a subscriber that does not read; images are large, so this bounds the memory that one can cost.
KEPT_ANSWERS: Final = 256
# For a broker that is away.
_MOST_WAITING: Final = 1_024


class SocketExit:
    """Publishes on a ZeroMQ socket, which knows nothing of arriving: what was sent counts as that.

    Parameters
    ----------
    address
        It is bound; ``connect:ADDRESS`` is connected to.
    topic
        Of the envelopes.
    secured
        insecure, keys and allow, as for ZMQPublisher.

    Attributes
    ----------
    publisher
        The socket.
    """

    trouble = ""

    def __init__(self, address: str, topic: str, secured: Mapping[str, Any]) -> None:
        self._given = address
        # Sent within put, on the thread that puts.
        self._items = Mailbox("drop_oldest", KEPT_ANSWERS)
        bind = not address.startswith(CONNECT)
        self.publisher = ZMQPublisher(bare(address), self._items, topic, bind, high_water_mark=KEPT_ANSWERS, **secured)

    def start(self) -> None:
        """Open it."""
        self.publisher.start()

    def stop(self, timeout_s: float) -> None:
        """Close it; what was published still leaves."""
        self.publisher.stop(timeout_s)

    def publish(self, item: Any, id: str, then: Arrived) -> None:  # noqa: A002 - as everywhere
        """Publish an item; one that could not be sent has not arrived."""
        before = self.publisher.rejected
        self._items.put(item)
        reasons = self.publisher.rejected - before
        then(MessageError("not sent", f"The answer could not be sent: {', '.join(reasons)}.") if reasons else None)

    @property
    def slow_subscribers(self) -> int:
        """How often a subscriber was so slow that it lost messages; see ZMQPublisher."""
        return self.publisher.slow_subscribers

    @property
    def address(self) -> str:
        """Where it is, once it is open."""
        return self._given if self._given.startswith(CONNECT) else self.publisher.address


class BrokerExit:
    """Hands items to a broker, over its outages, and tells of each that it has it.

    Parameters
    ----------
    address
        Of the place.
    topic
        Of the envelopes.
    on_change
        Called when the broker is away, or there again.
    """

    # A broker keeps messages for whoever is slow.
    slow_subscribers = 0

    def __init__(self, address: str, topic: str, on_change: Callable[[], object]) -> None:
        self._place, self._topic, self._on_change = place_of(bare(address)), topic, on_change
        self._outbox = self._made()

    def _made(self) -> Outbox:
        return Outbox(self._place, topic=self._topic, tell=lambda is_connected, reason: self._on_change())

    def start(self) -> None:
        """Connect.

        Raises
        ------
        BrokerError
            The broker can't be reached, refuses, or has no such place.
        """
        if not self._outbox.is_alive():
            self._outbox = self._made()
        self._outbox.start()

    def stop(self, timeout_s: float) -> None:
        """Hand over what waits, as far as that is possible in time; the rest is told to be unsent."""
        self._outbox.stop(timeout_s)

    def publish(self, item: Any, id: str, then: Arrived) -> None:  # noqa: A002
        """Have an item handed over; returns at once."""
        if self._outbox.waiting < _MOST_WAITING:
            self._outbox.put(item, id=id, then=then)
            return
        # Of events that no broker keeps there may be any number.
        text = f"{self._place} has not taken {_MOST_WAITING} messages before this one. {self.trouble}"
        then(BrokerError(self.address, text))

    @property
    def address(self) -> str:
        """Where it is, without the password."""
        return str(self._place)

    @property
    def trouble(self) -> str:
        """Why the broker is not there; empty if it is."""
        return self._outbox.trouble


def exit_to(
    address: str, topic: str, secured: Mapping[str, Any], on_change: Callable[[], object]
) -> SocketExit | BrokerExit:
    """Return what publishes to an address; see `SocketExit` and `BrokerExit`."""
    if is_brokered(bare(address)):
        return BrokerExit(address, topic, on_change)
    return SocketExit(address, topic, secured)
