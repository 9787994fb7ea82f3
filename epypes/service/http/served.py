"""What do the server's answers come from?"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated, Any, Final

from fastapi import Depends, Request, Security
from fastapi.security import HTTPBearer

from epypes.service.http.calls import Calls
from epypes.service.http.models import Refusal
from epypes.service.http.told import Told

if TYPE_CHECKING:
    from epypes.service.service import Service

_MOST_CALLS: Final = 8
_PATIENCE_S: Final = 2.0


def _calls(most: int = _MOST_CALLS) -> Calls:
    return Calls(most, _PATIENCE_S, "The server has too many requests under way. Ask again later.")


@dataclass(frozen=True, slots=True)
class Served:
    """A service, and how it is asked.

    Attributes
    ----------
    service
        What is served.
    told
        What its listeners are told.
    asks
        Calls that end within seconds.
    changes
        Calls that may take long: a bundle that is replayed, events that are worked off.
    exchanges
        The one call that loads another bundle, or writes the parameters into this one.
    """

    service: Service
    told: Told
    asks: Calls = field(default_factory=_calls)
    changes: Calls = field(default_factory=_calls)
    exchanges: Calls = field(default_factory=lambda: _calls(1))

    def stop(self) -> None:
        """Let all that wait for an answer have one."""
        self.told.stop()
        self.asks.stop()
        self.changes.stop()
        self.exchanges.stop()


def _served(request: Request) -> Served:
    served: Served = request.app.state.served
    return served


OfRequest = Annotated[Served, Depends(_served)]
# The guard asks for the token, before a request is read; this is its description.
NEEDS_TOKEN: Final = Security(
    HTTPBearer(auto_error=False, description="The token that `epypes serve` names a file of.")
)

BINARY: Final = {"schema": {"type": "string", "format": "binary"}}

# What any request may be answered.
REFUSALS: Final[dict[int | str, dict[str, Any]]] = {
    400: {"model": Refusal, "description": "The body is not JSON, or is not whole."},
    408: {"model": Refusal, "description": "The body took too long."},
    413: {"model": Refusal, "description": "The body has more than 64 KB."},
    414: {"model": Refusal, "description": "The address is too long."},
    415: {"model": Refusal, "description": "The body is not said to be JSON."},
    421: {"model": Refusal, "description": "The Host header names another server."},
    431: {"model": Refusal, "description": "The headers are too long."},
    503: {
        "model": Refusal,
        "description": "The service can't answer just now.",
        "headers": {
            "Retry-After": {"schema": {"type": "integer"}, "description": "After how many seconds to ask again."}
        },
    },
}
CHANGE_REFUSALS: Final[dict[int | str, dict[str, Any]]] = REFUSALS | {
    401: {"model": Refusal, "description": "The token is missing."},
    403: {"model": Refusal, "description": "The token is another one."},
}
