"""Which events failed, and how does one of them get into a notebook?"""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Any, Final

from fastapi import APIRouter, Path, Query, Response

from epypes.service.http.answers import answer
from epypes.service.http.models import Failure, Failures, Refusal
from epypes.service.http.served import BINARY, REFUSALS, OfRequest

router = APIRouter(prefix="/v1/failures", tags=["failures"])

EVENT: Final = "application/vnd.epypes.v1+event"
_Id = Annotated[str, Path(description="Its id.", pattern="^[A-Za-z0-9_-]{1,64}$", examples=["01hx3v5k7m2q8z"])]
_NONE: Final[dict[int | str, dict[str, Any]]] = {
    404: {"model": Refusal, "description": "No such failure is kept."},
    422: {"model": Refusal, "description": "This is no id."},
}


@router.get("", response_model=Failures, responses={**REFUSALS, 422: _NONE[422]})
async def failures(
    served: OfRequest, limit: Annotated[int, Query(ge=1, le=1_000, description="How many at most.")] = 100
) -> Response:
    """List the events that failed, the last one first."""
    records = await served.asks(served.service.failure_records, limit)
    return answer({"failures": [asdict(record) for record in records]})


@router.get("/{id}", response_model=Failure, responses=REFUSALS | _NONE)
async def failure(served: OfRequest, id: _Id) -> Response:  # noqa: A002 - as in the path
    """Say what failed, where, and with which parameters."""
    return answer(asdict(await served.asks(served.service.failure_store.record, id)))


@router.get(
    "/{id}/event",
    response_class=Response,
    responses={
        **REFUSALS,
        **_NONE,
        200: {
            "description": "The event, packed.",
            "content": {EVENT: BINARY},
        },
    },
)
async def event(served: OfRequest, id: _Id) -> Response:  # noqa: A002 - as in the path
    """Give the event itself, so that it can be computed again elsewhere."""
    return Response(await served.asks(served.service.failure_store.packed_event, id), media_type=EVENT)
