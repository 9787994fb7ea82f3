"""Publishers: what is put into a queue is sent to an address, over ZeroMQ or to a broker."""

from __future__ import annotations

import contextlib
import logging
import os
import queue as queues
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any, ClassVar, Final, Protocol, Self

from epypes.errors import BrokerError, MessageError, StillRunning
from epypes.run import Failure
from epypes.transport.address import Address
from epypes.transport.channel import NO_HEADERS, Channel, Confirmed, Frames, confirm
from epypes.transport.endpoint import ConnectionState, Endpoint
from epypes.transport.sequences import check_source
from epypes.transport.throttle import Throttle
from epypes.wire import EncodedEnvelope, Envelope, Limits, encode, failure_event, new_id, serialized, topic_frame
from epypes.wire.encoder import stamped_frames

if TYPE_CHECKING:
    from epypes.transport.zeromq.curve import Keys, PublicKey

log = logging.getLogger("epypes.transport")

# How long the bridge sleeps in the user's queue before it checks its stop flag, while items come and when none comes:
# a stop takes this long at most. To wake up takes up to 100 us of a core.
_TICK_S: Final = 0.025
_LONGEST_TICK_S: Final = 0.045
# What it takes for a thread to notice that the channel is closed, when the time for a stop is over.
_CLOSE_S: Final = 0.5


class TakeQueue(Protocol):
    """What a publisher takes from: queue.Queue, queue.SimpleQueue, ep.Mailbox."""

    def get(self, *, timeout: float) -> Any:
        """Return the next item, or raise queue.Empty after ``timeout`` seconds."""


