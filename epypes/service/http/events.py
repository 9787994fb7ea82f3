"""How is a running service listened to?"""

from __future__ import annotations

import math
from collections.abc import AsyncIterable, AsyncIterator
from time import monotonic
from typing import Annotated, Any, Final

from fastapi import APIRouter, Depends, Query
from fastapi.sse import EventSourceResponse, ServerSentEvent

from epypes.service.http.models import Refusal
from epypes.service.http.served import REFUSALS, OfRequest
from epypes.service.http.told import Listener

router = APIRouter(tags=["service"])

_LONGEST_S: Final = 86_400
_SENTENCE: Final = {"application/json": {"schema": Refusal.model_json_schema()}}
# FastAPI would have a model of these in the media type of the events.
_REFUSALS: Final[dict[int | str, dict[str, Any]]] = {
    status: {"description": part["description"], "content": _SENTENCE}
    for status, part in {**REFUSALS, 422: {"description": "The request is not as described here."}}.items()
}


async def _listener(served: OfRequest) -> AsyncIterator[Listener]:
    """Listen for as long as the answer lasts, however it ends."""
    listener = served.told.listen()
    try:
        yield listener
    finally:
        served.told.forget(listener)


@router.get(
    "/v1/events",
    response_class=EventSourceResponse,
    responses=_REFUSALS,
)
async def events(
    listener: Annotated[Listener, Depends(_listener)],
    for_s: Annotated[float | None, Query(ge=0, le=_LONGEST_S, description="For how many seconds.")] = None,
) -> AsyncIterable[ServerSentEvent]:
    """Tell what happens, as server-sent events: `state`, `run`, `failure`, `parameters`, and `counts` each second.

    So is `group` where events are shared with other replicas.

    Each has JSON as data. There are at most ten `run` events per second; `skipped` says how many runs were between.
    """
    async for message in listener.messages(math.inf if for_s is None else monotonic() + for_s):
        yield message
