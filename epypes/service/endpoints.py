"""Where a service's events come from, and where answers and failures go: ZeroMQ sockets or a broker's queues.

Events arrive as frames whose header alone is read, and answers leave as the frames that the worker encoded, with the
publisher's stamp.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from contextlib import ExitStack
from time import monotonic
from typing import Any, Final

from epypes.errors import BrokerError
from epypes.service.options import Options
from epypes.transport import Publisher, Subscriber
from epypes.transport.address import Address, open_channel, parse_address
from epypes.transport.channel import Confirmed, Delivery
from epypes.transport.throttle import Throttle
from epypes.transport.zeromq.channel import prepare_lending
from epypes.wire import EncodedEnvelope

# Answers kept for a subscriber that does not read; images are large, so this bounds the memory that one can cost.
_MAX_KEPT_ANSWERS: Final = 256
# Unconfirmed messages for a broker that is away.
_MAX_UNCONFIRMED: Final = 1_024
_FIRST_RETRY_S: Final = 0.1
_LONGEST_RETRY_S: Final = 5.0
# The least time for closing one endpoint, however late it is.
_MIN_CLOSE_S: Final = 0.5
# A Subscriber counts among its rejected messages the events that it hands over as delivered too often.
_EXHAUSTED: Final = "exhausted"

_log = logging.getLogger("epypes.service")


def group_address(options: Options) -> Address | None:
    """Return the broadcast address of the replicas that share a broker's queue; None without a broker."""
    if not options.has_broker:
        return None
    return parse_address(options.sub).beside("group", "broadcast", create=True)


