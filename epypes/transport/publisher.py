"""How does what is put into a queue leave the process? Through a publisher."""

from __future__ import annotations

import threading
import warnings
import weakref
from collections import Counter
from collections.abc import Collection
from pathlib import Path
from typing import Any, Self

from epypes.transport.keys import Keys, PublicKey
from epypes.transport.outlet import Counts, Outlet
from epypes.transport.security import security
from epypes.transport.takers import TakeQueue, Taker, taker
from epypes.transport.within import Within
from epypes.wire import Limits, topic_frame

HIGH_WATER_MARK = 1_000


class ZMQPublisher(Within):
    """Publishes what is put into a queue, on a ZeroMQ XPUB socket.

    Parameters
    ----------
    address
        ``"tcp://127.0.0.1:5555"``; ``"tcp://127.0.0.1:*"`` takes a free port, which `address` then names.
    queue
        Any object with ``get(timeout=...)`` that raises queue.Empty. bytes, bytearray and memoryview go out as one
        frame, and so does a protobuf message (2019 mode: without a topic, for peers of the published system);
        an Envelope goes out as topic, header and payload frames, a Failure as the Envelope that reports it, a tuple
        of bytes and memoryviews as these frames. Anything else is counted in `rejected`. From a Mailbox an item is
        sent within ``put``, on the thread that puts, whatever its policy: buffers may be used again then. From other
        queues a thread takes it a little later, so leave arrays alone, or make them read-only. Read-only arrays are
        sent without a copy.
    topic
        Topic of the envelopes. 2019 mode knows none.
    bind
        False to connect to a subscriber that binds.
    insecure
        True to bind an address that other machines can reach, without keys.
    keys
        Its own pair of CURVE keys, from `make_keys` or `read_keys`, or the path of its .key_secret file.
    allow
        With keys: the public keys of the peers that may connect, as text, .key files or a folder of these; where it
        connects itself, the one of the peer that is bound there.
    max_message_bytes
        Larger messages are rejected here, since the receiver would drop the connection.
    high_water_mark
        Messages kept for a subscriber that does not keep up; what is more is dropped, which the subscriber sees in
        its ``lost``, and `slow_subscribers` here.

    Raises
    ------
    AddressError
        If ``bind`` is asked for an address that is not loopback, with neither keys nor ``insecure``.
    KeysError
        If keys can't be read, or it is not said which are allowed.
    MessageError
        If ``topic`` can't be one.

    Notes
    -----
    Start it, or use ``with``. Each start begins a new epoch; within it the sequence numbers of the envelopes of one
    source rise by 1 from 1. Threads are daemons. Semeniuta and Falkman 2019, "Reactive pipelines".
    """

    def __init__(
        self,
        address: str,
        queue: TakeQueue,
        topic: str = "",
        bind: bool = True,
        *,
        insecure: bool = False,
        keys: Keys | str | Path | None = None,
        allow: PublicKey | Collection[PublicKey] | None = None,
        max_message_bytes: int = Limits().total_bytes,
        high_water_mark: int = HIGH_WATER_MARK,
    ) -> None:
        self._security = security(address, bind, insecure, keys, allow)
        topic_frame(topic)
        self._given = address
        self._queue, self._topic = queue, topic
        self._limits = Limits(total_bytes=max_message_bytes)
        self._high_water_mark = high_water_mark
        self._counts = Counts()
        self._lock = threading.Lock()
        self._outlet: Outlet | None = None
        self._taker: Taker | None = None
        self._finalizer: weakref.finalize[Any, Any] | None = None

    @property
    def address(self) -> str:
        """The endpoint that is bound, once it is started; before that, the address that was given."""
        outlet = self._outlet
        return self._given if outlet is None else outlet.address

    @property
    def sent(self) -> int:
        """How many messages were handed to ZeroMQ."""
        return self._counts.sent

    @property
    def rejected(self) -> Counter[str]:
        """How many items could not be sent, by reason; a copy."""
        return Counter(self._counts.rejected)

    @property
    def slow_subscribers(self) -> int:
        """How often the queue of a subscriber filled up, so that at least one message was lost to it.

        ZeroMQ does not say how many more it dropped for that subscriber until half of its queue had been sent; the
        subscriber's ``lost`` does.
        """
        return self._counts.slow_subscribers

    @property
    def refused(self) -> Counter[str]:
        """How often peers were refused because their key is not allowed, by public key; a copy."""
        return Counter(self._security.refused)

    def start(self) -> Self:
        """Open the socket and begin to publish; nothing happens if it runs already.

        Raises
        ------
        AddressError
            If the address can't be bound or understood.
        StillRunning
            If another thread's stop takes too long.
        """
        with self._lock:
            if self._taker is not None and not _is_over(self._taker):
                return self
            outlet = Outlet(self._topic, self._limits, self._counts)
            outlet.open(self._given, self._security, self._high_water_mark)
            try:
                self._taker = taker(self._queue, outlet)
            except BaseException:
                outlet.close()
                raise
            self._outlet = outlet
            self._finalizer = weakref.finalize(self, _abandon, self._taker, self._given)
        return self

    def stop(self, timeout_s: float = 5.0) -> None:
        """Send what is queued, then close the socket; from any thread, as often as you like.

        Called by a queue's own ``get`` or ``put``, it does not wait: the rest happens when that has returned.

        Parameters
        ----------
        timeout_s
            Longest wait, in seconds. What is still queued then stays in the queue.

        Raises
        ------
        StillRunning
            If the queue's ``get`` does not return in time. The socket is closed all the same.
        """
        running = self._taker
        if running is None:
            return
        if self._finalizer is not None:
            self._finalizer.detach()
        running.stop(timeout_s)
        with self._lock:
            if self._taker is running and not running.is_alive():
                self._taker = self._outlet = None

    def wait_for_subscriber(self, timeout_s: float = 5.0) -> bool:
        """Return whether a subscriber, of any topic, is there within ``timeout_s`` seconds."""
        outlet = self._outlet
        return outlet is not None and outlet.doorkeeper.wait(timeout_s)

    def __repr__(self) -> str:
        state = "stopped" if self._taker is None else "running"
        return f"<ZMQPublisher {self.address[:40]} {state}: {self.sent} sent>"


def _is_over(running: Taker) -> bool:
    """Return whether a taker has ended, after waiting for it if it is about to."""
    if running.is_alive() and not running.stopping:
        return False
    running.stop(5.0)
    return True


def _abandon(running: Taker, address: str) -> None:
    # By the garbage collector or at exit: so no waiting, no locks.
    if running.is_alive():
        running.abandon()
        warnings.warn(
            f"ZMQPublisher {address} was left running. Call stop(), or use with.", ResourceWarning, stacklevel=2
        )