class Publisher(Endpoint):
    """Sends what is put into a queue to an address, of ZeroMQ or of a broker.

    Parameters
    ----------
    address
        ``"tcp://127.0.0.1:5555"``; ``"tcp://127.0.0.1:*"`` takes a free port, which `address` then names. Or
        ``"amqp://user:password@127.0.0.1/answers"``; see `epypes.transport.address.parse_address`.
    queue
        Any object with ``get(timeout=...)`` that raises queue.Empty; None to use `send` alone. bytes, bytearray and
        memoryview are sent as one frame, and so is a protobuf message (2019 mode: without a topic, for peers of the
        published system); an Envelope or EncodedEnvelope as topic, header and payload frames, a Failure as the Envelope
        that reports it, a tuple of bytes and memoryviews as these frames. Anything else is counted in `rejected`.

        From a Mailbox an item is sent within ``put``, on the thread that puts, whatever its policy: buffers may be used
        again then. To a broker, ``put`` returns when the broker has confirmed the message, so that a pipeline
        acknowledges an event when its answer is safe; what can't be sent raises MessageError there, and BrokerError if
        the publisher is stopped before. From other queues a thread takes an item a little later, so leave arrays alone,
        or make them read-only. Read-only arrays are sent over ZeroMQ without a copy.
    topic
        Topic of the envelopes; an EncodedEnvelope keeps its own if there is none. 2019 mode knows none.
    bind
        False to connect to a ZeroMQ subscriber that binds.
    insecure
        True to bind a ZeroMQ address that other machines can reach, without keys.
    keys
        Its own pair of CURVE keys, from `make_keys` or `read_keys`, or the path of its .key_secret file.
    allow
        With keys: the public keys of the peers that may connect, as text, .key files or a folder of these; where it
        connects itself, the one of the peer that is bound there.
    max_message_bytes
        Larger messages are rejected here. A broker may take less: NATS 1 MB, unless its ``max_payload`` says more.
    high_water_mark
        Messages kept for a ZeroMQ subscriber that does not keep up; what is more is dropped: the subscriber counts it
        in its ``lost``, and the publisher in `slow_subscribers`.
    timeout_s
        Longest wait for the broker's answer, in seconds; after it the message is sent again, under the same id.

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
    Start it, or use ``with``. Each start begins a new epoch; within it the sequence numbers of the envelopes of one
    source rise by 1 from 1. A message to a broker has the id of its Envelope, by which duplicates are detected: if an
    answer may be computed twice, let f_out give it an id made of the event's. Threads are daemons. Semeniuta and
    Falkman 2019, "Reactive pipelines".
    """

    def __init__(
        self,
        address: str | Address,
        queue: TakeQueue | None = None,
        topic: str = "",
        bind: bool = True,
        *,
        insecure: bool = False,
        keys: Keys | str | Path | None = None,
        allow: PublicKey | Collection[PublicKey] | None = None,
        max_message_bytes: int = Limits().total_bytes,
        high_water_mark: int = 1_000,
        timeout_s: float = 10.0,
    ) -> None:
        super().__init__(
            address,
            bind=bind,
            insecure=insecure,
            keys=keys,
            allow=allow,
            max_message_bytes=max_message_bytes,
            timeout_s=timeout_s,
        )
        self._queue, self._high_water_mark = queue, high_water_mark
        self._taker: HandOver | Bridge | None = None
        self._slow_subscribers = 0
        self._outbox = Outbox(
            str(self.place), topic, Limits(total_bytes=max_message_bytes), self.place.is_broker, self._connection
        )

    @property
    def sent(self) -> int:
        """How many messages were handed to ZeroMQ, or confirmed by the broker."""
        return self._outbox.sent

    @property
    def rejected(self) -> Counter[str]:
        """How many items could not be sent, by reason; a copy."""
        return Counter(self._outbox.rejected)

    @property
    def waiting(self) -> int:
        """How many messages the broker has not confirmed."""
        channel = self._channel
        return 0 if channel is None else channel.waiting

    @property
    def slow_subscribers(self) -> int:
        """How often the queue of a ZeroMQ subscriber filled up, so that at least one message was lost to it.

        ZeroMQ does not report how many more it dropped for that subscriber until half of its queue had been sent; the
        subscriber's ``lost`` does.
        """
        channel = self._zeromq_channel
        return self._slow_subscribers + (0 if channel is None else channel.slow_subscribers)

    def start(self) -> Self:
        """Connect and begin to send; nothing happens if it runs already.

        Raises
        ------
        AddressError
            The address can't be bound or understood.
        BrokerError
            The broker can't be reached, refuses, or has no such queue.
        StillRunning
            The queue's ``get`` does not return since the last stop.
        ValueError
            The queue is a Mailbox that another publisher takes from.
        """
        with self._lock:
            if self._running is not None:
                return self
            if self._taker is not None and not self._taker.stop(5.0):
                raise StillRunning(f"{type(self).__name__} {self._given}", ["get"], 5.0)
            options = {} if self._security is None else {"high_water_mark": self._high_water_mark}
            channel = self._new_channel(1, **options)
            channel.open(None)
            self._outbox.begin(channel)
            taker: HandOver | Bridge | None = None
            try:
                if self._queue is not None:
                    taker = take_from(self._queue, self._outbox, channel)
            except BaseException:
                channel.close()
                raise
            self._taker = taker

            def on_forgotten() -> None:
                if taker is not None:
                    taker.abandon()
                channel.abandon()

            self._opened(channel, on_forgotten)
        return self

    def stop(self, timeout_s: float = 5.0) -> None:
        """Send what is queued, then disconnect or close the socket; from any thread, as often as you like.

        Called by a queue's own ``get``, it does not wait: the rest happens when that has returned.

        Parameters
        ----------
        timeout_s
            Longest wait, in seconds. What is still queued then stays in the queue; what was taken from it and is not
            confirmed is counted in `rejected`, and raises from a Mailbox's ``put``.

        Raises
        ------
        StillRunning
            The queue's ``get`` does not return in time, or the ``put`` of a subscriber holds up the I/O thread. The
            channel is closed all the same.
        """
        taker = self._taker
        channel = self._taken_to_stop()
        if channel is not None:
            self._slow_subscribers += getattr(channel, "slow_subscribers", 0)
        if threading.get_ident() in self._connection.callback_threads:
            # What is not confirmed would wait for this thread, which is the channel's.
            timeout_s = 0.0
        until_s = monotonic() + timeout_s
        has_ended = taker is None or taker.stop(timeout_s)
        if channel is not None and (taker is None or not taker.closes_channel):
            channel.close(max(until_s - monotonic(), 0.0) if has_ended else _CLOSE_S)
        if timeout_s and not has_ended and taker is not None and not taker.stop(_CLOSE_S):
            raise StillRunning(f"{type(self).__name__} {self._given}", ["get"], timeout_s)

    def send(
        self,
        item: Any,
        *,
        id: str = "",  # noqa: A002 - that is its name in every protocol
        headers: Mapping[str, str] = NO_HEADERS,
        confirmed: Confirmed | None = None,
    ) -> None:
        """Send an item now, without the queue; from any thread. It returns before a broker has confirmed the message.

        Parameters
        ----------
        item
            What could be put into the queue.
        id
            The id of the message; without one, that of the envelope, or a new one. ZeroMQ does not carry it.
        headers
            Text that goes beside it, by name. ZeroMQ does not carry it.
        confirmed
            Called once if the item was accepted: with None when the broker has confirmed the message (ZeroMQ: at once),
            else with the error; on a thread of the channel or the caller's. It must be quick.

        Raises
        ------
        MessageError
            The item can't be sent. What code of the item itself raises comes as it is.
        BrokerError
            The publisher is stopped.
        """
        self._outbox.send(item, id, headers, confirmed)

    def wait_for_subscriber(self, timeout_s: float = 5.0) -> bool:
        """Return whether a ZeroMQ subscriber, of any topic, is connected within ``timeout_s`` seconds.

        A broker keeps messages, so that there the connection is enough.
        """
        if self._security is None:
            return self.wait_connected(timeout_s)
        channel = self._zeromq_channel
        return channel is not None and channel.subscriptions.wait(timeout_s)

    def __repr__(self) -> str:
        return self._repr(f"{self.sent} sent")


