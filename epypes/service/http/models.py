"""The shapes of requests and responses, from which FastAPI makes the description at /openapi.json."""

from __future__ import annotations

from typing import Annotated, Any, Final

from fastapi import Depends, Request
from pydantic import BaseModel, ConfigDict, Field, JsonValue

from epypes.service import Service
from epypes.service.event_states import StateChoice
from epypes.service.failures.record import FailedEvent

Sentence = Annotated[str, Field(description="What is wrong, and the way out.")]
Revision = Annotated[int, Field(ge=0, description="It rises with every change of the parameters.", examples=[3])]
Entry = Annotated[dict[str, Any], Field(examples=[{"value": 70, "type": "int", "low": 0, "high": 255}])]
Entries = Annotated[
    dict[str, Entry],
    Field(
        description="By token: the value, and what it may be, as in pipeline.toml. Its type is int, float, bool, text, "
        "list, none or other: a float may be given as 1 and as 1.5."
    ),
]


StateFate = Annotated[
    StateChoice | None,
    Field(
        description="Whether the state between events is kept or reset; null to keep it if both bundles delay the same "
        "tokens with the same initial values."
    ),
]


class Refusal(BaseModel):
    """A request that was refused."""

    model_config = ConfigDict(
        json_schema_extra={"example": {"detail": "No token 'edgs' in this graph. Did you mean 'edges'?"}}
    )
    detail: Sentence


class Invalid(Refusal):
    """A request that is not as described, or values that a parameter can't have."""

    problems: dict[str, str] = Field(
        default_factory=dict,
        description="Reasons, by token or by place.",
        examples=[{"canny_lo": "It is 300; at most 255."}],
    )


class Conflict(Refusal):
    """The parameters were changed concurrently."""

    revision: Revision
    parameters: Entries


class DeployRefusal(Refusal):
    """A bundle that was refused; the service goes on with the bundle before."""

    reasons: list[str] = Field(default_factory=list, description="What differs, or what else is wrong.")


class Alive(BaseModel):
    """Whether the service works; if not, it should be restarted."""

    alive: bool
    reason: str = Field(description="Why not; empty if it is.", examples=[""])


class Ready(BaseModel):
    """Whether events are answered."""

    ready: bool
    state: str = Field(
        description="LOADING, READY, PAUSED, DEGRADED, DRAINING, FAULTED or STOPPED.", examples=["READY"]
    )
    reason: str


class States(BaseModel):
    """The state between events."""

    per: str = Field(description="What has a state of its own: one for all events, or each source.", examples=["one"])
    tokens: dict[str, str] = Field(description="By key of the state, the token that is delayed.")
    count: int = Field(description="How many states there are.")
    bytes: int = Field(description="Their size.")
    forgotten: int = Field(description="How many were forgotten, since there were too many.")


class Info(BaseModel):
    """What is served, by which processes, at which addresses."""

    model_config = ConfigDict(extra="allow")
    name: str
    bundle: str = Field(description="The folder that is served.", examples=["/srv/edges"])
    digest: str = Field(description="SHA-256 of its manifest.")
    state: str
    reason: str
    inputs: list[str]
    outputs: list[str]
    func_io: dict[str, Any] = Field(description="Input and output tokens by function.")
    rgb: list[str]
    colours: dict[str, str] = Field(
        default={},
        description="By input and output that is an image, the order of its colours and what says it.",
        examples=[{"image": "rgb, as in function 'gray'"}],
    )
    threads: int
    revision: Revision
    addresses: dict[str, str] = Field(description="sub, pub, failures and http.")
    pid: int
    worker_pid: int | None
    started_ns: int
    restarts: int
    counts: dict[str, int]
    states: States | None = None
    versions: dict[str, str]


class Member(BaseModel):
    """A replica, as its last heartbeat described it."""

    replica: str = Field(description="Its name.", examples=["1"])
    host: str
    pid: int
    state: str
    reason: str
    name: str = Field(description="Of the bundle that it serves.")
    digest: str = Field(description="SHA-256 of the manifest of what it serves.")
    revision: int = Field(description="Of the parameters that it computes with.")
    counts: dict[str, int]
    http: str = Field(description="Its HTTP control; empty if it has none.")
    trouble: str = Field(description="Why it does not follow the others; empty if it does.")
    heard_s: float = Field(description="Seconds since its last heartbeat; after 3.5 it is not a member any more.")
    is_self: bool = Field(description="Whether it is the replica that answers this request.")


