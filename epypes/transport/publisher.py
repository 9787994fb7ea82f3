"""Publishers: what is put into a queue is sent to an address, from peer to peer or to a broker."""

from __future__ import annotations

import contextlib
import logging
import os
import queue as queues
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from time import monotonic
from typing import TYPE_CHECKING, Any, ClassVar, Final, Protocol, Self

from epypes.errors import BrokerError, MessageError, StillRunning
from epypes.run import Failure
from epypes.transport.address import Address
from epypes.transport.channel import NO_HEADERS, Channel, Confirmed, Frames, confirm
from epypes.transport.endpoint import Endpoint, has_ended, not_waiting
from epypes.transport.ordering import check_source
from epypes.transport.throttle import Throttle
from epypes.wire import EncodedEnvelope, Envelope, Limits, encode, failure_event, new_id, serialized, topic_frame
from epypes.wire.encoder import stamped_frames

if TYPE_CHECKING:
    from epypes.transport.zeromq.curve import Keys, PublicKey

log = logging.getLogger("epypes.transport")

# How long the bridge sleeps in the user's queue before it checks its stop flag: a stop takes this long at most. To wake
# up takes up to 100 us of a core.
_TICK_S: Final = 0.035
# What it takes for a thread to notice that the channel is closed, when the time for a stop is over.
_CLOSE_S: Final = 0.5


class TakeQueue(Protocol):
    """What a publisher takes from: queue.Queue, queue.SimpleQueue, ep.Mailbox."""

    def get(self, *, timeout: float) -> Any:
        """Return the next item, or raise queue.Empty after ``timeout`` seconds."""


