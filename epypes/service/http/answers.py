"""How does an answer become JSON, and what is said when something is refused?"""

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
    ServiceError,
    UnknownName,
)
from epypes.service.parameters import Entries, type_of

if TYPE_CHECKING:
    from epypes.service.parameters import Parameters

_MOST_CHARACTERS: Final = 4_000
RETRY_AFTER_S: Final = 1


def answer(data: Any, status: int = 200, headers: Mapping[str, str] | None = None) -> Response:
    """Return data as JSON, in ASCII, so that no text in it can fail to be encoded."""
    text = json.dumps(json_ready(data), allow_nan=False, separators=(",", ":"))
    return Response(text, status, headers, media_type="application/json")


def json_ready(value: Any) -> Any:
    """Return data with what JSON lacks as text: ``"NaN"``, ``"Infinity"``, ``"-Infinity"``."""
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else f"{'-' if value < 0 else ''}Infinity"
    if isinstance(value, Mapping):
        return {str(key): json_ready(item) for key, item in value.items()}
    return [json_ready(item) for item in value] if isinstance(value, list | tuple) else value


def refusal(status: int, detail: str, headers: Mapping[str, str] | None = None, **more: Any) -> Response:
    """Return what is wrong, and the way out, as a sentence in ``detail``."""
    cut = detail if len(detail) <= _MOST_CHARACTERS else f"{detail[:_MOST_CHARACTERS]}..."
    return answer({"detail": cut, **more}, status, headers)


def unavailable(detail: str) -> Response:
    """Return that the service can't answer just now."""
    return refusal(503, detail, {"Retry-After": str(RETRY_AFTER_S)})


def written(parameters: Parameters) -> dict[str, Any]:
    """Return the service's Parameters as they are answered."""
    return {"revision": parameters.revision, "parameters": typed(parameters.entries)}


def typed(entries: Entries) -> dict[str, Any]:
    """Return entries that say which type their values have, which JSON doesn't."""
    return {token: {**entry, "type": type_of(entry)} for token, entry in entries.items()}


# The first that fits is taken.
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
    ServiceError: 503,
}


def refused(error: EpypesError) -> Response:
    """Return what an error of the service's says, with what it carries."""
    if isinstance(error, RevisionConflict):
        return refusal(409, str(error), **written(error.current))
    if isinstance(error, ParametersRefused):
        return refusal(422, str(error), problems=error.problems)
    if isinstance(error, DeployRefused):
        return refusal(409, str(error), reasons=list(error.reasons))
    status = next((status for kind, status in _STATUS.items() if isinstance(error, kind)), 503)
    return unavailable(str(error)) if status == 503 else refusal(status, str(error))


def _invalid(error: RequestValidationError) -> Response:
    problems = {".".join(map(str, each["loc"])): str(each["msg"]) for each in error.errors()}
    listed = "; ".join(f"{place}: {problem}" for place, problem in problems.items())
    return refusal(422, f"This request is not as /openapi.json says. {listed}.", problems=problems)


def _no_such(request: Request, error: HTTPException) -> Response:
    method, path = request.method, f"{request.url.path:.200}"
    if error.status_code == 404:
        text = f"There is nothing at {path}. Look at / or /openapi.json."
    elif error.status_code == 405:
        # Starlette names those of the first route of a path alone.
        allowed = ", ".join(request.app.state.methods(request.url.path))
        text = f"{path} does not take {method:.20}. Take one of: {allowed}."
        return refusal(405, text, {"Allow": allowed})
    else:
        text = str(error.detail)
    return refusal(error.status_code, text, error.headers)


def answer_errors(app: FastAPI) -> None:
    """Let an application answer whatever is raised with a sentence."""

    async def on_refusal(request: Request, error: Exception) -> Response:
        return refused(error) if isinstance(error, EpypesError) else unavailable(str(error))

    async def on_invalid(request: Request, error: Exception) -> Response:
        return _invalid(error) if isinstance(error, RequestValidationError) else unavailable(str(error))

    async def on_no_such(request: Request, error: Exception) -> Response:
        return _no_such(request, error) if isinstance(error, HTTPException) else unavailable(str(error))

    async def on_bug(request: Request, error: Exception) -> Response:
        return refusal(500, f"The server failed: {type(error).__name__}. Its log has the traceback.")

    app.add_exception_handler(EpypesError, on_refusal)
    app.add_exception_handler(RequestValidationError, on_invalid)
    app.add_exception_handler(HTTPException, on_no_such)
    app.add_exception_handler(Exception, on_bug)
