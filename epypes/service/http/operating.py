"""How is a running service given another bundle, paused and drained?"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated, Any, Final

from fastapi import APIRouter, Body, Response

from epypes.bundle.seal import check_seal
from epypes.errors import BundleError
from epypes.service.http.answers import answer
from epypes.service.http.exchanging import exchanging
from epypes.service.http.models import Access, Deploy, DeployRefusal, Drain, Info, Refusal
from epypes.service.http.served import CHANGE_REFUSALS, NEEDS_TOKEN, OfRequest, Served

router = APIRouter(prefix="/v1", tags=["operation"], dependencies=[NEEDS_TOKEN])

_EXCHANGE: Final = CHANGE_REFUSALS | {
    409: {"model": DeployRefusal, "description": "It is not served, for these reasons; the one before goes on."},
    422: {"model": Refusal, "description": "There is no bundle at this path."},
}
_INVALID: Final[dict[int | str, dict[str, Any]]] = {
    422: {"model": Refusal, "description": "The request is not as described here."}
}


@router.post("/access", response_model=Access, responses=CHANGE_REFUSALS)
async def access() -> Response:
    """Say whether the token is the service's, and change nothing."""
    return answer({"allowed": True})


@router.post("/deploy", response_model=Info, responses=_EXCHANGE)
async def deploy(served: OfRequest, wanted: Deploy) -> Response:
    """Serve another bundle, which is replayed beside the one that is served and follows it between two events."""
    return answer(await exchanging(served, _deploy, served, wanted.bundle))


@router.post("/rollback", response_model=Info, responses=_EXCHANGE)
async def rollback(served: OfRequest) -> Response:
    """Serve the bundle again that was served before this one."""
    return answer(await exchanging(served, served.service.rollback))


@router.post("/pause", response_model=Info, responses=CHANGE_REFUSALS)
async def pause(served: OfRequest) -> Response:
    """Begin no more events; those that come wait, as many as the mailbox holds."""
    await served.changes(served.service.pause)
    return answer(await served.asks(served.service.info))


@router.post("/resume", response_model=Info, responses=CHANGE_REFUSALS)
async def resume(served: OfRequest) -> Response:
    """Go on after a pause."""
    await served.changes(served.service.resume)
    return answer(await served.asks(served.service.info))


@router.post("/drain", response_model=Info, responses=CHANGE_REFUSALS | _INVALID)
async def drain(served: OfRequest, wanted: Annotated[Drain | None, Body()] = None) -> Response:
    """Take no more events, and work off those that wait."""
    await served.changes(served.service.drain, (wanted or Drain()).timeout_s)
    return answer(await served.asks(served.service.info))


def _deploy(served: Served, path: str) -> Any:
    # Unlike Path's own, these take any text.
    if not os.path.isabs(path) or not os.path.isdir(path):
        text = f"{path!r:.300} is no folder on the service's machine. Name a bundle's folder, from the root on."
        raise BundleError(path, text)
    check_seal(Path(path))
    return served.service.deploy(path)