class Publisher(Endpoint):
    """Sends what is put into a queue to an address: of ZeroMQ, a broker, DDS or Zenoh.

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
    answer may be computed twice, let f_out give it an id made of the event's. What the handler of a signal, or the own
    code of an item, sends within another send is rejected (``"nested"``). Threads are daemons. Semeniuta and
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
        self._slow_subscribers = 0
        self._outbox = Outbox(
            str(self.place),
            topic,
            Limits(total_bytes=max_message_bytes),
            not self.place.is_zeromq,
            self._callback_threads,
        )
        # The thread that takes from a queue which is no Mailbox, and what has a Mailbox keep its items again.
        self._bridge: threading.Thread | None = None
        self._end_hand_over: Callable[[], object] = lambda: None

    @property
    def sent(self) -> int:
        """How many messages were handed to ZeroMQ, DDS or Zenoh, or confirmed by the broker."""
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
        channel = self._peer_channel
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
            if not has_ended(self._bridge, 5.0):
                raise StillRunning(f"{type(self).__name__} {self._given}", ["get"], 5.0)
            channel, outbox = self._new_channel(1, high_water_mark=self._high_water_mark), self._outbox
            channel.open(None)
            outbox.begin(channel)
            hand_to = getattr(self._queue, "hand_to", None)
            try:
                if callable(hand_to):
                    # What the queue has kept comes first, within this call, which waits for no confirmation.
                    with not_waiting(self._callback_threads):
                        self._end_hand_over = hand_to(outbox.take)
                elif self._queue is not None:
                    name = "epypes-publisher"
                    bridge = threading.Thread(target=outbox.take_all, args=(self._queue,), name=name, daemon=True)
                    bridge.start()
                    self._bridge = bridge
            except BaseException:
                channel.close()
                raise
            end_hand_over = self._end_hand_over

            def on_forgotten() -> None:
                end_hand_over()
                outbox.is_stopping = True
                channel.abandon()

            self._opened(channel, on_forgotten)
        return self

    def stop(self, timeout_s: float = 5.0) -> None:
        """Send what is queued, then disconnect or close the socket; from any thread, as often as you like.

        Called by a queue's own ``get``, it leaves what is queued in the queue.

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
        channel = self._taken_to_stop()
        if channel is not None:
            self._slow_subscribers += getattr(channel, "slow_subscribers", 0)
        if threading.get_ident() in self._callback_threads:
            # What is not confirmed would wait for this thread, which is the channel's.
            timeout_s = 0.0
        until_s = monotonic() + timeout_s
        self._end_hand_over()
        if not self._outbox.is_stopping:
            self._outbox.until_s, self._outbox.is_stopping = until_s, True
        is_drained = has_ended(self._bridge, timeout_s)
        if channel is not None:
            rest_s = max(until_s - monotonic(), 0.0) if is_drained else 0.0
            channel.close(rest_s if rest_s > 0 or not timeout_s else _CLOSE_S)
        if timeout_s and not is_drained and not has_ended(self._bridge, _CLOSE_S):
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
            The id of the message; without one, that of the envelope, or a new one. ZeroMQ does not carry it, and
            neither do messages of ROS 2.
        headers
            Text that goes beside it, by name. Likewise.
        confirmed
            Called once if the item was accepted: with None when the broker has confirmed the message (without a broker:
            at once), else with the error; on a thread of the channel or the caller's. It must be quick.

        Raises
        ------
        MessageError
            The item can't be sent. What code of the item itself raises comes as it is.
        BrokerError
            The publisher is stopped.
        """
        self._outbox.send(item, id, headers, confirmed)

    def wait_for_subscriber(self, timeout_s: float = 5.0) -> bool:
        """Return whether a subscriber is connected within ``timeout_s`` seconds; over ZeroMQ, one of any topic.

        A broker keeps messages, so that there the connection is enough.
        """
        if self.place.is_broker:
            return self.wait_connected(timeout_s)
        channel = self._peer_channel
        return channel is not None and channel.subscriptions.wait(timeout_s)

    def __repr__(self) -> str:
        return self._repr(f"{self.sent} sent")


class ZMQPublisher(Publisher):
    """A `Publisher` over ZeroMQ, for addresses of ZeroMQ alone."""

    takes_brokers: ClassVar[bool] = False


class Outbox:
    """What a publisher does with items: take them, make frames, number the envelopes, send and count; over all starts.

    It is an object of its own since a Mailbox and the bridge keep it alive, and must not keep the publisher alive.

    Parameters
    ----------
    name
        The address.
    topic
        Of the envelopes.
    limits
        Larger messages are rejected.
    is_confirmed
        Whether a message has an id, and counts as sent when the channel has confirmed it; not over ZeroMQ.
    callback_threads
        The threads that must not wait for a confirmation.

    Attributes
    ----------
    is_stopping, until_s
        Set at the stop: what is queued is sent until then, by the monotonic clock. Not an Event: the garbage collector
        sets it, in any thread, where a lock could be held already.
    """

    def __init__(self, name: str, topic: str, limits: Limits, is_confirmed: bool, callback_threads: set[int]) -> None:
        self._name, self._topic, self._limits = name, topic, limits
        self._topic_frame = topic_frame(topic)
        self._is_confirmed, self._callback_threads = is_confirmed, callback_threads
        self.sent = 0
        self.rejected: Counter[str] = Counter()
        self.is_stopping, self.until_s = True, 0.0
        self._log = Throttle(log)
        self._channel: Channel | None = None
        self._process = os.getpid()
        self._epoch = 0
        self._sequences: Counter[str] = Counter()
        # Re-entrant, so that a send within a send, of a signal's handler or of the item's own code, is noticed.
        self._turn = threading.RLock()
        self._is_sending = False

    def begin(self, channel: Channel) -> None:
        """Send over a channel from now on, in a new epoch."""
        if self._process != os.getpid():
            # A thread of the parent may hold the lock.
            self._turn, self._is_sending, self._process = threading.RLock(), False, os.getpid()
        self._channel, self._epoch, self._sequences = channel, time.time_ns(), Counter()
        self.is_stopping, self.until_s = False, 0.0

    def take(self, item: Any) -> None:
        """Send an item of the queue.

        Over a channel that confirms, this waits for that, and raises the error if it can't be sent. Else, and on a
        thread that must not wait, what can't be sent is counted and logged.
        """
        me = threading.get_ident()
        if not self._is_confirmed or me in self._callback_threads:
            try:  # noqa: SIM105 - each call costs 3 to 5 us here, after an image has filled the caches
                self.send(item)
            except Exception:  # noqa: S110 - it is counted
                pass
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

    def take_all(self, queue: TakeQueue) -> None:
        """Take from a queue until the stop, and then what is queued; the bridge's thread."""
        while not self.is_stopping:
            self._take_next(queue, _TICK_S)
        while monotonic() < self.until_s and self._take_next(queue, 0.0):
            pass

    def _take_next(self, queue: TakeQueue, timeout_s: float) -> bool:
        try:
            item = queue.get(timeout=timeout_s)
        except queues.Empty:
            return False
        except BaseException as error:
            # A queue that is shut down or broken raises at once, each time: without the pause this would spin.
            self._count_rejected(error, reason="queue failed")
            time.sleep(_TICK_S)
            return False
        # What the item's own code raises is counted, even SystemExit; the thread goes on.
        with contextlib.suppress(BaseException):
            self.take(item)
        return True

    def send(
        self,
        item: Any,
        id: str = "",  # noqa: A002
        headers: Mapping[str, str] = NO_HEADERS,
        confirmed: Confirmed | None = None,
    ) -> None:
        """Send an item; from any thread, one after the other.

        What a signal's handler raises meanwhile, as Ctrl+C does, comes as it is, and the next item is sent.
        """
        channel = self._channel
        try:
            if channel is None or self._process != os.getpid():
                text = f"A message to {self._name} was not sent: the publisher is not started in this process."
                raise BrokerError(self._name, text)
            with self._turn:
                if self._is_sending:
                    text = "It was sent by a signal's handler, or by the code of another item, within another send."
                    raise MessageError("nested", text)
                self._is_sending = True
                try:
                    frames, source = self._frames(item)
                    if self._is_confirmed:
                        known_as = id or (item.id if isinstance(item, Envelope | EncodedEnvelope) else "") or new_id()
                        channel.send(frames, id=known_as, headers=headers, confirmed=self._counting(confirmed))
                    else:
                        # Counted before: a thread that has received it must find it counted.
                        self.sent += 1
                        try:
                            channel.send(frames)
                        except BaseException:
                            self.sent -= 1
                            raise
                    if source is not None:
                        # Counted when it is sent: a refused item is no loss on the way.
                        self._sequences[source] += 1
                finally:
                    self._is_sending = False
        except BaseException as error:
            self._count_rejected(error, item)
            raise
        if not self._is_confirmed:
            confirm(confirmed, None)

    def _counting(self, confirmed: Confirmed | None) -> Confirmed:
        def counted(error: Exception | None) -> None:
            if error is None:
                self.sent += 1
            else:
                self._count_rejected(error)
            with not_waiting(self._callback_threads):
                confirm(confirmed, error)

        return counted

    def _count_rejected(self, error: BaseException, item: object = None, reason: str = "") -> None:
        """Count and log an item that can't be sent."""
        text = repr(error)
        if isinstance(error, MessageError | BrokerError):
            text = str(error)
            reason = reason or (error.reason if isinstance(error, MessageError) else "not sent")
        # The item's own code, called to make bytes of it, may raise anything.
        reason = reason or type(error).__name__
        self.rejected[reason] += 1
        if isinstance(error, KeyboardInterrupt):  # the user's, who sees it raised: nothing is wrong with the item
            return
        kind = "" if item is None else f" of type {type(item).__name__}"
        self._log.warning(reason, f"{self._name} rejected an item{kind} ({reason}): {text}")

    def _frames(self, item: Any) -> tuple[Frames, str | None]:
        """Return the frames of an item, and the source that numbers it; None if it is no envelope.

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
        return frames, None

    def _stamped(self, source: str, frames: Frames) -> tuple[Frames, str]:
        """Return the frames of an envelope with the next number of its source, and the source."""
        check_source(source)
        number = self._sequences[source] + 1
        return stamped_frames(frames, self._epoch, number, time.time_ns(), self._limits), source
