"""Server-sent events: what a service reports, for any number of HTTP clients.

`EventHub` listens to the service once. Each client has a `Subscription`, a short queue in which a later event of a kind
replaces an earlier one where only the last matters. A client that does not read costs its queue, and nothing else.
"""

from __future__ import annotations

import asyncio
import math
import threading
from collections import deque
from collections.abc import AsyncIterable, AsyncIterator, Callable
from contextlib import suppress
from time import monotonic
from typing import TYPE_CHECKING, Annotated, Any, Final

from fastapi import APIRouter, Depends, Query, Request
from fastapi.sse import EventSourceResponse, ServerSentEvent

from epypes.errors import EpypesError, ServiceError
from epypes.service.http.models import EVENT_REFUSALS
from epypes.service.http.responses import json_text, parameters_body, with_types
from epypes.service.http.server import MAX_CONNECTIONS

if TYPE_CHECKING:
    from epypes.service import Service

router = APIRouter(tags=["service"])

# Half of the connections of the server, so that others are always answered.
_MAX_SUBSCRIPTIONS: Final = MAX_CONNECTIONS // 2
_MAX_WAITING: Final = 100
_RUN_INTERVAL_S: Final = 0.1
_COUNTS_INTERVAL_S: Final = 1.0
_MAX_DURATION_S: Final = 86_400
# Of these kinds the last event replaces earlier ones.
_LATEST_ONLY: Final = frozenset({"run", "counts", "parameters", "group"})


class Subscription:
    """The events that wait for one client."""

    def __init__(self) -> None:
        self._waiting: deque[ServerSentEvent] = deque(maxlen=_MAX_WAITING)
        self._changed = asyncio.Event()
        self._is_closed = False

    def put(self, event: ServerSentEvent) -> None:
        """Add an event; of too many the oldest is dropped."""
        if event.event in _LATEST_ONLY:
            for earlier in [each for each in self._waiting if each.event == event.event]:
                self._waiting.remove(earlier)
        self._waiting.append(event)
        self._changed.set()

    def close(self) -> None:
        """End the stream after what waits."""
        self._is_closed = True
        self._changed.set()

    async def events(self, deadline_s: float) -> AsyncIterator[ServerSentEvent]:
        """Yield events as they come, until a time of the monotonic clock."""
        while True:
            while self._waiting:
                yield self._waiting.popleft()
            left_s = deadline_s - monotonic()
            if self._is_closed or left_s <= 0:
                return
            self._changed.clear()
            with suppress(TimeoutError):
                async with asyncio.timeout(None if math.isinf(left_s) else left_s):
                    await self._changed.wait()


class EventHub:
    """Passes on what a service reports to all subscriptions; used on the server's event loop.

    Only ``_on_event`` is called on other threads: those of the service.
    """

    def __init__(self, service: Service) -> None:
        self._service = service
        self._subscriptions: set[Subscription] = set()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._stop_listening: Callable[[], object] = lambda: None
        self._counts_task: asyncio.Task[None] | None = None
        self._is_stopped = False
        self._next_run_s = 0.0
        # The last run that was not passed on yet, and how many came before it. With the lock.
        self._lock = threading.Lock()
        self._last_run: dict[str, Any] | None = None
        self._skipped = 0

    def __len__(self) -> int:
        return len(self._subscriptions)

    def subscribe(self) -> Subscription:
        """Return a new subscription, in which the present state is waiting.

        Raises
        ------
        ServiceError
            There are too many, or the service stops.
        """
        if self._is_stopped:
            raise ServiceError("", "The service stops.")
        if len(self._subscriptions) >= _MAX_SUBSCRIPTIONS:
            raise ServiceError("", f"There are {len(self._subscriptions)} listeners already. Close one, or ask later.")
        if self._loop is None:
            self._loop = asyncio.get_running_loop()
            self._stop_listening = self._service.listen(self._on_event)
        if self._counts_task is None:
            self._counts_task = self._loop.create_task(self._publish_counts())
        subscription = Subscription()
        self._subscriptions.add(subscription)
        service = self._service
        subscription.put(_event("state", {"state": service.state, "reason": service.reason}))
        subscription.put(_event("parameters", parameters_body(service.parameters())))
        for kind, data in self._counts():
            subscription.put(_event(kind, data))
        return subscription

    def unsubscribe(self, subscription: Subscription) -> None:
        """Forget a subscription."""
        self._subscriptions.discard(subscription)

    def stop(self) -> None:
        """End all subscriptions."""
        self._is_stopped = True
        self._stop_listening()
        if self._counts_task is not None:
            self._counts_task.cancel()
        for subscription in list(self._subscriptions):
            subscription.close()

    def _counts(self) -> list[tuple[str, Any]]:
        group = self._service.group()
        return [("counts", self._service.counts()), *([("group", group)] if group["is_shared"] else [])]

    async def _publish_counts(self) -> None:
        """Publish the counts each second, and the group where there is one, while there is a subscription."""
        try:
            while self._subscriptions:
                await asyncio.sleep(_COUNTS_INTERVAL_S)
                with suppress(EpypesError):
                    for kind, data in self._counts():
                        self._publish(kind, data)
        finally:
            self._counts_task = None

    def _on_event(self, kind: str, data: Any) -> None:
        """Take an event from a thread of the service, and return at once."""
        if not self._subscriptions or self._loop is None:
            return
        if kind == "parameters":
            data = {**data, "parameters": with_types(data["parameters"])}
        with suppress(RuntimeError):  # the event loop has ended
            if kind != "run":
                self._loop.call_soon_threadsafe(self._publish, kind, data)
                return
            with self._lock:
                is_first = self._last_run is None
                self._skipped += not is_first
                self._last_run = data
            if is_first:
                self._loop.call_soon_threadsafe(self._publish_run)

    def _publish_run(self) -> None:
        """Publish the last run, now or when the interval since the one before has passed."""
        wait_s = self._next_run_s - monotonic()
        if wait_s > 0:
            asyncio.get_running_loop().call_later(wait_s, self._publish_run)
            return
        self._next_run_s = monotonic() + _RUN_INTERVAL_S
        with self._lock:
            run, skipped = self._last_run or {}, self._skipped
            self._last_run, self._skipped = None, 0
        self._publish("run", {**run, "skipped": skipped})

    def _publish(self, kind: str, data: Any) -> None:
        event = _event(kind, data)
        for subscription in self._subscriptions:
            subscription.put(event)


def _event(kind: str, data: Any) -> ServerSentEvent:
    return ServerSentEvent(raw_data=json_text(data), event=kind)


async def _subscription(request: Request) -> AsyncIterator[Subscription]:
    hub: EventHub = request.app.state.events
    subscription = hub.subscribe()
    try:
        yield subscription
    finally:
        hub.unsubscribe(subscription)


@router.get("/v1/events", response_class=EventSourceResponse, responses=EVENT_REFUSALS)
async def events(
    subscription: Annotated[Subscription, Depends(_subscription)],
    for_s: Annotated[float | None, Query(ge=0, le=_MAX_DURATION_S, description="For how many seconds.")] = None,
) -> AsyncIterable[ServerSentEvent]:
    """Report what happens, as server-sent events: `state`, `run`, `failure`, `parameters`, and `counts` each second.

    Where replicas share the events of a broker, also `group` each second.

    Each has JSON as data. There are at most ten `run` events per second; `skipped` says how many runs were between.
    """
    async for event in subscription.events(math.inf if for_s is None else monotonic() + for_s):
        yield event
