"""How are the parameters of a running service read, changed and written back into its bundle?"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from fastapi import APIRouter, Response

from epypes.service.http.answers import answer, written
from epypes.service.http.exchanging import exchanging
from epypes.service.http.models import Change, Conflict, Invalid, Parameters, Refusal, WriteBack, WrittenBack
from epypes.service.http.served import CHANGE_REFUSALS, NEEDS_TOKEN, REFUSALS, OfRequest, Served

router = APIRouter(tags=["parameters"])

_NUMBERS: Final = {"NaN": float("nan"), "Infinity": float("inf"), "-Infinity": float("-inf")}


@router.get("/v1/parameters", response_model=Parameters, responses=REFUSALS)
async def parameters(served: OfRequest) -> Response:
    """Give the parameters, what each may be, and their revision."""
    return answer(written(await served.asks(served.service.parameters)))


@router.patch(
    "/v1/parameters",
    response_model=Parameters,
    dependencies=[NEEDS_TOKEN],
    responses={
        **CHANGE_REFUSALS,
        409: {"model": Conflict, "description": "Somebody else changed them meanwhile; nothing is changed."},
        422: {"model": Invalid, "description": "A value can't be taken; nothing is changed."},
    },
)
async def change(served: OfRequest, wanted: Change) -> Response:
    """Change parameters, all or none, between two events; outputs say with which revision they were computed."""
    service = served.service
    entries = (await served.asks(service.parameters)).entries
    values = {token: _number(value, entries.get(token, {})) for token, value in wanted.values.items()}
    return answer(written(await served.asks(service.set_parameters, values, wanted.revision)))


@router.post(
    "/v1/parameters/write-back",
    response_model=WrittenBack,
    dependencies=[NEEDS_TOKEN],
    responses={
        **CHANGE_REFUSALS,
        409: {"model": Refusal, "description": "A bundle is being exchanged."},
        422: {"model": Invalid, "description": "The bundle can't be written."},
    },
)
async def write_back(served: OfRequest, wanted: WriteBack) -> Response:
    """Write the parameters into pipeline.toml, or say what would change there; the bundle is replayed and sealed."""
    return answer(await exchanging(served, _write_back, served, wanted.dry_run))


def _write_back(served: Served, dry_run: bool) -> dict[str, str]:
    done = served.service.write_back(dry_run=dry_run)
    return {"diff": done.diff, "digest": done.digest}


def _number(value: Any, entry: Mapping[str, Any]) -> Any:
    """Return a number that JSON has no sign for, if the parameter is a number and the text means one."""
    return _NUMBERS.get(value, value) if isinstance(value, str) and isinstance(entry.get("value"), float) else value