class Group(BaseModel):
    """The replicas that share the events of a broker."""

    is_shared: bool = Field(description="Whether the events come from a broker; otherwise there is one member.")
    replicas: int
    ready: int = Field(description="How many of them answer events.")
    agree: bool = Field(description="Whether all serve the same bundle with the same revision of its parameters.")
    counts: dict[str, int] = Field(description="The sums of theirs.")
    trouble: str = Field(description="Why this replica does not hear the others; empty if it does.")
    rejected: int = Field(description="Messages between replicas that were rejected.")
    members: list[Member]
    lost: list[Member] = Field(
        description="Replicas that went away without stopping in the last ten minutes, as last heard; state LOST."
    )


class Parameters(BaseModel):
    """The parameters of one revision."""

    revision: Revision
    parameters: Entries


class Change(BaseModel):
    """New values for some parameters; all are applied, or none."""

    model_config = ConfigDict(
        extra="forbid", strict=True, json_schema_extra={"example": {"revision": 3, "values": {"canny_lo": 60}}}
    )
    revision: Revision | None = Field(
        default=None,
        description="The revision that was read before; another revision now is a conflict. Null to change any.",
    )
    values: dict[str, JsonValue] = Field(min_length=1, max_length=1_000, description="New values by token.")


class WriteBackRequest(BaseModel):
    """Whether to write the parameters into pipeline.toml, or only to say what would change."""

    model_config = ConfigDict(extra="forbid", strict=True)
    dry_run: bool = Field(default=True, description="True to say what would change.")


class Failures(BaseModel):
    """Events that failed, the last one first."""

    failures: list[FailedEvent]


class Access(BaseModel):
    """Whether changes are allowed; without the access key the request is refused."""

    allowed: bool


class Deploy(BaseModel):
    """The bundle to serve from now on."""

    model_config = ConfigDict(extra="forbid", strict=True, json_schema_extra={"example": {"bundle": "/srv/edges-2"}})
    bundle: str = Field(min_length=1, max_length=4_096, description="An absolute path on the service's machine.")
    state: StateFate = None


class Rollback(BaseModel):
    """What becomes of the state between events."""

    model_config = ConfigDict(extra="forbid", strict=True)
    state: StateFate = None


class Reset(BaseModel):
    """Which state between events begins anew."""

    model_config = ConfigDict(extra="forbid", strict=True)
    source: str | None = Field(default=None, max_length=4_096, description="Of one source of events; null for all.")


class Drain(BaseModel):
    """How long the events that wait may take."""

    model_config = ConfigDict(extra="forbid", strict=True)
    timeout_s: float = Field(default=5.0, gt=0, le=600, description="In seconds.")


# -- what each route may answer besides its result --------------------------------------------------------------------

Responses = dict[int | str, dict[str, Any]]
BINARY: Final = {"schema": {"type": "string", "format": "binary"}}


def refused(description: str, model: type[BaseModel] = Refusal) -> dict[str, Any]:
    """Return the description of a refusal."""
    return {"model": model, "description": description}


def content(media_types: list[str], description: str) -> dict[str, Any]:
    """Return the description of a response that is bytes of one of these types."""
    return {"description": description, "content": dict.fromkeys(media_types, BINARY)}


REFUSALS: Final[Responses] = {
    400: refused("The body is not JSON, or is not whole."),
    413: {"description": "The body has more than 64 KB."},
    503: {
        **refused("The service can't answer now."),
        "headers": {"Retry-After": {"schema": {"type": "integer"}, "description": "Seconds until the next try."}},
    },
}
CHANGE_REFUSALS: Final[Responses] = REFUSALS | {
    401: refused("The access key is missing."),
    403: refused("This is not the service's access key."),
}
INVALID: Final = refused("The request is not as described here.")
# FastAPI would put a model into the media type of the events.
EVENT_REFUSALS: Final[Responses] = {
    status: {
        "description": part["description"],
        "content": {"application/json": {"schema": Refusal.model_json_schema()}},
    }
    for status, part in {**REFUSALS, 422: INVALID}.items()
}


# -- what routes take -------------------------------------------------------------------------------------------------


def _service(request: Request) -> Service:
    service: Service = request.app.state.service
    return service


ServiceOf = Annotated[Service, Depends(_service)]
