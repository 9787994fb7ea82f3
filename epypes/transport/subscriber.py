"""Subscribers: what arrives at an address, from a peer or from a broker, is put into a queue."""

from __future__ import annotations

import contextlib
import dataclasses
import logging
import os
import queue as queues
import threading
from collections import Counter
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from time import monotonic, sleep
from typing import TYPE_CHECKING, Any, ClassVar, Final, Literal, Protocol, Self, get_args

from epypes.errors import BrokerError, InvalidValue, MessageError, StillRunning
from epypes.transport.address import Address
from epypes.transport.channel import ERROR, ERROR_REASON, Channel, Delivery
from epypes.transport.deduplication import Deduplication
from epypes.transport.endpoint import Endpoint, has_ended, weakly
from epypes.transport.ordering import LossCounter, ReorderBuffer, Source, check_source, place_in_order
from epypes.transport.throttle import Throttle
from epypes.wire import EncodedEnvelope, Envelope, Limits, decode, topic_frame

if TYPE_CHECKING:
    from epypes.transport.zeromq.curve import Keys, PublicKey

log = logging.getLogger("epypes.transport")

Acknowledge = Literal["done", "received"]
# A queue that has ended takes nothing, whatever it is: that is no fault of the message, which other consumers get.
_ENDED: Final = (BrokerError, getattr(queues, "ShutDown", BrokerError))
# How long a subscriber of a broker takes no message after its queue has ended: so other consumers get what it returns.
_ENDED_S: Final = 1.0
# How long a full queue of the user is waited for before it is checked whether the subscriber stops.
_TICK_S: Final = 0.05
_NO_DELIVERY: Final = Delivery(())
_FIELDS: Final = tuple(field.name for field in dataclasses.fields(Envelope))
# A header of this size holds some 10,000 values, which take about 20 ms to decode: too long for the I/O thread.
_LARGE_HEADER_BYTES: Final = 32 * 1024
# What a message that waits takes beside its frames, about.
_OVERHEAD_BYTES: Final = 512
# How long an ordered subscriber waits for a missing envelope: ZeroMQ sends none again, and a broker delivers the event
# of a killed consumer again after some 5 s.
_HOLD_S: Final = 1.0
_HOLD_BROKER_S: Final = 10.0


class PutQueue(Protocol):
    """What a subscriber puts into: queue.Queue, queue.SimpleQueue, ep.Mailbox."""

    def put(self, item: Any, *, block: bool) -> object:
        """Take an item, or raise queue.Full.

        It is called with ``block=False``, by one thread at a time. If messages come from a broker and it was full, it
        is called with ``block=True`` and a ``timeout``.
        """


