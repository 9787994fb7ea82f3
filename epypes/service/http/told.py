"""What are listeners told of a running service (server-sent events), and what does one cost who doesn't listen?

Each listener has a short queue, in which a later event of a kind that only the last one matters of replaces the one
before. Nothing is written for a listener who doesn't take what was written.
"""

from __future__ import annotations

import asyncio
import json
import math
import threading
from collections import deque
from collections.abc import AsyncIterator, Callable
from contextlib import suppress
from time import monotonic
from typing import TYPE_CHECKING, Any, Final

from fastapi.sse import ServerSentEvent

from epypes.errors import EpypesError, ServiceError
from epypes.service.http.answers import json_ready, typed, written

if TYPE_CHECKING:
    from epypes.service.service import Service

MOST_LISTENERS: Final = 64
_MOST_WAITING: Final = 100
RUN_EVERY_S: Final = 0.1
_COUNTS_EVERY_S: Final = 1.0
# Of these the last one says all.
_LATEST: Final = frozenset({"run", "counts", "parameters", "group"})


class Listener:
    """What one client is still to be told."""

    def __init__(self) -> None:
        self._waiting: deque[ServerSentEvent] = deque(maxlen=_MOST_WAITING)
        self._there = asyncio.Event()
        self._ended = False

    def put(self, message: ServerSentEvent) -> None:
        """Have something to be told; the oldest is forgotten if it is too much."""
        if message.event in _LATEST:
            for before in [each for each in self._waiting if each.event == message.event]:
                self._waiting.remove(before)
        self._waiting.append(message)
        self._there.set()

    def end(self) -> None:
        """Tell what waits, then nothing more."""
        self._ended = True
        self._there.set()

    async def messages(self, until: float) -> AsyncIterator[ServerSentEvent]:
        """Give what is to be told, as it comes, up to a time of the monotonic clock."""
        while True:
            while self._waiting:
                yield self._waiting.popleft()
            left_s = until - monotonic()
            if self._ended or left_s <= 0:
                return
            self._there.clear()
            with suppress(TimeoutError):
                async with asyncio.timeout(None if math.isinf(left_s) else left_s):
                    await self._there.wait()


class Told:
    """What a service tells, and those who listen to it; used on the server's thread but for what the service calls."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._listeners: set[Listener] = set()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._forget: Callable[[], object] = lambda: None
        self._counting: asyncio.Task[None] | None = None
        self._stopped = False
        self._next_run = 0.0
        # The service's threads write these two.
        self._turn = threading.Lock()
        self._skipped = 0
        self._held: dict[str, Any] | None = None

    def listen(self) -> Listener:
        """Return a new listener, who is told first how things are.

        Raises
        ------
        ServiceError
            There are too many.
        """
        if self._stopped or len(self._listeners) >= MOST_LISTENERS:
            raise ServiceError("", f"There are {len(self._listeners)} listeners already. Close one, or ask later.")
        self._begin()
        listener = Listener()
        self._listeners.add(listener)
        for kind, data in self._now():
            listener.put(_message(kind, data))
        return listener

    def forget(self, listener: Listener) -> None:
        """Tell a listener no more."""
        self._listeners.discard(listener)

    def __len__(self) -> int:
        return len(self._listeners)

    def stop(self) -> None:
        """End what all listeners are told."""
        self._stopped = True
        self._forget()
        if self._counting is not None:
            self._counting.cancel()
        for listener in list(self._listeners):
            listener.end()

    def _begin(self) -> None:
        if self._loop is None:
            self._loop = asyncio.get_running_loop()
            self._forget = self._service.listen(self._hear)
        if self._counting is None:
            self._counting = self._loop.create_task(self._count())

    def _now(self) -> list[tuple[str, Any]]:
        service = self._service
        return [
            ("state", {"state": service.state, "reason": service.reason}),
            ("parameters", written(service.parameters())),
            *self._each_second(),
        ]

    def _each_second(self) -> list[tuple[str, Any]]:
        group = self._service.group()
        return [("counts", self._service.counts()), *([("group", group)] if group["is_shared"] else [])]

    async def _count(self) -> None:
        """Tell the counts each second, and how the group is where there is one, as long as anybody listens."""
        try:
            while self._listeners:
                await asyncio.sleep(_COUNTS_EVERY_S)
                with suppress(EpypesError):
                    for kind, data in self._each_second():
                        self._spread(kind, data)
        finally:
            self._counting = None

    def _hear(self, kind: str, data: Any) -> None:
        """Take what the service tells, on its thread, and return at once."""
        if not self._listeners:
            return
        if kind == "parameters" and "parameters" in data:
            data = {**data, "parameters": typed(data["parameters"])}
        if kind != "run":
            self._soon(self._spread, kind, data)
        elif self._hold(data):
            self._soon(self._run_soon)

    def _hold(self, run: dict[str, Any]) -> bool:
        """Keep a run until it is told; return whether that has to be asked for."""
        with self._turn:
            is_first = self._held is None
            self._skipped += not is_first
            self._held = run
            return is_first

    def _soon(self, function: Callable[..., None], *arguments: Any) -> None:
        if self._loop is not None:
            with suppress(RuntimeError):  # the server's loop has ended
                self._loop.call_soon_threadsafe(function, *arguments)

    def _run_soon(self) -> None:
        """Tell of the latest run, now or when the time for the next one has come."""
        wait_s = self._next_run - monotonic()
        if wait_s > 0 and self._loop is not None:
            self._loop.call_later(wait_s, self._run_soon)
            return
        self._next_run = monotonic() + RUN_EVERY_S
        with self._turn:
            skipped, self._skipped = self._skipped, 0
            held, self._held = self._held, None
        self._spread("run", {**(held or {}), "skipped": skipped})

    def _spread(self, kind: str, data: Any) -> None:
        message = _message(kind, data)
        for listener in self._listeners:
            listener.put(message)


def _message(kind: str, data: Any) -> ServerSentEvent:
    text = json.dumps(json_ready(data), allow_nan=False, separators=(",", ":"))
    return ServerSentEvent(raw_data=text, event=kind)
