"""How do replicas talk at one place of a broker, though that goes away at times?"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any, Final

from epypes.errors import BrokerError
from epypes.transport.channels import Place, Received
from epypes.transport.channels.seam import Channel
from epypes.transport.connection import Connection

# How long it is quiet before `quiet` is called, and at most until a stop is noticed.
TICK_S: Final = 0.25
_PREFETCH: Final = 64
_TIMEOUT_S: Final = 5.0

_log = logging.getLogger("epypes.service")


class Talk:
    """Says and hears at one place; opened anew when the connection is lost, until it is stopped.

    Parameters
    ----------
    place
        Where.
    hear
        Called on a thread of its own with what has come.
    pause
        Called on that thread when there is nothing more just now, with whether that was so for a moment.
    """

    def __init__(
        self, place: Place, hear: Callable[[Received], object], pause: Callable[[bool], object] = lambda is_quiet: None
    ) -> None:
        self.place = place
        self._hear, self._pause = hear, pause
        self._turn = threading.Lock()
        self._over = threading.Event()
        self._channel: Channel | None = None
        self._has_failed = False
        self._connection = Connection(place, _PREFETCH, _TIMEOUT_S, lambda is_connected, trouble: None)
        self._connection.trouble = f"{place} has not been reached yet."
        self._thread = threading.Thread(target=self._run, name=f"epypes at {place.name}", daemon=True)

    @property
    def trouble(self) -> str:
        """Why nothing can be said; empty if something can."""
        return self._connection.trouble

    def start(self) -> None:
        """Begin to hear, as soon as the broker is there."""
        self._thread.start()

    def say(self, data: bytes, *, id: str = "") -> None:  # noqa: A002
        """Say something; return when the broker has taken it over.

        Raises
        ------
        BrokerError
            It is away: whether it has it is not known.
        MessageError
            It is too large.
        """
        with self._turn:
            channel = self._channel
            if channel is None:
                raise BrokerError(str(self.place), self.trouble or f"{self.place} is away.")
            channel.send((data,), id=id)

    def end_soon(self) -> None:
        """End without waiting for it."""
        self._over.set()

    def stop(self, timeout_s: float) -> None:
        """End; bounded. If the broker does not answer, the connection ends in the background."""
        self.end_soon()
        if self._thread.is_alive():
            self._thread.join(timeout_s)

    def _run(self) -> None:
        try:
            while (channel := self._connection.channel(self._over)) is not None:
                self._listen(channel)
        finally:
            self._channel = None
            self._connection.end()

    def _listen(self, channel: Channel) -> None:
        self._channel, wait_s = channel, TICK_S
        while not self._over.is_set():
            try:
                received = channel.receive(wait_s)
            except Exception as error:
                self._channel = None
                self._connection.lose(error)
                return
            self._connection.works()
            if received is None:
                self._call(self._pause, wait_s > 0.0)
                wait_s = TICK_S
            else:
                received.ack()
                self._call(self._hear, received)
                wait_s = 0.0

    def _call(self, function: Callable[[Any], object], said: Any) -> None:
        try:
            function(said)
        except Exception:
            # Once as an error: it may be so each time. Whoever is heard next must not suffer from it.
            _log.log(logging.DEBUG if self._has_failed else logging.ERROR, "at %s:", self.place, exc_info=True)
            self._has_failed = True
