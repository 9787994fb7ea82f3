"""Routes that show the graph and the values of its last run: pictures, text, and packed values."""

from __future__ import annotations

from typing import Annotated, Final

from fastapi import APIRouter, Path, Query, Response

from epypes.errors import NotComputed
from epypes.service.http.models import INVALID, REFUSALS, Responses, ServiceOf, content, refused

router = APIRouter(tags=["graph"])

FRAMES: Final = "application/vnd.epypes.v1+frames"
_PICTURES: Final = frozenset({"image/png", "image/jpeg", "image/svg+xml"})
_MAX_TOKENS: Final = 1_000
_Token = Annotated[str, Path(description="A token of the graph.", max_length=500, examples=["edges"])]
_TOKEN_REFUSALS: Final[Responses] = {
    **REFUSALS,
    404: refused("The graph has no such token."),
    409: refused("It has no value yet."),
    422: INVALID,
}


@router.get(
    "/v1/graph.svg", response_class=Response, responses={**REFUSALS, 200: content(["image/svg+xml"], "The picture.")}
)
def graph_svg(service: ServiceOf) -> Response:
    """Draw the graph, with times and thumbnails of the last run."""
    return Response(service.graph_svg(), media_type="image/svg+xml")


@router.get(
    "/v1/view",
    response_class=Response,
    responses={**REFUSALS, 200: {"description": "A GraphView.", "content": {"application/json": {}}}},
)
def view(service: ServiceOf) -> Response:
    """Return what the picture of the graph is drawn from."""
    return Response(service.view(), media_type="application/json")


@router.get(
    "/v1/tokens/{name:path}/preview",
    response_class=Response,
    responses={
        **_TOKEN_REFUSALS,
        200: content([*sorted(_PICTURES), "text/plain"], "A picture, or text for a value that has none."),
    },
)
def preview(
    service: ServiceOf,
    name: _Token,
    max_side_px: Annotated[int, Query(ge=16, le=4_096, description="The longest side, in pixels.")] = 512,
) -> Response:
    """Show the value that a token had in the last run."""
    media_type, data = service.preview(name, max_side_px)
    media_type = media_type.partition(";")[0].strip()
    return Response(data, media_type=media_type if media_type in _PICTURES else "text/plain")


@router.get(
    "/v1/run",
    response_class=Response,
    responses={**_TOKEN_REFUSALS, 200: content([FRAMES], "The frames of one Envelope, packed.")},
)
def run(
    service: ServiceOf,
    tokens: Annotated[list[str], Query(max_length=_MAX_TOKENS, description="The tokens.")],
    revision: Annotated[
        int | None,
        Query(ge=0, description="Of the parameters; where no event had them yet, the last event is computed again."),
    ] = None,
) -> Response:
    """Return the values that tokens had in the last run."""
    now = service.parameters().revision
    if revision is not None and revision > now:
        raise NotComputed("", f"There is no revision {revision} yet: the parameters have revision {now}.")
    return Response(service.run(tokens, revision=revision), media_type=FRAMES)
