"""Channels to message brokers: the asyncio thread, reconnecting, outgoing messages and deliveries.

All broker channels of a process share one asyncio event loop on one daemon thread. It is started with the first channel
and ends with the last. Each channel has a `BrokerSession`, which is used on that thread alone, and a receiving thread,
which calls the handler of deliveries; the handler may block. What is settled or sent from other threads is handed to
the event loop by ``call_soon_threadsafe``.

Order: messages are published in the order of `BrokerChannel.send`, several of them before the first is confirmed. When
a connection is lost, all that are not confirmed are published again, in the same order and under the same ids. So the
first copies arrive in order; second copies are detected by their ids.
"""

from __future__ import annotations

import abc
import asyncio
import contextlib
import logging
import os
import queue
import socket
import ssl
import threading
from collections import deque
from collections.abc import Callable, Coroutine, Mapping
from functools import partial
from time import monotonic
from typing import Any, Final

from epypes.errors import BrokerError, MessageError
from epypes.transport.address import Address
from epypes.transport.brokers.message import (
    IncomingMessage,
    OutgoingMessage,
    dead_letter,
    header_bytes,
    pack,
    unpack,
)
from epypes.transport.channel import (
    CLOSING_GRACE_S,
    MESSAGE_OVERHEAD_BYTES,
    MOST_BACKLOG_BYTES,
    NO_HEADERS,
    ChannelOptions,
    Confirmed,
    Delivery,
    Frames,
    confirm,
)

log = logging.getLogger("epypes.transport")

# A broker that restarts is met within a moment of its being there; one that is away for hours costs nothing.
_FIRST_PAUSE_S: Final = 0.1
_LONGEST_PAUSE_S: Final = 5.0
# Messages that are published and not confirmed, at most: enough that the network is never waited for, and bounded.
_MOST_IN_FLIGHT: Final = 64
_MOST_IN_FLIGHT_BYTES: Final = 32 * 1024**2
# So many are delivered ahead of what is acknowledged as soon as the handler has it.
_AHEAD: Final = 100
# A message that could not be put into the dead-letter queue is delivered again after this time.
REDELIVERY_S: Final = 5.0
# After this time without an acknowledgement a full prefetch window is worth a warning.
STALLED_S: Final = 10.0
# What the end of a connection takes at most.
CLOSING_S: Final = 2.0


class BrokerSession(abc.ABC):
    """A connection to one broker, for one channel; used on the asyncio thread alone.

    Attributes
    ----------
    address, timeout_s
        See `epypes.transport.channel.ChannelOptions`.
    lost
        Made by the channel before `connect`; done with the reason when the connection is of no more use.
    most_header_bytes
        How much the headers of a message may take.
    """

    lost: asyncio.Future[str]
    most_header_bytes: int

    def __init__(self, address: Address, timeout_s: float) -> None:
        self.address, self.timeout_s = address, timeout_s

    def lose(self, reason: str) -> None:
        """Give the connection up: the channel closes it, and connects again."""
        if not self.lost.done():
            self.lost.set_result(reason)

    def check(self, message: OutgoingMessage) -> None:  # noqa: B027 - most brokers take any
        """Raise MessageError if the broker can never take a message; on the thread that sends it."""

    def hint(self, address: Address) -> str:
        """Return where to look if the broker doesn't answer: sentences with a space before them, or nothing."""
        return ""

    @abc.abstractmethod
    async def connect(self, window: int) -> None:
        """Connect, and see that the address is there, or make it; again after a connection was closed.

        Parameters
        ----------
        window
            How many messages may be unsettled; 0 on a channel that only sends.

        Raises
        ------
        BrokerError
            The broker can't be reached, refuses, or has no such queue.
        """

    @abc.abstractmethod
    async def publish(self, message: OutgoingMessage) -> None:
        """Send a message; return when the broker has confirmed it.

        Raises
        ------
        BrokerError
            It was refused or not confirmed; the channel tries again over another connection.
        MessageError
            The broker can never take it.
        """

    @abc.abstractmethod
    async def consume(self, deliver: Callable[[IncomingMessage], object], window: int) -> None:
        """Have a function called with each message that comes, with at most so many unsettled."""

    @abc.abstractmethod
    async def settle(self, message: IncomingMessage, *, requeue: bool) -> None:
        """Acknowledge a message, or have the broker deliver it again."""

    @abc.abstractmethod
    async def close(self) -> None:
        """Disconnect; the broker delivers again what is unsettled. As often as you like; may raise."""


