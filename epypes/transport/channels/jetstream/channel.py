"""How do messages go through NATS JetStream? Published and confirmed; asked for ahead, held, acknowledged."""

from __future__ import annotations

import asyncio
import logging
from collections import deque
from collections.abc import Callable, Coroutine, Mapping
from functools import partial
from time import monotonic
from types import MappingProxyType
from typing import Any, Final

from nats.aio.msg import Msg
from nats.errors import Error as NatsError

from epypes.errors import BrokerError, MessageError
from epypes.transport.channels.jetstream import pulls
from epypes.transport.channels.jetstream.link import Link
from epypes.transport.channels.jetstream.papers import attempt_of, dead_letter, headers_of, received, refused
from epypes.transport.channels.jetstream.places import (
    check,
    check_sending,
    consumer_of,
    is_for_dead_letters,
    streams_of,
)
from epypes.transport.channels.packing import packed
from epypes.transport.channels.place import Place
from epypes.transport.channels.seam import Frames, Received

_log = logging.getLogger("epypes.transport")
_NOTHING: Final[Mapping[str, str]] = MappingProxyType({})
_PROGRESS_S: Final = 1.0
# How many messages of a log, or broadcasts, wait to be received: they are small, and a replay shall be quick.
_AHEAD: Final = 256
_MOST_BROADCASTS: Final = 10_000