class ZMQPublisher(Publisher):
    """A `Publisher` over ZeroMQ, for addresses of ZeroMQ alone."""

    takes_brokers: ClassVar[bool] = False


class Outbox:
    """What a publisher does with items: make frames, number the envelopes, send and count; over all its starts.

    Parameters
    ----------
    name
        The address.
    topic
        Of the envelopes.
    limits
        Larger messages are rejected.
    is_confirmed_later
        Whether a message counts as sent when a broker has confirmed it.
    connection
        Knows the threads that must not wait for a confirmation.
    """

    def __init__(
        self, name: str, topic: str, limits: Limits, is_confirmed_later: bool, connection: ConnectionState
    ) -> None:
        self._name, self._topic, self._limits = name, topic, limits
        self._topic_frame = topic_frame(topic)
        self.is_confirmed_later, self._connection = is_confirmed_later, connection
        self.sent = 0
        self.rejected: Counter[str] = Counter()
        self._log = Throttle(log)
        self._channel: Channel | None = None
        self._process = os.getpid()
        self._epoch = 0
        self._sequences: Counter[str] = Counter()
        # Re-entrant: a signal's handler may send in the midst of a send, and so may the item's own code.
        self._turn = threading.RLock()
        # The thread that sends just now; 0 for none.
        self._busy_thread = 0
        self._later: deque[tuple[Any, str, Mapping[str, str], Confirmed | None]] = deque()

    def begin(self, channel: Channel) -> None:
        """Send over a channel from now on, in a new epoch."""
        if self._process != os.getpid():
            # A thread of the parent may hold the lock.
            self._turn, self._busy_thread, self._process = threading.RLock(), 0, os.getpid()
            self._later.clear()
        self._channel, self._epoch, self._sequences = channel, time.time_ns(), Counter()

    def send(
        self,
        item: Any,
        id: str = "",  # noqa: A002
        headers: Mapping[str, str] = NO_HEADERS,
        confirmed: Confirmed | None = None,
    ) -> None:
        """Send an item; from any thread, one after the other.

        An item that is sent from within, by the item's own code or by a signal's handler, follows. What such a handler
        raises, as Ctrl+C does, comes as it is, and the next item is sent.
        """
        if self._process != os.getpid():
            error = BrokerError(self._name, f"A message to {self._name} was not sent: this is a forked child.")
            self.count_rejected(error)
            raise error
        entry = mine = (item, id, headers, confirmed)
        failure: Exception | None = None
        me = threading.get_ident()
        # A signal is handled neither between the lock and its block nor between a flag and its try; wherever else one
        # comes, its handler finds the flag down and sends, or up and leaves its item to the caller that has put it up.
        with self._turn:
            self._later.append(mine)
            while self._later and not self._busy_thread:
                self._busy_thread = me
                try:
                    entry = self._later.popleft()
                    self._send(*entry)
                except BaseException as error:
                    self.count_rejected(error, entry[0])
                    if not isinstance(error, Exception):
                        raise
                    if entry is mine:
                        failure = error
                    else:
                        confirm(entry[3], error)
                finally:
                    self._busy_thread = 0
        if failure is not None:
            raise failure

    def send_unconfirmed(self, item: Any) -> None:
        """Send an item; what can't be sent is counted and logged."""
        try:  # noqa: SIM105 - each call costs 3 to 5 us here, after an image has filled the caches
            self.send(item)
        except Exception:  # noqa: S110 - it is counted
            pass

    def send_and_wait(self, item: Any) -> None:
        """Send an item, and wait until the broker has confirmed it; raise the error if it can't be sent."""
        me = threading.get_ident()
        if self._busy_thread == me or me in self._connection.callback_threads:
            # This thread sends, or the channel's thread has called the user: it would wait for itself.
            self.send(item)
            return
        is_confirmed = threading.Event()
        errors: list[Exception | None] = []

        def confirmed(error: Exception | None) -> None:
            errors.append(error)
            is_confirmed.set()

        self.send(item, confirmed=confirmed)
        is_confirmed.wait()
        if errors[0] is not None:
            raise errors[0]

    @property
    def taken_by(self) -> Callable[[Any], None]:
        """What a Mailbox hands its items to."""
        return self.send_and_wait if self.is_confirmed_later else self.send_unconfirmed

    def _send(self, item: Any, id: str, headers: Mapping[str, str], confirmed: Confirmed | None) -> None:  # noqa: A002
        channel = self._channel
        if channel is None:
            raise BrokerError(self._name, f"A message to {self._name} was not sent: the publisher was not started.")
        frames = self._frames(item)
        if self.is_confirmed_later:
            known_as = id or (item.id if isinstance(item, Envelope | EncodedEnvelope) else "") or new_id()
            channel.send(frames, id=known_as, headers=headers, confirmed=self._counting(confirmed))
            return
        # Counted before: a thread that has received it must find it counted.
        self.sent += 1
        try:
            channel.send(frames, confirmed=confirmed)
        except BaseException:
            self.sent -= 1
            raise

    def _counting(self, confirmed: Confirmed | None) -> Confirmed:
        def counted(error: Exception | None) -> None:
            if error is None:
                self.sent += 1
            else:
                self.count_rejected(error)
            if confirmed is not None:
                me = threading.get_ident()
                self._connection.callback_threads.add(me)
                try:
                    confirm(confirmed, error)
                finally:
                    self._connection.callback_threads.discard(me)

        return counted

    def count_rejected(self, error: BaseException, item: object = None, reason: str = "", once: bool = False) -> None:
        """Count and log an item that can't be sent; with ``once``, the first of its reason alone is logged."""
        text = repr(error)
        if isinstance(error, MessageError | BrokerError):
            text = str(error)
            reason = reason or (error.reason if isinstance(error, MessageError) else "not sent")
        # The item's own code, called to make bytes of it, may raise anything.
        reason = reason or type(error).__name__
        self.rejected[reason] += 1
        if not once or self.rejected[reason] == 1:
            kind = "" if item is None else f" of type {type(item).__name__}"
            self._log.warning(reason, f"{self._name} rejected an item{kind} ({reason}): {text}")

    def _frames(self, item: Any) -> Frames:
        """Return the frames of an item.

        Raises
        ------
        MessageError
            It can't be sent. What code of the item itself raises comes as it is.
        """
        frames: tuple[Any, ...]
        if isinstance(item, Envelope):
            return self._stamped(item.source, encode(item, self._topic, limits=self._limits))
        if isinstance(item, EncodedEnvelope):
            frames = (self._topic_frame, *item.frames[1:]) if self._topic else item.frames
            return self._stamped(item.source, frames)
        if isinstance(item, bytes):
            frames = (item,)
        elif isinstance(item, tuple):
            frames = item
            if not frames or not all(isinstance(frame, bytes | memoryview) for frame in frames):
                text = "A tuple is sent as the frames of a message, each bytes or a memoryview."
                raise MessageError("no codec", text)
        elif callable(getattr(item, "SerializeToString", None)):
            frames = (serialized(item),)
        elif isinstance(item, Failure):
            return self._frames(failure_event(item))
        elif isinstance(item, bytearray | memoryview):
            frames = (bytes(item),)
        else:
            raise MessageError(
                "no codec",
                f"A publisher sends bytes, protobuf messages, Envelopes and Failures, not {type(item).__name__}. "
                "Let f_out return one of these.",
            )
        size = sum(map(len, frames))
        if size > self._limits.total_bytes:
            raise MessageError("too large", f"A message of {size:,} bytes; the limit is {self._limits.total_bytes:,}.")
        return frames

    def _stamped(self, source: str, frames: Frames) -> Frames:
        """Return the frames of an envelope with the next number of its source."""
        check_source(source)
        number = self._sequences[source] + 1
        stamped = stamped_frames(frames, self._epoch, number, time.time_ns(), self._limits)
        # Counted when it can be sent: a rejected item is no loss on the way.
        self._sequences[source] = number
        return stamped