class Subscriber(Endpoint):
    """Puts the messages of an address into a queue: of ZeroMQ, a broker, DDS or Zenoh.

    Parameters
    ----------
    address
        ``"tcp://127.0.0.1:5555"`` or ``"amqp://user:password@127.0.0.1/events"``; see
        `epypes.transport.address.parse_address`.
    queue
        Any object with ``put(item, block=False)``, as queue.Queue and ep.Mailbox have it. A message of one frame is put
        as bytes (2019 mode), one of more frames as an Envelope, whose arrays are read-only. From a broker both have
        ``ack()``, ``reject(reason)``, ``nack()`` and ``attempt``. From ZeroMQ it is called on the I/O thread, and must
        be quick; otherwise it is called on a thread of the channel. What a full queue does not take is dropped and
        counted; with a broker it is waited for.
    topic
        Topic of the envelopes: ``"cam1"`` gets ``cam1`` and ``cam1/left``, not ``cam10``; ``""`` gets everything.
        Messages of 2019 have no topic: with one given, only those come whose own bytes begin with it and a slash. At a
        queue of a broker, a message of another topic is a dead letter.
    bind
        True to bind a ZeroMQ address, for publishers that connect.
    acknowledge
        ``"done"``: the broker keeps a message until its ``ack`` or ``reject`` was called, which a pipeline does when it
        has answered; so none is lost, and one may be delivered again. ``"received"``: until it is in the queue.
    prefetch
        How many messages of a broker may be unacknowledged at once: then delivery pauses.
    exhausted
        None, or called with a message that was delivered more often than the address allows, in place of rejecting it;
        on the channel's thread.
    ordered
        True to put envelopes in the order of their sequence numbers, by source and epoch; answers in the order of the
        requests that they answer, also those of several replicas of a service. What comes too early waits for what is
        missing: for 1 s, from a broker for 10 s, or for the number of seconds that is given in place of
        True. A line in the log then names what is missing. What waits is unacknowledged: ``prefetch`` bounds how far
        apart the messages of a broker may come.
    insecure
        True to bind a ZeroMQ address that other machines can reach, without keys.
    keys
        Its own pair of CURVE keys, from `make_keys` or `read_keys`, or the path of its .key_secret file.
    allow
        With keys: the public keys of the peers that may connect, as text, .key files or a folder of these; where it
        connects itself, the one of the peer that is bound there.
    max_message_bytes
        Larger messages are rejected. A ZeroMQ peer that sends a larger frame is disconnected. ZeroMQ keeps a message of
        several frames in memory until its last frame has come: a peer that has sent 64 MB more than this to a bound TCP
        port without ending its message is disconnected.
    high_water_mark
        Messages kept by ZeroMQ until the I/O thread has read them.
    undecoded
        True to put every message as a `epypes.transport.channel.Delivery`: with its frames as they came, and with its
        header (``envelope``) if they are an envelope.
    heartbeat_s
        After so many seconds of silence ZeroMQ publishers of EPypes 1.0 are asked whether they live; after three times
        as many without an answer the input is stale.
    timeout_s
        Longest wait for the broker's answer, in seconds.

    Attributes
    ----------
    on_stale
        None, or called with True when the input becomes stale and with False when something is heard again. It is
        called on the I/O thread of ZeroMQ or a thread of the channel, and must be quick.

    Raises
    ------
    AddressError
        The address can't be understood, or ``bind`` is asked for an address that is not loopback, with neither keys nor
        ``insecure``.
    KeysError
        Keys can't be read, or there is no list of allowed keys.
    MessageError
        ``topic`` can't be one.

    Notes
    -----
    Start it, or use ``with``. What is not acknowledged when it stops is delivered again, to any consumer. Semeniuta and
    Falkman 2019, "Reactive pipelines".
    """

    def __init__(
        self,
        address: str | Address,
        queue: PutQueue,
        topic: str = "",
        bind: bool = False,
        *,
        acknowledge: Acknowledge = "done",
        prefetch: int = 8,
        exhausted: Callable[[Any], object] | None = None,
        ordered: bool | float = False,
        insecure: bool = False,
        keys: Keys | str | Path | None = None,
        allow: PublicKey | Collection[PublicKey] | None = None,
        max_message_bytes: int = Limits().total_bytes,
        high_water_mark: int = 1_000,
        undecoded: bool = False,
        heartbeat_s: float = 1.0,
        timeout_s: float = 10.0,
    ) -> None:
        if acknowledge not in get_args(Acknowledge):
            raise InvalidValue(f"acknowledge is {' or '.join(map(repr, get_args(Acknowledge)))}, not {acknowledge!r}.")
        self._prefetch = _checked(prefetch)
        super().__init__(
            address,
            bind=bind,
            insecure=insecure,
            keys=keys,
            allow=allow,
            max_message_bytes=max_message_bytes,
            timeout_s=timeout_s,
        )
        self._high_water_mark, self._heartbeat_s = high_water_mark, heartbeat_s
        self._topic = topic_frame(topic) if topic else b""
        self.on_stale: Callable[[bool], None] | None = None
        self._inbox = Inbox(
            queue,
            self._topic,
            self.place,
            Limits(total_bytes=max_message_bytes),
            acknowledge=acknowledge,
            exhausted=exhausted,
            ordered=ordered,
            undecoded=undecoded,
        )

    @property
    def prefetch(self) -> int:
        """How many messages may be unacknowledged at once."""
        return self._prefetch

    @property
    def received(self) -> int:
        """How many messages were put into the queue."""
        return self._inbox.received

    @property
    def rejected(self) -> Counter[str]:
        """How many messages could not be understood, or were delivered too often, by reason; a copy."""
        return Counter(self._inbox.rejected)

    @property
    def dropped(self) -> Counter[str]:
        """How many messages the queue did not take, by reason (``"queue full"``, or what it raised); a copy."""
        return Counter(self._inbox.dropped)

    @property
    def lost(self) -> Mapping[Source, int]:
        """How many envelopes never arrived from a peer, by (source, epoch): gaps in their numbers; a copy."""
        return dict(self._inbox.losses.lost)

    @property
    def duplicates(self) -> int:
        """How many deliveries of a broker were of a message that was in flight or answered."""
        return self._inbox.deduplication.duplicates

    @property
    def dead_letters(self) -> int:
        """How many messages went into the dead-letter queue, because this subscriber or the user rejected them."""
        return self._inbox.dead_letters

    @property
    def is_stale(self) -> bool:
        """Whether the publishers that had joined are gone or silent; one that is idle is not. False with a broker."""
        channel = self._peer_channel
        return channel is not None and channel.publishers.is_stale

    @property
    def last_heard_s(self) -> float | None:
        """How many seconds ago anything came from a publisher; None before that, with a broker, and when stopped."""
        channel = self._peer_channel
        return None if channel is None else channel.publishers.last_heard_s

    def start(self) -> Self:
        """Connect and begin to receive; nothing happens if it runs already.

        Raises
        ------
        AddressError
            The address can't be bound, or can't be understood.
        BrokerError
            The broker can't be reached, refuses, or has no such queue.
        """
        with self._lock:
            if self._running is not None:
                return self
            channel = self._new_channel(
                self._prefetch,
                subscription=self._topic,
                high_water_mark=self._high_water_mark,
                heartbeat_s=self._heartbeat_s,
                on_stale=weakly(self._report_stale),
            )
            inbox = self._inbox
            inbox.begin(channel)
            try:
                channel.open(inbox.accept)
            except BaseException:
                inbox.end()
                raise

            def on_forgotten() -> None:
                inbox.abandon()
                channel.abandon()

            self._opened(channel, on_forgotten)
        return self

    def stop(self, timeout_s: float = 5.0) -> None:
        """Disconnect, or close the socket; from any thread, as often as you like.

        Parameters
        ----------
        timeout_s
            Longest wait, in seconds. If a broker does not answer by then, the rest happens in the background.

        Raises
        ------
        StillRunning
            A ``put`` of the queue, or of another one on the I/O thread, does not return in time. The channel is closed
            as soon as it does.
        """
        channel = self._taken_to_stop()
        if channel is None:
            return
        until_s = monotonic() + timeout_s
        self._inbox.end()
        channel.close(timeout_s)
        if not self._inbox.wait_returned(until_s - monotonic()):
            raise StillRunning(f"{type(self).__name__} {self._given}", ["put"], timeout_s)

    def pause(self) -> None:
        """Take no further messages from the broker and stay connected: messages can be acknowledged.

        What arrives from peers meanwhile is dropped.
        """
        if self._channel is not None:
            self._channel.pause()

    def resume(self) -> None:
        """Take messages again after `pause`."""
        if self._channel is not None:
            self._channel.resume()

    def wait_joined(self, timeout_s: float = 5.0, publishers: int = 1) -> bool:
        """Return whether publishers have confirmed the subscription: what they send from then on is not lost.

        Parameters
        ----------
        timeout_s
            Longest wait, in seconds.
        publishers
            How many publishers must have confirmed it: of ZeroMQ since the start, of DDS and Zenoh those that are
            there. A ZeroMQ publisher of 2019 never will. A broker keeps messages, so that there the connection is
            enough.
        """
        if self.place.is_broker:
            return self.wait_connected(timeout_s)
        channel = self._peer_channel
        return channel is not None and channel.publishers.wait(timeout_s, publishers)

    def _report_stale(self, is_stale: bool) -> None:
        if self.on_stale is not None:
            self.on_stale(is_stale)

    def __repr__(self) -> str:
        return self._repr(f"{self.received} received")


