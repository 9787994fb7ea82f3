"""Which paths does the server answer, and how are they described?"""

from __future__ import annotations

from typing import Final

from fastapi import FastAPI
from fastapi.routing import APIRoute

import epypes
from epypes.service.http import events, failures, group, health, operating, page, parameters, pictures
from epypes.service.http.answers import answer_errors
from epypes.service.http.metrics import registry_of
from epypes.service.http.served import Served

_ABOUT: Final = """
Watches and controls a running service of EPypes.

Whoever reaches the server may read. Changes need the service's token, as `Authorization: Bearer TOKEN`; `epypes serve`
names the file that holds it. What is refused is answered with a sentence in `detail` that says the way out.
"""
_TAGS: Final = [
    {"name": "health", "description": "For what watches many services."},
    {"name": "service", "description": "What is served, and what happens."},
    {"name": "graph", "description": "The graph, and the values of its latest run."},
    {"name": "parameters", "description": "The hyperparameters, changed between two events."},
    {"name": "failures", "description": "Events that failed, kept so that they can be computed again."},
    {"name": "operation", "description": "Another bundle, pause and drain."},
]


_ROOMS: Final = (health, group, pictures, parameters, events, failures, operating, page)


def app_of(served: Served) -> FastAPI:
    """Return the application that answers for a service."""
    app = FastAPI(
        title="EPypes service",
        description=_ABOUT,
        version=epypes.__version__,
        openapi_tags=_TAGS,
        # They would load scripts from elsewhere; the page at / and any client of OpenAPI do without.
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
    )
    app.state.served = served
    app.state.registry = registry_of(served.service)
    app.state.methods = _methods
    answer_errors(app)
    for room in _ROOMS:
        app.include_router(room.router)
    return app


def _methods(path: str) -> list[str]:
    """Return the methods that a path takes."""
    routes = [route for room in _ROOMS for route in room.router.routes if isinstance(route, APIRoute)]
    return sorted({method for route in routes if route.path_regex.match(path) for method in route.methods or ()})