def take_from(queue: TakeQueue, outbox: Outbox, channel: Channel) -> HandOver | Bridge:
    """Have the items of a queue sent from now on, within ``put`` if the queue hands them over as a Mailbox does."""
    hand_to = getattr(queue, "hand_to", None)
    return HandOver(outbox, hand_to) if callable(hand_to) else Bridge(queue, outbox, channel)


class HandOver:
    """Has a queue hand its items over within the call of ``put``: no thread has to be woken up.

    When ``put`` returns, its item has been sent, and arrays that could still change have been copied.
    """

    closes_channel: Final = False

    def __init__(self, outbox: Outbox, hand_to: Callable[[Callable[[Any], object]], Callable[[], None]]) -> None:
        self.is_stopping = False
        starter: int | None = threading.get_ident()

        def take(item: Any) -> None:
            # Within the publisher's start the queue hands over what it has kept, which must neither wait nor raise.
            (outbox.send_unconfirmed if starter == threading.get_ident() else outbox.send_and_wait)(item)

        self._end = hand_to(take if outbox.is_confirmed_later else outbox.send_unconfirmed)
        starter = None

    def stop(self, timeout_s: float) -> bool:
        """Take no more: what is put from now on stays in the queue; return True, since nothing has to end."""
        self.abandon()
        return True

    def abandon(self) -> None:
        """Stop without waiting."""
        self.is_stopping = True
        self._end()