class ZMQSubscriber(Subscriber):
    """A `Subscriber` over ZeroMQ, for addresses of ZeroMQ alone."""

    takes_brokers: ClassVar[bool] = False


def _hold_s(ordered: bool | float, address: Address) -> float:
    if ordered is True:
        return _HOLD_BROKER_S if address.is_broker else _HOLD_S
    return float(ordered)


def _checked(prefetch: int) -> int:
    if prefetch < 1:
        raise InvalidValue(f"prefetch is a whole number from 1, not {prefetch!r}.")
    return prefetch


class Inbox:
    """What a subscriber does with deliveries: decode, deduplicate, order, put and count; over all its starts.

    Attributes
    ----------
    is_over
        Set when the subscriber stops: nothing is put from then on.
    """

    def __init__(
        self,
        queue: PutQueue,
        topic: bytes,
        address: Address,
        limits: Limits,
        *,
        acknowledge: Acknowledge,
        exhausted: Callable[[Any], object] | None,
        ordered: bool | float,
        undecoded: bool,
    ) -> None:
        self._queue, self._topic, self._address, self._limits = queue, topic, address, limits
        self._acknowledge, self._exhausted, self._undecoded = acknowledge, exhausted, undecoded
        self._is_zeromq = address.is_zeromq
        self._ordering = ReorderBuffer(_hold_s(ordered, address)) if ordered else None
        self._timer: threading.Timer | None = None
        self.is_over = True
        self.received = self._refused = self._starts = 0
        self.rejected: Counter[str] = Counter()
        self.dropped: Counter[str] = Counter()
        self.losses = LossCounter()
        self.deduplication = Deduplication()
        self._log = Throttle(log)
        self._process = os.getpid()
        self._channel: Channel | None = None
        # Held while a message is handled: on the thread of the channel, the one of large messages, or a timer's.
        # Re-entrant, since the queue of the user may stop the subscriber.
        self._handling = threading.RLock()
        self._large = _LargeMessages(self._handle, self._limits.total_bytes)

    @property
    def dead_letters(self) -> int:
        """How many messages were rejected."""
        return self._refused + self.deduplication.rejected

    def begin(self, channel: Channel) -> None:
        """Take the deliveries of a channel from now on."""
        if self._process != os.getpid():
            # A thread of the parent may hold the locks, and what is in flight is the parent's.
            self._process, self._handling, self.deduplication = os.getpid(), threading.RLock(), Deduplication()
        self._channel, self._keeps, self._timer = channel, channel.keeps_messages, None
        self._starts += 1
        self.losses.begin()
        self._large = _LargeMessages(self._handle, self._limits.total_bytes)
        self.is_over = False

    def abandon(self) -> None:
        """Put nothing from now on; without a lock, since the garbage collector calls this."""
        self.is_over = True
        self._large.end()

    def end(self) -> None:
        """Put nothing from now on."""
        self.abandon()
        timer = self._timer
        if timer is not None:
            timer.cancel()

    def wait_returned(self, timeout_s: float) -> bool:
        """After `end`: return whether the queue's ``put`` has returned within ``timeout_s`` seconds."""
        until_s = monotonic() + timeout_s
        if not self._handling.acquire(timeout=max(timeout_s, 0.0)):
            return False
        try:
            if self._ordering is not None and (rest := self._ordering.rest()) and not self._keeps:
                self.dropped["stopped"] += len(rest)
        finally:
            self._handling.release()
        return all(has_ended(thread, until_s - monotonic()) for thread in (self._timer, self._large.thread))

    def accept(self, delivery: Delivery) -> None:
        """Take a delivery; called by the channel."""
        if self._is_zeromq:
            frames, large = delivery.frames, self._large
            if (len(frames) > 1 and len(frames[1]) > _LARGE_HEADER_BYTES) or large.is_busy:
                try:
                    if not large.put(delivery):
                        self._count_rejected("too many at once", "Large messages come faster than they are decoded.")
                except RuntimeError as error:
                    self._count_rejected("no thread", f"A large message can't be decoded just now: {error}.")
                return
        self._handle(delivery)

    def _handle(self, delivery: Delivery) -> None:
        with self._handling:
            if self.is_over:
                return
            try:
                if not self._is_zeromq and not self._is_wanted(delivery):
                    return
                envelope = self._read(delivery)
            except Exception as error:
                # Also if memory is short: the message is gone, and is counted.
                reason = error.reason if isinstance(error, MessageError) else type(error).__name__
                self._count_rejected(reason, f"{error!s:.1000}", delivery)
                self._refused += self._keeps
                delivery.reject(str(error) or reason)
                return
            item: Any = delivery
            if self._keeps:
                known_as = delivery.id or ("" if envelope is None else envelope.id)
                reconnects = 0 if self._channel is None else self._channel.reconnects
                if not self.deduplication.is_first(known_as, delivery, (self._starts, reconnects)):
                    return
                if isinstance(envelope, Envelope):
                    item = DeliveredEnvelope.of(envelope, delivery)
                elif not self._undecoded:
                    item = DeliveredBytes.of(delivery)
                if delivery.attempt > self._address.attempts:
                    self._exhaust(item, delivery)
                    return
            else:
                if not self._undecoded:
                    item = bytes(delivery.frames[0]) if envelope is None else envelope
                if envelope is not None:
                    self.losses.add(envelope.source, envelope.epoch, envelope.sequence)
            if self._ordering is None or envelope is None:
                self._put(item, delivery)
                return
            self._put_all(self._ordering, self._ordering.add(*place_in_order(envelope), (item, delivery)))

    def _is_wanted(self, delivery: Delivery) -> bool:
        """Check a delivery, unless ZeroMQ has; return False if it is of another topic and not kept by a queue."""
        frames = delivery.frames
        size = sum(map(len, frames))
        if size > self._limits.total_bytes:
            raise MessageError("too large", f"A message of {size:,} bytes; the limit is {self._limits.total_bytes:,}.")
        if not frames or not self._topic or bytes(frames[0][: len(self._topic)]) == self._topic:
            return True
        if self._address.kind == "queue":
            raise MessageError("other topic", f"The message is not of topic {self._topic.decode()}.")
        return False

    def _read(self, delivery: Delivery) -> Envelope | EncodedEnvelope | None:
        """Return the envelope that a delivery is; None for a message of 2019.

        If nothing is to be decoded, the header is set at the delivery, or why its frames are no envelope.

        Raises
        ------
        MessageError
            It can't be understood.
        """
        frames, headers = delivery.frames, delivery.headers
        if not frames:
            text = headers.get(ERROR, "The message has no frames.")
            raise MessageError(headers.get(ERROR_REASON, "bad frames"), text)
        if len(frames) == 1:
            return None
        if not self._undecoded:
            envelope = decode(frames, self._limits)
            check_source(envelope.source)
            return envelope
        try:
            header = EncodedEnvelope.read(frames, self._limits)
            check_source(header.source)
        except MessageError as error:
            delivery.error = error
            return None
        delivery.envelope = header
        return header

    def _exhaust(self, item: Any, delivery: Delivery) -> None:
        self.rejected["exhausted"] += 1
        text = f"delivered {delivery.attempt} times, and no consumer has answered it"
        try:
            if self._exhausted is not None:
                self._exhausted(item)
                return
            way_out = (
                "Its consumers crashed, or took it and called neither ack() nor reject(). It is in the dead-letter "
                "queue %s; attempts=N in the address allows more."
            )
            address = self._address
            log.warning(f"rejected message %r of %s: %s. {way_out}", delivery.id, address, text, address.dead_letters)
        except BaseException:
            log.exception("%s: exhausted itself failed", self._address)
        delivery.reject(text)

    def _put_all(self, ordering: ReorderBuffer, entries: Iterator[tuple[Any, Delivery]]) -> None:
        for item, delivery in entries:
            self._put(item, delivery)
            if self.is_over:
                # The queue of the user has stopped the subscriber.
                return
        due_s = ordering.due_s
        if due_s is not None and self._timer is None and not self.is_over:
            self._timer = threading.Timer(max(due_s - monotonic(), 0.0) + 0.001, self._put_overdue)
            self._timer.name, self._timer.daemon = "epypes-ordering", True
            self._timer.start()

    def _put_overdue(self) -> None:
        with self._handling:
            self._timer = None
            if self._ordering is not None and not self.is_over:
                self._put_all(self._ordering, self._ordering.overdue())

    def _put(self, item: Any, delivery: Delivery) -> None:
        """Put an item into the queue of the user, and settle its delivery if that is to be done now."""
        # Counted before: a thread that has the item must find it counted.
        self.received += 1
        try:
            try:
                self._queue.put(item, block=False)
            except queues.Full:
                if not self._address.is_broker:
                    raise
                self._put_when_there_is_room(item)
        except queues.Full:
            self.received -= 1
            if not self._address.is_broker:
                self.dropped["queue full"] += 1
            delivery.nack()
        except BaseException as error:
            # The user's queue may raise anything, as a Mailbox of policy "fault" does; other messages go on.
            self.received -= 1
            self.dropped[type(error).__name__] += 1
            self._log.warning("refused", f"the queue refused a message: {error!r}")
            if isinstance(error, _ENDED):
                delivery.nack()
                self._wait_after_end()
            else:
                delivery.reject(f"the queue refused it: {error!r}")
        else:
            if self._acknowledge == "received":
                delivery.ack()

    def _wait_after_end(self) -> None:
        """Take no message for a moment: the queue has ended, and a returned message would come again at once."""
        until_s = monotonic() + _ENDED_S
        while self._keeps and not self.is_over and monotonic() < until_s:
            sleep(_TICK_S)

    def _put_when_there_is_room(self, item: Any) -> None:
        """Put an item; raise queue.Full if the subscriber stops before there is room."""
        while not self.is_over:
            with contextlib.suppress(queues.Full):
                self._queue.put(item, block=True, timeout=_TICK_S)  # type: ignore[call-arg]  # see PutQueue
                return
        raise queues.Full

    def _count_rejected(self, reason: str, text: str, delivery: Delivery | None = None) -> None:
        self.rejected[reason] += 1
        name = f" {delivery.id!r} of {self._address}" if delivery is not None and delivery.id else ""
        self._log.warning(reason, f"rejected a message{name} ({reason}): {text}")


