"""``epypes deploy``, ``epypes rollback``: another bundle for a running service."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from epypes.cli.source import TokenFile, connected
from epypes.cli.terminal import err, out
from epypes.errors import ServiceError

_Http = Annotated[str, typer.Option(help="Where the service is controlled, as http://127.0.0.1:8642.")]
_Service = Annotated[str, typer.Option(help="Or the bundle that it was started with.")]
_DIGITS = 12


def deploy(
    bundle: Annotated[Path, typer.Argument(help="The folder of the bundle, on the service's machine.")],
    http: _Http = "",
    service: _Service = "",
    token_file: TokenFile = None,
) -> None:
    """Have a running service replay another bundle and serve it; if it computes something else, the old one goes on."""
    with connected(_one(http, service), token_file) as connection:
        before = connection.info()
        err.print(f"{bundle} is replayed beside {before['bundle']}, which goes on meanwhile.")
        out.print(_told("DEPLOYED", before, connection.deploy(bundle)))


def rollback(http: _Http = "", service: _Service = "", token_file: TokenFile = None) -> None:
    """Have a running service serve the bundle again that it served before; twice is there and back."""
    with connected(_one(http, service), token_file) as connection:
        out.print(_told("ROLLED BACK", connection.info(), connection.rollback()))


def _one(http: str, service: str) -> str:
    """Return the source that was named."""
    if bool(http) == bool(service):
        raise ServiceError("", "Which service? Say --http URL, or --service and the bundle that it was started with.")
    # What is no URL is refused as an address, not looked for as a folder.
    if http and not http.startswith(("http://", "https://")):
        raise ServiceError(http, f"{http!r:.200} is no address of a service. Write it as http://127.0.0.1:8642.")
    return http or service


def _told(what: str, before: dict[str, Any], now: dict[str, Any]) -> str:
    """Return in one line what happened."""
    served, left = (f"{info['bundle']} ({info['digest'][:_DIGITS]})" for info in (now, before))
    changed = "".join(f" {line}." for line in now.get("changed", ()))
    return f"{what} {served} in place of {left}: {now['state']}.{changed}"
