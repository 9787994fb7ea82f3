"""Where a service's events come from, and where answers and failures go: ZeroMQ sockets or a broker's queues.

The one module of the service that uses `epypes.transport`. Events arrive as frames whose header alone is read, and
answers leave as the frames that the worker encoded, with the publisher's stamp.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import ExitStack
from time import monotonic
from typing import Any, Final

from epypes.errors import BrokerError, MessageError
from epypes.pipeline import Mailbox
from epypes.service.options import CONNECT, Options, bare
from epypes.transport import Subscriber, ZMQPublisher, ZMQSubscriber
from epypes.transport.channels import is_brokered, open_channel, place_of
from epypes.transport.framing import check_source
from epypes.transport.outbox import Outbox
from epypes.transport.outlet import prepare_lending
from epypes.transport.throttle import Throttle
from epypes.wire import EncodedEnvelope

FAILURE_TOPIC: Final = "failure"
# Called once when a message is confirmed, with None, or will never be sent: with the reason.
Confirmed = Callable[[Exception | None], object]

# Answers kept for a subscriber that does not read; images are large, so this bounds the memory that one can cost.
_MAX_KEPT_ANSWERS: Final = 256
# Unconfirmed messages for a broker that is away.
_MAX_UNCONFIRMED: Final = 1_024
_FIRST_RETRY_S: Final = 0.1
_LONGEST_RETRY_S: Final = 5.0
# The least time for closing one endpoint, however late it is.
_MIN_CLOSE_S: Final = 0.5
# Sources whose sequence numbers are followed; a peer that invents sources must not fill the memory.
_MAX_SOURCES: Final = 1_024
# A Subscriber counts among its rejected messages the events that it hands over as delivered too often.
_EXHAUSTED: Final = "exhausted"

_log = logging.getLogger("epypes.service")


class ReceivedEvent:
    """An event as it was received: its frames, and the broker's delivery if there is one.

    Attributes
    ----------
    frames
        Topic, header and payloads; or the one frame of a message of 2019.
    envelope
        The header of the frames, with values that are not decoded; None for a message of 2019.
    id
        Of the envelope, or of the broker's message; empty if there is none.
    """

    __slots__ = ("_delivery", "envelope", "frames", "id")

    def __init__(
        self,
        frames: Sequence[bytes | memoryview],
        envelope: EncodedEnvelope | None,
        id: str,  # noqa: A002 - its name everywhere
        delivery: Any = None,
    ) -> None:
        self.frames, self.envelope, self.id, self._delivery = frames, envelope, id, delivery

    @property
    def stored(self) -> EncodedEnvelope | bytes:
        """What the failure store keeps of it."""
        return self.envelope or bytes(self.frames[0])

    @property
    def attempt(self) -> int | None:
        """How often a broker has delivered it, from 1; 0 if the broker does not count; None without a broker."""
        return None if self._delivery is None else int(self._delivery.attempt)

    def ack(self) -> None:
        """Tell the broker that the event is done."""
        if self._delivery is not None:
            self._delivery.ack()

    def reject(self, reason: str) -> None:
        """Have the broker make it a dead letter."""
        if self._delivery is not None:
            self._delivery.reject(reason)

    def nack(self) -> None:
        """Return it to the broker, which delivers it again."""
        if self._delivery is not None:
            self._delivery.give_back()


def group_address(options: Options) -> Any:
    """Return the broadcast address of the replicas that share a broker's queue; None without a broker."""
    return place_of(bare(options.sub)) if options.has_broker else None


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
        accept: Callable[[ReceivedEvent, bool, float | None], object],
        on_exhausted: Callable[[ReceivedEvent], object],
        on_change: Callable[[], object],
    ) -> None:
        self._options, self._accept, self._on_exhausted, self._on_change = options, accept, on_exhausted, on_change
        self.is_broker = options.has_broker
        self._losses, self._log = _LossCounter(), Throttle(_log)
        self._rejected = 0
        # Where a bound socket was, while events are not taken.
        self._closed_at = ""
        self._not_open = ""
        self._is_retry_over = threading.Event()
        self._subscriber: Any = self._make_subscriber(options.sub)

    def _make_subscriber(self, address: str) -> Any:
        options = self._options
        if self.is_broker:
            subscriber = Subscriber(bare(address), self, prefetch=options.prefetch, exhausted=self._exhausted)
            subscriber.on_connection = lambda is_connected, reason: self._on_change()
            return subscriber
        bind = not options.sub.startswith(CONNECT)
        return ZMQSubscriber(bare(address), self, "", bind, undecoded=True, **_secured(options))

    # -- as the subscriber's queue ------------------------------------------------------------------------------------

    def put(self, item: Any, *, block: bool = False, timeout: float | None = 0.0) -> None:
        """Accept a message; called on the subscriber's thread.

        Raises
        ------
        queue.Full
            There is no room for a broker's event.
        """
        if self.is_broker:
            self._accept(_delivered(item), block, timeout)
            return
        if len(item) == 1:
            self._accept(ReceivedEvent(item, None, ""), False, None)
            return
        try:
            envelope = EncodedEnvelope.read(item)
            check_source(envelope.source)
        except MessageError as error:
            self._rejected += 1
            self._log.warning(error.reason, f"rejected a message ({error.reason}): {error}")
            return
        self._losses.follow(envelope)
        self._accept(ReceivedEvent(envelope.frames, envelope, envelope.id), False, None)

    def _exhausted(self, item: Any) -> None:
        self._on_exhausted(_delivered(item))

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
            open_channel(place_of(bare(self._options.sub))).close()
        else:
            self.start()

    def start(self) -> None:
        """Take events; again where they were taken before. If the broker is away, a thread tries that again."""
        self._end_retry()
        if self.is_broker:
            try:
                self._subscriber.start()
                self._subscriber.resume()
            except BrokerError as error:
                self._not_open, self._is_retry_over = str(error), threading.Event()
                threading.Thread(
                    target=self._retry, args=(self._is_retry_over,), name="epypes opening", daemon=True
                ).start()
                self._on_change()
            return
        if self._closed_at:
            self._rejected += sum(self._subscriber.rejected.values())
            self._subscriber, self._closed_at = self._make_subscriber(self._closed_at), ""
        self._losses.reopen()
        self._subscriber.start()

    def _retry(self, is_over: threading.Event) -> None:
        pause_s = _FIRST_RETRY_S
        while not is_over.wait(pause_s):
            pause_s = min(2 * pause_s, _LONGEST_RETRY_S)
            try:
                self._subscriber.start()
            except BrokerError as error:
                self._not_open = str(error)
                continue
            if is_over.is_set():
                self._subscriber.stop()
                return
            self._not_open = ""
            self._on_change()
            return

    def _end_retry(self) -> None:
        self._is_retry_over.set()
        self._not_open = ""

    def pause(self, timeout_s: float) -> None:
        """Take no more events; those of a broker that were taken can still be acknowledged."""
        self._end_retry()
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
        self._end_retry()
        self._closed_at = ""
        self._subscriber.stop(timeout_s)

    # -- description --------------------------------------------------------------------------------------------------

    @property
    def address(self) -> str:
        """Where events come from, without a password; the bound endpoint, also while no events are taken."""
        if not self.is_broker and self._options.sub.startswith(CONNECT):
            return self._options.sub
        return self._closed_at or str(self._subscriber.address)

    @property
    def trouble(self) -> str:
        """Why the broker is not connected; empty if it is."""
        return (self._not_open or self._subscriber.trouble) if self.is_broker else ""

    def answered(self, ids: Iterable[str]) -> None:
        """Note that other replicas have answered events: they are duplicates if they are delivered again."""
        self._subscriber.seen(ids)

    def counts(self) -> dict[str, int]:
        """Return ``rejected``, and ``lost`` for a socket, ``duplicates`` and ``reconnects`` for a broker."""
        rejected = self._subscriber.rejected
        if self.is_broker:
            subscriber = self._subscriber
            own = {"duplicates": subscriber.duplicates, "reconnects": subscriber.reconnects}
            return {"rejected": sum(rejected.values()) - rejected[_EXHAUSTED], **own}
        return {"rejected": self._rejected + sum(rejected.values()), "lost": self._losses.total}