class _LargeMessages:
    """Messages with large headers, and those behind them: handled in order, on a thread that starts with the first.

    Parameters
    ----------
    handle
        Called with each.
    most_bytes
        Of all that wait; a single message may always wait.

    Attributes
    ----------
    thread
        None before the first message.
    """

    def __init__(self, handle: Callable[[Delivery], None], most_bytes: int) -> None:
        self._handle, self._most_bytes = handle, most_bytes
        # Its put may be called by the garbage collector.
        self._waiting: queues.SimpleQueue[Delivery | None] = queues.SimpleQueue()
        # Written by one thread each.
        self._accepted_bytes = self._handled_bytes = 0
        self.thread: threading.Thread | None = None

    @property
    def is_busy(self) -> bool:
        """Whether a message waits or is being handled: later messages must wait for their turn."""
        return self._accepted_bytes != self._handled_bytes

    def put(self, delivery: Delivery) -> bool:
        """Hand over a message; return False if too many wait already. On the I/O thread.

        Raises
        ------
        RuntimeError
            The system has no thread to give just now; the next message asks for it again.
        """
        if self.thread is None:
            # First: without a thread, what waits would never be handled, and would keep out all others.
            thread = threading.Thread(target=self._run, name="epypes-decoding", daemon=True)
            thread.start()
            self.thread = thread
        size = _size(delivery)
        if self.is_busy and self._accepted_bytes - self._handled_bytes + size > self._most_bytes:
            return False
        self._accepted_bytes += size
        self._waiting.put(delivery)
        return True

    def end(self) -> None:
        """Let the thread end; what waits is then no longer wanted."""
        self._waiting.put(None)

    def _run(self) -> None:
        while (delivery := self._waiting.get()) is not None:
            size = _size(delivery)
            try:
                self._handle(delivery)
            except BaseException:
                # What can't be read is counted; this is a fault of ours, and must not stop the others.
                log.exception("a message could not be handled")
            # Not kept in memory while the next one is waited for.
            del delivery
            self._handled_bytes += size


