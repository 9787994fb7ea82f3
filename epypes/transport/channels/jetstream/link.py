"""How do threads talk through a client that lives in an event loop? One connection to a NATS server.

The loop is driven by whoever waits, see `turns`. The library would wait, when it closes a connection, until all was
sent: so we take a connection for lost before it does, and close the socket.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import types
from collections.abc import Callable, Coroutine, Generator
from functools import partial
from typing import Any, Final

from nats.aio.client import Client
from nats.aio.msg import Msg
from nats.aio.subscription import Subscription
from nats.errors import Error as NatsError

from epypes.errors import BrokerError
from epypes.transport.channels.jetstream.entry import check_encryption, entry, refusal, said, unreachable
from epypes.transport.channels.jetstream.loop import OwnLoop, is_not_ours
from epypes.transport.channels.place import Place
from epypes.transport.channels.turns import Turns, always, nothing

_log = logging.getLogger("epypes.transport")
# A cut link is noticed after at most the sum of both.
_BEAT_S: Final = 2.5
_SILENCE_S: Final = 5.0
_CLOSING_S: Final = 2.0


class _Hearing:
    """What the library takes for a future: it gets each message at once; for a callback a task would be woken first."""

    def __init__(self, hear: Callable[[Msg], object]) -> None:
        self._hear = hear

    def cancelled(self) -> bool:
        return False

    def set_result(self, message: Msg) -> None:
        try:
            self._hear(message)
        except Exception:  # what others send to our inbox must not end the connection
            _log.debug("a message to %s was not understood", message.subject, exc_info=True)


class _Client(Client):  # type: ignore[misc]  # the library has no types
    """A client that writes what is said at once; the library wakes a task for it, which takes longer than to write."""

    _pending: list[bytes]

    async def _flush_pending(self, force_flush: bool = False) -> Any:
        transport = self._transport
        if transport is None or not self.is_connected:
            return await super()._flush_pending(force_flush)
        pending, self._pending, self._pending_data_size = self._pending, [], 0
        if pending:
            # Nor is waited until there is room again: who sends waits for the server's word, so little is on its way.
            transport.writelines(pending)
        return None


class Link:
    """A connection, which never comes back once it is lost.

    Parameters
    ----------
    place
        A place of the server.
    timeout_s
        Longest wait for the server's word, in seconds.
    lost
        Called within the loop, once, when it is lost: with the error for who waits.
    """

    def __init__(self, place: Place, timeout_s: float, lost: Callable[[BrokerError], object]) -> None:
        self._place, self._timeout_s, self._lost = place, timeout_s, lost
        self.client = _Client()
        self._why: str | None = None
        self._is_closing = self._is_over = False
        self._tasks: set[asyncio.Task[Any]] = set()
        self._loop = OwnLoop()
        self._loop.set_exception_handler(lambda loop, context: _log.debug("%s: %s", place, context))
        self._turns = Turns(self._loop, lambda error: self.lose(said(error)), f"epypes nats {place.name}")
        logging.getLogger("nats.aio.client").addFilter(is_not_ours)

    def open(self) -> None:
        """Connect; BrokerError says why not."""
        began: list[BrokerError | None] = []
        within_s = self._timeout_s + 2 * _CLOSING_S
        self.run(lambda: self.spawn(self._begin(began.append)), lambda: began, within_s)
        error = began[0] if began else unreachable(self._place, TimeoutError(), self._timeout_s)
        if error is not None:
            self._why = str(error)
            self.close()
            raise error

    # --- for any thread ---

    def run(self, function: Callable[[], object], is_done: Callable[[], object], timeout_s: float) -> bool:
        """Have a function called by whose turn it is, wait until something is so, and return whether it is."""
        return self._turns.run(function, is_done, timeout_s)

    def wait(self, is_done: Callable[[], object], timeout_s: float) -> bool:
        """Wait until something is so that `changed` tells of, and return whether it is."""
        return self._turns.run(nothing, is_done, timeout_s)

    def call(self, function: Callable[[], object]) -> None:
        """Have a function called by whose turn it is, without waiting; not at all if it is over."""
        self.run(function, always, 0.0)

    def ask(self, question: Callable[[], Coroutine[Any, Any, Any]]) -> Any:
        """Return what a coroutine returns that runs in the loop; raise what it raises, or BrokerError."""
        answers: list[tuple[Any, BaseException | None]] = []
        # The server's word is waited for within it: this is for a thread that is not given the processor.
        within_s = 2 * self._timeout_s + _CLOSING_S
        if self._why is None:
            # Once it is lost, the library goes on to wait for answers that can't come any more.
            is_done = lambda: answers or self._why is not None  # noqa: E731
            self.run(lambda: self.spawn(self._answer(question, answers.append)), is_done, within_s)
        if not answers:
            raise self.error()
        value, error = answers[0]
        if error is not None:
            raise error
        return value

    async def _answer(
        self,
        question: Callable[[], Coroutine[Any, Any, Any]],
        then: Callable[[tuple[Any, BaseException | None]], object],
    ) -> None:
        try:
            async with asyncio.timeout(self._timeout_s):
                then((await question(), None))
        except TimeoutError:
            self.lose(f"it did not answer within {self._timeout_s:g} s")
        except (NatsError, OSError) as error:
            then((None, error if isinstance(error, BrokerError) else self.failed(error)))
        except Exception as error:  # it is the asking thread's
            then((None, error))
        self.changed()

    def error(self) -> BrokerError:
        """Return what is said to who uses it now."""
        why = self._why or "it was closed"
        return BrokerError(str(self._place), f"The connection to {self._place} is over: {why}.")

    def close(self, last: Callable[[], Coroutine[Any, Any, None]] | None = None) -> None:
        """End it, after a last coroutine, which has a moment; bounded."""
        within_s = min(self._timeout_s, _CLOSING_S) + 2 * _CLOSING_S
        self.run(lambda: self._close(last), lambda: self._is_over, within_s)
        self._turns.end(_CLOSING_S)

    # --- within the loop ---

    def _close(self, last: Callable[[], Coroutine[Any, Any, None]] | None) -> None:
        if not self._is_closing:
            self._is_closing = True
            self.spawn(self._end(last))

    async def _end(self, last: Callable[[], Coroutine[Any, Any, None]] | None) -> None:
        waiting = [task for task in self._tasks - {asyncio.current_task()} if task.get_name() != "beat"]
        with contextlib.suppress(TimeoutError, NatsError, OSError):
            if self._why is None and last is not None:
                async with asyncio.timeout(min(self._timeout_s, _CLOSING_S)):
                    # What was acknowledged or rejected before is told before.
                    await asyncio.gather(*waiting, return_exceptions=True)
                    await last()
                    await self.flush(_CLOSING_S)
        self.lose("it was closed")
        self._abort()
        others = asyncio.all_tasks() - {asyncio.current_task()}
        for task in others:
            task.cancel()
        # Bounded, and with it what else is to be done: to close the socket takes one round more.
        await asyncio.wait(others | {asyncio.ensure_future(asyncio.sleep(0))}, timeout=_CLOSING_S)
        self._is_over = True
        self.changed()

    def changed(self) -> None:
        """Have who waits look whether it is so."""
        self._loop.stop()

    def spawn(self, work: Coroutine[Any, Any, Any], name: str | None = None) -> None:
        """Have a coroutine run beside the others."""
        task = self._loop.create_task(work, name=name)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def start(self, work: Coroutine[Any, Any, Any]) -> None:
        """Have a coroutine run to where it first waits, now, and raise what it raises; the rest runs beside the others.

        To publish is to wait for nothing, mostly: a task for it takes longer than it does itself.
        """
        try:
            awaited = work.send(None)
        except StopIteration:
            return
        self.spawn(_going_on(work, awaited))

    async def hear(self, subject: str, hear: Callable[[Msg], object]) -> Subscription:
        """Have a function called with what comes to a subject; it must not wait."""
        hearing: Any = _Hearing(hear)
        return await self.client.subscribe(subject, future=hearing)

    async def flush(self, timeout_s: float) -> None:
        """Return when the server has read all that was sent so far."""
        pause_s = 0.0
        # Should the library let it wait once more, its own question whether it has would go ahead of it.
        while self.client.pending_data_size and self._why is None:
            await asyncio.sleep(pause_s)
            pause_s = 0.001
        await self.client.rtt(timeout_s)

    def lose(self, why: str) -> None:
        """Take it for lost, if it isn't already, and tell who waits."""
        if self._why is None:
            self._why = why
            self._lost(self.error())
            self.changed()

    async def _begin(self, then: Callable[[BrokerError | None], object]) -> None:
        try:
            await self._connect()
        except Exception as error:
            then(unreachable(self._place, error, self._timeout_s))
        else:
            self.spawn(self._beat(), "beat")
            then(None)
        self.changed()

    async def _connect(self) -> None:
        self._refused = refused = asyncio.get_running_loop().create_future()
        options = entry(self._place, self._timeout_s, self.client)
        connecting = asyncio.ensure_future(self.client.connect(**options, error_cb=self._failed))
        await asyncio.wait((connecting, refused), timeout=self._timeout_s, return_when=asyncio.FIRST_COMPLETED)
        error = TimeoutError() if not connecting.done() else connecting.exception()
        if refused.done():
            error = refused.result()
        refused.cancel()
        connecting.cancel()
        if error is None:
            check_encryption(self._place, self.client)
            self._watch_reading()
            return
        await asyncio.wait((connecting,), timeout=_CLOSING_S)
        raise unreachable(self._place, error, self._timeout_s)

    async def _failed(self, error: Exception) -> None:
        """Hear of an error from the library: the first before the server has let us in says why it doesn't."""
        if not self._refused.done():
            self._refused.set_result(error)
        elif "permissions violation" in str(error):
            self.lose(f"the server refuses: {said(error)}")

    def _watch_reading(self) -> None:
        # The library tells of a lost connection only once it has closed it in good order, which may never be.
        reading = getattr(self.client, "_reading_task", None)
        if reading is not None:
            reading.add_done_callback(lambda task: self._reading_ended())

    def _reading_ended(self) -> None:
        error = self.client.last_error
        told = f" ({said(error)})" if error is not None and said(error) else ""
        self.lose(f"the server has closed it, or has gone away{told}")

    def failed(self, error: BaseException) -> BrokerError:
        """Return what is said of an error of the library: that the server has gone, if it has, or that it refuses."""
        if not self.client.is_connected:
            self._reading_ended()
        return refusal(self._place, error) if self._why is None else self.error()

    async def _beat(self) -> None:
        while True:
            await asyncio.sleep(_BEAT_S)
            # Asked twice: what came in the first half of the time says nothing of the second.
            if not (await self._answers(_SILENCE_S / 2) or await self._answers(_SILENCE_S / 2)):
                self.lose(f"nothing was heard of the server for {_SILENCE_S:g} s")
                return

    async def _answers(self, within_s: float) -> bool:
        """Return whether anything is heard of the server."""
        seen = self.client.stats["in_msgs"]
        try:
            await self.client.rtt(within_s)
        except Exception:
            return bool(self.client.is_connected and self.client.stats["in_msgs"] != seen)
        return True

    def _abort(self) -> None:
        """Close the socket without waiting until all was sent: a cut link takes nothing."""
        writer = getattr(getattr(self.client, "_transport", None), "_io_writer", None)
        if writer is not None:
            writer.transport.abort()


@types.coroutine
def _going_on(work: Coroutine[Any, Any, Any], awaited: Any) -> Generator[Any, Any, None]:
    """Go on with a coroutine that has begun, and waits for something."""
    while True:
        try:
            answer = yield awaited
        except BaseException as error:
            step = partial(work.throw, error)
        else:
            step = partial(work.send, answer)
        try:
            awaited = step()
        except StopIteration:
            return
