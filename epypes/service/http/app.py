"""The FastAPI application: routes for health, service, parameters, failures, operation, and the live page at /.

Routes are plain functions where they may block: Starlette runs them on its thread pool, so that a bundle that is being
replayed for minutes keeps no other request waiting.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, Final

from fastapi import APIRouter, Body, FastAPI, Query, Request, Response
from fastapi import Path as PathParameter
from starlette.responses import FileResponse
from starlette.staticfiles import StaticFiles
from starlette.types import Lifespan

import epypes
from epypes.bundle.writeback import WriteBack
from epypes.errors import BundleError
from epypes.service import Service
from epypes.service.failures.record import FailedEvent
from epypes.service.http import graph_routes, models, server_sent_events
from epypes.service.http.metrics import exposed, registry_of
from epypes.service.http.models import CHANGE_REFUSALS, INVALID, REFUSALS, Responses, ServiceOf, refused
from epypes.service.http.responses import add_error_handlers, json_response, parameters_body
from epypes.service.http.security import NEEDS_ACCESS_KEY

_DESCRIPTION: Final = """
Watches and controls a running service of EPypes.

Reading needs no access key. Changes need that of the service, as `Authorization: Bearer ACCESS_KEY`; `epypes serve`
prints it, and names the file that holds it. A refusal says in `detail` what is wrong, and the way out.
"""
_TAGS: Final = [
    {"name": "health", "description": "For monitoring."},
    {"name": "service", "description": "What is served, and what happens."},
    {"name": "graph", "description": "The graph, and the values of its last run."},
    {"name": "parameters", "description": "The hyperparameters, changed between two events."},
    {"name": "failures", "description": "Events that failed, kept so that they can be computed again."},
    {"name": "operation", "description": "Another bundle, pause and drain."},
]
_PAGE: Final = Path(__file__).parent / "page"
_EVENT: Final = "application/vnd.epypes.v1+event"
_STATE: Final = "application/vnd.epypes.v1+state"
_NON_FINITE: Final = {"NaN": float("nan"), "Infinity": float("inf"), "-Infinity": float("-inf")}

health = APIRouter(tags=["health"])
parameters = APIRouter(tags=["parameters"])
failures = APIRouter(prefix="/v1/failures", tags=["failures"])
operation = APIRouter(prefix="/v1", tags=["operation"], dependencies=[NEEDS_ACCESS_KEY])


def create_app(service: Service, lifespan: Lifespan[FastAPI] | None = None) -> FastAPI:
    """Return the application that answers for a service; ``lifespan`` is entered on the server's event loop."""
    app = FastAPI(
        title="EPypes service",
        description=_DESCRIPTION,
        version=epypes.__version__,
        openapi_tags=_TAGS,
        # These pages would load scripts from other sites.
        docs_url=None,
        redoc_url=None,
        redirect_slashes=False,
        lifespan=lifespan,
    )
    app.state.service = service
    app.state.events = server_sent_events.EventHub(service)
    app.state.registry = registry_of(service)
    add_error_handlers(app)
    for router in (health, graph_routes.router, parameters, server_sent_events.router, failures, operation):
        app.include_router(router)

    @app.get("/", include_in_schema=False)
    def page() -> Response:
        return FileResponse(_PAGE / "index.html")

    app.mount("/page", StaticFiles(directory=_PAGE))
    return app


# -- health -----------------------------------------------------------------------------------------------------------


@health.get("/livez", response_model=models.Alive, responses={**REFUSALS, 503: refused("It does not.", models.Alive)})
async def livez(service: ServiceOf) -> Response:
    """Say whether the service works: 503 means that it should be restarted.

    A long computation is no reason; a function that did not return in time is, and it is named.
    """
    reason = service.alive()
    return json_response({"alive": not reason, "reason": reason}, 503 if reason else 200)


@health.get("/readyz", response_model=models.Ready, responses={**REFUSALS, 503: refused("They are not.", models.Ready)})
async def readyz(service: ServiceOf) -> Response:
    """Say whether events are answered: the bundle computes what was recorded, and the sockets are bound."""
    reason = service.ready()
    return json_response({"ready": not reason, "state": service.state, "reason": reason}, 503 if reason else 200)


