"""How do the graph, and the values of its latest run, leave the service?"""

from __future__ import annotations

from typing import Annotated, Any, Final

from fastapi import APIRouter, Path, Query, Response

from epypes.errors import NotComputed
from epypes.service.http.models import Refusal
from epypes.service.http.served import BINARY, REFUSALS, OfRequest

router = APIRouter(tags=["graph"])

FRAMES: Final = "application/vnd.epypes.v1+frames"
_PICTURES: Final = frozenset({"image/png", "image/jpeg", "image/webp", "image/gif", "image/svg+xml"})
_MOST_TOKENS: Final = 1_000
_Token = Annotated[str, Path(description="A token of the graph.", max_length=500, examples=["edges"])]
_NO_TOKEN: Final[dict[int | str, dict[str, Any]]] = {
    404: {"model": Refusal, "description": "The graph has no such token."},
    409: {"model": Refusal, "description": "It has no value yet."},
    422: {"model": Refusal, "description": "The request is not as described here."},
}


def _of(media_types: list[str], description: str) -> dict[str, Any]:
    return {"description": description, "content": dict.fromkeys(media_types, BINARY)}


@router.get(
    "/v1/graph.svg",
    response_class=Response,
    responses={**REFUSALS, 200: _of(["image/svg+xml"], "The picture.")},
)
async def graph_svg(served: OfRequest) -> Response:
    """Draw the graph, with times and small pictures of the latest run."""
    return Response(await served.asks(served.service.graph_svg), media_type="image/svg+xml")


@router.get(
    "/v1/view",
    response_class=Response,
    responses={**REFUSALS, 200: {"description": "A GraphView.", "content": {"application/json": {}}}},
)
async def view(served: OfRequest) -> Response:
    """Give what the picture of the graph is drawn from."""
    return Response(await served.asks(served.service.view), media_type="application/json")


@router.get(
    "/v1/tokens/{name:path}/preview",
    response_class=Response,
    responses={
        **REFUSALS,
        **_NO_TOKEN,
        200: _of([*sorted(_PICTURES), "text/plain"], "A picture, or text for a value that has none."),
    },
)
async def preview(
    served: OfRequest,
    name: _Token,
    max_side_px: Annotated[int, Query(ge=16, le=4_096, description="How long its sides may be, in pixels.")] = 512,
) -> Response:
    """Show the value that a token had in the latest run."""
    media_type, data = await served.asks(served.service.preview, name, max_side_px)
    kind = media_type.partition(";")[0].strip()
    return Response(data, media_type=kind if kind in _PICTURES else "text/plain")


@router.get(
    "/v1/run",
    response_class=Response,
    responses={**REFUSALS, **_NO_TOKEN, 200: _of([FRAMES], "The frames of one Envelope, packed.")},
)
async def run(
    served: OfRequest,
    tokens: Annotated[list[str], Query(max_length=_MOST_TOKENS, description="Which tokens.")],
    revision: Annotated[
        int | None,
        Query(ge=0, description="Of a run with these parameters; the last event is computed again if need be."),
    ] = None,
) -> Response:
    """Give the values that tokens had in the latest run."""
    now = (await served.asks(served.service.parameters)).revision
    if revision is not None and revision > now:
        raise NotComputed("", f"There is no revision {revision} yet: the parameters have revision {now}.")
    return Response(await served.asks(served.service.run, tokens, revision=revision), media_type=FRAMES)
