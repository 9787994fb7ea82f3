"""Is the service alive, is it ready, what is it, and what has it done?"""

from __future__ import annotations

from fastapi import APIRouter, Request, Response

from epypes.service.http.answers import answer
from epypes.service.http.metrics import exposed
from epypes.service.http.models import Alive, Info, Ready
from epypes.service.http.served import REFUSALS, OfRequest

router = APIRouter(tags=["health"])
_DOWN = {key: part for key, part in REFUSALS.items() if key != 503}


@router.get("/livez", response_model=Alive, responses={**_DOWN, 503: {"model": Alive, "description": "It is not."}})
async def livez(served: OfRequest) -> Response:
    """Say whether the service does its work: 503 means that it should be started anew.

    A long computation is no reason; a function that did not return in time is, and it is named.
    """
    reason = served.service.alive()
    return answer({"alive": not reason, "reason": reason}, 503 if reason else 200)


@router.get("/readyz", response_model=Ready, responses={**_DOWN, 503: {"model": Ready, "description": "It is not."}})
async def readyz(served: OfRequest) -> Response:
    """Say whether events are answered: the bundle computes what was recorded, and its sockets are bound."""
    reason = served.service.ready()
    return answer({"ready": not reason, "state": served.service.state, "reason": reason}, 503 if reason else 200)


@router.get(
    "/metrics",
    response_class=Response,
    responses={
        **REFUSALS,
        200: {
            "description": "In the format that the Accept header asks for.",
            "content": {"text/plain": {"schema": {"type": "string"}}, "application/openmetrics-text": {}},
        },
    },
)
async def metrics(request: Request, served: OfRequest) -> Response:
    """Give counts and times to Prometheus."""
    media_type, text = await served.asks(exposed, request.app.state.registry, request.headers.get("accept", ""))
    return Response(text, headers={"Content-Type": media_type})


@router.get("/v1/info", response_model=Info, responses=REFUSALS, tags=["service"])
async def info(served: OfRequest) -> Response:
    """Say what is served, by which processes, at which addresses."""
    return answer(await served.asks(served.service.info))
