"""What is the live page made of?"""

from __future__ import annotations

from functools import cache
from importlib import resources
from typing import Final

from fastapi import APIRouter, Response

router = APIRouter(include_in_schema=False)

# What else there is in the folder is not answered.
_FILES: Final = {
    "index.html": "text/html",
    "page.css": "text/css",
    "page.js": "text/javascript",
    "server.js": "text/javascript",
    "graph.js": "text/javascript",
    "rates.js": "text/javascript",
    "replicas.js": "text/javascript",
    "parameters.js": "text/javascript",
    "failures.js": "text/javascript",
    "icon.svg": "image/svg+xml",
}
_OPEN: Final = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' data: blob:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS: Final = {"Content-Security-Policy": _OPEN, "Cache-Control": "no-cache"}


@router.get("/")
async def page() -> Response:
    """Give the live page."""
    return _file("index.html")


@cache
def _file(name: str) -> Response:
    data = resources.files(__package__).joinpath("page", name).read_bytes()
    return Response(data, headers=_HEADERS, media_type=_FILES[name])


def _add(name: str) -> None:
    async def part() -> Response:
        return _file(name)

    router.add_api_route(f"/page/{name}", part, methods=["GET"])


for _name in _FILES:
    _add(_name)
