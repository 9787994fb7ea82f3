"""JSON responses, and how each error of EPypes is answered: with a status and a sentence in ``detail``."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Final

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from starlette.exceptions import HTTPException

from epypes.errors import (
    BundleError,
    DeployRefused,
    EpypesError,
    FailureNotKept,
    HyperparameterError,
    MessageError,
    NotComputed,
    ParametersRefused,
    RevisionConflict,
    UnknownName,
)
from epypes.service.parameters import Entries, type_of

if TYPE_CHECKING:
    from epypes.service.parameters import Parameters

_MAX_DETAIL_CHARACTERS: Final = 4_000
_RETRY_AFTER: Final = {"Retry-After": "1"}
# The first entry that matches an error decides; every other error of EPypes is answered with 503.
_STATUS: Final[Mapping[type[EpypesError], int]] = {
    UnknownName: 404,
    FailureNotKept: 404,
    NotComputed: 409,
    DeployRefused: 409,
    RevisionConflict: 409,
    ParametersRefused: 422,
    BundleError: 422,
    HyperparameterError: 422,
    MessageError: 422,
}


def json_text(value: Any) -> str:
    """Return data as JSON in ASCII; a number that JSON lacks becomes ``"NaN"``, ``"Infinity"`` or ``"-Infinity"``."""
    return json.dumps(_json_ready(value), allow_nan=False, separators=(",", ":"))


def _json_ready(value: Any) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else f"{'-' if value < 0 else ''}Infinity"
    if isinstance(value, Mapping):
        return {str(key): _json_ready(item) for key, item in value.items()}
    return [_json_ready(item) for item in value] if isinstance(value, list | tuple) else value


def json_response(data: Any, status: int = 200, headers: Mapping[str, str] | None = None) -> Response:
    """Return a response with data as JSON."""
    return Response(json_text(data), status, headers, media_type="application/json")


def refusal(status: int, detail: str, headers: Mapping[str, str] | None = None, **more: Any) -> Response:
    """Return a response that says in ``detail`` what is wrong, and the way out."""
    if len(detail) > _MAX_DETAIL_CHARACTERS:
        detail = f"{detail[:_MAX_DETAIL_CHARACTERS]}..."
    if status == 503:
        headers = {**_RETRY_AFTER, **(headers or {})}
    return json_response({"detail": detail, **more}, status, headers)


def with_types(entries: Entries) -> dict[str, Any]:
    """Return entries of parameters with the type of each value, which JSON does not show."""
    return {token: {**entry, "type": type_of(entry)} for token, entry in entries.items()}


def parameters_body(parameters: Parameters) -> dict[str, Any]:
    """Return the service's parameters as responses and events show them."""
    return {"revision": parameters.revision, "parameters": with_types(parameters.entries)}


def add_error_handlers(app: FastAPI) -> None:
    """Have an application answer every error with a sentence."""

    async def on_epypes_error(request: Request, error: Exception) -> Response:
        if isinstance(error, RevisionConflict):
            return refusal(409, str(error), **parameters_body(error.current))
        if isinstance(error, ParametersRefused):
            return refusal(422, str(error), problems=error.problems)
        if isinstance(error, DeployRefused):
            return refusal(409, str(error), reasons=list(error.reasons))
        return refusal(next((status for kind, status in _STATUS.items() if isinstance(error, kind)), 503), str(error))

    async def on_invalid_request(request: Request, error: Exception) -> Response:
        found = error.errors() if isinstance(error, RequestValidationError) else []
        if any(each["type"] == "json_invalid" for each in found):
            return refusal(400, f"The body is not JSON: {found[0]['ctx']['error']}.")
        problems = {".".join(map(str, each["loc"])): str(each["msg"]) for each in found}
        listed = "; ".join(f"{place}: {problem}" for place, problem in problems.items())
        return refusal(422, f"This request is not as /openapi.json says. {listed}.", problems=problems)

    async def on_http_error(request: Request, error: Exception) -> Response:
        status = error.status_code if isinstance(error, HTTPException) else 500
        path = f"{request.url.path:.200}"
        if status == 404:
            return refusal(404, f"There is nothing at {path}. Look at / or /openapi.json.")
        if status == 405:
            # Starlette's Allow header names only the methods of the first route with this path.
            methods = [method.upper() for method in request.app.openapi()["paths"].get(request.url.path, ())]
            headers = {"Allow": ", ".join(sorted(methods))} if methods else getattr(error, "headers", None)
            return refusal(405, f"{path} does not take {request.method:.20}. Look at /openapi.json.", headers)
        if status == 413:
            return refusal(413, "The body is too long. Send less.", {"Connection": "close"})
        return refusal(status, str(getattr(error, "detail", error)), getattr(error, "headers", None))

    async def on_bug(request: Request, error: Exception) -> Response:
        return refusal(500, f"The server failed: {type(error).__name__}. Its log has the traceback.")

    app.add_exception_handler(EpypesError, on_epypes_error)
    app.add_exception_handler(RequestValidationError, on_invalid_request)
    app.add_exception_handler(HTTPException, on_http_error)
    app.add_exception_handler(Exception, on_bug)