@health.get(
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
def metrics(request: Request) -> Response:
    """Return counts and times for Prometheus."""
    media_type, text = exposed(request.app.state.registry, request.headers.get("accept", ""))
    return Response(text, headers={"Content-Type": media_type})


@health.get("/v1/info", response_model=models.Info, responses=REFUSALS, tags=["service"])
def info(service: ServiceOf) -> Response:
    """Say what is served, by which processes, at which addresses."""
    return json_response(service.info())


@health.get("/v1/group", response_model=models.Group, responses=REFUSALS)
def group(service: ServiceOf) -> Response:
    """Name the replicas that answer events from the same queue, and say whether all have the same parameters.

    Any replica answers for all. A service that shares its events with no other is the only member of its group.
    """
    return json_response(service.group())


# -- parameters -------------------------------------------------------------------------------------------------------


@parameters.get("/v1/parameters", response_model=models.Parameters, responses=REFUSALS)
def read_parameters(service: ServiceOf) -> Response:
    """Return the parameters, their ranges and their revision."""
    return json_response(parameters_body(service.parameters()))


@parameters.patch(
    "/v1/parameters",
    response_model=models.Parameters,
    dependencies=[NEEDS_ACCESS_KEY],
    responses={
        **CHANGE_REFUSALS,
        409: refused("They were changed concurrently; nothing is changed now.", models.Conflict),
        422: refused("A value is refused; nothing is changed.", models.Invalid),
    },
)
def change_parameters(service: ServiceOf, wanted: models.Change) -> Response:
    """Change parameters, all or none, between two events; outputs carry the revision they were computed with."""
    entries = service.parameters().entries
    values = {token: _number(value, entries.get(token, {})) for token, value in wanted.values.items()}
    return json_response(parameters_body(service.set_parameters(values, wanted.revision)))


@parameters.post(
    "/v1/parameters/write-back",
    response_model=WriteBack,
    dependencies=[NEEDS_ACCESS_KEY],
    responses={
        **CHANGE_REFUSALS,
        422: refused("The bundle can't be written.", models.Invalid),
    },
)
def write_back(service: ServiceOf, wanted: models.WriteBackRequest) -> Response:
    """Write the parameters into pipeline.toml, or say what would change there; the bundle is replayed and sealed."""
    return json_response(asdict(service.write_back(dry_run=wanted.dry_run)))


def _number(value: Any, entry: Mapping[str, Any]) -> Any:
    """Return the number that a text stands for which JSON has no sign for, where the parameter is a number."""
    return _NON_FINITE.get(value, value) if isinstance(value, str) and isinstance(entry.get("value"), float) else value


# -- failures ---------------------------------------------------------------------------------------------------------

_FailureId = Annotated[
    str, PathParameter(description="Its id.", pattern="^[A-Za-z0-9_-]{1,64}$", examples=["01hx3v5k7m2q8z"])
]
_FAILURE_REFUSALS: Final[Responses] = {
    **REFUSALS,
    404: refused("No such failure is kept."),
    422: refused("This is no id."),
}


@failures.get("", response_model=models.Failures, responses={**REFUSALS, 422: INVALID})
def list_failures(
    service: ServiceOf, limit: Annotated[int, Query(ge=1, le=1_000, description="How many at most.")] = 100
) -> Response:
    """List the events that failed, the newest first."""
    return json_response({"failures": [asdict(record) for record in service.failure_records(limit)]})


@failures.get("/{id}", response_model=FailedEvent, responses=_FAILURE_REFUSALS)
def failure(service: ServiceOf, id: _FailureId) -> Response:  # noqa: A002 - as in the path
    """Say what failed, where, and with which parameters."""
    return json_response(asdict(service.failure_store.record(id)))


@failures.get(
    "/{id}/event",
    response_class=Response,
    responses={**_FAILURE_REFUSALS, 200: {"description": "The event, packed.", "content": {_EVENT: models.BINARY}}},
)
def failed_event(service: ServiceOf, id: _FailureId) -> Response:  # noqa: A002 - as in the path
    """Return the event itself, so that it can be computed again elsewhere."""
    return Response(service.failure_store.packed_event(id), media_type=_EVENT)


@failures.get(
    "/{id}/state",
    response_class=Response,
    responses={**_FAILURE_REFUSALS, 200: {"description": "The state, packed.", "content": {_STATE: models.BINARY}}},
)
def failed_state(service: ServiceOf, id: _FailureId) -> Response:  # noqa: A002 - as in the path
    """Return the state between events that the event began with; nothing for the initial one, and without state."""
    return Response(service.failure_store.state(id), media_type=_STATE)


# -- operation --------------------------------------------------------------------------------------------------------

_DEPLOY_REFUSALS: Final[Responses] = CHANGE_REFUSALS | {
    409: refused("It is not served, for these reasons; the bundle before goes on.", models.DeployRefusal),
    422: refused("There is no bundle at this path.", models.Refusal),
}


@operation.post("/access", response_model=models.Access, responses=CHANGE_REFUSALS)
async def access() -> Response:
    """Say whether the access key is the service's, and change nothing."""
    return json_response({"allowed": True})


@operation.post("/deploy", response_model=models.Info, responses=_DEPLOY_REFUSALS)
def deploy(service: ServiceOf, wanted: models.Deploy) -> Response:
    """Replay another bundle beside the one that is served, and serve it from the next event on."""
    # Unlike the methods of Path, these take any text.
    if not os.path.isabs(wanted.bundle) or not os.path.isdir(wanted.bundle):
        text = f"{wanted.bundle!r:.300} is no folder on the service's machine. Name a bundle's absolute path."
        raise BundleError(wanted.bundle, text)
    return json_response(service.deploy(wanted.bundle, wanted.state))


@operation.post("/rollback", response_model=models.Info, responses=_DEPLOY_REFUSALS)
def rollback(service: ServiceOf, wanted: Annotated[models.Rollback | None, Body()] = None) -> Response:
    """Serve the bundle again that was served before this one."""
    return json_response(service.rollback((wanted or models.Rollback()).state))


@operation.post(
    "/reset",
    response_model=models.Info,
    responses={**CHANGE_REFUSALS, 404: refused("There is no state of this source."), 422: INVALID},
)
def reset(service: ServiceOf, wanted: Annotated[models.Reset | None, Body()] = None) -> Response:
    """Have the next event begin with the initial state between events, as if it were the first."""
    service.reset((wanted or models.Reset()).source)
    return json_response(service.info())


@operation.post("/pause", response_model=models.Info, responses=CHANGE_REFUSALS)
def pause(service: ServiceOf) -> Response:
    """Begin no more events; those that come wait, as many as the mailbox holds."""
    service.pause()
    return json_response(service.info())


@operation.post("/resume", response_model=models.Info, responses=CHANGE_REFUSALS)
def resume(service: ServiceOf) -> Response:
    """Go on after a pause."""
    service.resume()
    return json_response(service.info())


@operation.post("/drain", response_model=models.Info, responses={**CHANGE_REFUSALS, 422: INVALID})
def drain(service: ServiceOf, wanted: Annotated[models.Drain | None, Body()] = None) -> Response:
    """Take no more events, and work off those that wait."""
    service.drain((wanted or models.Drain()).timeout_s)
    return json_response(service.info())