class Bridge:
    """A thread that takes from a queue which does not hand its items over.

    Attributes
    ----------
    closes_channel
        Whether its thread closes the channel at its end, since that thread itself has called stop.
    """

    def __init__(self, queue: TakeQueue, outbox: Outbox, channel: Channel) -> None:
        self._queue, self._outbox, self._channel = queue, outbox, channel
        self._process = os.getpid()
        self._deadline_s = 0.0
        self.closes_channel = False
        # Not an Event: the garbage collector sets it, in any thread, where a lock could be held already.
        self.is_stopping = False
        self._thread = threading.Thread(target=self._run, name="epypes-publisher", daemon=True)
        self._thread.start()

    def stop(self, timeout_s: float) -> bool:
        """Let the thread send what is queued; return whether it has ended in time."""
        if self._process != os.getpid():
            return True
        if not self.is_stopping:
            self._deadline_s = monotonic() + timeout_s
            self.is_stopping = True
        if self._thread is threading.current_thread():
            self.closes_channel = True
            return True
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def abandon(self) -> None:
        """Stop without waiting."""
        self.is_stopping = True

    def _run(self) -> None:
        try:
            tick_s = _TICK_S
            while not self.is_stopping:
                tick_s = _TICK_S if self._take(tick_s) else _LONGEST_TICK_S
            # As many as there were: a producer that goes on must not keep it from stopping.
            left = _size(self._queue)
            while left != 0 and monotonic() < self._deadline_s and self._take(0.0):
                left = None if left is None else left - 1
        finally:
            if self.closes_channel:
                self._channel.close()

    def _take(self, timeout_s: float) -> bool:
        try:
            item = self._queue.get(timeout=timeout_s)
        except queues.Empty:
            return False
        except BaseException as error:
            # A queue that is shut down or broken raises at once, each time: without the pause this would spin.
            self._outbox.count_rejected(error, reason="queue failed", once=True)
            time.sleep(_TICK_S)
            return False
        # The outbox has counted what the item's own code raises, even SystemExit; the thread goes on.
        with contextlib.suppress(BaseException):
            self._outbox.taken_by(item)
        return True


def _size(queue: object) -> int | None:
    """Return how many items a queue has, or None if it can't tell, as one of multiprocessing on macOS."""
    try:
        return int(queue.qsize())  # type: ignore[attr-defined]  # not every queue has one
    except BaseException:
        return None