class EventInput:
    """Receives events from a ZeroMQ socket, or from a broker that keeps each until it is answered.

    Parameters
    ----------
    options
        Of the service.
    accept
        Called with each event, whether to wait for room, and for how long; raises queue.Full if there is none.
    on_exhausted
        Called with an event that a broker has delivered too often.
    on_change
        Called when the broker is away, or connected again.
    """

    def __init__(
        self,
        options: Options,
        accept: Callable[[Delivery, bool, float | None], object],
        on_exhausted: Callable[[Delivery], object],
        on_change: Callable[[], object],
    ) -> None:
        self._options, self._accept, self._on_exhausted, self._on_change = options, accept, on_exhausted, on_change
        self.is_broker = options.has_broker
        self._log = Throttle(_log)
        # Counted by earlier subscribers; `_rejected` also counts messages of several frames that are no envelopes.
        self._rejected = self._lost = 0
        # Where a bound socket was, while events are not taken.
        self._closed_at = ""
        self._not_open = ""
        # Of the thread that connects to the broker; it is set when events are not to be taken any more.
        self._is_opening_over = threading.Event()
        self._opening: threading.Thread | None = None
        self._opening_lock = threading.Lock()
        self._subscriber = self._make_subscriber(options.sub)

    def _make_subscriber(self, address: str) -> Subscriber:
        options = self._options
        subscriber = Subscriber(
            address,
            self,
            bind=True,
            prefetch=options.prefetch,
            exhausted=self._exhausted,
            undecoded=True,
            **_secured(options.sub, options),
        )
        subscriber.on_connection = lambda is_connected, reason: self._on_change()
        return subscriber

    # -- as the subscriber's queue ------------------------------------------------------------------------------------

    def put(self, item: Delivery, *, block: bool = False, timeout: float | None = 0.0) -> None:
        """Accept a message; called on the subscriber's thread.

        Raises
        ------
        queue.Full
            There is no room for a broker's event.
        """
        if self._is_event(item):
            self._accept(item, block, timeout)

    def _exhausted(self, item: Delivery) -> None:
        if self._is_event(item):
            self._on_exhausted(item)

    def _is_event(self, delivery: Delivery) -> bool:
        """Whether a delivery is an envelope, or a message of 2019; any other is counted and rejected."""
        error = delivery.error
        if error is None:
            return True
        self._rejected += 1
        self._log.warning(error.reason, f"rejected a message ({error.reason}): {error}")
        delivery.reject(str(error))
        return False

    # -- start and stop -----------------------------------------------------------------------------------------------

    def open(self) -> None:
        """Bind the socket; or check that the broker has the queue, of which no event is taken before `start`.

        Raises
        ------
        AddressError, BrokerError
            The address can't be bound; the broker can't be reached, refuses, or has no such queue.
        """
        if self.is_broker:
            # Until this service is ready, other replicas can take the events.
            channel = open_channel(self._options.sub)
            channel.open(None)
            channel.close()
        else:
            self.start()

    def start(self) -> None:
        """Take events; again where they were taken before. A broker is connected by a thread, which waits for it."""
        self._end_opening()
        if self.is_broker:
            self._is_opening_over = is_over = threading.Event()
            self._opening = threading.Thread(target=self._open, args=(is_over,), name="epypes opening", daemon=True)
            self._opening.start()
            return
        if self._closed_at:
            self._rejected += sum(self._subscriber.rejected.values())
            self._lost += sum(self._subscriber.lost.values())
            self._subscriber, self._closed_at = self._make_subscriber(self._closed_at), ""
        self._subscriber.start()

    def _open(self, is_over: threading.Event) -> None:
        pause_s = _FIRST_RETRY_S
        # An earlier thread may still wait for a broker that does not answer.
        with self._opening_lock:
            while not is_over.is_set():
                try:
                    self._subscriber.start()
                    self._subscriber.resume()
                except Exception as error:  # the system may be short of threads, memory or descriptors
                    if not is_over.is_set():
                        self._not_open = str(error) or repr(error)
                        self._on_change()
                    is_over.wait(pause_s)
                    pause_s = min(2 * pause_s, _LONGEST_RETRY_S)
                    continue
                if is_over.is_set():
                    self._subscriber.stop()
                elif self._not_open:
                    self._not_open = ""
                    self._on_change()
                return

    def _end_opening(self) -> None:
        self._is_opening_over.set()
        self._not_open = ""

    def _has_opened(self, timeout_s: float) -> bool:
        """Whether no thread opens the subscriber; one that still does stops it in the end."""
        if self._opening is not None and self._opening is not threading.current_thread():
            self._opening.join(timeout_s)
            return not self._opening.is_alive()
        return True

    def pause(self, timeout_s: float) -> None:
        """Take no more events; those of a broker that were taken can still be acknowledged."""
        self._end_opening()
        if self.is_broker:
            self._subscriber.pause()
        else:
            self._closed_at = self.address
            self._subscriber.stop(timeout_s)

    def leave(self, timeout_s: float) -> None:
        """End the connection to the broker, which delivers again what is not acknowledged; a socket stays."""
        if self.is_broker:
            self.stop(timeout_s)

    def stop(self, timeout_s: float) -> None:
        """Close it until the next `start`."""
        self._end_opening()
        self._closed_at = ""
        until_s = monotonic() + timeout_s
        if self._has_opened(timeout_s):
            self._subscriber.stop(max(until_s - monotonic(), 0.0))

    # -- description --------------------------------------------------------------------------------------------------

    @property
    def address(self) -> str:
        """Where events come from, without a password; the bound endpoint, also while no events are taken."""
        return self._closed_at or _shown(self._subscriber)

    @property
    def trouble(self) -> str:
        """Why the broker is not connected; empty if it is."""
        return self._not_open or _named(self.address, self._subscriber.trouble)

    def counts(self) -> dict[str, int]:
        """Return ``rejected``, and ``lost`` for a socket, ``duplicates`` and ``reconnects`` for a broker."""
        subscriber, rejected = self._subscriber, self._subscriber.rejected
        counts = {"rejected": self._rejected + sum(rejected.values()) - rejected[_EXHAUSTED]}
        if self.is_broker:
            return {**counts, "duplicates": subscriber.duplicates, "reconnects": subscriber.reconnects}
        return {**counts, "lost": self._lost + sum(subscriber.lost.values())}