class JetStreamChannel:
    """A way to one place of a NATS server; see `seam.Channel`."""

    def __init__(self, place: Place, prefetch: int, timeout_s: float) -> None:
        self._place, self.prefetch, self._timeout_s = place, max(prefetch, 1), timeout_s
        self._arrived: deque[Msg] = deque()
        # Of the link's loop alone, as is all that they are about: who waits for the server's word on what he has
        # sent, and what was received and is not settled, by the subject that it is acknowledged to.
        self._unconfirmed: dict[str, Callable[[Any], object]] = {}
        self._held: dict[str, Msg] = {}
        self._pulls = pulls.Pulls(self.prefetch if place.kind == "queue" else _AHEAD)
        self._asked_for = self.prefetch
        self._number = 0
        self._asked: Any = None
        self._is_listening = False
        self._error: BrokerError | None = None
        check(place)
        self._link = Link(place, timeout_s, self._lost)
        self._link.open()
        self._client = self._link.client
        self._inbox = self._client.new_inbox()
        try:
            self._link.ask(self._begin)
        except BaseException:
            self.close()
            raise

    async def _begin(self) -> None:
        self._stream = await streams_of(self._client, self._place, self._timeout_s)
        self._asked = await self._link.hear(f"{self._inbox}.*", self._hear)

    # --- send ---

    def send(self, frames: Frames, *, id: str = "", headers: Mapping[str, str] = _NOTHING) -> None:  # noqa: A002
        """Send a message; see `seam.Channel.send`."""
        check_sending(self._place)
        body, more = packed(frames, id, headers)
        told = headers_of(self._place, id, more, len(body), self._client.max_payload)
        answers: list[BrokerError | MessageError | None] = []
        publish = self._broadcast if self._place.kind == "broadcast" else self._publish
        work = partial(publish, self._place.name, body, told, answers.append)
        if self._error is None and not self._link.run(work, lambda: answers or self._error, self._timeout_s):
            self._link.call(partial(self._link.lose, f"what was sent was not confirmed within {self._timeout_s:g} s"))
            text = f"{self._place} has not confirmed a message within {self._timeout_s:g} s. It may have it."
            raise BrokerError(str(self._place), text)
        error = answers[0] if answers else self._error
        if error is not None:
            raise error

    def _publish(self, subject: str, body: bytes, headers: dict[str, str], then: Callable[[Any], object]) -> None:
        self._number += 1
        number = f"p{self._number}"
        self._unconfirmed[number] = then
        if self._error is not None:
            self._confirm(number, self._error)
            return
        self._start(self._client.publish(subject, body, f"{self._inbox}.{number}", headers or None), number)

    def _broadcast(self, subject: str, body: bytes, headers: dict[str, str], then: Callable[[Any], object]) -> None:
        self._number += 1
        number = f"b{self._number}"
        self._unconfirmed[number] = then
        self._link.spawn(self._spread(number, subject, body, headers))

    async def _spread(self, number: str, subject: str, body: bytes, headers: dict[str, str]) -> None:
        try:
            await self._client.publish(subject, body, "", headers or None)
            await self._link.flush(self._timeout_s)
            self._confirm(number, None)
        except (NatsError, OSError) as error:
            self._confirm(number, self._error or self._link.failed(error))

    def _confirm(self, number: str, error: BrokerError | MessageError | None) -> None:
        then = self._unconfirmed.pop(number, None)
        if then is not None:
            then(error)
            self._link.changed()

    # --- receive ---

    def receive(self, timeout_s: float) -> Received | None:
        """Return the next message; see `seam.Channel.receive`."""
        if self._error is not None:
            raise self._error
        if not self._is_listening:
            self._link.ask(self._listen)
            self._is_listening = True
        if self.prefetch != self._asked_for:
            self._asked_for = self.prefetch
            self._link.call(partial(self._make_room, self.prefetch))
        if not self._arrived:
            self._link.wait(lambda: self._arrived or self._error, timeout_s)
        if self._error is not None:
            raise self._error
        if not self._arrived:
            return None
        message = self._arrived.popleft()
        if self._place.kind == "queue":
            return received(message, attempt_of(message), partial(self._settle, message))
        self._settle(message, None)
        return received(message, 0, None)

    async def _listen(self) -> None:
        if self._place.kind == "broadcast":
            await self._link.hear(self._place.name, self._overhear)
            await self._link.flush(self._timeout_s)
            return
        consumer, wait_s = await consumer_of(self._client, self._place, self._stream, self._timeout_s)
        self._next = f"$JS.API.CONSUMER.MSG.NEXT.{self._stream}.{consumer}"
        await self._ask_for_more()
        self._link.spawn(self._go_on(min(_PROGRESS_S, wait_s / 4)), "beat")

    def _overhear(self, message: Msg) -> None:
        if len(self._arrived) < _MOST_BROADCASTS:
            self._arrived.append(message)
            self._link.changed()

    def _hear(self, message: Msg) -> None:
        """Take what has come to our inbox: a message, a confirmation, or that a request has ended."""
        if message.reply.startswith("$JS.ACK."):
            self._pulls.came()
            self._held[message.reply] = message
            self._arrived.append(message)
            self._link.changed()
            return
        number = message.subject.rpartition(".")[2]
        if number.startswith("p"):
            self._confirm(number, refused(self._place, message))
            return
        headers = message.headers or {}
        status, told = headers.get("Status", ""), headers.get("Description", "")
        self._pulls.ended(int(number), int(headers.get("Nats-Pending-Messages", "0")))
        if status == "503" or "deleted" in told.lower():
            self._link.lose("the stream is gone, or the consumer that it is received by")
        elif status == "408":
            self._start(self._ask_for_more(is_due=True))

    async def _ask_for_more(self, *, is_due: bool = False) -> None:
        number, batch = self._pulls.wanted(len(self._held), monotonic(), is_due=is_due)
        if batch:
            await self._client.publish(self._next, pulls.request(batch), f"{self._inbox}.{number}")

    def _make_room(self, prefetch: int) -> None:
        if self._place.kind == "queue":
            self._pulls.more = max(prefetch - self._pulls.room, 0)
            self._start(self._ask_for_more())

    async def _go_on(self, every_s: float) -> None:
        """Say of what is held that it is being worked on, as long as we live, and ask for what nobody answered to."""
        while True:
            await asyncio.sleep(every_s)
            if self._place.kind == "queue":
                for reply in tuple(self._held):
                    await self._client.publish(reply, b"+WPI")
            await self._ask_for_more(is_due=True)

    @property
    def trouble(self) -> str:
        """Why it is over; see `seam.Channel.trouble`."""
        return "" if self._error is None else str(self._error)

    # --- settle ---

    def _settle(self, message: Msg, reason: str | None) -> None:
        self._link.call(partial(self._settled, message, reason))

    def _settled(self, message: Msg, reason: str | None) -> None:
        if self._error is not None or message.reply not in self._held:
            return
        if reason is None:
            self._acknowledge(message)
        elif is_for_dead_letters(self._place):
            # There is nowhere to put it. It stays, and comes again after a while.
            del self._held[message.reply]
        else:
            self._put_aside(message, reason)

    def _put_aside(self, message: Msg, reason: str) -> None:
        body, headers = dead_letter(self._place, message, reason)
        self._publish(self._place.dead_letters.name, body, headers, partial(self._was_put_aside, message))

    def _was_put_aside(self, message: Msg, error: BrokerError | MessageError | None) -> None:
        if error is None:
            self._acknowledge(message)
            return
        self._held.pop(message.reply, None)
        if self._error is None:
            # Nobody says any more that it is being worked on, so it comes again.
            text = "A message of %s can't be put among the dead letters, and comes again: %s"
            _log.warning(text, self._place, error)

    def _acknowledge(self, message: Msg) -> None:
        del self._held[message.reply]
        self._start(self._free(message.reply))

    async def _free(self, reply: str) -> None:
        if self._place.kind == "queue":
            await self._client.publish(reply, b"+ACK")
        await self._ask_for_more()

    # --- end ---

    def _start(self, work: Coroutine[Any, Any, Any], number: str = "") -> None:
        try:
            self._link.start(work)
        except (NatsError, OSError) as error:
            self._confirm(number, self._error or self._link.failed(error))

    def _lost(self, error: BrokerError) -> None:
        self._error = error
        for number in tuple(self._unconfirmed):
            self._confirm(number, error)

    def close(self) -> None:
        """End it; see `seam.Channel.close`."""
        self._link.close(self._give_back)

    async def _give_back(self) -> None:
        # Not what is just being put among the dead letters.
        while self._unconfirmed:
            await asyncio.sleep(0.001)
        if self._asked is not None:
            await self._asked.drain()
        for reply in tuple(self._held) if self._place.kind == "queue" else ():
            await self._client.publish(reply, b"-NAK")


def open_channel(place: Place, prefetch: int, timeout_s: float) -> JetStreamChannel:
    """Open a way to a place of a NATS server."""
    return JetStreamChannel(place, prefetch, timeout_s)
