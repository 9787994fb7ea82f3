"""Which replicas share the events of a service, and how are they?"""

from __future__ import annotations

from fastapi import APIRouter, Response

from epypes.service.http.answers import answer
from epypes.service.http.models import Group
from epypes.service.http.served import REFUSALS, OfRequest

router = APIRouter(tags=["health"])


@router.get("/v1/group", response_model=Group, responses=REFUSALS)
async def group(served: OfRequest) -> Response:
    """Say who answers events of this bundle from the same queue, and whether all compute with the same parameters.

    Any replica answers for all. A service that shares its events with nobody is the one member of its group.
    """
    return answer(await served.asks(served.service.group))
