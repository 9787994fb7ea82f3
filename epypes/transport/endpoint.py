"""What a Subscriber and a Publisher have in common: an address, a channel from start to stop, and its connection."""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import warnings
import weakref
from abc import ABC, abstractmethod
from collections import Counter
from collections.abc import Callable, Collection, Iterator
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, ClassVar, Self

from epypes.deprecation import OldNames
from epypes.errors import AddressError
from epypes.optional import optional_import
from epypes.transport.address import Address, open_channel, parse_address
from epypes.transport.channel import Channel, ChannelOptions

if TYPE_CHECKING:
    from epypes.transport.peers.channel import PeerChannel
    from epypes.transport.zeromq.channel import ZeroMQChannel
    from epypes.transport.zeromq.curve import CurveOptions, Keys, PublicKey

log = logging.getLogger("epypes.transport")


class Startable(ABC):
    """Is started at the beginning of a ``with`` block, and stopped at its end, whatever happens in it."""

    @abstractmethod
    def start(self) -> Self:
        """Begin; nothing happens if it runs already."""

    @abstractmethod
    def stop(self, timeout_s: float = 5.0) -> None:
        """End; as often as you like."""

    def __enter__(self) -> Self:
        return self.start()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()


def warn_left_running(name: str) -> None:
    """Give a ResourceWarning for an object that the garbage collector ends."""
    warnings.warn(f"{name} was left running. Call stop(), or use with.", ResourceWarning, stacklevel=3)