def _delivered(item: Any) -> ReceivedEvent:
    """Return an event of a broker."""
    frames = item.received.frames
    envelope = EncodedEnvelope.read(frames) if len(frames) > 1 else None
    return ReceivedEvent(frames, envelope, (envelope.id if envelope else "") or item.received.id, item)


class _LossCounter:
    """Counts the events that were sent and never arrived, by gaps in the sequence numbers of their senders."""

    def __init__(self) -> None:
        self.total = 0
        self._opened_ns = 0
        self._epochs: dict[str, int] = {}
        self._last: dict[tuple[str, int], int] = {}

    def reopen(self) -> None:
        """Note that the socket is opened: what was sent before is not lost."""
        self._opened_ns = time.time_ns()
        self._epochs.clear()
        self._last.clear()

    def follow(self, envelope: EncodedEnvelope) -> None:
        """Count the numbers that are missing before this one."""
        number = envelope.sequence
        if number == 0:
            return
        source = (envelope.source, envelope.epoch)
        last = self._last.pop(source, None)
        if last is None:
            # A source that is known and has begun anew while this end listened has sent from number 1 on.
            known = self._epochs.get(envelope.source)
            self._epochs[envelope.source] = max(envelope.epoch, known or 0)
            has_restarted = known is not None and envelope.epoch > max(known, self._opened_ns)
            last = 0 if has_restarted else number - 1
        self.total += max(number - last - 1, 0)
        self._last[source] = max(last, number)
        if len(self._last) > _MAX_SOURCES:
            oldest = next(iter(self._last))
            del self._last[oldest]
            self._epochs.pop(oldest[0], None)


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
        self._address, self._options, self._on_change = address, options, on_change
        self.is_broker = is_brokered(bare(address))
        self._epoch, self._sequences, self._rejected = time.time_ns(), Counter[str](), Counter[str]()
        self._items = Mailbox("drop_oldest", _MAX_KEPT_ANSWERS)
        self._publisher: Any = self._make_publisher()

    def _make_publisher(self) -> Any:
        if self.is_broker:
            place = place_of(bare(self._address))
            return Outbox(place, tell=lambda is_connected, reason: self._on_change())
        bind, mark = not self._address.startswith(CONNECT), _MAX_KEPT_ANSWERS
        secured = _secured(self._options)
        return ZMQPublisher(bare(self._address), self._items, "", bind, high_water_mark=mark, **secured)

    def start(self) -> None:
        """Open it.

        Raises
        ------
        AddressError, BrokerError
            The address can't be bound; the broker can't be reached, refuses, or has no such queue.
        """
        if self.is_broker and not self._publisher.is_alive():
            self._publisher = self._make_publisher()
        self._epoch = time.time_ns()
        self._sequences.clear()
        self._publisher.start()

    def stop(self, timeout_s: float) -> None:
        """Close it; what was published still leaves, as far as that is possible in time."""
        self._publisher.stop(timeout_s)

    def publish(self, answer: EncodedEnvelope | bytes, id: str, confirmed: Confirmed) -> None:  # noqa: A002
        """Publish an answer under an id; returns at once. A ZeroMQ socket confirms what it has taken."""
        frames: tuple[bytes | memoryview, ...]
        if isinstance(answer, EncodedEnvelope):
            try:
                check_source(answer.source)
            except MessageError as error:
                confirmed(error)
                return
            number = self._sequences[answer.source] + 1
            frames = answer.stamped(self._epoch, number, time.time_ns()).frames
        else:
            frames = (answer,)
        refusal = self._send(frames, id, confirmed)
        if refusal is None and isinstance(answer, EncodedEnvelope):
            # Counted when it can be sent: what is refused here is no loss on the way.
            self._sequences[answer.source] = number
        if refusal is not None or not self.is_broker:
            confirmed(refusal)

    def _send(self, frames: tuple[bytes | memoryview, ...], id: str, confirmed: Confirmed) -> Exception | None:  # noqa: A002
        """Send frames; return why they can't be sent."""
        publisher = self._publisher
        if self.is_broker:
            if publisher.waiting < _MAX_UNCONFIRMED:
                publisher.put(frames, id=id, then=confirmed)
                return None
            # Events that no broker keeps may be any number.
            text = f"{self.address} has not taken {_MAX_UNCONFIRMED} messages before this one. {self.trouble}"
            return BrokerError(self.address, text)
        sent = publisher.sent
        # Sent within put, on this thread.
        self._items.put(frames)
        if publisher.sent > sent:
            return None
        rejected, before = publisher.rejected, self._rejected
        self._rejected = rejected
        return MessageError("not sent", f"The answer could not be sent: {', '.join(rejected - before)}.")

    @property
    def address(self) -> str:
        """Where it publishes, without a password; ``connect:`` in front where it connects."""
        if self.is_broker:
            return str(self._publisher.place)
        return self._address if self._address.startswith(CONNECT) else str(self._publisher.address)

    @property
    def trouble(self) -> str:
        """Why the broker is not connected; empty if it is."""
        return str(self._publisher.trouble) if self.is_broker else ""

    @property
    def slow_subscribers(self) -> int:
        """How often a subscriber was so slow that it lost messages; a broker keeps messages instead."""
        return 0 if self.is_broker else int(self._publisher.slow_subscribers)


class Endpoints:
    """All endpoints of a service.

    Attributes
    ----------
    events, answers, failures
        Where events come from, where answers go, and where failures are published.
    """

    def __init__(
        self,
        options: Options,
        accept: Callable[[ReceivedEvent, bool, float | None], object],
        on_exhausted: Callable[[ReceivedEvent], object],
        on_change: Callable[[], object],
    ) -> None:
        self.events = EventInput(options, accept, on_exhausted, on_change)
        self.answers = AnswerOutput(options.pub, options, on_change)
        self.failures = AnswerOutput(options.failures, options, on_change)

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
        """Return the counts of what came and left beside events."""
        return {**self.events.counts(), "slow_subscribers": self.answers.slow_subscribers}


def _stop(endpoint: EventInput | AnswerOutput, until_s: float, shares: int) -> None:
    endpoint.stop(max((until_s - monotonic()) / shares, _MIN_CLOSE_S))


def _secured(options: Options) -> Mapping[str, Any]:
    return {name: getattr(options, name) for name in ("insecure", "keys", "allow")}
