"""What is an event that a broker has delivered? What others are as well, with a word for the broker on it."""

from __future__ import annotations

import dataclasses
import os
import threading
from collections.abc import Callable
from typing import Any, Self

from epypes.transport.channels.seam import Received
from epypes.transport.seen import Word
from epypes.wire import Envelope

__all__ = ["DeliveredBytes", "DeliveredEnvelope", "Delivery"]

# Called with the id and what was said, once per event.
Told = Callable[[str, Word], object]


class Delivery:
    """One event in hand: its deliveries, and the one word that is said about it, from any thread.

    Parameters
    ----------
    id
        Of the event; empty if it has none.
    received
        The delivery.
    connection
        The number of the connection that it came over: a word on what came over an earlier one is heard by nobody.
    done, given_back
        Called with the id when the word is said.
    """

    def __init__(
        self,
        id: str,  # noqa: A002 - that is what it is called everywhere
        received: Received,
        connection: int,
        done: Told,
        given_back: Callable[[str], object],
    ) -> None:
        self.id, self.received, self._connection = id, received, connection
        self._done, self._given_back = done, given_back
        self._earlier: list[Received] = []
        self._is_settled = False
        self._turn = threading.Lock()
        self._process = os.getpid()

    def again(self, received: Received, connection: int) -> bool:
        """Let a newer delivery take the older one's place; False if the word is said already."""
        with self._turn:
            if self._is_settled:
                return False
            if connection == self._connection:
                # Kept: to acknowledge it now would acknowledge the message, where a broker counts by message.
                self.received.frames = ()
                self._earlier.append(self.received)
            else:
                self._earlier.clear()
            self.received, self._connection = received, connection
            return True

    def settle(self, reason: str | None) -> None:
        """Say the word: that it is done, or what it is rejected for. Only the first counts; it raises nothing."""
        if self._process != os.getpid():
            # The connection is that of the parent, whose event it is.
            return
        with self._turn:
            if self._is_settled:
                return
            self._is_settled = True
            newest, earlier = self.received, self._earlier
            # Before the broker is told: what it delivers meanwhile is no new event.
            self._done(self.id, Word(reason, self._connection))
        if reason is None:
            newest.ack()
        else:
            newest.reject(reason)
        for received in earlier:
            received.ack()

    def give_back(self) -> None:
        """Say that somebody else shall have it: it is delivered again when the connection ends."""
        with self._turn:
            if self._is_settled:
                return
            self._is_settled = True
            self._given_back(self.id)


class _Delivered:
    """What `DeliveredEnvelope` and `DeliveredBytes` have in common.

    A copy that was made of one with other fields is no delivery: its `ack` and `reject` do nothing.
    """

    __slots__ = ()

    @property
    def delivery(self) -> Delivery | None:
        """What is known of its delivery; None for a copy."""
        return getattr(self, "_delivery", None)

    @property
    def received(self) -> Received | None:
        """The message, as it was delivered last; None for a copy."""
        return None if self.delivery is None else self.delivery.received

    @property
    def attempt(self) -> int:
        """How often it was delivered, from 1; 0 where nobody counts."""
        return 0 if self.received is None else self.received.attempt

    def ack(self) -> None:
        """Tell the broker that it is done with. The first word counts; from any thread; raises nothing."""
        if self.delivery is not None:
            self.delivery.settle(None)

    def reject(self, reason: str) -> None:
        """Have the broker put it aside among the dead letters, with the reason. Otherwise as `ack`."""
        if self.delivery is not None:
            self.delivery.settle(reason)

    def give_back(self) -> None:
        """Leave it to the broker, which delivers it again, to whoever asks, when this connection ends."""
        if self.delivery is not None:
            self.delivery.give_back()


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
        object.__setattr__(made, "_delivery", delivery)
        return made


_FIELDS = tuple(field.name for field in dataclasses.fields(Envelope))


class DeliveredBytes(_Delivered, bytes):
    """Bytes that a broker keeps until their `ack` or `reject` was called."""

    _delivery: Delivery

    @classmethod
    def of(cls, data: Any, delivery: Delivery) -> Self:
        """Return bytes as some that were delivered; they are copied."""
        made = cls(_bytes_of(data))
        made._delivery = delivery
        return made

    def __reduce__(self) -> tuple[type[bytes], tuple[bytes]]:
        # In another process, as in a copy, nobody hears a word on them.
        return bytes, (bytes(self),)


def _bytes_of(frame: Any) -> Any:
    """Return the bytes that a frame shows, if they are all of them: from others they would be copied twice."""
    whole = frame.obj if isinstance(frame, memoryview) else frame
    return whole if type(whole) is bytes and len(whole) == len(frame) else frame