class _EventLoopThread:
    """The asyncio event loop that all broker channels of this process share, on one daemon thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._users = 0
        self._released = asyncio.Event()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._thread: threading.Thread | None = None

    def acquire(self) -> asyncio.AbstractEventLoop:
        """Return the running loop; it runs until each user has called `release`."""
        with self._lock:
            if self._loop is None:
                runner, self._released = asyncio.Runner(loop_factory=asyncio.new_event_loop), asyncio.Event()
                self._loop, arguments = runner.get_loop(), (runner, self._released)
                self._thread = threading.Thread(target=_run_loop, args=arguments, name="epypes brokers", daemon=True)
                self._thread.start()
            self._users += 1
            return self._loop

    def release(self) -> None:
        with self._lock:
            self._users -= 1
            if not self._users and self._loop is not None:
                self._loop.call_soon_threadsafe(self._released.set)
                self._loop = self._thread = None

    def is_current(self) -> bool:
        """Return whether the calling thread is the one of the loop."""
        return threading.current_thread() is self._thread


def _run_loop(runner: asyncio.Runner, released: asyncio.Event) -> None:
    # Clients leave tasks behind that fail when a connection breaks; the channel reports the broken connection itself.
    runner.get_loop().set_exception_handler(lambda _, context: log.debug("a broker's client: %s", context))
    with runner:
        runner.run(released.wait())


_thread = _EventLoopThread()
# Loops of a parent process: to collect one in a forked child would unregister the parent's sockets from its selector.
_inherited: Final[list[_EventLoopThread]] = []


def _forget_parent() -> None:
    global _thread
    _inherited.append(_thread)
    _thread = _EventLoopThread()


os.register_at_fork(after_in_child=_forget_parent)


class BrokerChannel:
    """A `epypes.transport.channel.Channel` over the session of any broker.

    Parameters
    ----------
    session
        Of the broker; not connected.
    options
        See there.
    """

    def __init__(self, session: BrokerSession, options: ChannelOptions) -> None:
        self._session, self._options, self._address = session, options, session.address
        self.address = str(session.address)
        self.keeps_messages = session.address.kind == "queue"
        self.is_connected, self.trouble, self.reconnects = False, "", 0
        self.prefetch = options.prefetch
        self._process = os.getpid()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._handler: Callable[[Delivery], object] | None = None
        self._receiver: threading.Thread | None = None
        self._arrived: queue.SimpleQueue[IncomingMessage | None] = queue.SimpleQueue()
        self._resumed = threading.Event()
        self._resumed.set()
        # Guards what `send` shares with the asyncio thread: whether it is closed, and what was accepted.
        self._lock = threading.RLock()
        self._is_closed = False
        self._finished = threading.Event()
        # In the order of sending: what is not confirmed, and what of it was not published over this connection.
        self._unconfirmed: dict[OutgoingMessage, None] = {}
        self._unpublished: deque[OutgoingMessage] = deque()
        # From here on, of the asyncio thread alone.
        self._in_flight_bytes = 0
        self._wake, self._progress = asyncio.Event(), asyncio.Event()
        self._main: asyncio.Task[None] | None = None
        self._closing: asyncio.Task[None] | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._unsettled: set[IncomingMessage] = set()
        self._changed_s = monotonic()
        self._has_warned = self._is_dropping = False
        self._backlog_bytes = 0

    # --- for any thread ---

    @property
    def waiting(self) -> int:
        """How many messages were accepted for sending and are not confirmed."""
        return len(self._unconfirmed)

    def open(self, on_delivery: Callable[[Delivery], object] | None) -> None:
        """Connect for the first time; see `epypes.transport.channel.Channel.open`."""
        _warn_if_readable(self._address)
        self._handler = on_delivery
        loop = self._loop = _thread.acquire()
        opening = asyncio.run_coroutine_threadsafe(self._open(), loop)
        try:
            opening.result()
            if on_delivery is not None:
                name = f"epypes from {self._address.name}"
                self._receiver = threading.Thread(target=self._receive, name=name, daemon=True)
                self._receiver.start()
        except BaseException:
            # After Ctrl+C it may still be connecting.
            opening.cancel()
            self.close(0.0)
            raise
        finally:
            # It keeps the error, whose traceback keeps this frame: a cycle, with the sockets of the client in it.
            del opening

    def send(
        self,
        frames: Frames,
        *,
        id: str = "",  # noqa: A002 - that is its name in every protocol
        headers: Mapping[str, str] = NO_HEADERS,
        confirmed: Confirmed | None = None,
    ) -> None:
        """Accept a message for sending; see `epypes.transport.channel.Channel.send`."""
        body, carried = pack(frames, id, headers)
        message = OutgoingMessage(self._address, body, id, carried, confirmed)
        if len(body) > self._options.max_message_bytes:
            text = f"A message of {len(body):,} bytes; the limit is {self._options.max_message_bytes:,}."
            raise MessageError("too large", text)
        most = self._session.most_header_bytes
        if headers and header_bytes(carried) > most:
            raise MessageError(
                "too large", f"The headers of a message to {self.address} take more than {most:,} bytes."
            )
        self._session.check(message)
        with self._lock:
            if self._is_closed or self._loop is None or self._process != os.getpid():
                raise BrokerError(self.address, f"The channel to {self.address} is closed.")
            self._unconfirmed[message] = None
            self._unpublished.append(message)
            if not self._wake.is_set():
                self._loop.call_soon_threadsafe(self._wake.set)

    def pause(self) -> None:
        """Hand nothing more to the handler, and stay connected; the broker stops at the prefetch window."""
        self._resumed.clear()

    def resume(self) -> None:
        """Hand messages to the handler again after `pause`."""
        self._resumed.set()

    def close(self, timeout_s: float = 5.0) -> None:
        """Send what was accepted, and disconnect; see `epypes.transport.channel.Channel.close`."""
        with self._lock:
            self._is_closed = True
        if self._loop is None or self._process != os.getpid():
            return
        self._call(self._start_closing, timeout_s)
        if not _thread.is_current():
            # If the broker does not answer, the rest happens in the background.
            self._finished.wait(timeout_s + CLOSING_GRACE_S)

    def abandon(self) -> None:
        """Close without waiting and without taking a lock: the garbage collector calls it."""
        self._call(self._start_closing, 0.0)

    def _call(self, function: Callable[..., object], *arguments: object) -> None:
        """Have a function called on the asyncio thread; not at all once that has ended, and in a forked child."""
        if self._loop is not None and self._process == os.getpid():
            with contextlib.suppress(RuntimeError):
                self._loop.call_soon_threadsafe(function, *arguments)

    # --- the receiving thread ---

    def _receive(self) -> None:
        while True:
            message = self._arrived.get()
            self._resumed.wait()
            if message is None or self._is_closed:
                return
            # The broker delivers again what it had delivered over a connection that was lost.
            if (message.receipt is None or message in self._unsettled) and self._handler is not None:
                self._hand_over(message, self._handler)
            self._call(self._shrink_backlog, _size(message))

    def _hand_over(self, message: IncomingMessage, handler: Callable[[Delivery], object]) -> None:
        frames, headers = unpack(message)
        delivery = Delivery(frames, message.id, message.attempt, headers)
        if self.keeps_messages:
            delivery.settle = partial(self._call, self._settle, message)
        try:
            handler(delivery)
        except BaseException:
            # A fault of the handler's: the message is delivered again.
            log.exception("%s: a message could not be taken", self.address)
            delivery.nack()
        if not self.keeps_messages:
            self._call(self._settle, message, "ack", "")

    # --- the asyncio thread: connections ---

    async def _open(self) -> None:
        await self._connect()
        self._main = asyncio.ensure_future(self._run())

    async def _connect(self) -> None:
        session, timeout_s = self._session, self._options.timeout_s
        session.lost = asyncio.get_running_loop().create_future()
        window = self.prefetch if self.keeps_messages else max(self.prefetch, _AHEAD)
        try:
            async with asyncio.timeout(timeout_s):
                await session.connect(window if self._handler is not None else 0)
                self.reconnects += self._main is not None
                self._unsettled.clear()
                self._changed_s = monotonic()
                if self._handler is not None:
                    await session.consume(self._deliver, window)
        except BaseException as error:
            await self._disconnect()
            if isinstance(error, TimeoutError):
                text = f"{self.address} did not answer within {timeout_s:g} s.{session.hint(self._address)}"
                raise BrokerError(self.address, text) from error
            raise
        self._report("")

    async def _disconnect(self) -> None:
        """Close the session, whatever the broker says or does not say."""
        with contextlib.suppress(Exception):
            async with asyncio.timeout(CLOSING_S):
                await self._session.close()

    async def _run(self) -> None:
        """Use one connection after another until the channel is closed."""
        pause_s, lost_s = _FIRST_PAUSE_S, 0.0
        while True:
            opened_s = monotonic()
            if lost_s:
                log.warning("%s is connected again after %.1f s", self.address, monotonic() - lost_s)
            reason = await self._use()
            await self._disconnect()
            log.warning("lost %s, which is tried again until it is connected: %s", self.address, reason)
            lost_s = monotonic()
            self._report(reason)
            # A broker that lets us in and hangs up again, each time, is asked less and less often.
            if lost_s - opened_s > pause_s:
                pause_s = _FIRST_PAUSE_S
            while not self.is_connected:
                await asyncio.sleep(pause_s)
                pause_s = min(2 * pause_s, _LONGEST_PAUSE_S)
                try:
                    await self._connect()
                except Exception as error:
                    self._report(str(error) or repr(error))

    async def _use(self) -> str:
        """Send and receive over the connection; return why it was lost."""
        helpers = [asyncio.ensure_future(self._send_accepted())]
        if self.keeps_messages and self._handler is not None:
            helpers.append(asyncio.ensure_future(self._warn_if_stalled()))
        try:
            return await asyncio.shield(self._session.lost) or "the connection was lost"
        finally:
            for task in (*helpers, *self._tasks):
                task.cancel()
            await asyncio.gather(*helpers, *self._tasks, return_exceptions=True)

    def _report(self, trouble: str) -> None:
        was_connected, self.trouble, self.is_connected = self.is_connected, trouble, not trouble
        listener = self._options.on_connection
        if was_connected == self.is_connected or listener is None:
            return
        try:
            listener(self.is_connected, trouble)
        except BaseException:
            log.exception("%s: on_connection itself failed", self.address)

    def _spawn(self, work: Callable[..., Coroutine[Any, Any, None]], *args: Any) -> None:
        """Run something beside the rest; the connection is lost if it fails."""
        task = asyncio.ensure_future(self._guarded(work, *args))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def _guarded(self, work: Callable[..., Coroutine[Any, Any, None]], *args: Any) -> None:
        try:
            # Called here: a task may be cancelled before it begins.
            await work(*args)
        except Exception as error:
            self._session.lose(str(error) or repr(error))

    # --- the asyncio thread: sending ---

    async def _send_accepted(self) -> None:
        """Publish what was accepted, and first what an earlier connection left unconfirmed."""
        self._in_flight_bytes = 0
        with self._lock:
            self._unpublished = deque(self._unconfirmed)
        while True:
            self._wake.clear()
            while self._unpublished and self._has_room_in_flight():
                message = self._unpublished.popleft()
                self._in_flight_bytes += len(message.body)
                self._spawn(self._publish, message)
            await self._wake.wait()

    def _has_room_in_flight(self) -> bool:
        in_flight = len(self._unconfirmed) - len(self._unpublished)
        return in_flight < _MOST_IN_FLIGHT and self._in_flight_bytes < _MOST_IN_FLIGHT_BYTES

    async def _publish(self, message: OutgoingMessage) -> None:
        refused = None
        try:
            await self._until_confirmed(message)
        except MessageError as error:
            refused = error
        self._in_flight_bytes -= len(message.body)
        self._unconfirmed.pop(message, None)
        confirm(message.confirmed, refused)
        self._progress.set()
        self._wake.set()

    async def _until_confirmed(self, message: OutgoingMessage) -> None:
        session, timeout_s = self._session, self._options.timeout_s
        try:
            async with asyncio.timeout(timeout_s):
                await session.publish(message)
        except TimeoutError as error:
            text = f"{message.address} did not confirm a message within {timeout_s:g} s: it may have it or not."
            raise BrokerError(self.address, text + session.hint(message.address)) from error

    # --- the asyncio thread: receiving ---

    def _deliver(self, message: IncomingMessage) -> None:
        if message.receipt is not None:
            self._unsettled.add(message)
            self._changed_s = monotonic()
        elif self._backlog_bytes > MOST_BACKLOG_BYTES:
            if not self._is_dropping:
                self._is_dropping = True
                log.warning(
                    "%s: the handler is behind; messages that the broker does not keep are dropped", self.address
                )
            return
        self._backlog_bytes += _size(message)
        self._arrived.put(message)

    def _shrink_backlog(self, size: int) -> None:
        self._backlog_bytes -= size
        self._is_dropping = self._is_dropping and self._backlog_bytes > MOST_BACKLOG_BYTES // 2

    def _settle(self, message: IncomingMessage, verdict: str, reason: str) -> None:
        if message not in self._unsettled:
            return
        self._changed_s = monotonic()
        if verdict != "reject":
            self._spawn(self._settled, message, verdict == "nack")
        elif self._address.has_dead_letters:
            self._spawn(self._reject, message, reason)
        else:
            # This is a dead-letter queue: the message stays where it is.
            self._redeliver_later(message)

    async def _settled(self, message: IncomingMessage, requeue: bool) -> None:
        self._unsettled.discard(message)
        await self._session.settle(message, requeue=requeue)

    async def _reject(self, message: IncomingMessage, reason: str) -> None:
        try:
            await self._until_confirmed(dead_letter(self._address, message, reason, self._session.most_header_bytes))
        except (BrokerError, MessageError) as error:
            if not self._session.lost.done():
                text = "A message of %s can't be put into the dead-letter queue, and is delivered again in %g s: %s"
                log.warning(text, self.address, REDELIVERY_S, error)
                self._redeliver_later(message)
        else:
            await self._settled(message, False)

    def _redeliver_later(self, message: IncomingMessage) -> None:
        asyncio.get_running_loop().call_later(REDELIVERY_S, self._settle, message, "nack", "")

    async def _warn_if_stalled(self) -> None:
        while not self._has_warned:
            await asyncio.sleep(STALLED_S / 2)
            if len(self._unsettled) >= self.prefetch and monotonic() - self._changed_s > STALLED_S:
                self._has_warned = True
                text = (
                    "%s: prefetch limit reached: %d unacknowledged messages, and none was acknowledged for %g s. "
                    "Call ack() on each message that is done; or give the Subscriber acknowledge='received'."
                )
                log.warning(text, self.address, len(self._unsettled), STALLED_S)

    # --- the asyncio thread: the end ---

    def _start_closing(self, timeout_s: float) -> None:
        self._is_closed = True
        if self._closing is None:
            self._closing = asyncio.ensure_future(self._close(timeout_s))

    async def _close(self, timeout_s: float) -> None:
        self._arrived.put(None)
        self._resumed.set()
        try:
            with contextlib.suppress(TimeoutError):
                async with asyncio.timeout(timeout_s):
                    while self.waiting and self._main is not None:
                        self._progress.clear()
                        await self._progress.wait()
            if self.is_connected and self._tasks:
                # What was acknowledged or rejected just before.
                await asyncio.wait(self._tasks, timeout=min(timeout_s, CLOSING_S))
            if self._main is not None:
                self._main.cancel()
                await asyncio.gather(self._main, return_exceptions=True)
            await self._disconnect()
        finally:
            self.is_connected = False
            self._unsettled.clear()
            with self._lock:
                unsent = [*self._unconfirmed]
                self._unconfirmed.clear()
                self._unpublished.clear()
            why = self.trouble.rstrip(".") or "the channel was closed before the broker had confirmed it"
            for message in unsent:
                error = BrokerError(self.address, f"A message to {self.address} was not sent: {why}.")
                confirm(message.confirmed, error)
            _thread.release()
            self._finished.set()


def _size(message: IncomingMessage) -> int:
    return len(message.body) + MESSAGE_OVERHEAD_BYTES


# The brokers that were warned of.
_warned: Final[set[tuple[str, str, int]]] = set()


def _warn_if_readable(address: Address) -> None:
    """Warn once of a broker on another machine whose connection is not encrypted."""
    broker = (address.scheme, address.host, address.port)
    if not address.encrypted_as or address.is_on_this_machine or broker in _warned:
        return
    _warned.add(broker)
    log.warning(
        "%s is on another machine and not encrypted: every machine on the way can read the messages and the password. "
        "Write %s:// with ?ca=FILE.",
        address,
        address.encrypted_as,
    )


def certificates_of(address: Address) -> ssl.SSLContext | None:
    """Return what checks the certificate of an encrypted broker; None for one without encryption.

    Raises
    ------
    BrokerError
        The file of certificates can't be read.
    """
    if not (address.is_encrypted or address.ca):
        return None
    try:
        return ssl.create_default_context(cafile=address.ca or None)
    except OSError as error:
        why = getattr(error, "strerror", None) or error
        text = f"The certificates for {address} can't be read from {address.ca}: {why}."
        raise BrokerError(str(address), text) from error


def unreachable(address: Address, error: BaseException, timeout_s: float, what: str, otherwise: str) -> BrokerError:
    """Return the error for a broker that can't be connected to.

    Parameters
    ----------
    address
        Of the broker.
    error
        What its client raised.
    timeout_s
        How long it was waited for.
    what
        The kind of the broker, as ``"a RabbitMQ"``.
    otherwise
        What the error means if it is none of the network's: a sentence.
    """
    if isinstance(error, BrokerError):
        return error
    if isinstance(error, ssl.SSLError):
        why = getattr(error, "verify_message", "") or error.reason or str(error)
        text = f"{address} can't be trusted: {why}. Name the file with its certificates: ?ca=FILE."
    elif isinstance(error, TimeoutError):
        text = f"{address} did not answer within {timeout_s:g} s. Is it {what}, and can it be reached from here?"
    elif isinstance(error, socket.gaierror):
        text = f"{address} can't be reached: no host is called {address.host!r}."
    elif isinstance(error, OSError) and error.errno is not None:
        # asyncio's own text names an address as Python writes one.
        why = os.strerror(error.errno) if error.errno > 0 else str(error)
        text = f"{address} can't be reached: {why}. Is the broker running there?"
    else:
        text = otherwise
    return BrokerError(str(address), text)