def _size(delivery: Delivery) -> int:
    return sum(map(len, delivery.frames)) + _OVERHEAD_BYTES


class _Delivered:
    """What `DeliveredEnvelope` and `DeliveredBytes` have in common.

    A copy that was made of one with other fields is not delivered: its `ack`, `reject` and `nack` do nothing.
    """

    __slots__ = ()

    @property
    def delivery(self) -> Delivery:
        """The delivery, without its frames; of a copy, one that nothing keeps."""
        return getattr(self, "_delivery", _NO_DELIVERY)

    @property
    def attempt(self) -> int:
        """How often it was delivered, from 1; 0 where the broker does not count."""
        return self.delivery.attempt

    def ack(self) -> None:
        """Tell the broker that it is done. The first of ack, reject and nack counts; it raises nothing."""
        self.delivery.ack()

    def reject(self, reason: str) -> None:
        """Have the broker put it into the dead-letter queue, with the reason. Otherwise as `ack`."""
        self.delivery.reject(reason)

    def nack(self) -> None:
        """Return it to the broker, which delivers it again, to any consumer. Otherwise as `ack`."""
        self.delivery.nack()


class DeliveredEnvelope(_Delivered, Envelope):
    """An Envelope that a broker keeps until its `ack` or `reject` was called."""

    __slots__ = ("_delivery",)
    _delivery: Delivery

    @classmethod
    def of(cls, envelope: Envelope, delivery: Delivery) -> Self:
        """Return an envelope as one that was delivered."""
        made = object.__new__(cls)
        # As it was decoded, so nothing is checked or copied again.
        for name in _FIELDS:
            object.__setattr__(made, name, getattr(envelope, name))
        delivery.frames = ()
        object.__setattr__(made, "_delivery", delivery)
        return made


class DeliveredBytes(_Delivered, bytes):
    """Bytes that a broker keeps until their `ack` or `reject` was called."""

    _delivery: Delivery

    @property
    def id(self) -> str:
        """The id of the message; empty if it came without."""
        return self.delivery.id

    @classmethod
    def of(cls, delivery: Delivery) -> Self:
        """Return the only frame of a delivery; it is copied."""
        frame: Any = delivery.frames[0]
        whole = frame.obj if isinstance(frame, memoryview) else frame
        # If the frame is all of some bytes: a view would be copied twice.
        made = cls(whole if type(whole) is bytes and len(whole) == len(frame) else frame)
        delivery.frames = ()
        made._delivery = delivery
        return made

    def __reduce__(self) -> tuple[type[bytes], tuple[bytes]]:
        # In another process, as in a copy, there is no channel to settle it.
        return bytes, (bytes(self),)