class AnswerOutput:
    """Publishes answers, or failures, to a ZeroMQ socket or a broker.

    Parameters
    ----------
    address
        It is bound; ``connect:ADDRESS`` is connected to. Or that of a broker.
    options
        Of the service: its keys.
    on_change
        Called when the broker is away, or connected again.
    """

    def __init__(self, address: str, options: Options, on_change: Callable[[], object]) -> None:
        self._publisher = Publisher(address, high_water_mark=_MAX_KEPT_ANSWERS, **_secured(address, options))
        self.is_broker = self._publisher.place.is_broker
        self._publisher.on_connection = lambda is_connected, reason: on_change()

    def start(self) -> None:
        """Open it.

        Raises
        ------
        AddressError, BrokerError
            The address can't be bound; the broker can't be reached, refuses, or has no such queue.
        """
        self._publisher.start()

    def stop(self, timeout_s: float) -> None:
        """Close it; what was published still leaves, as far as that is possible in time."""
        self._publisher.stop(timeout_s)

    def publish(
        self,
        answer: EncodedEnvelope | bytes,
        id: str = "",  # noqa: A002
        confirmed: Confirmed = lambda error: None,
    ) -> None:
        """Publish an answer under an id; returns at once. A ZeroMQ socket confirms what it has taken."""
        if self._publisher.waiting >= _MAX_UNCONFIRMED:
            # Events that no broker keeps may be any number.
            text = f"{self.address} has not taken {_MAX_UNCONFIRMED} messages before this one. {self.trouble}"
            confirmed(BrokerError(self.address, text))
            return
        try:
            self._publisher.send(answer, id=id, confirmed=confirmed)
        except Exception as error:  # memory may be short
            confirmed(error)

    @property
    def address(self) -> str:
        """Where it publishes, without a password; ``connect:`` in front where it connects."""
        return _shown(self._publisher)

    @property
    def trouble(self) -> str:
        """Why the broker is not connected; empty if it is."""
        return _named(self.address, self._publisher.trouble)

    @property
    def slow_subscribers(self) -> int:
        """How often a subscriber was so slow that it lost messages; a broker keeps messages instead."""
        return self._publisher.slow_subscribers


class Endpoints:
    """All endpoints of a service.

    Attributes
    ----------
    events, answers, failures
        Where events come from, where answers go, and where failures are published.
    """

    def __init__(self, events: EventInput, answers: AnswerOutput, failures: AnswerOutput) -> None:
        self.events, self.answers, self.failures = events, answers, failures

    def start(self) -> None:
        """Open them; those that peers may wait for first.

        Raises
        ------
        AddressError, BrokerError
            An address can't be bound, or a broker can't be reached.
        """
        # pyzmq starts a thread with the first large frame otherwise, and ends the process if it can't.
        prepare_lending()
        try:
            self.answers.start()
            self.failures.start()
            self.events.open()
        except Exception:
            self.stop(1.0)
            raise

    def stop(self, timeout_s: float) -> None:
        """Close them, within one time for all; what was published still leaves.

        Brokers, which may not answer, have equal shares of it.
        """
        until_s, brokers = monotonic() + timeout_s, 0
        with ExitStack() as closing:
            # The last that is pushed is the first that is called; all are, whichever of them fails.
            for endpoint in (self.failures, self.answers, self.events):
                closing.callback(_stop, endpoint, until_s, 1 + brokers)
                brokers += endpoint.is_broker

    @property
    def addresses(self) -> dict[str, str]:
        """Their addresses, ``connect:`` in front of those that connect; bound endpoints once they are bound."""
        return {"sub": self.events.address, "pub": self.answers.address, "failures": self.failures.address}

    @property
    def trouble(self) -> str:
        """Why a broker is not connected; empty if all are."""
        return self.events.trouble or self.answers.trouble or self.failures.trouble

    def counts(self) -> dict[str, int]:
        """Return the counts of the endpoints: rejected, lost or duplicates, reconnects, slow_subscribers."""
        return {**self.events.counts(), "slow_subscribers": self.answers.slow_subscribers}


def _stop(endpoint: EventInput | AnswerOutput, until_s: float, shares: int) -> None:
    endpoint.stop(max((until_s - monotonic()) / shares, _MIN_CLOSE_S))


def _shown(endpoint: Subscriber | Publisher) -> str:
    """Return the address of an endpoint, ``connect:`` in front where it connects."""
    return f"connect:{endpoint.address}" if endpoint.place.binds is False else endpoint.address


def _named(address: str, trouble: str) -> str:
    """Return why a broker is not connected, with its address."""
    return trouble if not trouble or address in trouble else f"{address}: {trouble}"


def _secured(address: str, options: Options) -> Mapping[str, Any]:
    """Return the options for peers of ZeroMQ, which other endpoints of the service may need; none for the others."""
    names = ("insecure", "keys", "allow") if parse_address(address).is_zeromq else ()
    return {name: getattr(options, name) for name in names}