class Endpoint(OldNames, Startable):
    """A Subscriber or a Publisher; it has a channel while it runs.

    Attributes
    ----------
    place
        The parsed address.
    on_connection
        None, or called with whether the broker is connected, and why not, when that changes; on the thread of the
        channel, and at the start perhaps on the caller's. It is not called for ZeroMQ, which connects by itself. For
        DDS and Zenoh it says whether their session is open and, with a router, whether that is connected.
    """

    takes_brokers: ClassVar[bool] = True

    def __init__(
        self,
        address: str | Address,
        *,
        bind: bool,
        insecure: bool,
        keys: Keys | str | Path | None,
        allow: PublicKey | Collection[PublicKey] | None,
        max_message_bytes: int,
        timeout_s: float,
    ) -> None:
        self.place = parse_address(address)
        self.on_connection: Callable[[bool, str], object] | None = None
        self._max_message_bytes, self._timeout_s = max_message_bytes, timeout_s
        self._established = threading.Event()
        # The threads that run a callback of the user just now: they must not wait for the channel.
        self._callback_threads: set[int] = set()
        self._lock = threading.Lock()
        self._channel: Channel | None = None
        self._process = os.getpid()
        self._reconnects = 0
        self._finalizer: weakref.finalize[Any, Any] | None = None
        self._security: CurveOptions | None = None
        if self.place.is_zeromq:
            with optional_import():
                from epypes.transport.zeromq.curve import CurveOptions
            self._given = self.place.endpoint
            binds = bind if self.place.binds is None else self.place.binds
            self._security = CurveOptions.checked(self._given, binds, insecure, keys, allow)
        else:
            self._given = str(self.place)
            if not self.takes_brokers:
                other = type(self).__name__.removeprefix("ZMQ")
                text = (
                    f"{self._given} is no address of ZeroMQ. Give it to a {other} in place of a {type(self).__name__}."
                )
                raise AddressError(self._given, text)
            if keys is not None or allow is not None:
                text = f"{self._given} takes no keys= and allow=, which are for ZeroMQ."
                text += " Write the encrypted scheme." if self.place.is_broker else ""
                raise AddressError(self._given, text)

    @property
    def address(self) -> str:
        """The address, without a password; of ZeroMQ, the endpoint that is bound once it is started."""
        channel = self._channel
        return self._given if channel is None else channel.address

    @property
    def refused(self) -> Counter[str]:
        """How often ZeroMQ peers were refused because their key is not allowed, by public key; a copy."""
        return Counter() if self._security is None else Counter(self._security.refused)

    @property
    def is_connected(self) -> bool:
        """Whether the broker is connected, as far as is known; of ZeroMQ, whether the socket is open."""
        channel = self._running
        return channel is not None and channel.is_connected

    @property
    def trouble(self) -> str:
        """Why the broker is not connected; empty if it is, and when this is stopped."""
        channel = self._running
        return "" if channel is None else channel.trouble

    @property
    def reconnects(self) -> int:
        """How often the broker was connected again, over all starts."""
        channel = self._channel
        return self._reconnects + (0 if channel is None else channel.reconnects)

    def wait_connected(self, timeout_s: float = 5.0) -> bool:
        """Return whether the broker is connected within ``timeout_s`` seconds."""
        if self._running is None:
            return False
        return self.is_connected or (self._established.wait(timeout_s) and self.is_connected)

    @property
    def _running(self) -> Channel | None:
        """The channel; None in a forked child, which has neither its parent's threads nor its connections."""
        return self._channel if self._process == os.getpid() else None

    @property
    def _peer_channel(self) -> ZeroMQChannel | PeerChannel | None:
        """The channel of ZeroMQ, DDS or Zenoh, which knows its peers; None for a broker."""
        return None if self.place.is_broker else self._channel  # type: ignore[return-value]

    def _new_channel(
        self, prefetch: int, on_stale: Callable[[bool], object] | None = None, **zeromq_options: Any
    ) -> Channel:
        """Return a channel that is not open; the options of ZeroMQ have no meaning for any other."""
        if self._security is not None:
            from epypes.transport.zeromq.channel import ZeroMQChannel

            if on_stale is not None:
                zeromq_options["on_stale"] = on_stale
            return ZeroMQChannel(
                self._given, self._security, max_message_bytes=self._max_message_bytes, **zeromq_options
            )
        options = ChannelOptions(
            prefetch=prefetch,
            timeout_s=self._timeout_s,
            max_message_bytes=self._max_message_bytes,
            on_connection=weakly(self._connection_changed),
            on_stale=on_stale,
        )
        return open_channel(self.place, options)

    def _connection_changed(self, is_connected: bool, reason: str) -> None:
        """Take note that the broker is connected or lost, and call the user's listener."""
        if is_connected:
            self._established.set()
        else:
            self._established.clear()
        if self.on_connection is not None:
            with not_waiting(self._callback_threads):
                try:
                    self.on_connection(is_connected, reason)
                except BaseException:
                    # It is the user's; the connection goes on.
                    log.exception("%s: on_connection itself failed", self)

    def _opened(self, channel: Channel, on_forgotten: Callable[[], object]) -> None:
        """Take note of a channel that was opened; ``on_forgotten`` is called by the garbage collector."""
        self._channel, self._process = channel, os.getpid()
        name = f"{type(self).__name__} {self._given}"
        self._finalizer = weakref.finalize(self, _abandon, os.getpid(), name, on_forgotten)

    def _taken_to_stop(self) -> Channel | None:
        """Return the channel, which belongs to the caller then; None if there is none to close here."""
        with self._lock:
            running, channel, self._channel = self._running, self._channel, None
            if channel is not None:
                self._reconnects += channel.reconnects
            if self._finalizer is not None:
                self._finalizer.detach()
        return running

    def _repr(self, count: str) -> str:
        state = "stopped" if self._running is None else "running"
        return f"<{type(self).__name__} {self.address[:50]} {state}: {count}>"


def has_ended(thread: threading.Thread | None, timeout_s: float) -> bool:
    """Return whether a thread has ended in time, or is the one that asks."""
    if thread is None or thread is threading.current_thread():
        return True
    thread.join(max(timeout_s, 0.0))
    return not thread.is_alive()


def weakly(method: Callable[..., object]) -> Callable[..., None]:
    """Return what calls a bound method as long as its object lives, and does not keep that alive."""
    known = weakref.WeakMethod(method)

    def call(*arguments: object) -> None:
        found = known()
        if found is not None:
            found(*arguments)

    return call


@contextlib.contextmanager
def not_waiting(threads: set[int]) -> Iterator[None]:
    """Have this thread be one of ``threads`` for the time of a ``with`` block."""
    me = threading.get_ident()
    threads.add(me)
    try:
        yield
    finally:
        threads.discard(me)


def _abandon(process: int, name: str, on_forgotten: Callable[[], object]) -> None:
    # By the garbage collector or at exit: so no waiting, no locks.
    if process == os.getpid():
        on_forgotten()
        warn_left_running(name)
